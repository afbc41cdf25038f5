"""What an oracle is shown: one episode, without its rewards."""

from __future__ import annotations

import base64
import io
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np


def encode_array(array: np.ndarray) -> dict[str, Any]:
    """Write an array as JSON-ready data, bit for bit.

    Decimal text would be larger and slower, and people do not read trajectories; so the array's own
    ``.npy`` bytes are compressed and written in base 64. The shape stands beside them for the
    reader's benefit.

    :param array: Any numeric or boolean array.
    :return: A dictionary that :func:`decode_array` reads.
    """
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return {
        "shape": list(array.shape),
        "npy": base64.b64encode(zlib.compress(buffer.getvalue(), 1)).decode("ascii"),
    }


def decode_array(data: dict[str, Any]) -> np.ndarray:
    """Read what :func:`encode_array` wrote.

    :param data: The dictionary.
    :return: The array, with its dtype and shape.
    :raises ValueError: If the data is not such a dictionary.
    """
    try:
        return np.load(
            io.BytesIO(zlib.decompress(base64.b64decode(data["npy"], validate=True))),
            allow_pickle=False,
        )
    except (KeyError, TypeError, ValueError, EOFError, zlib.error) as error:
        raise ValueError(f"not an encoded array: {error}") from error


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of a latent-conditioned policy. It holds no rewards on purpose: adaptation must
    not see them.

    :param observations: (T + 1, obs_dim); the last is the observation after the last action.
    :param actions: (T, act_dim).
    :param latent: (d,) the latent whose policy acted.
    :param reward_features: (T, feat_dim), from which an oracle that knows the task computes
        rewards; None where the environment gives none.
    :param frames: RGB images (height, width, 3) uint8, one a step, and one more where the episode
        was cut, when rendering was asked for; else None.
    :raises ValueError: If the shapes do not fit together, or T = 0.
    """

    observations: np.ndarray
    actions: np.ndarray
    latent: np.ndarray
    reward_features: np.ndarray | None = None
    frames: list[np.ndarray] | None = None

    def __post_init__(self) -> None:
        steps = len(self.actions)
        if steps < 1:
            raise ValueError("a trajectory needs at least one step, but `actions` is empty")
        if len(self.observations) != steps + 1:
            raise ValueError(
                f"`observations` must hold one more row than `actions` ({steps + 1}), but holds {len(self.observations)}"
            )
        if self.latent.ndim != 1:
            raise ValueError(
                f"`latent` must have shape (latent_dim,), but has shape {self.latent.shape}"
            )
        if self.reward_features is not None and len(self.reward_features) != steps:
            raise ValueError(
                f"`reward_features` must hold one row a step ({steps}), but holds {len(self.reward_features)}"
            )

    def __repr__(self) -> str:
        frames = "" if self.frames is None else f", {len(self.frames)} frames"
        widths = f"{self.observations.shape[-1]} observations and {self.actions.shape[-1]} actions"
        return f"Trajectory({len(self)} steps of {widths}{frames})"

    def __len__(self) -> int:
        """The number of steps T."""
        return len(self.actions)

    def to_dict(self) -> dict[str, Any]:
        """Write the trajectory as JSON-ready data. Frames stay out: they are large, and the
        rollout's seed gives them again.

        :return: A dictionary that :meth:`from_dict` reads.
        """
        return {
            "observations": encode_array(self.observations),
            "actions": encode_array(self.actions),
            "latent": encode_array(self.latent),
            "reward_features": None
            if self.reward_features is None
            else encode_array(self.reward_features),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Trajectory:
        """Read what :meth:`to_dict` wrote.

        :param data: The dictionary.
        :return: The trajectory, without frames.
        :raises ValueError: If the data is incomplete or broken.
        """
        try:
            features = data["reward_features"]
            return cls(
                observations=decode_array(data["observations"]),
                actions=decode_array(data["actions"]),
                latent=decode_array(data["latent"]),
                reward_features=None if features is None else decode_array(features),
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a stored trajectory: {error!r} is missing") from error
