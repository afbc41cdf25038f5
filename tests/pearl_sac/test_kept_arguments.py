"""What shaped a training is kept with the model, in both of its forms."""

from __future__ import annotations

from pathlib import Path

import pytest
from meta_toys import small

from sb3_poem import PEARLSAC, POEMSAC

ANT_GOAL = "poem/AntGoal-v0"  # has all that the arguments need


@pytest.mark.parametrize("algorithm", [PEARLSAC, POEMSAC])
def test_arguments_come_back(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    arguments = {
        "n_steps": 2,
        "policy_delay": 2,
        "shaping_coef": 0.5,
    }
    model = small(algorithm, ANT_GOAL, n_train_tasks=4, meta_batch_size=4, **arguments).learn(800)
    model.save_pretrained(tmp_path)
    model.save(tmp_path / "model.zip")
    for loaded in (
        algorithm.from_pretrained(tmp_path, ANT_GOAL),
        algorithm.load(tmp_path / "model.zip", env=ANT_GOAL),
    ):
        kept = {name: getattr(loaded, name) for name in arguments}
        assert kept == arguments
