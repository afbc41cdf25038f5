"""Goal-conditioned environments as task families: the desired goal becomes the hidden task."""

import contextlib
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from poem_envs.family import BOUNDS_TOLERANCE, TaskFamily, is_flat
from poem_envs.mujoco_rendering import prepared_viewer

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
#: Wrappers whose work is done anyway; by name, since rl_zoo3 replaces Gymnasium's TimeLimit
TAKEN_OFF = frozenset({"TimeLimit", "OrderEnforcing", "PassiveEnvChecker"})
REWARD = "compute_reward(achieved_goal, desired_goal, info)"
SetGoal = Callable[[gym.Env, np.ndarray], None]


class GoalFamily(TaskFamily):
    """The task family of a goal-conditioned environment, such as those of gymnasium-robotics.

    The environment must be what HER takes: observations are a dictionary of ``"observation"``,
    ``"achieved_goal"`` and ``"desired_goal"``, and ``compute_reward(achieved_goal, desired_goal,
    info)`` is its reward, sparse or dense. Then

    - the observation is ``"observation"``, and ``"achieved_goal"`` behind it if asked for;
      ``"desired_goal"`` is left out;
    - a task is a desired goal, drawn as the environment's own reset draws it;
    - the reward features are the achieved goal, and rewards of any task are ``compute_reward`` of
      it;
    - ``"is_success"`` or ``"success"`` of the environment's info is the family's ``"success"``.

    >>> env = GoalFamily("gymnasium_robotics:FetchSlide-v4")
    >>> env.observation_space.shape, env.task_space.shape, env.max_episode_steps
    ((28,), (3,), 50)

    So that an id makes it::

        slide = {"env": "gymnasium_robotics:FetchSlide-v4"}
        gym.register("my/FetchSlide-v0", entry_point=GoalFamily, kwargs=slide)

    The environment's resets must depend on their seed alone. Its time limit is the family's too
    (:attr:`max_episode_steps`), unless the family is registered with another or ``gym.make`` is
    given one. Other wrappers than those of ``gym.make`` are refused.

    :param env: An id, or a function that makes the environment. ``"module:id"`` names the module
        that registers it, which processes of :class:`~poem_envs.TaskFamilyVector` need to know
    :param observe_achieved_goal: Whether the observation holds the achieved goal, which is needed
        unless ``"observation"`` says where the agent is by itself
    :param set_goal: Gives the environment a goal after its reset, so that its own info and images
        follow it: called as ``set_goal(env.unwrapped, goal)``; None sets the attribute ``goal``, as
        gymnasium-robotics has it
    :param goal_low: Lower bounds of the goals, ``(goal_dim,)``; None takes those of
        ``desired_goal``
    :param goal_high: Upper bounds
    :param render_task: Whether rendering shows the goal. If not, MuJoCo sites that mark it are made
        invisible, and whatever else is drawn for it is drawn at the achieved goal
    :param env_kwargs: Further arguments of the environment
    :raises ValueError: If the environment is not goal-conditioned, or wrapped
    """

    metadata = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012 (Gymnasium declares it so)
    #: The time limit of the environment; None if it has none.
    max_episode_steps: int | None = None
    _spec: EnvSpec | None = None

    def __init__(
        self,
        env: str | Callable[..., gym.Env],
        *,
        observe_achieved_goal: bool = True,
        set_goal: SetGoal | None = None,
        goal_low: npt.ArrayLike | None = None,
        goal_high: npt.ArrayLike | None = None,
        render_mode: str | None = None,
        render_task: bool = False,
        **env_kwargs: Any,
    ) -> None:
        if isinstance(env, gym.Env):
            raise ValueError(
                f"env={env} is an environment, but goals are drawn from a second copy of it: pass "
                "its id, or a function that makes it"
            )
        if render_mode is not None:
            env_kwargs["render_mode"] = render_mode
        self._source, self._env_kwargs = env, env_kwargs
        self._set_goal_function = set_goal
        self._observed = GOAL_KEYS[: 1 + observe_achieved_goal]
        self._goal_env: gym.Env | None = None
        self._success: Any = None
        self._achieved_goal = np.zeros(0)
        self.env = self._make()
        self.metadata = {**self.env.metadata}
        super().__init__(render_mode=render_mode, render_task=render_task)
        own: Any = self.env.observation_space  # a Dict of flat boxes, as check_goal_env saw to
        goal = own["desired_goal"]
        low = goal.low if goal_low is None else goal_low
        high = goal.high if goal_high is None else goal_high
        low, high = (np.broadcast_to(np.array(b, np.float64), goal.shape) for b in (low, high))
        self.task_space = spaces.Box(low, high, dtype=np.float64)
        self.reward_feature_dim = goal.shape[0]
        boxes = [(own[key].low, own[key].high) for key in self._observed]
        low, high = (np.concatenate(b).astype(np.float64) for b in zip(*boxes, strict=True))
        self.observation_space = spaces.Box(low, high, dtype=np.float64)
        self.action_space = self.env.action_space  # type: ignore[assignment]  # see check_goal_env
        self._rewards_broadcast = self._check_reward()

    def _make(self) -> gym.Env:
        if "gymnasium_robotics" in (str(self._source).partition(":")[0], *sys.modules):
            _mend_joint_access()
        if isinstance(self._source, str):
            env = gym.make(self._source, disable_env_checker=True, **self._env_kwargs)
        else:
            env = self._source(**self._env_kwargs)
        check_goal_env(env)
        # The family checks actions itself, and a time limit of its own ends episodes.
        wrapper = env
        while isinstance(wrapper, gym.Wrapper):
            if TAKEN_OFF.isdisjoint(kind.__name__ for kind in type(wrapper).__mro__):
                raise ValueError(
                    f"env makes {env}: its {type(wrapper).__name__} would have no effect, since "
                    "the family steps the environment inside all wrappers. Make it without, or put "
                    "what it does into the environment itself"
                )
            self.max_episode_steps = getattr(wrapper, "_max_episode_steps", self.max_episode_steps)
            wrapper = wrapper.env
        return wrapper

    @property  # type: ignore[override]
    def spec(self) -> EnvSpec | None:
        """How the family is registered; None if it was not made by ``gym.make``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # gym.make sets this before it looks for the registration's time limit.
        self._spec = spec
        registered = None if spec is None else gym.registry.get(spec.id)
        if registered is not None and registered.max_episode_steps is None:
            registered.max_episode_steps = self.max_episode_steps

    def step(self, action: npt.ArrayLike) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """See :class:`TaskFamily`; not made by ``gym.make``, it keeps its time limit itself."""
        observation, reward, terminated, _, info = super().step(action)
        truncated = self._spec is None and self._elapsed_steps >= (self.max_episode_steps or np.inf)
        return observation, reward, terminated, truncated, info

    def _check_reward(self) -> bool:
        """Whether ``compute_reward``, which it tries, takes many goals at once."""
        goals = self._goals_of_resets(self.env, range(2))
        try:
            one_by_one = [self._own_reward(goals[i : i + 1], goals[:1]) for i in range(2)]
        except Exception as error:
            raise ValueError(
                f"{self.env}: {REWARD} fails for goals of shape (1, {goals.shape[1]}) and an empty "
                f"info: {type(error).__name__}: {error}. It must be a function of the two goals"
            ) from error
        self._place_goal(goals[0])
        try:
            together = self._own_reward(goals, goals[[0, 0]])
        except Exception:
            return False
        return together.shape == (2,) and np.array_equal(together, np.concatenate(one_by_one))

    def _own_reward(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        compute_reward: Callable[..., Any] = self.env.compute_reward  # type: ignore[attr-defined]
        return np.atleast_1d(np.asarray(compute_reward(achieved, desired, {}), dtype=np.float64))

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        tasks, features = np.broadcast_arrays(tasks, features)
        desired = np.ascontiguousarray(tasks).reshape(-1, tasks.shape[-1])
        achieved = np.ascontiguousarray(features).reshape(desired.shape)
        if self._rewards_broadcast:
            rewards = self._own_reward(achieved, desired)
        else:
            pairs = zip(achieved[:, None], desired[:, None], strict=True)
            rewards = np.array([self._own_reward(*pair)[0] for pair in pairs])
        return rewards.reshape(tasks.shape[:-1])

    def _draw_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        if self._goal_env is None:
            self._goal_env = self._make()
        return self._goals_of_resets(self._goal_env, rng.integers(2**31, size=n).tolist())

    def _goals_of_resets(self, env: gym.Env, seeds: Iterable[int]) -> np.ndarray:
        """The goals that the environment draws itself, ``(seeds, goal_dim)``."""
        drawn = [env.reset(seed=seed)[0]["desired_goal"] for seed in seeds]
        goals, space = np.stack(drawn).astype(np.float64), self.task_space
        low, high = space.low - BOUNDS_TOLERANCE, space.high + BOUNDS_TOLERANCE
        outside = ((goals < low) | (goals > high)).any(axis=1)
        if outside.any():
            raise ValueError(
                f"goal_low and goal_high span {space}, but {self.env} draws the goal "
                f"{goals[outside][0].tolist()}; widen them"
            )
        return goals

    def _place_goal(self, goal: np.ndarray) -> None:
        if self._set_goal_function is not None:
            self._set_goal_function(self.env, goal.copy())
            return
        if not hasattr(self.env, "goal"):
            raise ValueError(
                f"{self.env} has no attribute 'goal' to set; pass set_goal=f, a function that "
                "gives the environment a goal: f(env, goal)"
            )
        self.env.goal = goal.astype(np.asarray(self.env.goal).dtype)
        if hasattr(self.env, "update_target_site_pos"):
            self.env.update_target_site_pos()

    def _observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate([observation[key] for key in self._observed]).astype(np.float64)

    def _begin_episode(self, rng: np.random.Generator) -> np.ndarray:
        assert self._task is not None
        observation, _ = self.env.reset(seed=int(rng.integers(2**31)))
        self._place_goal(self._task)
        self._success, self._achieved_goal = None, observation["achieved_goal"].copy()
        return self._observation(observation)

    def _simulate(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        action = action.astype(self.action_space.dtype)
        observation, reward, terminated, _, info = self.env.step(action)
        features = observation["achieved_goal"].astype(np.float64)
        self._check_step(observation["desired_goal"], features, float(reward))
        self._success = info.get("success", info.get("is_success"))
        self._achieved_goal = observation["achieved_goal"].copy()
        return self._observation(observation), features, bool(terminated)

    def _check_step(self, shown_goal: np.ndarray, features: np.ndarray, reward: float) -> None:
        assert self._task is not None
        if not np.allclose(shown_goal, self._task, rtol=0.0, atol=1e-5):
            raise RuntimeError(
                f"{self.env} was given the goal {self._task}, but {self._describe_episode()} shows "
                f"the desired goal {shown_goal}: the goal must stay for the whole episode (in "
                "gymnasium-robotics' mazes: reset_target=False), and set_goal must set what "
                "'desired_goal' shows"
            )
        expected = float(self._reward(self._task, features))
        if not np.isclose(reward, expected, rtol=1e-4, atol=1e-5):
            raise RuntimeError(
                f"{self.env} gave the reward {reward} at {self._describe_episode()}, but its "
                f"{REWARD} gives {expected}: rewards must depend on the two goals alone to be "
                "relabelled"
            )

    def _step_info(self) -> dict[str, Any]:
        return {} if self._success is None else {"success": bool(self._success)}

    def render(self) -> Any:
        if self._task is None:
            raise RuntimeError("render() was called before the first reset()")
        renderer = renderer_inside(self.env)
        if renderer is not None and self.render_mode is not None:
            prepared_viewer(renderer, self.render_mode)
        with unchanged_physics(self.env):
            if self.render_task:
                return self.env.render()
            hide_goal_sites(self.env)
            self._place_goal(self._achieved_goal)
            try:
                return self.env.render()
            finally:
                self._place_goal(self._task)

    def close(self) -> None:
        for env in (self.env, self._goal_env):
            if env is not None:
                env.close()
        self._goal_env = None


def renderer_inside(env: Any) -> Any:
    """The ``MujocoRenderer`` of a bare environment, which mazes keep one deeper, if it has one."""
    holders = (env, getattr(env, "ant_env", None), getattr(env, "point_env", None))
    renderers = (getattr(holder, "mujoco_renderer", None) for holder in holders)
    return next((renderer for renderer in renderers if renderer is not None), None)


@contextlib.contextmanager
def unchanged_physics(env: gym.Env) -> Iterator[None]:
    """Put a MuJoCo environment back afterwards: some let a rendering change the warm start."""
    model, data = getattr(env, "model", None), getattr(env, "data", None)
    if model is None or data is None:
        yield
        return
    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data, state, spec)
    try:
        yield
    finally:
        mujoco.mj_setState(model, data, state, spec)


def hide_goal_sites(env: gym.Env) -> None:
    """Make the sites invisible by which MuJoCo environments of gymnasium-robotics mark the goal."""
    model: Any = getattr(env, "model", None)
    for site in range(0 if model is None else model.nsite):
        if model.site(site).name.startswith("target"):
            model.site(site).rgba[3] = 0.0


def _mend_joint_access() -> None:
    """Let gymnasium-robotics 1.4 know hinges and slides under MuJoCo 3.12 and newer, where the
    test by which it does, ``number in (enumeration, ...)``, is false.
    """
    if mujoco.mjtJoint.mjJNT_HINGE == np.int32(mujoco.mjtJoint.mjJNT_HINGE):
        return
    from gymnasium_robotics.utils import mujoco_utils

    def mend(kind: str) -> None:
        def get_joint(model: Any, data: mujoco.MjData, name: str) -> np.ndarray:
            return getattr(data.joint(name), kind).copy()

        def set_joint(model: Any, data: mujoco.MjData, name: str, value: npt.ArrayLike) -> None:
            getattr(data.joint(name), kind)[:] = value

        setattr(mujoco_utils, f"get_joint_{kind}", get_joint)
        setattr(mujoco_utils, f"set_joint_{kind}", set_joint)

    mend("qpos")
    mend("qvel")


def check_goal_env(env: gym.Env) -> None:
    """Refuse what is no goal-conditioned environment, and say what is needed."""
    bare, space = env.unwrapped, env.observation_space
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    if not set(GOAL_KEYS) <= set(parts):
        found = f"a Dict of {sorted(parts)}" if parts else str(space)
        raise ValueError(
            f"{bare} is not goal-conditioned: its observation space must be a Dict of "
            f"{', '.join(map(repr, GOAL_KEYS))}, but is {found}"
        )
    for key in GOAL_KEYS:
        if not is_flat(parts[key]):
            raise ValueError(f"{bare}: the space of {key!r} must be a flat Box, not {parts[key]}")
    achieved, desired = parts["achieved_goal"].shape, parts["desired_goal"].shape
    if achieved != desired:
        raise ValueError(
            f"{bare}: 'achieved_goal' and 'desired_goal' must have the same shape, but have "
            f"{achieved} and {desired}"
        )
    if not isinstance(env.action_space, spaces.Box):
        raise ValueError(f"{bare}: the action space must be a Box, but is {env.action_space}")
    if not callable(getattr(bare, "compute_reward", None)):
        raise ValueError(
            f"{bare} has no {REWARD}, by which rewards of other goals are computed; define it as "
            "gymnasium_robotics.core.GoalEnv does"
        )
