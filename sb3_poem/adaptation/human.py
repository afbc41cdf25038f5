"""A person at a terminal answers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sb3_poem.adaptation.noise import MistakeNoise, NoiseModel
from sb3_poem.adaptation.preference import Preference, Query
from sb3_poem.common.trajectory import Trajectory

PROMPT = "Which is better? [l]eft, [r]ight, or [e]qual (can't tell): "
ANSWERS = {
    **dict.fromkeys(("l", "left", "1"), Preference.LEFT),
    **dict.fromkeys(("r", "right", "2"), Preference.RIGHT),
    **dict.fromkeys(("e", "equal", "=", "can't tell", "cant tell", "?"), Preference.EQUAL),
}


@dataclass(frozen=True, eq=False)
class HumanAnswer:
    """An answer with its video, and when (seconds since 1970) it was asked for and shown."""

    preference: Preference
    left: Trajectory
    right: Trajectory
    video: Path
    fps: float
    asked: float
    shown: float


class HumanOracle:
    """Shows both trajectories side by side in a video file, and asks at the terminal.

    The n-th question's file is ``query-001.gif`` and so on (or ``.mp4``) within the folder. The
    prompt takes l, left or 1; r, right or 2; e, equal, = or ?; upper or lower case; anything else
    is asked again.

    :param folder: Where the videos go; it is made if missing.
    :param video_format: "gif" (any viewer plays it) or "mp4" (smaller).
    :param mistake_rate: How often a person is taken to err, for the Bayesian rule.
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
        mistake_rate: float = 0.05,
        read: Callable[[str], str] = input,
        write: Callable[[str], None] = print,
        record: Callable[[HumanAnswer], None] | None = None,
    ) -> None:
        if video_format not in ("gif", "mp4"):
            raise ValueError(f'`video_format` must be "gif" or "mp4", but is {video_format!r}')
        self.folder, self.video_format, self.fps = Path(folder), video_format, fps
        self.noise_model: NoiseModel = MistakeNoise(mistake_rate)
        self.n_asked = 0
        self._read, self._write, self._record = read, write, record

    def __repr__(self) -> str:
        return f"HumanOracle({self.n_asked} asked, videos in {self.folder})"

    def __call__(self, left: Trajectory, right: Trajectory) -> Preference:
        """Write the video of two trajectories with frames, and ask until an answer is understood;
        an ``EOFError`` if standard input has ended.
        """
        asked = time.time()
        name = f"query-{self.n_asked + 1:03d}.{self.video_format}"
        path = Query(left, right).to_video(self.folder / name, self.fps)
        self.n_asked += 1
        shown = time.time()
        self._write(f"Query {self.n_asked}: {path}")
        while True:
            try:
                line = self._read(PROMPT)
            except EOFError:
                raise EOFError("no answer can be read: standard input is closed") from None
            answer = ANSWERS.get(line.strip().lower())
            if answer is not None:
                if self._record is not None:
                    self._record(HumanAnswer(answer, left, right, path, self.fps, asked, shown))
                return answer
            self._write(f"{line.strip()!r} is no answer; type l, r or e.")
