"""Videos and plots, read back by other programs than those that wrote them."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from sb3_poem.common.video import side_by_side, write_video
from sb3_poem.plotting import plot_returns


def clip(length: int, height: int = 33, width: int = 47, value: int = 0) -> list[np.ndarray]:
    return [np.full((height, width, 3), value + 10 * i, dtype=np.uint8) for i in range(length)]


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_written_frames_are_read_back(tmp_path: Path, suffix: str) -> None:
    path = write_video(clip(12), tmp_path / "new" / f"clip{suffix}", fps=10)
    frames = imageio.imread(path, index=None)
    assert frames.shape[0] == 12
    # Video codecs lose a little; the order and the brightness stay. Odd sides grow by one for
    # H.264.
    assert frames.shape[1:3] == ((34, 48) if suffix == ".mp4" else (33, 47))
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)), 10 * np.arange(12), atol=3)


@pytest.mark.parametrize(
    ("frames", "name", "words"),
    [
        ([], "a.mp4", "no frames"),
        (clip(2), "a.avi", r"\.mp4 or \.gif"),
        (clip(1) + clip(1, height=20), "a.gif", "one size"),
        ([np.zeros((4, 4), np.uint8)], "a.gif", "height, width, 3"),
        ([np.zeros((4, 4, 3))], "a.mp4", "uint8"),
    ],
)
def test_bad_frames_are_refused(tmp_path: Path, frames: list, name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        write_video(frames, tmp_path / name)


def test_side_by_side_places_both_and_holds_the_last_frame() -> None:
    frames = side_by_side(clip(3), clip(5, width=20, value=100))
    assert len(frames) == 5
    assert frames[0].shape == (33, 47 + 4 + 20, 3)
    assert [int(frame[0, 0, 0]) for frame in frames] == [0, 10, 20, 20, 20]
    assert [int(frame[0, -1, 0]) for frame in frames] == [100, 110, 120, 130, 140]
    assert (frames[0][:, 47:51] == 255).all()


def test_captions_are_drawn_above_the_frames() -> None:
    plain = side_by_side(clip(1, 120, 160), clip(1, 120, 160))
    captioned = side_by_side(
        clip(1, 120, 160), clip(1, 120, 160), captions=("before", "after ten answers")
    )
    band = captioned[0].shape[0] - plain[0].shape[0]
    assert band > 0
    np.testing.assert_array_equal(captioned[0][band:], plain[0])
    assert (captioned[0][:band, :160] < 100).any()
    assert (captioned[0][:band, 164:] < 100).any()


def test_side_by_side_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="need frames"):
        side_by_side([], clip(1))
    with pytest.raises(ValueError, match="same height"):
        side_by_side(clip(1), clip(1, height=10))


def test_plot_shows_what_it_was_given(tmp_path: Path) -> None:
    returns = np.array([[-5.0, -3.0, -1.0], [-7.0, -5.0, -2.0]])
    figure = plot_returns(
        [0, 1, 5],
        returns,
        limit=[-6, -3.5, -1],
        known_task=-0.5,
        title="family",
        path=tmp_path / "a/b.png",
    )
    axes = figure.axes[0]
    lines = {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in axes.lines}
    np.testing.assert_allclose(lines["adapted policy"], [-6.0, -4.0, -1.5])
    np.testing.assert_allclose(lines["limit of so many answers"], [-6, -3.5, -1])
    np.testing.assert_allclose(lines["task known"], [-0.5, -0.5])
    assert axes.get_title() == "family"
    assert (tmp_path / "a/b.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("returns", [np.zeros((3, 2)), np.zeros(3), np.zeros((0, 3))])
def test_plot_refuses_other_shapes(returns: np.ndarray) -> None:
    with pytest.raises(ValueError, match="returns must be"):
        plot_returns([0, 1, 2], returns)


def test_plot_refuses_a_limit_of_another_length() -> None:
    with pytest.raises(ValueError, match="limit needs one value"):
        plot_returns([0, 1, 2], np.zeros((3, 3)), limit=[1.0])


@pytest.mark.parametrize("fps", [10, 30, 50, 67, 80, 125])
def test_a_gif_takes_as_long_as_what_it_shows(fps: int, tmp_path: Path) -> None:
    from PIL import Image

    frames = [np.full((8, 8, 3), 2 * number, dtype=np.uint8) for number in range(100)]
    write_video(frames, tmp_path / "a.gif", fps)
    image, delays = Image.open(tmp_path / "a.gif"), []
    for number in range(image.n_frames):
        image.seek(number)
        delays.append(image.info["duration"])
    assert min(delays) >= 20
    assert sum(delays) == pytest.approx(1000 * 100 / fps, abs=20)
