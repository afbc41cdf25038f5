"""`policy_delay`: critics and encoder take more steps than everything else."""

from __future__ import annotations

import pytest
import torch as th
from meta_toys import EPOCH, small

from sb3_poem import PEARLSAC, POEMSAC


def changed_by_a_step(model: PEARLSAC) -> set[str]:
    """Names of the parts that the next update changes."""
    before = {name: value.clone() for name, value in model.policy.named_parameters()} | {
        "entropy": model.log_ent_coef.clone()
    }
    model.train(1, 16)
    after = dict(model.policy.named_parameters()) | {"entropy": model.log_ent_coef}
    return {
        name.split(".")[0] for name, value in after.items() if not th.equal(value, before[name])
    }


@pytest.mark.parametrize(
    ("algorithm", "precision"), [(PEARLSAC, "fp32"), (POEMSAC, "fp32"), (POEMSAC, "bf16")]
)
def test_all_learn_at_every_third_step_only(algorithm: type[PEARLSAC], precision: str) -> None:
    model = small(algorithm, policy_delay=3, gradient_steps=3, precision=precision).learn(EPOCH)
    always = {"critic", "critic_target", "encoder"}
    everything = {name.split(".")[0] for name, _ in model.policy.named_parameters()} | {"entropy"}
    assert everything > always
    assert [changed_by_a_step(model) for _ in range(6)] == [everything, always, always] * 2


def test_what_a_step_in_between_does_to_the_critics_is_what_a_whole_step_does() -> None:
    """The actor's loss and the others have no say in it."""
    models = [
        small(PEARLSAC, policy_delay=delay, gradient_steps=2, reward_coef=0.0, seed=1).learn(EPOCH)
        for delay in (1, 2)
    ]
    for model in models:  # the second update is whole in the first model only
        assert model._n_updates == 2
    # the first update is the same for both; the actor's change at the second reaches no critic
    # before the third
    first, second = (model.policy.critic.state_dict() for model in models)
    for name, value in first.items():
        th.testing.assert_close(second[name], value, msg=name)
