"""A point in the plane with a hidden goal on the half-circle: the smallest task family."""

import time
from collections.abc import Sequence
from copy import copy as shallow_copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from poem_envs.films import PATH_COLOURS, moments_of
from poem_envs.vector import BatchFamily

# Of the first path, the second and so on.
_COLOURS = np.rint(255 * np.array(PATH_COLOURS))
GREY = (190, 190, 190)


@dataclass(kw_only=True, eq=False, repr=False)
class PointGoalEnv(BatchFamily):
    r"""
    ## Description
    A point starts near the origin of the plane and is to move to a goal on the upper unit
    half-circle that it cannot see. It is the smallest environment on which meta-learning shows:
    where to go is in the task alone, and a policy for it takes seconds to train. Use it for tests,
    documentation and first contact.

    ## Task
    The angle of the goal, uniform on [0, pi], hidden from the observation: `task_space` is
    `Box(0, pi, (1,), float64)`, and the goal lies at `(cos(angle), sin(angle))`.

    ## Action Space
    The action space is a `Box(-1, 1, (2,), float32)`: the movement in x and in y direction, in
    units of `step_length`.

    ## Observation Space
    The observation space is a `Box(-Inf, Inf, (2,), float64)`: the x- and the y-coordinate.

    ## Rewards
    Minus the Euclidean distance between goal and position after the move. The reward features are
    that position, `(x, y)`.

    ## Starting State
    $\mathcal{N}(0, reset\_noise\_scale^2)$ in either coordinate.

    ## Episode End
    There is no early end. `gymnasium.make` truncates episodes after 25 steps.

    ## Arguments
    ```python
    import gymnasium as gym
    env = gym.make("poem_envs:poem/PointGoal-v0", step_length=0.05)
    ```

    | Parameter           | Type      | Default | Description                                  |
    | ------------------- | --------- | ------- | -------------------------------------------- |
    | `step_length`       | **float** | `0.05`  | Distance that an action of 1 moves the point |
    | `reset_noise_scale` | **float** | `0.02`  | Standard deviation of the start              |
    | `width`, `height`   | **int**   | `480`   | Size of the rendered image, pixels           |
    | `render_mode`       | **str**   | `None`  | `"rgb_array"` or `"human"`                   |
    | `render_task`       | **bool**  | `False` | Whether rendering shows the goal             |
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    task_space = spaces.Box(0.0, np.pi, (1,), np.float64)
    reward_feature_dim = 2
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # noqa: RUF012

    step_length: float = 0.05
    reset_noise_scale: float = 0.02
    width: int = 480
    height: int = 480

    def _allocate(self, n: int) -> None:
        self._positions = np.zeros((n, 2))
        self._window: ImageWindow | None = None

    def _begin_episodes(self, copies: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        for copy, rng in zip(copies, rngs, strict=True):
            self._positions[copy] = self.reset_noise_scale * rng.standard_normal(2)

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self._positions += self.step_length * actions
        return self._positions.copy(), np.zeros(len(actions), dtype=bool)

    def _observations(self) -> np.ndarray:
        return self._positions.copy()

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        angle = np.array(tasks[..., 0])  # contiguous: strided input may be rounded differently
        x = features[..., 0] - np.cos(angle)
        y = features[..., 1] - np.sin(angle)
        return -np.sqrt(x * x + y * y)

    def _potential(self, tasks: np.ndarray, observations: np.ndarray) -> np.ndarray:
        return self._reward(tasks, observations)  # the position is seen, and it earns

    def _render_copy(self, copy: int, render_mode: str, task: np.ndarray | None) -> Any:
        canvas = Canvas(self.width, self.height)
        if task is not None:
            canvas.disc(np.cos(task[0]), np.sin(task[0]), 0.07, (60, 160, 75))
        canvas.disc(self._positions[copy, 0], self._positions[copy, 1], 0.045, (31, 90, 180))
        image = canvas.image()
        if render_mode == "rgb_array":
            return image
        if self._window is None:
            self._window = ImageWindow(self.width, self.height, "PointGoal")
        self._window.show(image)
        time.sleep(1.0 / self.metadata["render_fps"])
        return None

    def film_state(self) -> np.ndarray:
        """See :class:`~poem_envs.films.Filmed`: the position of the first copy, ``(2,)``."""
        return self._positions[0].copy()

    def film(
        self, paths: Sequence[np.ndarray], shown: Sequence[int], size: tuple[int, int]
    ) -> list[np.ndarray]:
        """See :class:`~poem_envs.films.Filmed`."""
        images, chosen, trails = [], [paths[i] for i in shown], Canvas(*size)
        drawn = [0] * len(chosen)
        for moments in moments_of(chosen):
            for number, now in enumerate(moments):
                for x, y in chosen[number][drawn[number] : now]:
                    trails.disc(x, y, 0.02, _COLOURS[shown[number]])
                drawn[number] = now
            canvas = trails.copy()
            for i, path, now in zip(shown, chosen, moments, strict=True):
                canvas.disc(path[now][0], path[now][1], 0.07, _COLOURS[i])
            images.append(canvas.image())
        return images

    def close(self) -> None:
        if self._window is not None:
            self._window.close()
            self._window = None


class Canvas:
    """A white image, ``width`` by ``height`` pixels, of the plane (x right, y up) around the upper
    unit half-circle, which is drawn in it.
    """

    def __init__(self, width: int, height: int) -> None:
        self._pixels = np.full((height, width, 3), 255.0)
        self._per_unit = min(width, height) / 2.7
        self._x = (np.arange(width) + 0.5 - width / 2) / self._per_unit
        self._y = 0.4 - (np.arange(height)[:, None] + 0.5 - height / 2) / self._per_unit
        line = np.abs(np.hypot(self._x, self._y) - 1.0) - 0.0075
        self._paint(np.maximum(line, -self._y), GREY, self._pixels)
        self.disc(0.0, 0.0, 0.02, GREY)

    def copy(self) -> Self:
        """One of its own with the same shapes on it."""
        copied = shallow_copy(self)
        copied._pixels = self._pixels.copy()
        return copied

    def disc(self, x: float, y: float, radius: float, colour: npt.ArrayLike) -> None:
        """Paint a filled circle around a point."""
        reach = radius + 1.0 / self._per_unit  # beyond it no pixel is touched
        rows = _span(np.abs(self._y[:, 0] - y) <= reach)
        columns = _span(np.abs(self._x - x) <= reach)
        distance = np.hypot(self._x[columns] - x, self._y[rows] - y) - radius
        self._paint(distance, colour, self._pixels[rows, columns])

    def image(self) -> np.ndarray:
        """What was painted, ``(height, width, 3)`` uint8."""
        return np.rint(self._pixels).astype(np.uint8)

    def _paint(self, distance: np.ndarray, colour: npt.ArrayLike, window: np.ndarray) -> None:
        """Paint where the distance to a shape's edge, ``(rows, columns)``, is below zero."""
        coverage = np.clip(0.5 - distance * self._per_unit, 0.0, 1.0)
        touched = coverage > 0.0
        old = window[touched]
        window[touched] = old + coverage[touched][:, None] * (np.array(colour, np.float64) - old)


def _span(inside: np.ndarray) -> slice:
    """The slice from the first to the last that is inside."""
    places = np.flatnonzero(inside)
    return slice(places[0], places[-1] + 1) if len(places) else slice(0, 0)


class ImageWindow:
    """A window that shows images, through GLFW and OpenGL, which MuJoCo's package brings along."""

    def __init__(self, width: int, height: int, title: str) -> None:
        import glfw

        self._glfw: Any = glfw
        self._window: Any = None
        if glfw.init():
            glfw.window_hint(glfw.RESIZABLE, glfw.FALSE)
            self._window = glfw.create_window(width, height, title, None, None)
        if not self._window:
            raise RuntimeError(
                "render_mode='human' could not open a window; use 'rgb_array' on a machine without "
                "a display"
            )

    def show(self, image: np.ndarray) -> None:
        """Show an image, ``(height, width, 3)`` uint8."""
        from OpenGL import GL

        glfw = self._glfw
        glfw.make_context_current(self._window)
        height, width, _ = image.shape
        # larger than the window on dense displays
        frame_width, frame_height = glfw.get_framebuffer_size(self._window)
        GL.glViewport(0, 0, frame_width, frame_height)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
        GL.glRasterPos2f(-1.0, -1.0)
        GL.glPixelZoom(frame_width / width, frame_height / height)
        upright = np.ascontiguousarray(image[::-1])
        GL.glDrawPixels(width, height, GL.GL_RGB, GL.GL_UNSIGNED_BYTE, upright)
        glfw.swap_buffers(self._window)
        glfw.poll_events()

    def close(self) -> None:
        self._glfw.destroy_window(self._window)
