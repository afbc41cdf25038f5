"""Contexts of other tasks' transitions, with the task's own rewards."""

import numpy as np
import pytest
import torch as th
from meta_toys import small, walks

from sb3_poem import PEARLSAC


def trained(fraction: float | None) -> PEARLSAC:
    return small(
        PEARLSAC, walks(6), horizon=10, n_train_tasks=6, context_relabel_fraction=fraction
    ).learn(2 * 60)


def sampled(model: PEARLSAC, n: int = 600) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Task numbers (n,), contexts (n, size, 6) and rewards (n, size)."""
    tasks = th.as_tensor(np.resize(np.arange(6), n))
    context, rewards = model.make_sampler().contexts(tasks)
    return tasks.numpy(), context.numpy(), rewards.numpy()


def own_transitions(model: PEARLSAC, tasks: np.ndarray, context: np.ndarray) -> np.ndarray:
    """(n, size), whether a transition, its reward aside, was collected by the task itself."""
    stored = model.epoch_context.transitions.numpy()[..., :-1]
    return np.array(
        [
            [(stored[i] == row[:-1]).all(axis=1).any() for row in rows]
            for i, rows in zip(tasks, context, strict=True)
        ]
    )


@pytest.mark.parametrize("fraction", [0.0, 0.5, 1.0])
def test_rewards_are_the_tasks_own_whoever_acted(fraction: float) -> None:
    model = trained(fraction)
    tasks, context, rewards = sampled(model)
    policy = model.policy
    obs, next_obs = (
        context[..., i : i + 2] * policy.obs_norm.std.numpy() + policy.obs_norm.mean.numpy()
        for i in (0, 3)
    )
    actions = 3.0 * context[..., 2] + 1.0  # from [-1, 1] to [-2, 4]
    goals = model.train_tasks.tasks[tasks]
    np.testing.assert_allclose(
        rewards, -np.abs(next_obs[..., 0] - goals) - 0.01 * actions**2, atol=1e-4
    )
    centre, deviation = model.context_reward_statistics
    np.testing.assert_allclose(context[..., -1], (rewards - centre) / deviation, atol=1e-4)
    # It is one step of the walk: the place moves by a tenth of the action.
    np.testing.assert_allclose(next_obs[..., 0] - obs[..., 0], 0.1 * actions, atol=1e-4)


def test_the_share_of_contexts_that_are_others() -> None:
    model = trained(0.0)
    assert own_transitions(model, *sampled(model)[:2]).all()
    assert model.epoch_context.features is None
    model = trained(None)  # half of them by default
    tasks, context, _ = sampled(model)
    own = own_transitions(model, tasks, context).all(axis=1)
    # Half of them, and of the others those whose two sources happen to be the task itself, 1 in 36.
    assert own.mean() == pytest.approx(0.5 + 0.5 / 36, abs=0.07)
    whole = trained(1.0)
    tasks, context, _ = sampled(whole)
    shares = own_transitions(whole, tasks, context).mean(axis=1)
    # Of two sources neither is the task itself in 25 of 36 cases.
    assert (shares == 0).mean() == pytest.approx(25 / 36, abs=0.07)
