"""Questions and answers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from sb3_poem.common.trajectory import Trajectory


class Preference(Enum):
    """The answer to "which of the two trajectories is better?"."""

    LEFT = "left"
    RIGHT = "right"
    EQUAL = "equal"


@dataclass(frozen=True, eq=False)
class Query:
    """A question: which is better?

    :param left: A trajectory on the new task.
    :param right: Another one.
    """

    left: Trajectory
    right: Trajectory

    def to_video(self, path: str | Path, fps: float = 20.0) -> Path:
        """Write both side by side, as MP4 or GIF by the file's suffix.

        :param path: The file; missing folders are made.
        :param fps: Frames per second.
        :return: The path.
        :raises ValueError: If they have no frames, or the suffix is another.
        """
        from sb3_poem.common.video import side_by_side, write_video

        if not self.left.frames or not self.right.frames:
            raise ValueError(
                "the question has no frames to show: ask for them by PreferenceAdapter(..., render=True) "
                "or oracle=HumanOracle(), with an environment's id, or an environment made with "
                'render_mode="rgb_array"'
            )
        frames = side_by_side(self.left.frames, self.right.frames, ("LEFT", "RIGHT"))
        return write_video(frames, path, fps)


def as_preference(answer: Any) -> Preference:
    """Read an answer: a :class:`Preference`, or one of the words "left", "right" and "equal".

    Numbers and booleans are refused, because their meaning is a convention that differs between
    programs, and a preference read the wrong way round is worse than none.

    :param answer: What an oracle returned.
    :return: The preference.
    :raises ValueError: If it is another word.
    :raises TypeError: If it is anything else.
    """
    if isinstance(answer, Preference):
        return answer
    if isinstance(answer, str):
        try:
            return Preference(answer)
        except ValueError:
            raise ValueError(
                f'an answer must be "left", "right" or "equal", but is {answer!r}'
            ) from None
    raise TypeError(
        "an answer must be Preference.LEFT, Preference.RIGHT or Preference.EQUAL (or the word), "
        f"but is {answer!r} of type {type(answer).__name__}"
    )
