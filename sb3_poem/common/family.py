"""What an algorithm needs to know of a task family, asked of any SB3 ``VecEnv`` of it."""

import importlib
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_wrapper

from poem_envs import Symmetry


def plain_id(env_id: str) -> str:
    """An environment's id as the registry has it.

    :param env_id: As for ``gym.make``: an id, or ``"module:id"``, whose module is imported first
    :raises ModuleNotFoundError: if there is no such module
    """
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    return name


# Arguments that change how an environment is drawn, not what it is.
DRAWING_ARGUMENTS = {"render_mode", "render_task"}
REQUIRED_ATTRIBUTES = ("task_space", "all_tasks", "shared_dynamics", "reward_feature_dim")


class FamilyEnv:
    """View of a vectorised environment as a task family.

    :param env: Vectorised environment whose copies are :class:`poem_envs.TaskFamily` environments
    :param horizon: Steps of an episode; None reads the time limit of the environment's registration
    :raises ValueError: if the environment is no task family, is wrapped in ``VecNormalize``, or no horizon is known
    """

    def __init__(self, env: VecEnv, horizon: int | None = None) -> None:
        if unwrap_vec_wrapper(env, VecNormalize) is not None:
            raise ValueError(
                "env must not be wrapped in VecNormalize: the model standardises observations itself, and relabelling "
                "needs rewards as they are. Pass the environment without it (in YAML: no `normalize`)."
            )
        if not isinstance(env.observation_space, spaces.Box) or len(env.observation_space.shape) != 1:
            raise ValueError(f"env must have a flat Box observation space, got {env.observation_space}")
        if not isinstance(env.action_space, spaces.Box) or not env.action_space.is_bounded():
            raise ValueError(f"env must have a bounded Box action space, got {env.action_space}")
        self.env = env
        self.task_space: spaces.Box = self._get("task_space")
        self.all_tasks: np.ndarray | None = self._get("all_tasks")
        self.shared_dynamics = bool(self._get("shared_dynamics"))
        self.reward_feature_dim = int(self._get("reward_feature_dim"))
        self.symmetries: tuple[Symmetry, ...] = self._get("symmetries") if env.has_attr("symmetries") else ()
        spec = self._get("spec")
        self.env_id: str | None = None if spec is None else spec.id
        given: dict[str, Any] = {} if spec is None else spec.kwargs
        registered = gym.registry[spec.id].kwargs if spec is not None and spec.id in gym.registry else {}
        #: What it was made with beyond its registration
        self.env_kwargs = {
            name: value
            for name, value in given.items()
            if name not in DRAWING_ARGUMENTS and not (name in registered and _equal(registered[name], value))
        }
        limit = None if spec is None else spec.max_episode_steps
        if limit is None and env.has_attr("max_episode_steps"):  # of a GoalFamily that was not made by gym.make
            limit = self._get("max_episode_steps")
        steps = horizon if limit is None else limit
        if steps is None:
            raise ValueError("horizon is unknown: register the environment with max_episode_steps, or pass horizon=<steps>")
        if horizon is not None and horizon != steps:
            raise ValueError(f"horizon is {horizon}, but the environment ends episodes after {limit} steps; they must agree")
        if steps < 1:
            raise ValueError(f"horizon must be at least 1 step, got {steps}")
        self.horizon = int(steps)

    @property
    def num_envs(self) -> int:
        return self.env.num_envs

    @property
    def task_dim(self) -> int:
        return int(self.task_space.shape[0])

    def _get(self, name: str) -> Any:
        if self.env.has_attr(name):  # asking for what is not there would end a worker of SubprocVecEnv
            return self.env.get_attr(name, indices=[0])[0]
        if name == "spec":
            return None
        raise ValueError(
            f"env is no task family: it has no attribute {name!r}. A task family subclasses poem_envs.TaskFamily, "
            f"which provides {', '.join(REQUIRED_ATTRIBUTES)}, sample_tasks, set_task and compute_reward."
        )

    def sample_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw (n, task_dim) tasks from the family's distribution."""
        return np.asarray(self.env.env_method("sample_tasks", n, rng, indices=[0])[0], dtype=np.float64)

    def compute_reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Rewards (...) of reward features (..., feat_dim) under tasks (..., task_dim)."""
        return np.asarray(self.env.env_method("compute_reward", tasks, features, indices=[0])[0])

    @property
    def has_potential(self) -> bool:
        """Whether the family has :meth:`compute_potential`."""
        return self.env.has_attr("has_potential") and bool(self._get("has_potential"))

    def compute_potential(self, tasks: np.ndarray, observations: np.ndarray) -> np.ndarray:
        """Potentials (...) of observations (..., obs_dim) under tasks (..., task_dim)."""
        return np.asarray(self.env.env_method("compute_potential", tasks, observations, indices=[0])[0])

    def set_tasks(self, tasks: np.ndarray) -> None:
        """Give copy i the task ``tasks[i]``, from its next reset on."""
        inner: Any = self.env
        while not hasattr(inner, "set_tasks") and hasattr(inner, "venv"):
            inner = inner.venv
        if hasattr(inner, "set_tasks"):
            inner.set_tasks(tasks)
        else:
            for index, task in enumerate(tasks):
                self.env.env_method("set_task", task, indices=[index])

    def reset(self, tasks: np.ndarray, seed: int) -> np.ndarray:
        """Start an episode of ``tasks[i]`` in each copy i, reproducibly; returns observations (num_envs, obs_dim)."""
        self.set_tasks(tasks)
        self.env.seed(seed)
        obs = self.env.reset()
        assert isinstance(obs, np.ndarray)
        return obs

    def features_of(self, infos: list[dict[str, Any]]) -> np.ndarray:
        """Reward features (num_envs, feat_dim) of the last step."""
        inner: Any = self.env
        while not hasattr(inner, "last_reward_features") and hasattr(inner, "venv"):
            inner = inner.venv
        if hasattr(inner, "last_reward_features"):
            return inner.last_reward_features
        return np.stack([info["reward_features"] for info in infos])

    def check_same_family(self, task_space: spaces.Box, reward_feature_dim: int) -> None:
        """
        :raises ValueError: if a model that was made for another family is given this environment
        """
        if self.task_space != task_space or self.reward_feature_dim != reward_feature_dim:
            raise ValueError(
                f"the model was trained for tasks in {task_space} with {reward_feature_dim} reward features, but "
                f"env ({self.env_id}) has tasks in {self.task_space} with {self.reward_feature_dim}. "
                "Pass an environment of the model's own family."
            )


def _equal(one: Any, other: Any) -> bool:
    """Whether two arguments are the same, of what can be told so; a dictionary may hold arrays."""
    return one is other or (not isinstance(other, dict) and np.array_equal(one, other))
