"""Trajectories: their shapes are checked, and they survive JSON bit for bit."""

import json

import numpy as np
import pytest

from sb3_poem.common.trajectory import Trajectory, decode_array, encode_array


def make(steps=3, features=True):
    rng = np.random.default_rng(steps)
    return Trajectory(
        observations=rng.normal(size=(steps + 1, 2)),
        actions=rng.normal(size=(steps, 1)).astype(np.float32),
        latent=rng.normal(size=4),
        reward_features=rng.normal(size=(steps, 1)) if features else None,
        frames=[np.zeros((2, 2, 3), np.uint8)],
    )


@pytest.mark.parametrize("features", [True, False])
def test_json_keeps_every_bit_but_the_frames(features):
    trajectory = make(features=features)
    copy = Trajectory.from_dict(json.loads(json.dumps(trajectory.to_dict())))
    for name in ("observations", "actions", "latent"):
        np.testing.assert_array_equal(getattr(copy, name), getattr(trajectory, name))
        assert getattr(copy, name).dtype == getattr(trajectory, name).dtype
    assert (copy.reward_features is None) == (not features)
    assert copy.frames is None
    assert len(copy) == 3


@pytest.mark.parametrize(
    "array", [np.array(np.nan), np.zeros((0, 3)), np.arange(6, dtype=np.int8).reshape(2, 3)[:, ::2]]
)
def test_arrays_survive(array):
    copy = decode_array(json.loads(json.dumps(encode_array(array))))
    np.testing.assert_array_equal(copy, array)
    assert copy.dtype == array.dtype


@pytest.mark.parametrize("data", [{}, {"npy": "?"}, {"npy": "AAAA"}, None])
def test_broken_arrays_are_refused(data):
    with pytest.raises(ValueError, match="not an encoded array"):
        decode_array(data)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": np.zeros((3, 2))}, "`observations` must hold 4 rows"),
        ({"actions": np.zeros((0, 1))}, "at least one step"),
        ({"latent": np.zeros((1, 4))}, "`latent` must have shape"),
        ({"reward_features": np.zeros((2, 1))}, "`reward_features` must hold 3 rows"),
    ],
)
def test_shapes_are_checked(changes, message):
    arguments = {
        "observations": np.zeros((4, 2)),
        "actions": np.zeros((3, 1)),
        "latent": np.zeros(4),
        **changes,
    }
    with pytest.raises(ValueError, match=message):
        Trajectory(**arguments)


def test_incomplete_data_is_refused():
    with pytest.raises(ValueError, match="stored trajectory"):
        Trajectory.from_dict({"observations": encode_array(np.zeros((2, 1)))})
