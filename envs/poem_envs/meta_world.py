"""Meta-World's benchmarks: placements of one manipulation (ML1), or of ten (ML10)."""

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from poem_envs import sawyer
from poem_envs.family import TaskFamily
from poem_envs.films import Look, MujocoFilms
from poem_envs.mujoco_rendering import renders_fast

OBSERVATION_DIM = 39
#: Manipulations whose goal is nothing but a place that the hand is to reach.
REACHING = ("reach", "reach-wall")
TARGET_RADIUS = 0.05
# What Meta-World keeps between a puck and a goal, in the plane.
PUCK_TO_GOAL = 0.15


class MetaWorldEnv(MujocoFilms, TaskFamily):
    """What ML1 and ML10 have in common: observations, actions, simulators and their rendering.

    :param width: Of rendered images, pixels
    :param height: Of rendered images, pixels
    :param camera_name: One of Meta-World's cameras
    :param render_quality: "full", or "fast": without shadows and antialiasing, for RGB images alone
    """

    #: The names of the sets that tasks can be drawn from, of which the first is for training.
    splits: tuple[str, ...]
    metadata = {"render_modes": ["human", "rgb_array", "depth_array"], "render_fps": 80}  # noqa: RUF012
    look = Look(145.0, -25.0, 1.0, (0.0, 0.68, 0.16), body="hand", follows=False, on_floor=False)

    def __init__(
        self,
        *,
        split: str = "train",
        width: int = 480,
        height: int = 480,
        camera_name: str | None = "corner2",
        render_quality: str = "full",
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if split not in self.splits:
            raise ValueError(
                f"split={split!r}: {type(self).__name__} has no such split of its tasks, it has "
                f"{', '.join(map(repr, self.splits))}"
            )
        self.split = split
        self.observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        view = {"width": width, "height": height, "camera_name": camera_name}
        fast = renders_fast(render_quality, self.render_mode)
        self._sawyer_arguments = {"renders_fast": fast, "render_mode": self.render_mode, **view}
        # Meta-World's models have these cameras upside down.
        self._upside_down = (camera_name or "").startswith("corner")
        self._sawyer: sawyer.Sawyer | None = None

    def _split_stream(self, rng: np.random.Generator) -> np.random.Generator:
        """A generator that another determines, another for each split but the first."""
        split = self.splits.index(self.split)
        return rng if split == 0 else np.random.default_rng([split, *rng.integers(2**32, size=4)])

    def _place(self, task: np.ndarray, rng: np.random.Generator) -> tuple[str, np.ndarray]:
        """The manipulation and the placement, ``(placement_dim,)``, of an episode."""
        raise NotImplementedError

    def _features(self, reward: float) -> np.ndarray:
        """The reward features of the step just taken; here, Meta-World's own reward of it."""
        return np.array([reward])

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(tasks.shape[:-1], features.shape[:-1])
        return np.broadcast_to(features[..., 0], shape).copy()

    def visible_difference(self, left: np.ndarray, right: np.ndarray, spread: np.ndarray) -> float:
        """See :class:`TaskFamily`: what differs may earn the same, so that it is taken for seen."""
        return super().visible_difference(left, right, spread) if self.shared_dynamics else np.inf

    def _begin_episode(self, rng: np.random.Generator) -> np.ndarray:
        assert self._task is not None
        manipulation, placement = self._place(self._task, rng)
        if self._sawyer is None or self._sawyer.manipulation != manipulation:
            self._release_sawyer()
            self._sawyer = sawyer.take_sawyer(manipulation, **self._sawyer_arguments)
        return self._sawyer.reset(placement, self.render_task)

    def _simulate(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        assert self._sawyer is not None
        try:
            observation, reward, self._success = self._sawyer.step(action)
        except FloatingPointError as error:
            raise RuntimeError(
                f"the simulation of {type(self).__name__} diverged at {self._describe_episode()}: "
                f"{error}"
            ) from error
        return observation, self._features(reward), False

    def _step_info(self) -> dict[str, Any]:
        return {"success": self._success}

    def _begun(self, method: str) -> sawyer.Sawyer:
        if self._sawyer is None:
            raise RuntimeError(f"{method}() was called before the first reset()")
        return self._sawyer

    def render(self) -> Any:
        """An image ``(height, width, 3)``, or what else ``render_mode`` says."""
        image = self._begun("render").render()
        turn = self._upside_down and isinstance(image, np.ndarray)
        return image[::-1, ::-1].copy() if turn else image

    def _simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        env = self._begun("film").env
        return env.model, env.data

    def close(self) -> None:
        """Free what rendering and simulation hold."""
        self._close_films()
        if self._sawyer is not None:
            self._sawyer.close()
        self._release_sawyer()

    def _release_sawyer(self) -> None:
        if self._sawyer is not None:
            sawyer.give_back_sawyer(self._sawyer)
            self._sawyer = None


class MetaWorldML1Env(MetaWorldEnv):
    r"""
    ## Description
    One manipulation of Meta-World (Yu et al. 2019), with a Sawyer arm, in many placements of its
    object and its goal: the benchmark ML1. The goal is hidden as Meta-World hides it, by zeros in
    the observation.

    ## Task
    For `reach` and `reach-wall` the position of the goal, `(x, y, z)` in metres, drawn as
    Meta-World draws it: uniform on its box, but for goals close to the puck that it draws with
    them. The puck, which the reward of these two does not depend on, is placed anew in every
    episode.

    For every other manipulation the placement that Meta-World calls `rand_vec`: the position of the
    object and, for some, that of the goal. It is drawn as Meta-World draws it. Observations show
    the object, as Meta-World's do.

    `split="train"` and `split="test"` are different draws from the same distribution.

    ## Action Space
    The action space is a `Box(-1, 1, (4,), float32)`: a movement of the hand in x, y and z, by up
    to a centimetre, and the effort that closes the gripper.

    ## Observation Space
    The observation space is a `Box(-Inf, Inf, (39,), float64)`, that of Meta-World.

    | Num   | Observation                                                       |
    | ----- | ----------------------------------------------------------------- |
    | 0-2   | position of the hand                                              |
    | 3     | how far the gripper is open                                       |
    | 4-17  | positions and quaternions of up to two objects, padded with zeros |
    | 18-35 | the same of the step before                                       |
    | 36-38 | zeros, in place of the goal                                       |

    ## Rewards
    Meta-World's own (version 2), between 0 and 10, and its `success` in the info.

    For `reach` and `reach-wall` the tasks share their dynamics and the reward features are the
    position of the gripper's centre, `(x, y, z)`: the reward of any goal is a function of it. The
    rewards of the other manipulations depend on the placement through the simulator's state, and so
    does what follows an action. There `shared_dynamics` is False and the one reward feature is the
    reward of the task that was played, which says nothing about other tasks.

    ## Starting State
    Meta-World's: the hand moves to its initial position. It depends on the task alone, but for the
    puck of `reach` and `reach-wall`. The puck's box is cut to where Meta-World accepts it together
    with any goal (at least 0.15 m away), so that the start says nothing about the goal.

    ## Episode End
    There is no early end. `gymnasium.make` truncates episodes after 200 steps.

    ## Arguments
    The extra `metaworld` is needed: `pip install '.[metaworld]'` in a checkout.

    ```python
    import gymnasium as gym
    env = gym.make("poem_envs:poem/MetaWorldML1-v0", env_name="push")
    ```

    | Parameter         | Type     | Default     | Description                                  |
    | ----------------- | -------- | ----------- | -------------------------------------------- |
    | `env_name`        | **str**  | `"reach"`   | One of 50, with or without `-v3`             |
    | `split`           | **str**  | `"train"`   | `"train"` or `"test"`                        |
    | `render_mode`     | **str**  | `None`      | `"rgb_array"`, `"human"` or `"depth_array"`  |
    | `render_task`     | **bool** | `False`     | Whether rendering shows the goal             |
    | `width`, `height` | **int**  | `480`       | Size of the rendered image, pixels           |
    | `camera_name`     | **str**  | `"corner2"` | One of Meta-World's cameras                  |
    | `render_quality`  | **str**  | `"full"`    | `"fast"` leaves out shadows and antialiasing |
    """

    splits = ("train", "test")

    def __init__(self, *, env_name: str = "reach", **kwargs: Any) -> None:
        self.env_name = sawyer.checked_manipulation(env_name)
        super().__init__(**kwargs)
        placements = sawyer.placements_of(self.env_name)
        low, high = placements.low, placements.high
        self._reaching = self.shared_dynamics = self.env_name in REACHING
        self.reward_feature_dim = 3 if self._reaching else 1
        if self._reaching:
            self.look = replace(self.look, hidden=("obj",))
            self._puck_low, self._puck_high = low[:3].copy(), high[:3].copy()
            self._puck_high[1] = min(high[1], low[4] - PUCK_TO_GOAL)
            low, high = low[3:], high[3:]
        self._hand_init_pos = placements.hand_init_pos
        self.task_space = spaces.Box(low, high, dtype=np.float64)

    def _draw_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        rng = self._split_stream(rng)
        draws = np.stack([sawyer.placements_of(self.env_name).draw(rng) for _ in range(n)])
        return draws[:, 3:] if self._reaching else draws

    def _checked_tasks(self, tasks: npt.ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
        checked = super()._checked_tasks(tasks, shape, name)
        if not self._reaching:
            for placement in checked.reshape(-1, checked.shape[-1]):
                sawyer.placements_of(self.env_name).check(placement)
        return checked

    def _place(self, task: np.ndarray, rng: np.random.Generator) -> tuple[str, np.ndarray]:
        if not self._reaching:
            return self.env_name, task
        return self.env_name, np.concatenate([rng.uniform(self._puck_low, self._puck_high), task])

    def _features(self, reward: float) -> np.ndarray:
        if not self._reaching:
            return super()._features(reward)
        return self._begun("step").env.tcp_center.copy()

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        if not self._reaching:
            return super()._reward(tasks, features)
        beyond = np.maximum(_distance(features, tasks) - TARGET_RADIUS, 0.0)
        relative = beyond / _distance(self._hand_init_pos, tasks)
        return 10.0 / (1.0 + 9.0 * relative * relative)  # a tenth at the distance of the start


class MetaWorldML10Env(MetaWorldEnv):
    r"""
    ## Description
    Ten manipulations of Meta-World (Yu et al. 2019), each in many placements: the benchmark ML10.
    Which of them it is, and where the goal is, is hidden; see :class:`MetaWorldML1Env` for
    observations, actions, start and end, which are the same.

    ## Task
    `(manipulation, placement)`, a `Box` of shape `(7,)`: the number of the manipulation in
    `manipulations`, and Meta-World's `rand_vec` for it, padded with zeros. `sample_tasks` draws
    manipulations in equal parts.

    | `split`      | Manipulations                                                         |
    | ------------ | --------------------------------------------------------------------- |
    | `"train"`    | 0-9: reach, push, pick-place, door-open, drawer-close,                |
    |              | button-press-topdown, peg-insert-side, window-open, sweep, basketball |
    | `"test"`     | the same ten, in other placements                                     |
    | `"held-out"` | 10-14, which ML10 keeps back: drawer-open, door-close, shelf-place,   |
    |              | sweep-into, lever-pull                                                |

    ## Rewards
    Meta-World's own (version 2), between 0 and 10, and its `success` in the info. The tasks have
    different dynamics: `shared_dynamics` is False, and the one reward feature is the reward of the
    task that was played, which says nothing about other tasks. POEM measures what one task's policy
    earns in another by running it there.

    ## Arguments
    `split`, and those of :class:`MetaWorldML1Env` but `env_name`.
    """

    splits = ("train", "test", "held-out")
    shared_dynamics = False
    reward_feature_dim = 1

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        table = sawyer.load_metaworld().ML10_V3
        names = [*table["train"], *table["test"]]
        #: The names of the manipulations, by number.
        self.manipulations = [name.removesuffix("-v3") for name in names]
        numbers = np.arange(len(names))
        trained, held_out = np.split(numbers, [len(table["train"])])
        self._numbers = held_out if self.split == "held-out" else trained
        bounds = [sawyer.placements_of(name) for name in self.manipulations]
        self._placement_dims = [len(placements.low) for placements in bounds]
        width = max(self._placement_dims)
        low = np.min([_padded(placements.low, width) for placements in bounds], axis=0)
        high = np.max([_padded(placements.high, width) for placements in bounds], axis=0)
        low, high = np.append(numbers[0], low), np.append(numbers[-1], high)
        self.task_space = spaces.Box(low, high, dtype=np.float64)

    def _draw_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        rng = self._split_stream(rng)
        rounds = -(-n // len(self._numbers))
        numbers = np.concatenate([rng.permutation(self._numbers) for _ in range(rounds)])[:n]
        width = self.task_space.shape[0] - 1
        places = [sawyer.placements_of(self.manipulations[number]) for number in numbers]
        return np.column_stack([numbers, [_padded(place.draw(rng), width) for place in places]])

    def _checked_tasks(self, tasks: npt.ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
        checked = super()._checked_tasks(tasks, shape, name)
        for task in checked.reshape(-1, checked.shape[-1]):
            if abs(task[0] - round(task[0])) > 1e-6:
                raise ValueError(f"{name}={task.tolist()} must begin with a whole number")
            manipulation, placement = self._place(task, np.random.default_rng(0))
            places = sawyer.placements_of(manipulation)
            inside = (placement >= places.low - 1e-6) & (placement <= places.high + 1e-6)
            if not inside.all() or np.any(task[1 + len(placement) :] != 0.0):
                raise ValueError(
                    f"{name}={task.tolist()}: a placement of {manipulation!r} is {len(placement)} "
                    f"numbers from {places.low} to {places.high}, then zeros"
                )
            places.check(placement)
        return checked

    def _place(self, task: np.ndarray, rng: np.random.Generator) -> tuple[str, np.ndarray]:
        number = round(task[0])
        return self.manipulations[number], task[1 : 1 + self._placement_dims[number]].copy()


def _distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Euclidean distance of points ``(..., 3)``, by elementwise operations alone."""
    x, y, z = (np.array(first[..., i]) - np.array(second[..., i]) for i in range(3))
    return np.sqrt(x * x + y * y + z * z)


def _padded(values: np.ndarray, width: int) -> np.ndarray:
    return np.pad(values, (0, width - len(values)))
