"""Coloured noise in training rollouts has the spectrum that was asked for, and reaches the robot."""

from itertools import islice

import numpy as np
import pytest
from meta_toys import small, walks
from stable_baselines3.common.callbacks import CallbackList

from sb3_poem import PEARLSAC
from sb3_poem.common.buffers import Segment


def noises(color: float, steps: int = 400) -> np.ndarray:
    """(steps, copies, action_dim) of one collection."""
    model = small(PEARLSAC, walks(6), horizon=steps, n_train_tasks=6, noise_color=color)
    noises = model.make_collector(CallbackList([])).action_noises((500, 2))
    return np.stack([noise.numpy() for noise in islice(noises, steps)])


@pytest.mark.parametrize("color", [0.0, 1.0, 2.0])
def test_the_power_falls_with_frequency_as_asked(color: float) -> None:
    sequences = noises(color)
    assert sequences.mean() == pytest.approx(0.0, abs=0.1)
    assert sequences.std() == pytest.approx(
        1.0, abs=0.2
    )  # red noise varies more: its mean does, too
    power = np.square(np.abs(np.fft.rfft(sequences, axis=0))).mean(axis=(1, 2))[1:]
    slope = np.polyfit(np.log(np.arange(1, len(power) + 1)), np.log(power), 1)[0]
    assert slope == pytest.approx(-color, abs=0.1)


def test_actions_keep_their_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    def persistence(color: float) -> float:
        model = small(PEARLSAC, walks(6), horizon=50, n_train_tasks=6, noise_color=color, seed=0)
        segments: list[Segment] = []
        monkeypatch.setattr(model.replay_buffer, "extend", segments.append)
        monkeypatch.setattr(model, "train", lambda **_: None)
        model.learn(6 * 50)
        actions = segments[0].actions[..., 0]
        return float(np.corrcoef(actions[:, 1:].ravel(), actions[:, :-1].ravel())[0, 1])

    assert abs(persistence(0.0)) < 0.2
    assert persistence(1.0) > 0.4
