"""Video files of questions and results: small, quick to encode, and to the frame seekable in every
browser.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

WIDTH, HEIGHT = 320, 240
# Frames between which a player can start: seeking decodes at most so many.
KEYFRAME_DISTANCE = 10
ENCODER = [
    *("-an", "-c:v", "libx264", "-pix_fmt", "yuv420p"),
    *("-preset", "ultrafast", "-crf", "24", "-bf", "0", "-threads", "1"),
    *("-g", str(KEYFRAME_DISTANCE), "-movflags", "+faststart"),
]


class StorageError(OSError):
    """What cannot be kept: the disk is full, say."""


def write_clip(frames: Sequence[np.ndarray], path: Path, fps: float) -> None:
    """Write frames as MP4 (H.264), completely or not at all.

    :param frames: (height, width, 3) uint8 each, of one size.
    :param path: The file, which must end in ``.mp4``; its folder must exist.
    :param fps: Frames per second.
    :raises StorageError: If it cannot be written.
    """
    from imageio_ffmpeg import get_ffmpeg_exe

    height, width = frames[0].shape[:2]
    source = [
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-s",
        f"{width}x{height}",
        "-r",
        f"{fps:.02f}",
        "-i",
        "-",
    ]
    temporary = path.with_name(f".writing-{path.name}")
    command = [get_ffmpeg_exe(), "-y", "-v", "error", *source, *ENCODER, str(temporary)]
    try:
        # Not imageio's writer, which takes no notice when ffmpeg fails at the end.
        pixels = b"".join(frame.tobytes() for frame in frames)
        done = subprocess.run(command, input=pixels, capture_output=True, check=False)
        if done.returncode != 0:
            words = done.stderr.decode(errors="replace").partition("\n")[0]
            raise OSError(f"ffmpeg ended with status {done.returncode} {words}")
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise StorageError(f"{path} cannot be written: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def pair(left: Sequence[np.ndarray], right: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Two clips beside each other, each :data:`WIDTH` x :data:`HEIGHT`: one file, so that they
    cannot fall out of step.

    :param left: Frames.
    :param right: Frames.
    :return: As many frames as the longer clip has; the shorter one holds its last.
    """
    left, right = [fit(frame) for frame in left], [fit(frame) for frame in right]
    return [
        np.concatenate([left[min(i, len(left) - 1)], right[min(i, len(right) - 1)]], axis=1)
        for i in range(max(len(left), len(right)))
    ]


def fit(frame: np.ndarray) -> np.ndarray:
    """A frame in the page's size, whole, with bars of its corner's colour where its shape is
    another.

    :param frame: (height, width, 3) uint8.
    :return: (:data:`HEIGHT`, :data:`WIDTH`, 3) uint8.
    """
    if frame.shape[:2] == (HEIGHT, WIDTH):
        return frame
    from PIL import Image

    scale = min(WIDTH / frame.shape[1], HEIGHT / frame.shape[0])
    width, height = round(frame.shape[1] * scale), round(frame.shape[0] * scale)
    image = Image.new("RGB", (WIDTH, HEIGHT), tuple(int(value) for value in frame[0, 0]))
    shrunk = Image.fromarray(frame).resize((width, height), Image.Resampling.BILINEAR)
    image.paste(shrunk, ((WIDTH - width) // 2, (HEIGHT - height) // 2))
    return np.asarray(image)
