"""A person at a terminal answers."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sb3_poem.adaptation.noise import MistakeNoise
from sb3_poem.adaptation.people import INFER
from sb3_poem.adaptation.preference import ANSWERS, BEST_OF_FOUR, Preference, Query
from sb3_poem.adaptation.rule import check_choice
from sb3_poem.common.checks import check_number
from sb3_poem.common.trajectory import Trajectory

PROMPTS = {
    "pair": "Which is better? [l]eft, [r]ight, or [e]qual (can't tell): ",
    "graded": "Which is better? 1 left, much; 2 left, a bit; 3 can't tell; 4 right, a bit; "
    "5 right, much: ",
    BEST_OF_FOUR: "Which is best? 1, 2, 3 or 4, or 0 (can't tell): ",
}
SHORT = {
    **{"l": Preference.LEFT, "ll": Preference.MUCH_LEFT},
    **{"r": Preference.RIGHT, "rr": Preference.MUCH_RIGHT},
    **dict.fromkeys(("e", "=", "can't tell", "cant tell", "?"), Preference.EQUAL),
}
NUMBERED = {
    "pair": {"1": Preference.LEFT, "2": Preference.RIGHT},
    "graded": {str(n): each for n, each in enumerate(ANSWERS["graded"][::-1], 1)},
    BEST_OF_FOUR: dict(zip("04321", ANSWERS[BEST_OF_FOUR], strict=True)),
}
#: What each word that may be typed means, by kind of question
READ = {
    kind: {word: each for word, each in SHORT.items() if each in answers}
    | {each.value: each for each in answers}
    | NUMBERED[kind]
    for kind, answers in ANSWERS.items()
}


@dataclass(frozen=True, eq=False)
class HumanAnswer:
    """An answer with its video, and when (seconds since 1970) it was asked for and shown."""

    preference: Preference
    query: Query
    video: Path
    fps: float
    asked: float
    shown: float


class HumanOracle:
    """Shows a question's trajectories beside each other in a video file, and asks at the terminal.

    The n-th question's file is ``query-001.gif`` and so on (or ``.mp4``) within the folder. The
    prompt takes l or left, r or right, and e, equal, = or ?, in upper or lower case; or a number,
    1 (left) and 2 (right) of a pair, 1 (left is much better) to 5 (right is much better) of a
    graded question, and 1 to 4, or 0, of a best of four; anything else is asked again.

    >>> from sb3_poem import PreferenceAdapter
    >>> import gymnasium as gym
    >>> env = gym.make("poem/PointGoal-v0", render_mode="rgb_array", width=48, height=48)
    >>> oracle = HumanOracle(read=lambda prompt: "l")  # without it, ``input`` asks
    >>> adapter = PreferenceAdapter("PointGoal", env, oracle=oracle, n_queries=1, seed=0)
    >>> policy = adapter.adapt()
    Query 1: preference_queries/query-001.gif

    :param folder: Where the videos go; it is made if missing.
    :param video_format: "gif" (any viewer plays it) or "mp4" (smaller).
    :param mistake_rate: How often a person is taken to err, for the Bayesian rule; None lets it
        infer how they do.
    :param question: "pair", "graded" or "best-of-four", as the rule's.
    :param read: Reads a line after showing a prompt; ``input`` by default.
    :param write: Shows a line; ``print`` by default.
    :param record: Called with each :class:`HumanAnswer` as soon as it is understood;
        ``sb3_poem.label`` has one that keeps them in the store of the web page.
    """

    needs_frames = True

    def __init__(
        self,
        folder: str | Path = "preference_queries",
        video_format: str = "gif",
        fps: float = 20.0,
        mistake_rate: float | None = None,
        read: Callable[[str], str] = input,
        write: Callable[[str], None] = print,
        record: Callable[[HumanAnswer], None] | None = None,
        question: str = "pair",
    ) -> None:
        check_choice("video_format", video_format, ("gif", "mp4"))
        check_choice("question", question, tuple(PROMPTS))
        if mistake_rate is not None:
            check_number("mistake_rate", mistake_rate, 0.0, 0.5)
        self.question = question
        self.folder, self.video_format, self.fps = Path(folder), video_format, fps
        self.noise_model = INFER if mistake_rate is None else MistakeNoise(mistake_rate)
        self.n_asked = 0
        self._read, self._write, self._record = read, write, record

    def __repr__(self) -> str:
        return f"HumanOracle({self.n_asked} asked, videos in {self.folder})"

    def __call__(self, *shown: Trajectory) -> Preference:
        """Write the video of trajectories with frames, as many as a question of its kind shows, and
        ask until an answer is understood; an ``EOFError`` if standard input has ended.
        """
        asked, query = time.time(), Query(shown, self.question)
        name = f"query-{self.n_asked + 1:03d}.{self.video_format}"
        path = query.to_video(self.folder / name, self.fps)
        self.n_asked += 1
        seen = time.time()
        self._write(f"Query {self.n_asked}: {path}")
        while True:
            try:
                line = self._read(PROMPTS[self.question])
            except EOFError:
                raise EOFError("no answer can be read: standard input is closed") from None
            answer = READ[self.question].get(line.strip().lower())
            if answer is not None:
                if self._record is not None:
                    self._record(HumanAnswer(answer, query, path, self.fps, asked, seen))
                return answer
            self._write(f"{line.strip()!r} is no answer.")
