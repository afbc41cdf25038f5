"""A point in the plane with a hidden goal on the half-circle: the smallest task family."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from poem_envs.drawing import Canvas, Colour, ImageWindow
from poem_envs.films import PATH_COLOURS, moments_of
from poem_envs.vector import BatchFamily


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
        canvas = _background(self.width, self.height)
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
        images, chosen = [], [paths[i] for i in shown]
        for moments in moments_of(chosen):
            canvas = _background(*size)
            for i, path, now in zip(shown, chosen, moments, strict=True):
                colour = _COLOURS[i]
                for x, y in path[:now]:
                    canvas.disc(x, y, 0.02, colour)
                canvas.disc(path[now][0], path[now][1], 0.07, colour)
            images.append(canvas.image())
        return images

    def _release(self) -> None:
        if self._window is not None:
            self._window.close()
            self._window = None


# Of the first path, the second and so on.
_COLOURS: list[Colour] = [
    (round(255 * r), round(255 * g), round(255 * b)) for r, g, b in PATH_COLOURS
]


def _background(width: int, height: int) -> Canvas:
    canvas = Canvas(width, height, centre=(0.0, 0.4), extent=2.7)
    canvas.upper_half_circle(1.0, 0.015, (190, 190, 190))
    canvas.disc(0.0, 0.0, 0.02, (190, 190, 190))
    return canvas
