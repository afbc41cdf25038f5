"""What shaped a training is kept with the model, in both of its forms."""

from __future__ import annotations

from pathlib import Path

import pytest
from meta_toys import POINT_GOAL, small

from sb3_poem import PEARLSAC, POEMSAC


@pytest.mark.parametrize("algorithm", [PEARLSAC, POEMSAC])
def test_arguments_come_back(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    arguments = {"n_steps": 2, "noise_color": 1.0, "policy_delay": 2, "shaping_coef": 0.5}
    model = small(algorithm, **arguments).learn(300)
    model.save_pretrained(tmp_path)
    model.save(tmp_path / "model.zip")
    for loaded in (
        algorithm.from_pretrained(tmp_path, POINT_GOAL),
        algorithm.load(tmp_path / "model.zip", env=POINT_GOAL),
    ):
        kept = {name: getattr(loaded, loaded.saved_arguments[name]) for name in arguments}
        assert kept == arguments
