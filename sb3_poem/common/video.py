"""Frames to a file, and two clips side by side."""

import contextlib
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_poem.common.files import write_atomically

Frame = np.ndarray  # (height, width, 3) uint8
#: White pixels between two clips
GAP = 4
# Frames between which a player can start: seeking decodes at most so many.
KEYFRAME_DISTANCE = 10
ENCODER = [
    *("-an", "-c:v", "libx264", "-pix_fmt", "yuv420p"),
    *("-preset", "ultrafast", "-crf", "24", "-bf", "0", "-threads", "1"),
    *("-g", str(KEYFRAME_DISTANCE), "-movflags", "+faststart"),
]


def write_video(frames: Sequence[Frame], path: str | Path, fps: float = 20.0) -> Path:
    """Write frames, (height, width, 3) uint8 of one size, as MP4 (H.264) or GIF, by the suffix;
    completely or not at all.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"path must end in .mp4 or .gif, got {str(path)!r}")
    if len(frames) == 0:
        raise ValueError(f"no frames to write to {str(path)!r}")
    kinds = {(np.shape(frame), str(np.asarray(frame).dtype)) for frame in frames}
    (shape, kind), *others = kinds
    if others or len(shape) != 3 or shape[2] != 3 or kind != "uint8":
        alike = "(height, width, 3) uint8 of one size"
        raise ValueError(f"frames must all be {alike}, got {sorted(kinds)}")
    write_atomically(path, _gif(frames, fps) if path.suffix == ".gif" else _mp4(frames, path, fps))
    return path


def _gif(frames: Sequence[Frame], fps: float) -> bytes:
    import imageio.v2 as imageio

    # Delays are whole hundredths of a second, two at least in browsers: leave frames out.
    step = int(np.ceil(fps / 50))
    kept: list[Any] = [np.asarray(frame) for frame in frames[::step]]
    ends = np.round(100.0 * step * np.arange(len(kept) + 1) / fps)
    delays = (10.0 * np.diff(ends)).tolist()
    content: Any = imageio.mimwrite("<bytes>", kept, "gif", duration=delays, loop=0)
    return content


def _mp4(frames: Sequence[Frame], path: Path, fps: float) -> bytes:
    from imageio_ffmpeg import get_ffmpeg_exe

    (height, width), rate = np.shape(frames[0])[:2], f"{fps:.02f}"
    # H.264 with 4:2:0 colour needs even sides; the last row or column is repeated.
    odd = ((0, height % 2), (0, width % 2), (0, 0))
    size = f"{width + width % 2}x{height + height % 2}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", rate, "-i", "-"]
    with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
        # Not imageio's writer, which takes no notice when ffmpeg fails at the end.
        command = [get_ffmpeg_exe(), "-y", "-v", "error", *source, *ENCODER, file.name]
        # Not communicate(), which hands frames over in pieces of 4 kB.
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # its status says why it ended
                for frame in frames:
                    ffmpeg.stdin.write(np.pad(frame, odd, mode="edge").tobytes())
            words = ffmpeg.communicate()[1].decode(errors="replace").partition("\n")[0]
        if ffmpeg.returncode != 0:
            ended = f"ffmpeg ended with status {ffmpeg.returncode} {words}"
            raise OSError(f"{path} cannot be written: {ended}")
        return file.read()


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
    return joined([left, [bar], right], axis=1)


def in_rows(clips: Sequence[Sequence[Frame]], captions: Sequence[str]) -> list[Frame]:
    """An even number of clips, two in a row; see :func:`side_by_side`."""
    rows = [
        side_by_side(clips[i], clips[i + 1], (captions[i], captions[i + 1]))
        for i in range(0, len(clips), 2)
    ]
    return joined(rows, axis=0)


def joined(clips: Sequence[Sequence[Frame]], axis: int) -> list[Frame]:
    """Clips below (axis 0) or beside each other (1) in one, in which they cannot fall out of step.
    What is shorter than the longest one holds its last frame.
    """
    longest = range(max(map(len, clips)))
    return [np.concatenate([clip[min(i, len(clip) - 1)] for clip in clips], axis) for i in longest]
