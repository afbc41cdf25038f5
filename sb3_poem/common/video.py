"""Frames to a file, and two clips side by side."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

Frame = np.ndarray  # (height, width, 3) uint8
#: White pixels between two clips
GAP = 4


def _even(frame: Frame) -> Frame:
    """H.264 with 4:2:0 colour needs even sides; repeat the last row or column where one is odd."""
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def write_video(frames: Sequence[Frame], path: str | Path, fps: float = 20.0) -> Path:
    """Write frames, (height, width, 3) uint8 of one size, as MP4 (H.264) or GIF, by the suffix."""
    import imageio.v2 as imageio

    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"path must end in .mp4 or .gif, got {str(path)!r}")
    if len(frames) == 0:
        raise ValueError(f"no frames to write to {str(path)!r}")
    shapes = {np.shape(frame) for frame in frames}
    if len(shapes) > 1 or any(len(shape) != 3 or shape[2] != 3 for shape in shapes):
        raise ValueError(f"frames must all be (height, width, 3) of one size, got {sorted(shapes)}")

    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        # Delays are whole hundredths of a second, two at least in browsers: leave frames out.
        step = int(np.ceil(fps / 50))
        kept: list[Any] = [np.asarray(frame) for frame in frames[::step]]
        ends = np.round(100.0 * step * np.arange(len(kept) + 1) / fps)
        imageio.mimwrite(path, kept, duration=(10.0 * np.diff(ends)).tolist(), loop=0)
    else:
        even: list[Any] = [_even(frame) for frame in frames]
        imageio.mimwrite(path, even, fps=fps, codec="libx264", macro_block_size=2)
    return path


def _with_captions(clips: Sequence[Sequence[Frame]], captions: Sequence[str]) -> list[list[Frame]]:
    """Each clip under its line of text, in the largest type that fits them all."""
    from PIL import Image, ImageDraw, ImageFont

    width = min(clip[0].shape[1] for clip in clips)
    size = max(10, width // 20)

    def longest(size: int) -> float:
        return max(map(ImageFont.load_default(size).getlength, captions))

    while size > 8 and longest(size) > width:
        size -= 1
    font = ImageFont.load_default(size)

    def captioned(frame: Frame, caption: str) -> Frame:
        image = Image.new("RGB", (frame.shape[1], frame.shape[0] + 2 * size), "white")
        image.paste(Image.fromarray(frame), (0, 2 * size))
        middle = (frame.shape[1] / 2, size)
        ImageDraw.Draw(image).text(middle, caption, fill="black", anchor="mm", font=font)
        return np.asarray(image)

    pairs = zip(clips, captions, strict=True)
    return [[captioned(frame, caption) for frame in clip] for clip, caption in pairs]


def side_by_side(
    left: Sequence[Frame], right: Sequence[Frame], captions: tuple[str, str] | None = None
) -> list[Frame]:
    """Two clips beside each other, under captions if any; the shorter one holds its last frame."""
    if len(left) == 0 or len(right) == 0:
        raise ValueError(f"both clips need frames, got {len(left)} and {len(right)}")
    heights = left[0].shape[0], right[0].shape[0]
    if heights[0] != heights[1]:
        raise ValueError(f"both clips need the same height, got {heights[0]} and {heights[1]}")
    if captions is not None:
        left, right = _with_captions((left, right), captions)
    bar = np.full((left[0].shape[0], GAP, 3), 255, dtype=np.uint8)
    lefts, rights = as_long((left, right))
    return [np.concatenate([a, bar, b], axis=1) for a, b in zip(lefts, rights, strict=True)]


def in_rows(clips: Sequence[Sequence[Frame]], captions: Sequence[str]) -> list[Frame]:
    """An even number of clips, two in a row; see :func:`side_by_side`."""
    rows = [
        side_by_side(clips[i], clips[i + 1], (captions[i], captions[i + 1]))
        for i in range(0, len(clips), 2)
    ]
    return [np.concatenate(frames) for frames in zip(*as_long(rows), strict=True)]


def as_long(clips: Sequence[Sequence[Frame]]) -> list[list[Frame]]:
    """All as long as the longest one."""
    longest = max(map(len, clips))
    return [[*clip, *[clip[-1]] * (longest - len(clip))] for clip in clips]
