"""Video files of questions and results: small, quick to encode, and to the frame seekable in every browser."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

WIDTH, HEIGHT = 320, 240
# Frames between which a player can start: seeking decodes at most so many.
KEYFRAME_DISTANCE = 10
ENCODER = [
    *("-preset", "ultrafast", "-crf", "24", "-bf", "0", "-threads", "1"),
    *("-g", str(KEYFRAME_DISTANCE), "-movflags", "+faststart"),
]


def write_clip(frames: Sequence[np.ndarray], path: Path, fps: float) -> None:
    """
    Write frames as MP4 (H.264), completely or not at all.

    :param frames: (height, width, 3) uint8 each, of one size.
    :param path: The file, which must end in ``.mp4``; its folder must exist.
    :param fps: Frames per second.
    """
    import imageio.v2 as imageio

    descriptor, temporary = tempfile.mkstemp(prefix=".writing-", suffix=".mp4", dir=path.parent)
    os.close(descriptor)
    try:
        imageio.mimwrite(
            temporary, list(frames), format="FFMPEG", fps=fps, codec="libx264", macro_block_size=2, output_params=ENCODER
        )
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)


def pair(left: Sequence[np.ndarray], right: Sequence[np.ndarray]) -> list[np.ndarray]:
    """
    Two clips beside each other, each :data:`WIDTH` x :data:`HEIGHT`: one file, so that they cannot fall out of step.

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
    """
    A frame in the page's size, whole, with bars of its corner's colour where its shape is another.

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
