"""What an oracle is shown: one episode, without its rewards."""

import base64
import io
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

STORED = ("observations", "actions", "latent", "reward_features")


def encode_array(array: np.ndarray) -> dict[str, Any]:
    """An array as JSON-ready data, bit for bit: compressed ``.npy`` bytes in base 64."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return {
        "shape": list(array.shape),
        "npy": base64.b64encode(zlib.compress(buffer.getvalue(), 1)).decode("ascii"),
    }


def decode_array(data: dict[str, Any]) -> np.ndarray:
    """Read what :func:`encode_array` wrote; ValueError if it is none such."""
    try:
        content = zlib.decompress(base64.b64decode(data["npy"], validate=True))
        return np.load(io.BytesIO(content), allow_pickle=False)
    except (KeyError, TypeError, ValueError, EOFError, zlib.error) as error:
        raise ValueError(f"not an encoded array: {error}") from error


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of a latent-conditioned policy, without rewards: adaptation must not see them.

    >>> from sb3_poem import PreferenceAdapter
    >>> query = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", seed=0).ask()
    >>> query.left.observations.shape, query.left.actions.shape, query.left.latent.shape
    ((26, 2), (25, 2), (5,))

    :param observations: (T + 1, obs_dim); the last is the observation after the last action.
    :param actions: (T, act_dim).
    :param latent: (d,) the latent whose policy acted.
    :param reward_features: (T, feat_dim), from which an oracle that knows the task computes
        rewards; None where the environment gives none.
    :param frames: RGB images (height, width, 3) uint8, one a step, and one more where the episode
        was cut, when rendering was asked for; else None.
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
        if self.latent.ndim != 1:
            raise ValueError(f"`latent` must have shape (latent_dim,), but has {self.latent.shape}")
        parts = [("observations", self.observations, steps + 1)]
        if self.reward_features is not None:
            parts.append(("reward_features", self.reward_features, steps))
        for name, array, rows in parts:
            if len(array) != rows:
                raise ValueError(
                    f"`{name}` must hold {rows} rows for {steps} actions, but holds {len(array)}"
                )

    def __repr__(self) -> str:
        frames = "" if self.frames is None else f", {len(self.frames)} frames"
        widths = f"{self.observations.shape[-1]} observations and {self.actions.shape[-1]} actions"
        return f"Trajectory({len(self)} steps of {widths}{frames})"

    def __len__(self) -> int:
        """The number of steps T."""
        return len(self.actions)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready data for :meth:`from_dict`, without frames, which the rollout's seed gives."""
        arrays = {name: getattr(self, name) for name in STORED}
        return {name: None if a is None else encode_array(a) for name, a in arrays.items()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Trajectory":
        """Read what :meth:`to_dict` wrote; ValueError if it is incomplete or broken."""
        try:
            names = STORED if data["reward_features"] is not None else STORED[:-1]
            arrays: dict[str, Any] = {name: decode_array(data[name]) for name in names}
            return cls(**arrays)
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a stored trajectory: {error!r} is missing") from error
