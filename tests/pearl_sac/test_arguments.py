"""Seeds and arguments do what they do in SB3's SAC."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest
import torch as th
from meta_toys import (
    ARCH,
    EPOCH,
    N_TASKS,
    POINT_GOAL,
    assert_same_model,
    differing,
    experience_of,
    parameters,
    small,
    walks,
)
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.sac.policies import SACPolicy

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.common.precision import hidden_dtype
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.policies import LatentPolicy
from sb3_poem.poem_sac.policies import POEMPolicy


def test_a_seed_determines_everything(algorithm: type[PEARLSAC]) -> None:
    first = small(algorithm).learn(2 * EPOCH)
    th.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002 (to show that it does not matter)
    second = small(algorithm).learn(2 * EPOCH)
    assert_same_model(first, second)
    assert th.equal(first.epoch_context.transitions, second.epoch_context.transitions)
    third = small(algorithm, seed=1).learn(2 * EPOCH)
    assert not np.array_equal(first.train_tasks.tasks, third.train_tasks.tasks)
    different = differing(parameters(first), parameters(third))
    assert sum(name.startswith("policy.") for name in different) > 20


def test_training_leaves_the_global_generators_alone(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm)
    np.random.seed(3)  # noqa: NPY002
    before_torch, before_numpy = th.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    model.learn(EPOCH)
    assert th.equal(th.get_rng_state(), before_torch)
    assert np.array_equal(np.random.get_state()[1], before_numpy)  # noqa: NPY002


def test_the_kind_of_environment_does_not_matter() -> None:
    ours = small(POEMSAC, make_task_vec_env(POINT_GOAL, 5)).learn(EPOCH)
    theirs = small(POEMSAC, make_vec_env(POINT_GOAL, 5)).learn(EPOCH)
    assert_same_model(ours, theirs)


def test_tasks_come_from_the_family_and_the_seed() -> None:
    tasks = small(POEMSAC, n_train_tasks=200).train_tasks.tasks
    assert tasks.shape == (200, 1)
    assert np.unique(tasks).size == 200
    # uniform on [0, pi]: Kolmogorov-Smirnov at 1 %
    deviation = np.abs(np.sort(tasks[:, 0]) / np.pi - (np.arange(200) + 0.5) / 200).max()
    assert deviation < 1.63 / np.sqrt(200)
    assert small(POEMSAC, walks(1), horizon=10, n_train_tasks=None).train_tasks.tasks.shape == (
        120,
        1,
    )


def test_help_explains_every_argument(algorithm: type[PEARLSAC]) -> None:
    for name in inspect.signature(algorithm).parameters.keys() - {
        "_init_setup_model",
        "unsupported",
    }:
        assert (algorithm.__doc__ or "").count(f":param {name}:") == 1, name


def test_the_signature_of_poem_has_the_arguments_of_pearl() -> None:
    of_pearl, of_poem = (inspect.signature(kind).parameters for kind in (PEARLSAC, POEMSAC))
    assert of_pearl.keys() - of_poem.keys() == {"context_relabel_fraction"}
    own = {"similarity", "similarity_temperature", "context"} | {
        name for name in of_poem if name.startswith("preference_")
    }
    assert of_poem.keys() - of_pearl.keys() == own
    defaults = {
        name: (of_pearl[name].default, of_poem[name].default) for name in of_poem.keys() - own
    }
    changed = {name: new for name, (old, new) in defaults.items() if new != old}
    assert changed == {"kl_coef": 0.02, "reward_coef": 0.2, "policy_coef": 0.5}
    by_place = [name for name, one in of_poem.items() if one.kind is one.POSITIONAL_OR_KEYWORD]
    assert by_place == list(of_pearl)[: len(by_place)]
    model = POEMSAC("MlpPolicy", POINT_GOAL, 1e-3, 500, 7, device="cpu", _init_setup_model=False)
    assert (model.learning_rate, model.buffer_size, model.learning_starts) == (1e-3, 500, 7)


def test_the_callers_policy_kwargs_stay_as_they_are() -> None:
    policy_kwargs = {"net_arch": {key: list(value) for key, value in ARCH.items()}, "n_critics": 3}
    model = small(POEMSAC, policy_kwargs=policy_kwargs)
    assert policy_kwargs == {"net_arch": ARCH, "n_critics": 3}
    assert len(model.policy.critic.members) == 3
    small(POEMSAC, policy_kwargs=policy_kwargs)


def test_net_arch_as_a_list_is_for_actor_and_critics() -> None:
    policy = small(
        POEMSAC, policy_kwargs={"net_arch": [24, 12], "activation_fn": th.nn.Tanh}
    ).policy
    assert policy.net_arch["pi"] == policy.net_arch["qf"] == [24, 12]
    assert policy.actor.mlp.output.in_features == 12
    assert policy.encoder.mlp.output.in_features == 128
    assert isinstance(policy.actor.mlp.activation, th.nn.Tanh)
    with pytest.raises(
        ValueError, match=r"net_arch has unknown keys \['vf'\]; known are .*'decoder'.*"
    ):
        small(POEMSAC, policy_kwargs={"net_arch": {"vf": [1]}})


def test_the_policy_can_be_a_class(algorithm: type[PEARLSAC]) -> None:
    policy_class = {PEARLSAC: LatentPolicy, POEMSAC: POEMPolicy}[algorithm]
    arguments = {"n_train_tasks": 2, "device": "cpu", "policy_kwargs": {"net_arch": ARCH}}
    assert isinstance(algorithm(policy_class, POINT_GOAL, **arguments).policy, policy_class)
    for other in ("CnnPolicy", "MultiInputPolicy", SACPolicy):
        message = rf'policy is .*, but must be "MlpPolicy" or a subclass of {policy_class.__name__}.*GoalFamily'
        with pytest.raises(ValueError, match=message):
            algorithm(other, POINT_GOAL, **arguments)


def test_another_optimizer() -> None:
    kwargs = {
        "net_arch": ARCH,
        "optimizer_class": th.optim.SGD,
        "optimizer_kwargs": {"momentum": 0.9},
    }
    model = small(POEMSAC, policy_kwargs=kwargs).learn(EPOCH)
    assert isinstance(model.policy.optimizer, th.optim.SGD)
    assert model.policy.optimizer.param_groups[0]["momentum"] == 0.9


@pytest.mark.parametrize(
    ("given", "fused"),
    [
        (None, True),
        ({"betas": (0.9, 0.99), "eps": 1e-7}, True),
        ({"fused": False}, False),
        ({"foreach": True}, None),
    ],
)
def test_adam_is_fused_unless_told(given: Any, fused: Any) -> None:
    """Which is what leaves out a bad step on a GPU, without waiting for it."""
    kwargs = {"net_arch": ARCH, "optimizer_kwargs": given}
    [group] = small(POEMSAC, policy_kwargs=kwargs).policy.optimizer.param_groups
    assert group["fused"] is fused
    assert {name: group[name] for name in given or {}} == (given or {})


class Record(BaseCallback):
    """Notes a value at the start of every epoch and at the end."""

    def __init__(self, read: Any) -> None:
        super().__init__()
        self.read, self.values = read, []

    def _on_rollout_start(self) -> None:
        self.values.append(self.read(self.model))

    def _on_training_end(self) -> None:
        self.values.append(self.read(self.model))

    def _on_step(self) -> bool:
        return True


def learning_rates(model: PEARLSAC) -> tuple[float, ...]:
    optimizers = [model.policy.optimizer, model.ent_coef_optimizer]
    return tuple(optimizer.param_groups[0]["lr"] for optimizer in optimizers)


def test_learning_rate_schedules_reach_the_optimisers() -> None:
    """Whole epochs overshoot the total, and a learning rate below 0 would climb the loss."""
    record, total = Record(learning_rates), 4 * EPOCH - 30
    small(POEMSAC, learning_rate=lambda remaining: 1e-3 * remaining).learn(total, record)
    # epochs train after their collection: the last with nothing of the run remaining
    done = np.minimum(EPOCH * np.arange(5), total)
    expected = 1e-3 * (1.0 - done / total)
    np.testing.assert_allclose(record.values, np.stack([expected, expected], axis=1), atol=1e-12)


def test_entropy_coefficient() -> None:
    fixed = small(POEMSAC, ent_coef=0.3).learn(EPOCH)
    assert fixed.ent_coef_optimizer is None
    assert fixed.entropy_coefficient.value.item() == pytest.approx(0.3)
    learned = small(POEMSAC, ent_coef="auto_0.1", learning_rate=3e-4)
    assert learned.entropy_coefficient.value.item() == pytest.approx(0.1)
    learned.learn(2 * EPOCH)
    assert learned.entropy_coefficient.value.item() != pytest.approx(0.1, abs=1e-5)
    # ten Adam steps of 3e-4 on the logarithm
    assert abs(np.log(learned.entropy_coefficient.value.item() / 0.1)) <= 10 * 3e-4 * 1.01
    with pytest.raises(ValueError, match=r'`ent_coef` must be a number or "auto", but is .little'):
        small(POEMSAC, ent_coef="little")


def test_target_entropy() -> None:
    assert small(POEMSAC).target_entropy == -2.0
    assert small(POEMSAC, target_entropy=-0.5).target_entropy == -0.5
    # far below the policy's entropy alpha falls, far above it rises
    falling = (
        small(POEMSAC, target_entropy=-50.0, ent_coef="auto")
        .learn(EPOCH)
        .entropy_coefficient.value.item()
    )
    rising = (
        small(POEMSAC, target_entropy=50.0, ent_coef="auto")
        .learn(EPOCH)
        .entropy_coefficient.value.item()
    )
    assert falling < 1.0 < rising


def target_networks(model: PEARLSAC) -> th.Tensor:
    return th.cat([parameter.flatten() for parameter in model.policy.critic_target.parameters()])


def critic_networks(model: PEARLSAC) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.critic.parameters()])


def test_target_critics_follow_slowly() -> None:
    model = small(POEMSAC, gradient_steps=1, tau=0.25)
    before = target_networks(model).clone()
    assert th.equal(before, critic_networks(model))
    model.learn(1)
    th.testing.assert_close(target_networks(model), 0.75 * before + 0.25 * critic_networks(model))


def test_target_update_interval() -> None:
    """Updates at gradient steps 0, 3, 6, ... with tau = 1 copy the critics."""
    model, copied = (
        small(POEMSAC, gradient_steps=0, target_update_interval=3, tau=1.0).learn(1),
        [],
    )
    updater = model.make_updater()
    with updater.precision:
        for batch in model.make_sampler().sample(7, 16):
            updater.step(batch)
            copied.append(th.equal(target_networks(model), critic_networks(model)))
    assert copied == [True, False, False, True, False, False, True]


def test_gradient_steps_and_learning_starts() -> None:
    assert small(POEMSAC, gradient_steps=0).learn(EPOCH)._n_updates == 0
    assert small(POEMSAC, gradient_steps=-1, n_train_tasks=2).learn(1)._n_updates == 50
    model = small(POEMSAC, learning_starts=EPOCH).learn(
        2 * EPOCH
    )  # the first epoch acts at random and learns nothing
    assert model._n_updates == 5
    first_actions = th.cat(
        [experience_of(model.replay_buffer, task).actions[:, :25] for task in range(N_TASKS)]
    )
    assert first_actions.abs().max() < 1.0
    assert abs(first_actions.mean().item()) < 0.1
    assert first_actions.std().item() == pytest.approx(1 / np.sqrt(3), rel=0.1)


def test_horizons_per_task_and_epoch() -> None:
    model = small(POEMSAC, trajectories_per_task=3).learn(1)
    assert model.num_timesteps == 3 * EPOCH
    assert model.epoch_context.transitions.shape[:2] == (N_TASKS, 75)
    assert (model.replay_buffer.counts == 75).all()
    # contexts are the tasks' own
    raw = experience_of(model.replay_buffer, 4).rewards[0]
    assert sorted(model.epoch_context.rewards[4].tolist()) == pytest.approx(
        sorted(raw.tolist()), abs=1e-5
    )


def test_precision() -> None:
    models = {
        name: small(POEMSAC, precision=name).learn(EPOCH) for name in ("fp32", "bf16", "auto")
    }
    learned = {name: parameters(model) for name, model in models.items()}
    for name, model in models.items():
        assert all(value.isfinite().all() for value in learned[name].values())
        assert all(value.dtype == th.float32 for value in model.policy.parameters())
    assert differing(learned["fp32"], learned["bf16"])
    own = "bf16" if hidden_dtype("auto", "cpu") is th.bfloat16 else "fp32"
    assert not differing(learned["auto"], learned[own])
