"""Targets some steps ahead, against sums over the recorded episodes."""

import numpy as np
import pytest
from meta_toys import Walk, small, walks

from sb3_poem import PEARLSAC
from sb3_poem.common.buffers import Segment

GAMMA = 0.9


def collected(
    monkeypatch: pytest.MonkeyPatch, **arguments: float
) -> tuple[PEARLSAC, list[Segment]]:
    """A model whose episodes end early, are cut off, and have partly been overwritten; and all that
    it has seen.
    """
    model = small(
        PEARLSAC,
        walks(6, Walk, edge=0.6),
        horizon=10,
        n_train_tasks=6,
        buffer_size=35,
        gamma=GAMMA,
        **arguments,
    )
    segments: list[Segment] = []
    extend = model.replay_buffer.extend
    monkeypatch.setattr(
        model.replay_buffer, "extend", lambda segment: (segments.append(segment), extend(segment))
    )
    return model.learn(5 * 60), segments


def places(segments: list[Segment], obs: np.ndarray) -> list[tuple[Segment, int, int]]:
    """Where an observation was recorded: segment, copy and step."""
    return [
        (segment, copy, step)
        for segment in segments
        for copy, step in np.argwhere((segment.observations == obs).all(axis=-1))
    ]


def ahead(
    model: PEARLSAC,
    segments: list[Segment],
    task: int,
    obs: np.ndarray,
    n_steps: int,
) -> tuple[float, np.ndarray, float]:
    """Step by step: the discounted rewards of ``task``, the observation after them, and the
    discount of its value.
    """
    [(segment, copy, step)] = places(segments, obs)
    total, horizon = 0.0, segment.observations.shape[1]
    for k in range(n_steps):
        features = segment.features[copy, step].astype(np.float64)
        total += GAMMA**k * float(
            model.family.compute_rewards(model.train_tasks.tasks[task], features)
        )
        over, after = segment.terminated[copy, step] > 0, segment.next_observations[copy, step]
        cut = step + 1 == horizon or not (segment.observations[copy, step + 1] == after).all()
        if over or cut or k + 1 == n_steps:
            return total, after, 0.0 if over else GAMMA ** (k + 1)
        step += 1
    raise AssertionError


@pytest.mark.parametrize(("n_steps", "relabel_fraction"), [(1, 0.5), (4, 0.0), (4, 0.5)])
def test_rewards_values_and_discounts(
    monkeypatch: pytest.MonkeyPatch, n_steps: int, relabel_fraction: float
) -> None:
    model, segments = collected(monkeypatch, n_steps=n_steps, relabel_fraction=relabel_fraction)
    assert model.replay_buffer.full
    [batch] = model.make_sampler().sample(1, 60)
    rewards, observations, discounts = (part.numpy() for part in batch.bootstraps)
    lengths = set()
    for row, task in enumerate(batch.task_ids.tolist()):
        for column in range(60):
            obs = batch.transitions.observations[row, column].numpy()
            total, after, discount = ahead(model, segments, task, obs, n_steps)
            assert rewards[row, column] == pytest.approx(total, abs=1e-4)
            np.testing.assert_array_equal(observations[row, column], after)
            assert discounts[row, column] == pytest.approx(discount, abs=1e-6)
            lengths.add(round(discount, 6))
    assert {
        0.0,
        round(GAMMA, 6),
        round(GAMMA**n_steps, 6),
    } <= lengths  # all kinds of ends were seen


def test_the_critics_learn_from_what_lies_ahead() -> None:
    model = small(PEARLSAC, n_steps=3).learn(300)
    [batch] = model.make_sampler().sample(1, 16)
    _, metrics = model.make_objective().loss(batch, model.entropy_coefficient.value)
    richer = batch._replace(
        bootstraps=batch.bootstraps._replace(rewards=batch.bootstraps.rewards + 100.0)
    )
    _, other = model.make_objective().loss(richer, model.entropy_coefficient.value)
    scale = 1.0 / model.policy.reward_norm.std.item()
    # Half the squared error of two critics: raising targets by c adds about c^2 once c is large.
    assert other["critic_loss"].item() == pytest.approx((100.0 * scale) ** 2, rel=0.2)
    assert metrics["critic_loss"].item() < 0.1 * other["critic_loss"].item()
