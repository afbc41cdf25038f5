"""What an algorithm needs to know of a task family, asked of any SB3 ``VecEnv`` of it."""

from typing import TYPE_CHECKING, Any

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from poem_envs.family import Symmetry, definition_problem
from sb3_poem.common.wrappers import WrapperError, unknown_wrappers

if TYPE_CHECKING:
    from sb3_poem.common.buffers import Segment

# Arguments that change how an environment is drawn, not what it is.
DRAWING_ARGUMENTS = {"render_mode", "render_task"}
REQUIRED_ATTRIBUTES = ("task_space", "all_tasks", "shared_dynamics", "reward_feature_dim")
#: Steps by which it is seen whether a wrapper changes a family
COMPARED_STEPS = 10


def no_family(env: str) -> str:
    """What to say of an environment that is no task family.

    :param env: How it describes itself
    """
    return (
        f"env {env} is no task family: an environment whose reward depends on a hidden task. "
        "Subclass poem_envs.TaskFamily, or make one of a goal-conditioned environment by "
        "poem_envs.GoalFamily; docs/families.md has both as complete programs, and "
        "poem_envs.testing.check_task_family says what is missing"
    )


class FamilyEnv:
    """View of a vectorised environment as a task family.

    :param env: Vectorised environment whose copies are :class:`poem_envs.TaskFamily` environments.
        Wrappers that change what is seen, done or paid are refused: those of Gymnasium and SB3 by
        name, others by the first experience, see :meth:`check_experience`
    :param horizon: Steps of an episode; None reads the time limit of the environment's registration
    :raises ValueError: if the environment is no task family, a wrapper changes it, or no horizon is
        known
    """

    task_space: spaces.Box
    reward_feature_dim: int

    def __init__(self, env: VecEnv, horizon: int | None = None) -> None:
        self.env = env
        name = str(env.env_method("__str__", indices=[0])[0])
        missing = [attribute for attribute in REQUIRED_ATTRIBUTES if not env.has_attr(attribute)]
        if "shared_dynamics" in missing:  # which a subclass of TaskFamily has without a word
            raise ValueError(no_family(name))
        attributes: list[Any] = [None if attribute in missing else self._get(attribute) for attribute in REQUIRED_ATTRIBUTES]
        task_space, self.all_tasks, shared_dynamics, feature_dim = attributes
        self._unknown_wrappers = ", ".join(unknown_wrappers(env))
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.task_space, self.reward_feature_dim = task_space, feature_dim
        problem = definition_problem(self)
        if problem is not None:
            raise ValueError(f"env {name}: {problem}")
        self.shared_dynamics = bool(shared_dynamics)
        self.symmetries: tuple[Symmetry, ...] = self._get("symmetries") if env.has_attr("symmetries") else ()
        spec = self._get("spec") if env.has_attr("spec") else None
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
        self._experience_is_right = False

    def check_experience(self, tasks: np.ndarray, seed: int, segment: "Segment") -> None:
        """Whether rewards are :meth:`compute_rewards`'s, and unknown wrappers leave the family as it is.
        The first call looks, and the others take its word.

        :param tasks: (copies, task_dim), those of the segment
        :param seed: Of the reset that it began with
        :param segment: Experience of all copies
        :raises ValueError: if not
        """
        if self._experience_is_right:
            return
        wrappers = self._unknown_wrappers
        expected = self.compute_rewards(tasks[:, None, :], segment.features)
        if expected.shape != segment.rewards.shape:
            raise ValueError(
                f"compute_rewards must give tasks {tasks[:, None, :].shape} and features "
                f"{segment.features.shape} rewards of shape {segment.rewards.shape}, but gave "
                f"{expected.shape}: in _reward index the last dimension, as in tasks[..., i]"
            )
        wrong = np.argwhere(~np.isclose(segment.rewards, expected, rtol=1e-5, atol=1e-6))
        if len(wrong):
            copy, step = wrong[0]
            what = (
                f"env paid {segment.rewards[copy, step]:.6g} at step {step} of copy {copy}, but "
                f'compute_rewards(task, info["reward_features"]) is {expected[copy, step]:.6g}'
            )
            if wrappers:
                raise WrapperError(f"{what}, by one of its wrappers {wrappers}")
            raise ValueError(f"{what}; poem_envs.testing.check_task_family says what to change")
        if wrappers and not self._lives_through(tasks[0], seed, segment):
            raise WrapperError(f"env's wrappers {wrappers} change what is seen or done")
        self._experience_is_right = True

    def _lives_through(self, task: np.ndarray, seed: int, segment: "Segment") -> bool:
        """Whether the family without its wrappers repeats the first copy's experience."""
        if self.env_id is None:
            try:
                twin = cloudpickle.loads(cloudpickle.dumps(self._get("unwrapped")))
            except Exception as error:
                raise WrapperError(
                    f"whether env's wrappers {self._unknown_wrappers} change it cannot be told without "
                    f"a copy of env, which {type(error).__name__} prevents ({error}): register it"
                ) from error
        else:
            twin = gym.make(self.env_id, disable_env_checker=True, **self.env_kwargs).unwrapped
        low, high = twin.action_space.low, twin.action_space.high
        twin.set_task(task)
        seen = [twin.reset(seed=seed)[0]]
        steps = min(COMPARED_STEPS, int(segment.first_episode[0].sum()))
        for action in segment.actions[0, :steps]:
            action = np.clip(low + 0.5 * (action + 1.0) * (high - low), low, high)
            seen.append(twin.step(action)[0])
        twin.close()
        shown = [segment.observations[0, 0], *segment.next_observations[0, :steps]]
        return np.allclose(np.array(seen, dtype=np.float32), shown, rtol=1e-4, atol=1e-4)

    @property
    def num_envs(self) -> int:
        return self.env.num_envs

    @property
    def task_dim(self) -> int:
        return int(self.task_space.shape[0])

    def _get(self, name: str) -> Any:
        return self.env.get_attr(name, indices=[0])[0]

    def sample_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw (n, task_dim) tasks from the family's distribution."""
        return np.asarray(self.env.env_method("sample_tasks", n, rng, indices=[0])[0], dtype=np.float64)

    def compute_rewards(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Rewards (...) of reward features (..., feat_dim) under tasks (..., task_dim)."""
        return np.asarray(self.env.env_method("compute_rewards", tasks, features, indices=[0])[0])

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
