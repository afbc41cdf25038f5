"""Questions and answers."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from sb3_poem.common.checks import check_choice
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.video import in_rows, write_video


class Preference(Enum):
    """The answer to "which of the trajectories is better?".

    >>> Preference("left")
    <Preference.LEFT: 'left'>
    """

    MUCH_LEFT = "much left"
    LEFT = "left"
    EQUAL = "equal"
    RIGHT = "right"
    MUCH_RIGHT = "much right"
    FIRST = "first"
    SECOND = "second"
    THIRD = "third"
    FOURTH = "fourth"


_GRADES = tuple(Preference)[:5]
#: What an answer to a pair, or a graded one, says to a rule that knows no degrees.
SIGNS = dict(zip(_GRADES, (1.0, 1.0, 0.0, -1.0, -1.0), strict=True))
BEST_OF_FOUR = "best-of-four"
#: The answers that each kind of question has, the last one (right, or can't tell) first.
ANSWERS = {
    "pair": (Preference.RIGHT, Preference.EQUAL, Preference.LEFT),
    "graded": tuple(reversed(_GRADES)),
    BEST_OF_FOUR: (Preference.EQUAL, *tuple(Preference)[:4:-1]),
}
#: How each kind of question calls what it shows, in order.
PLACES = {
    **dict.fromkeys(("pair", "graded"), ("left", "right")),
    BEST_OF_FOUR: ("first", "second", "third", "fourth"),
}


@dataclass(frozen=True, eq=False)
class Query:
    """A question: which of two trajectories on the new task is better, or of four the best?

    >>> from sb3_poem import PreferenceAdapter
    >>> query = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", seed=0).ask()
    >>> query.left.observations.shape, query.right.actions.shape
    ((26, 2), (25, 2))

    :param shown: Two, left and right, or four.
    :param kind: "pair" (left, right or equal), "graded" (much better, too) or "best-of-four"
        (first, second, third, fourth or equal).
    """

    shown: tuple[Trajectory, ...]
    kind: str = "pair"

    def __post_init__(self) -> None:
        check_choice("kind", self.kind, tuple(ANSWERS))
        check_shown(self.kind, self.shown)

    @property
    def left(self) -> Trajectory:
        """What a pair shows left."""
        return self.shown[0]

    @property
    def right(self) -> Trajectory:
        """What a pair shows right."""
        return self.shown[1]

    def to_video(self, path: str | Path, fps: float = 20.0) -> Path:
        """Write both side by side, or four in two rows, as MP4 or GIF by the file's suffix, and
        return its path. A ``ValueError`` if they have no frames, or the suffix is another.
        """
        if not all(each.frames for each in self.shown):
            raise ValueError(
                "the question has no frames to show: ask for them by PreferenceAdapter(..., "
                'render=True), with an environment\'s id, or one made with render_mode="rgb_array"'
            )
        clips = [each.frames or () for each in self.shown]
        captions = ("LEFT", "RIGHT") if len(clips) == 2 else tuple("1234")
        return write_video(in_rows(clips, captions), path, fps)


def check_shown(kind: str, shown: Sequence[Trajectory]) -> None:
    """Refuse another number of trajectories than this kind of question shows."""
    if len(shown) != len(PLACES[kind]):
        raise ValueError(
            f"a {kind} question is about {len(PLACES[kind])} trajectories, but {len(shown)} were "
            "given; oracle(*query.shown) answers any"
        )


def as_preference(answer: object, kind: str = "pair") -> Preference:
    """Read the answer to a question of this kind: a :class:`Preference` that it has, or its word;
    else a ``ValueError`` or ``TypeError``. Numbers, whose meaning differs between programs, are
    refused.
    """
    if isinstance(answer, str):
        answer = next((each for each in Preference if each.value == answer), answer)
    if isinstance(answer, Preference) and answer in ANSWERS[kind]:
        return answer
    given = repr(answer)
    if isinstance(answer, Preference):
        others = [each for each in ANSWERS if answer in ANSWERS[each]]
        given = f"{answer.value!r}, which only {' and '.join(others)} questions have"
    words = ", ".join(f'"{each.value}"' for each in reversed(ANSWERS[kind]))
    must = f"an answer to a {kind} question must be a Preference or its word, one of {words}"
    if not isinstance(answer, str | Preference):
        nothing = "; did the oracle return nothing?" if answer is None else ""
        raise TypeError(f"{must}, but is {given} of type {type(answer).__name__}{nothing}")
    raise ValueError(f"{must}, but is {given}")


def preference_log_likelihood(
    log_left: np.ndarray, log_right: np.ndarray, answers: list[Preference]
) -> np.ndarray:
    """(m,) log-likelihood of k answers from the log-probabilities (m, k) of LEFT and RIGHT. EQUAL
    has the geometric mean of both, which is largest where neither is more probable.
    """
    left_share = 0.5 + 0.5 * np.array([SIGNS[answer] for answer in answers])
    return log_left @ left_share + log_right @ (1.0 - left_share)
