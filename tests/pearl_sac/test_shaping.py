"""Shaped rewards differ from the plain ones by what the potentials say, and by nothing else."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from meta_toys import Shaped, Walk, small, walks

from poem_envs import TaskFamilyVector
from sb3_poem import PEARLSAC
from sb3_poem.common.vec_env import make_task_vec_env

GAMMA = 0.9


def targets(shaping_coef: float, n_steps: int) -> tuple[PEARLSAC, Any]:
    """A model whose episodes may end early, and a meta-batch of what its critics learn."""
    model = small(
        PEARLSAC,
        walks(6, Shaped, edge=0.6),
        horizon=10,
        n_train_tasks=6,
        gamma=GAMMA,
        n_steps=n_steps,
        gradient_steps=0,
        relabel_fraction=0.5,
        shaping_coef=shaping_coef,
    ).learn(5 * 60)
    return model, model.make_sampler().sample(1, 60)[0]


@pytest.mark.parametrize("n_steps", [1, 3])
def test_targets_are_the_plain_ones_and_the_difference_of_potentials(n_steps: int) -> None:
    model, batch = targets(0.5, n_steps)
    plain_model, plain = targets(0.0, n_steps)
    np.testing.assert_array_equal(model.train_tasks.tasks, plain_model.train_tasks.tasks)
    for name in ("observations", "actions", "rewards"):  # the decoder learns rewards as they are
        th.testing.assert_close(
            getattr(batch.transitions, name), getattr(plain.transitions, name), rtol=0, atol=0
        )
    if n_steps == 1:
        rewards, after = plain.transitions.rewards, plain.transitions.next_observations
        discounts = GAMMA * (1.0 - plain.transitions.terminated)
    else:
        rewards, after, discounts = plain.bootstraps
    assert (discounts == 0).any()  # an early end was seen
    task = model.train_tasks.tasks[batch.task_ids.numpy()][:, None, 0]

    def worth(observations: th.Tensor) -> np.ndarray:
        return 0.5 / (1.0 - GAMMA) * (3.0 * np.sin(observations[..., 0].numpy()) * task + 1.0)

    expected = (
        rewards.numpy() + discounts.numpy() * worth(after) - worth(plain.transitions.observations)
    )
    np.testing.assert_allclose(batch.bootstraps.rewards, expected, rtol=1e-4, atol=1e-4)
    th.testing.assert_close(batch.bootstraps.observations, after)
    th.testing.assert_close(batch.bootstraps.discounts, discounts)


def test_the_vectorised_and_the_process_family_have_the_potential_of_the_single_one() -> None:
    tasks, observations = np.array([[1.0, -2.0], [0.5, 0.0]]), np.zeros((2, 29))
    observations[:, :2] = [[0.0, 0.0], [1.0, -1.0]]
    single = gym.make("poem/AntGoal-v0").unwrapped
    np.testing.assert_allclose(single.compute_potential(tasks, observations), [-3.0, -1.5])
    standing = np.column_stack([observations[:, :2], np.zeros(2)])
    np.testing.assert_allclose(single.compute_rewards(tasks, standing), [-3.0, -1.5])
    vec_env = make_task_vec_env("poem/AntGoal-v0", 2)
    assert vec_env.get_attr("has_potential") == [True, True]
    np.testing.assert_allclose(
        vec_env.env_method("compute_potential", tasks, observations, indices=[0])[0], [-3.0, -1.5]
    )
    processes = TaskFamilyVector(Shaped, num_envs=2, nthread=1)
    assert processes.has_potential
    np.testing.assert_allclose(
        processes.compute_potential([[2.0]], [[0.5]]), [6.0 * np.sin(0.5) + 1.0]
    )
    assert not TaskFamilyVector(Walk, num_envs=2, nthread=1).has_potential


def test_it_needs_a_potential_and_a_discount() -> None:
    with pytest.raises(
        ValueError,
        match=r"shaping_coef must be 0: .*has no potential; a family defines one by _potential",
    ):
        small(PEARLSAC, walks(6), horizon=10, n_train_tasks=6, shaping_coef=1.0)
    with pytest.raises(ValueError, match="shaping_coef must be 0 with gamma=1"):
        small(PEARLSAC, walks(6, Shaped), horizon=10, n_train_tasks=6, shaping_coef=1.0, gamma=1.0)
