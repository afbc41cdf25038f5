"""Task families: environments that share observations and actions, and differ in a hidden
parameter, the *task*.

:class:`TaskFamily` is their base class; :mod:`poem_envs.vector` makes vectorised ones of them.
"""

from abc import ABCMeta, abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from poem_envs.headless import has_display

# Float32 policies and files round: a value so far outside its bounds is clipped, not refused.
BOUNDS_TOLERANCE = 1e-6

# Standard deviations of a reward feature by which the means of two films must differ for people to
# tell them apart: about 0.1 m/s of HalfCheetahVel, four pixels of PointGoal's film on the page.
JUST_VISIBLE = 0.1
# The same of their lengths, as a share of the longer film.
JUST_LONGER = 0.1


class _NothingToRender:
    """The ``metadata`` of families that cannot be rendered: their classes have none, since SB3 asks
    every environment for RGB images, and ``gym.make``, which looks at the class, would warn.
    """

    def __get__(self, instance: object, owner: type) -> dict[str, Any]:
        if instance is None:
            raise AttributeError(f"{owner.__name__} cannot be rendered, and has no metadata")
        return {"render_modes": []}


def check_definition(family: Any) -> None:
    """Refuse a family whose attributes are not what they must be, and say what would be right."""
    names = ("observation_space", "action_space", "task_space", "reward_feature_dim")
    given: list[Any] = [getattr(family, name, None) for name in names]
    observations, actions, tasks, features = given
    demands = (
        (is_flat(observations), "a flat Box"),
        (is_flat(actions) and actions.is_bounded(), "a flat Box, bounded below and above"),
        (is_flat(tasks) and tasks.dtype == np.float64, "a Box of shape (task_dim,), dtype float64"),
        (isinstance(features, int | np.integer) and features >= 1, "a whole number from 1 on"),
    )
    wrong = [
        f"{name} must be {what}, but is {value!r}"
        for name, value, (right, what) in zip(names, given, demands, strict=True)
        if not right
    ]
    if not wrong and family.all_tasks is not None:
        all_tasks = np.asarray(family.all_tasks)
        inside = all_tasks.shape[1:] == tasks.shape and all(task in tasks for task in all_tasks)
        if not inside or len(np.unique(all_tasks, axis=0)) < max(1, len(all_tasks)):
            wrong.append(
                f"all_tasks must have shape (n, {tasks.shape[0]}), lie in task_space {tasks} and "
                f"hold every task once, but is {all_tasks.tolist()}"
            )
    if wrong:
        raise TypeError(
            f"the task family {type(family).__name__}: {'; '.join(wrong)}; see poem_envs.TaskFamily"
        )


def is_flat(space: Any) -> bool:
    """Whether a space is a box of vectors."""
    return isinstance(space, spaces.Box) and len(space.shape) == 1


class _FamilyType(ABCMeta):
    """Looks at a family when it is made, whether or not its constructor called the base class's."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        family = super().__call__(*args, **kwargs)
        check_definition(family)
        if not has_display():  # Gymnasium's checker tries every mode that is named
            modes = family.metadata.get("render_modes", ())
            modes = [mode for mode in modes if mode != "human"]
            family.metadata = {**family.metadata, "render_modes": modes}
        return family


class TaskFamily(gym.Env[np.ndarray, np.ndarray], metaclass=_FamilyType):
    """Base class of a single environment whose task is hidden.

    A subclass sets ``observation_space``, ``action_space``, ``task_space``, ``reward_feature_dim``
    and defines three methods; unless its tasks are uniform on ``task_space`` or finitely many
    (``all_tasks``), it defines :meth:`_draw_tasks` too.

    >>> class Walk1D(TaskFamily):
    ...     observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    ...     action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    ...     task_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    ...     reward_feature_dim = 1
    ...
    ...     def _begin_episode(self, rng):  # -> observation
    ...         self.x = rng.normal(0.0, 0.1, size=1)
    ...         return self.x.copy()
    ...
    ...     def _simulate(self, action):  # -> observation, reward features, terminated
    ...         self.x = self.x + 0.1 * action
    ...         return self.x.copy(), self.x.copy(), False
    ...
    ...     def _reward(self, tasks, features):  # elementwise, broadcasting
    ...         return -np.abs(features[..., 0] - tasks[..., 0])
    >>> env = Walk1D()
    >>> _ = env.reset(seed=0)
    >>> _, reward, _, _, info = env.step(np.ones(1, np.float32))
    >>> bool(reward == -abs(info["reward_features"][0] - env.task[0]))
    True

    **The task.** As long as none was chosen, ``reset(seed=...)`` draws one from the family's
    distribution, from a stream of its own that the seed determines, and a reset without a seed
    keeps it. :meth:`set_task` chooses one, from the next reset on, and then no seed draws another;
    so does ``reset(options={"task": task})``. Gymnasium's wrappers forward no ``set_task``:
    ``poem_envs.set_task(env, task)`` reaches through them. None of this touches the random numbers
    of the episode itself, so two tasks see the same start.

    **The info** of every step holds ``"reward_features"``, ``(reward_feature_dim,)`` float64:
    everything that rewards of this family depend on (see :meth:`compute_rewards`).
    A family whose :meth:`_step_info` gives ``"success"``, whether the step reached what the task
    asks for, has ``"is_success"`` there too, as SB3 calls it: whether any step of the episode so
    far did. Training, evaluation and the command line then report success rates.

    :param render_mode: One of ``metadata["render_modes"]``, or None
    :param render_task: Whether rendering shows the hidden task, for a developer who debugs
    """

    observation_space: spaces.Box
    action_space: spaces.Box
    #: Where tasks live: a bounded box of shape ``(task_dim,)``.
    task_space: spaces.Box
    #: Every task of a finite family, ``(n, task_dim)``; None where there are infinitely many.
    all_tasks: np.ndarray | None = None
    #: Number of reward features, the last dimension of ``info["reward_features"]``.
    reward_feature_dim: int
    #: Whether tasks differ in the reward alone, so that trajectories can be relabelled.
    shared_dynamics: bool = True
    metadata: dict[str, Any] = _NothingToRender()  # type: ignore[assignment]
    render_task: bool = False

    # Class attributes, so that a subclass need not call super().__init__.
    _task: np.ndarray | None = None
    _next_task: np.ndarray | None = None
    _elapsed_steps: int = 0
    _episode: int = 0
    _succeeded: bool = False

    def __init__(self, *, render_mode: str | None = None, render_task: bool = False) -> None:
        modes = self.metadata.get("render_modes")
        if render_mode is not None and not modes:
            # a TypeError, upon which SB3's make_vec_env, which always asks, makes it without
            raise TypeError(
                f"render_mode={render_mode!r}: this environment cannot be drawn; its class needs "
                'metadata = {"render_modes": ["rgb_array"]}, and a render()'
            )
        if render_mode not in (None, *(modes or ())):
            raise ValueError(f"render_mode={render_mode!r} is not supported, choose one of {modes}")
        if render_mode == "human" and not has_display():
            raise ValueError("render_mode='human' needs a display; use 'rgb_array' without one")
        self.render_mode = render_mode
        self.render_task = render_task

    @property
    def task(self) -> np.ndarray | None:
        """The task in effect, ``(task_dim,)``; None before the first reset."""
        return None if self._task is None else self._task.copy()

    def set_task(self, task: npt.ArrayLike) -> None:
        """Choose the task, ``(task_dim,)``, of :attr:`task_space`, from the next reset on.

        :raises ValueError: If it has another shape, is not finite or lies outside of the space, or
            is none of a finite family's
        """
        self._next_task = self._checked_tasks(task, self.task_space.shape, "task")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; returns the observation and an empty info.

        :param seed: Makes this and the following episodes reproducible; draws another task, unless
            one was chosen
        :param options: ``{"task": task}`` is short for :meth:`set_task` just before
        """
        if (task := task_option(options, "task")) is not None:
            self.set_task(task)
        super().reset(seed=seed)
        self._episode = 1 if seed is not None else self._episode + 1
        self._elapsed_steps, self._succeeded = 0, False
        if self._next_task is not None:
            self._task = self._next_task
        elif self._task is None or seed is not None:
            self._task = self._sample_task(self.np_random)
        observation = self._begin_episode(self.np_random)
        if self.render_mode == "human":
            self.render()
        return observation, {}

    def step(self, action: npt.ArrayLike) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one step: observation, reward, terminated, truncated (always False, time limits are
        a wrapper's), info.

        :param action: Inside ``action_space``, or refused; a tiny excess (1e-6) is clipped
        :raises ValueError: If the action has another shape or lies outside
        :raises gymnasium.error.ResetNeeded: Before the first reset
        """
        if self._task is None:
            raise ResetNeeded("step() was called before the first reset()")
        action = checked(action, self.action_space, self.action_space.shape, "action")
        self._elapsed_steps += 1
        observation, features, terminated = self._simulate(action)
        reward = float(self.compute_rewards(self._task, features))
        if self.render_mode == "human":
            self.render()
        info = {"reward_features": features, **self._step_info()}
        if "success" in info:
            self._succeeded = self._succeeded or bool(info["success"])
            info["is_success"] = self._succeeded
        return observation, reward, bool(terminated), False, info

    @abstractmethod
    def _begin_episode(self, rng: np.random.Generator) -> np.ndarray:
        """Put the environment into a start state and return its observation, a new array."""

    @abstractmethod
    def _simulate(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """Apply a valid action; new arrays of observation and features, and whether it ended."""

    def _step_info(self) -> dict[str, Any]:
        """Further entries of the info of every step, say ``{"success": True}``; always the same."""
        return {}

    def _describe_episode(self, copy: int = 0) -> str:
        return (
            f"step {self._elapsed_steps} of episode {self._episode} since "
            f"reset(seed={self.np_random_seed})"
        )

    def sample_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw ``(n, task_dim)`` float64 tasks from the family's own distribution with a generator
        (not the environment's own); of a finite family without replacement.

        :raises ValueError: If ``n`` is below 1 or above the number of tasks of a finite family
        """
        if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1:
            raise ValueError(f"n={n!r} must be a whole number, at least 1")
        if self.all_tasks is None:
            return np.asarray(self._draw_tasks(int(n), rng), dtype=np.float64)
        size = len(self.all_tasks)
        if n > size:
            raise ValueError(
                f"n={n} tasks were asked for, but {type(self).__name__} is a finite family of "
                f"{size}; ask for at most {size}"
            )
        return np.asarray(rng.permutation(self.all_tasks)[:n], dtype=np.float64)

    def _sample_task(self, rng: np.random.Generator) -> np.ndarray:
        """A task that a generator's seed determines, without a draw from the generator itself."""
        return self.sample_tasks(1, rng.spawn(1)[0])[0]

    def compute_rewards(self, tasks: npt.ArrayLike, features: npt.ArrayLike) -> np.ndarray:
        """The rewards ``(...)`` float64 that steps with features ``(..., reward_feature_dim)``, as
        in ``info["reward_features"]``, earn in tasks ``(..., task_dim)``, broadcast.

        A pure function: ``step`` returns exactly this for its own task and features, so that a
        trajectory logged in one task can be relabelled for any other.

        :raises ValueError: If a last dimension does not fit
        """
        tasks = np.asarray(tasks, dtype=np.float64)
        features = np.asarray(features, dtype=np.float64)
        task_dim, feature_dim = self.task_space.shape[0], self.reward_feature_dim
        if tasks.shape[-1:] != (task_dim,):
            raise ValueError(f"tasks has shape {tasks.shape}, but must have (..., {task_dim=})")
        if features.shape[-1:] != (feature_dim,):
            needed = f"(..., reward_feature_dim={feature_dim})"
            raise ValueError(f"features has shape {features.shape}, but must have {needed}")
        return np.asarray(self._reward(tasks, features), dtype=np.float64)[()]

    @property
    def has_potential(self) -> bool:
        """Whether the family says how good it is to be somewhere: :meth:`compute_potential`."""
        return type(self)._potential is not TaskFamily._potential

    def compute_potential(self, tasks: npt.ArrayLike, observations: npt.ArrayLike) -> np.ndarray:
        """The reward per step ``(...)`` of staying where observations ``(..., obs_dim)`` show the
        robot, roughly, in tasks ``(..., task_dim)``; by it training can be shaped (Ng, Harada &
        Russell, ICML 1999), which changes how fast policies are learned, not which are best.

        :raises NotImplementedError: If the family defines none (:attr:`has_potential`)
        """
        return self._potential(np.asarray(tasks), np.asarray(observations))

    def _potential(self, tasks: np.ndarray, observations: np.ndarray) -> np.ndarray:
        """Optional, for families whose rewards say where to be rather than how to move."""
        raise NotImplementedError(f"{type(self).__name__} has no _potential(tasks, observations)")

    def visible_difference(self, left: np.ndarray, right: np.ndarray, spread: np.ndarray) -> float:
        """How different two episodes look to a person who watches their films: 1 is what people can
        just tell, below which questions about them are asked less readily.

        By default it is the distance between the means of the reward features, in units of a tenth
        of ``spread``, or the difference of their lengths, in units of a tenth of the longer one,
        whichever is larger. A family whose features are not what its films show overrides it.

        :param left: Reward features ``(steps, reward_feature_dim)``
        :param right: Those of the other episode, which may have another number of steps
        :param spread: ``(reward_feature_dim,)`` the features' standard deviation over all steps of
            the films that the person has seen, and of these two
        """
        means = left.mean(axis=0) - right.mean(axis=0)
        apart = float(np.linalg.norm(means / np.maximum(spread, 1e-12))) / JUST_VISIBLE
        longer = abs(len(left) - len(right)) / max(len(left), len(right)) / JUST_LONGER
        return max(apart, longer)

    @abstractmethod
    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Elementwise operations alone, so that one step and a batch give the same bits."""

    def _draw_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw from an infinite family: uniformly on ``task_space`` unless overridden."""
        space = self.task_space
        if not space.is_bounded():
            raise ValueError(
                "task_space must be bounded, since tasks are drawn uniformly from it, or "
                f"_draw_tasks overridden; it is {space}"
            )
        return rng.uniform(space.low, space.high, size=(n, *space.shape))

    def _checked_tasks(self, tasks: npt.ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
        """``tasks`` as a new float64 array; a ValueError says what is wrong with them."""
        given = checked(tasks, self.task_space, shape, name)
        if self.all_tasks is None:
            return given
        all_tasks = np.asarray(self.all_tasks, dtype=np.float64)
        distance = np.abs(given[..., None, :] - all_tasks).max(axis=-1)
        if (distance.min(axis=-1) > BOUNDS_TOLERANCE).any():
            raise ValueError(
                f"{name}={given.tolist()} is not among this family's tasks, which are "
                f"{all_tasks.tolist()}"
            )
        return all_tasks[distance.argmin(axis=-1)]


def task_option(options: dict[str, Any] | None, name: str) -> Any:
    """The one option that a reset knows, or None; refuses others."""
    unknown = sorted(set(options or {}) - {name})
    if unknown:
        raise ValueError(f"options={options!r} of reset holds unknown keys {unknown}, not {name!r}")
    return (options or {}).get(name)


def checked(
    values: npt.ArrayLike, space: spaces.Box, shape: tuple[int, ...], name: str
) -> np.ndarray:
    """One vector of a space, or many ``(n, dim)``, as a new float64 array inside its bounds; a
    ValueError says which is wrong.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}={values!r} is no array of numbers of shape {shape}") from error
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    clipped = np.clip(array, low, high)
    acceptable = np.abs(array - clipped) <= BOUNDS_TOLERANCE  # false for NaN
    if acceptable.all():
        return clipped
    *row, component = map(int, np.argwhere(~acceptable)[0])
    raise ValueError(
        f"{name}{row or ''} is {array[(*row, component)]} at component {component}, but must be "
        f"finite and inside [{low[component]:g}, {high[component]:g}]"
    )
