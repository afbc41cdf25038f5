"""What an algorithm needs to know of a task family, asked of any SB3 ``VecEnv`` of it."""

import re
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common import vec_env as sb3_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_poem.common.buffers import Segment
from sb3_poem.common.checks import check_whole

# Arguments that change how an environment is drawn, not what it is.
DRAWING_ARGUMENTS = {
    *("render_mode", "render_task", "render_quality", "max_geom", "camera_name"),
    "default_camera_config",
}
#: Test tasks have a stream of their own: no seed gives the tasks of a training
TEST_TASK_STREAM = 0x7E57
#: Steps by which it is seen whether a wrapper changes a family
COMPARED_STEPS = 10

#: These leave alone what is seen, done and paid; the patched one is rl_zoo3's.
HARMLESS = frozenset(
    {
        *("HumanRendering", "Monitor", "OrderEnforcing", "PassiveEnvChecker", "PatchedTimeLimit"),
        *("RecordEpisodeStatistics", "RecordVideo", "RenderCollection", "TimeLimit"),
        *("VecCheckNan", "VecMonitor", "VecVideoRecorder"),
    }
)
#: All others of Gymnasium and Stable-Baselines3 may change it, as may these kinds.
CHANGING = frozenset({*gym.wrappers.__all__, *sb3_vec_env.__all__}) - HARMLESS
CHANGING_KINDS = (gym.ObservationWrapper, gym.RewardWrapper, gym.ActionWrapper)


class WrapperError(ValueError):
    """Something stands between a family and the model, and changes what is seen, done or paid."""

    def __init__(self, what: str) -> None:
        super().__init__(
            f"{what}: the model standardises observations and rewards itself, and relabels rewards "
            "by the family's own function. Pass the environment without it (in YAML: no "
            "`normalize`, `frame_stack`, `env_wrapper`, `vec_env_wrapper`), or change the family "
            "itself"
        )


def no_family(env: str) -> str:
    """What to say of an environment that is no task family, but describes itself so."""
    return (
        f"env {env} is no task family: an environment whose reward depends on a hidden task. "
        "Subclass poem_envs.TaskFamily, or make one of a goal-conditioned environment by "
        "poem_envs.GoalFamily; docs/guides/families.md has both as complete programs, and "
        "poem_envs.testing.check_task_family says what is missing"
    )


class FamilyView:
    """A vectorised :class:`poem_envs.TaskFamily`, whatever its class: the one way to ask it."""

    #: Steps of an episode, of a family that training can use (:meth:`for_training`)
    horizon: int

    def __init__(self, env: VecEnv) -> None:
        if not env.has_attr("shared_dynamics"):  # which a subclass of TaskFamily has without a word
            raise ValueError(no_family(env.env_method("__str__", indices=[0])[0]))
        self.env, self.num_envs = env, env.num_envs
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.task_space: spaces.Box = self._get("task_space")
        self.task_dim = int(self.task_space.shape[0])
        self.reward_feature_dim: int = self._get("reward_feature_dim")
        self.all_tasks: np.ndarray | None = self._get("all_tasks")
        self.shared_dynamics = bool(self._get("shared_dynamics"))
        #: Whether the family has :meth:`compute_potential`
        self.has_potential = bool(self._get("has_potential"))
        self.spec: EnvSpec | None = self._get("spec")
        #: Of its registration
        self.env_id = None if self.spec is None else self.spec.id
        self._unknown_wrappers = ""
        self._experience_is_right = False

    @classmethod
    def of(cls, env: VecEnv) -> "FamilyView | None":
        """The family of an environment; None if it is of none."""
        return cls(env) if env.has_attr("shared_dynamics") else None

    @classmethod
    def for_training(cls, env: VecEnv, horizon: int | None = None) -> "FamilyView":
        """The same of what can be trained on: an episode's length is known, no wrapper changes what
        is seen, done or paid: those of Gymnasium and SB3 are refused by name, others by the first
        experience, see :meth:`check_experience`.

        :param horizon: Steps of an episode; None reads the time limit of the registration, or of a
            ``TimeLimit``
        """
        family = cls(env)
        family._unknown_wrappers = ", ".join(family.unknown_wrappers())
        family.horizon = family._horizon(horizon)
        return family

    def _horizon(self, horizon: int | None) -> int:
        limit = None if self.spec is None else self.spec.max_episode_steps
        if limit is None:  # a GoalFamily that was not made by gym.make
            limit = self._get("max_episode_steps")
        steps = horizon if limit is None else limit
        if steps is None:
            steps = self._get("_max_episode_steps")  # of a TimeLimit
        if steps is None:
            raise ValueError(
                "horizon is unknown: register the environment with max_episode_steps, or pass "
                "horizon=<steps>"
            )
        if horizon is not None and horizon != steps:
            raise ValueError(
                f"horizon is {horizon}, but the environment ends episodes after {limit} steps; "
                "they must agree"
            )
        check_whole("horizon", steps, 1)
        return int(steps)

    @cached_property
    def env_kwargs(self) -> dict[str, Any]:
        """What it was made with beyond its registration, and beyond how it is drawn."""
        own = {} if self.spec is None else dict(self.spec.kwargs)
        registered = gym.registry[self.env_id].kwargs if self.env_id in gym.registry else {}
        for name, value in registered.items():
            if name in own and _equal(value, own[name]):
                del own[name]
        return {name: value for name, value in own.items() if name not in DRAWING_ARGUMENTS}

    def unknown_wrappers(self) -> list[str]:
        """The names of wrappers that may change the family; refuses those that are known to."""
        env, names = self.env, self._wrapper_names()
        changing = [name for name in names if name in CHANGING]
        changing += [kind.__name__ for kind in CHANGING_KINDS if any(env.env_is_wrapped(kind))]
        if changing:
            wrappers = ", ".join(names)
            raise WrapperError(f"env must not be wrapped in {changing[0]} (it is in: {wrappers})")
        unknown = [name for name in names if name not in HARMLESS]
        for space in ("observation_space", "action_space") if unknown else ():
            own, given = getattr(self._get("unwrapped"), space), getattr(env, space)
            if own != given:
                raise WrapperError(
                    f"env's wrappers ({', '.join(names)}) must leave {space} {own}, but make it "
                    f"{given}"
                )
        return unknown

    def _wrapper_names(self) -> list[str]:
        """Of the wrappers around the environment and around its copies, outermost first."""
        env, names = self.env, []
        while isinstance(env, VecEnvWrapper):
            names.append(type(env).__name__)
            env = env.venv
        for chain in dict.fromkeys(env.env_method("__str__")):  # which SubprocVecEnv gives too
            words = re.findall(r"<([^<>]+)", chain)
            names += words[: -1 if words and words[-1].endswith(" instance") else -2]
        return list(dict.fromkeys(names))

    def check_experience(self, tasks: np.ndarray, seed: int, segment: Segment) -> None:
        """Refuse rewards that are not :meth:`compute_rewards`'s, and unknown wrappers that change
        the family, by a segment of these tasks (copies, task_dim) from a reset with this seed. The
        first call looks, and the others take its word.
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

    def _lives_through(self, task: np.ndarray, seed: int, segment: Segment) -> bool:
        """Whether the family without its wrappers repeats the first copy's experience."""
        if self.env_id is None:
            try:
                twin = cloudpickle.loads(cloudpickle.dumps(self._get("unwrapped")))
            except Exception as error:
                raise WrapperError(
                    f"whether env's wrappers {self._unknown_wrappers} change it cannot be told "
                    f"without a copy of env, which {type(error).__name__} prevents ({error}): "
                    "register it"
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
    def task(self) -> np.ndarray:
        """(task_dim,), the one in effect in the first copy."""
        task = self._get("task")
        if task is None:
            raise RuntimeError(
                "the environment has no task before its first reset(): reset it, or give the "
                "oracle its `task`"
            )
        return np.asarray(task, dtype=np.float64)

    @property
    def render_fps(self) -> float:
        """Frames of a second of its films."""
        return float(self._get("metadata").get("render_fps", 20))

    def _get(self, name: str) -> Any:
        return self.env.get_attr(name, indices=[0])[0] if self.env.has_attr(name) else None

    def _call(self, method: str, *arguments: Any, dtype: Any = np.float64) -> np.ndarray:
        return np.asarray(self.env.env_method(method, *arguments, indices=[0])[0], dtype=dtype)

    def sample_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw (n, task_dim) tasks from the family's distribution."""
        return self._call("sample_tasks", n, rng)

    def test_tasks(self, n: int, seed: int) -> np.ndarray:
        """(n, task_dim) tasks that no training draws; a finite family's are repeated in turn."""
        rng = np.random.default_rng([TEST_TASK_STREAM, seed])
        if self.all_tasks is None:
            return self.sample_tasks(n, rng)
        return np.resize(self.sample_tasks(len(self.all_tasks), rng), (n, self.task_dim))

    def compute_rewards(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Rewards (...) of reward features (..., feat_dim) under tasks (..., task_dim)."""
        return self._call("compute_rewards", tasks, features)

    def compute_potential(self, tasks: np.ndarray, observations: np.ndarray) -> np.ndarray:
        """Potentials (...) of observations (..., obs_dim) under tasks (..., task_dim)."""
        return self._call("compute_potential", tasks, observations, dtype=None)

    def visible_difference(self, left: np.ndarray, right: np.ndarray, spread: np.ndarray) -> float:
        """See :meth:`poem_envs.TaskFamily.visible_difference`; infinite where the family does not
        say.
        """
        if not self.env.has_attr("visible_difference"):
            return np.inf
        return float(self._call("visible_difference", left, right, spread))

    def set_tasks(self, tasks: np.ndarray) -> None:
        """Give copy i the task ``tasks[i]``, from its next reset on."""
        env: Any = self.env
        if hasattr(env, "set_tasks"):  # which SB3's wrappers pass on
            env.set_tasks(tasks)
            return
        for index, task in enumerate(tasks):
            env.env_method("set_task", task, indices=[index])

    def seed_episodes(self, seeds: Sequence[int]) -> None:
        """Seed every copy's next episode, one seed a copy, without touching its task, the one that
        was chosen for the next reset if there is one.

        A family that was never given a task draws one whenever it is reset with a seed. So its
        generators are replaced, and its next reset needs no seed; copies that have none to replace
        (``TaskVecEnv``) are told to keep their tasks. Seeds that are pending are used up first.
        """
        env: Any = self.env
        if any(seed is not None for seed in env.unwrapped._seeds):
            env.reset()  # as make_vec_env seeds, to choose tasks, not these episodes
        if not hasattr(env, "keep_tasks"):
            for copy, seed in enumerate(seeds):
                env.set_attr("np_random", np.random.default_rng(seed), indices=[copy])
            return
        if env.tasks is None:  # nobody has chosen yet, so that the first seeds do
            seed_copies(env, seeds)
            env.reset()
        env.keep_tasks()
        seed_copies(env, seeds)

    def reset(self, tasks: np.ndarray, seed: int) -> np.ndarray:
        """Start an episode of ``tasks[i]`` in each copy i, reproducibly: (num_envs, obs_dim)."""
        self.set_tasks(tasks)
        self.env.seed(seed)
        obs = self.env.reset()
        assert isinstance(obs, np.ndarray)
        return obs

    def features_of(self, infos: list[dict[str, Any]]) -> np.ndarray:
        """Reward features (num_envs, feat_dim) of the last step."""
        return demanded(reward_features(self.env, infos))

    def check_same_family(self, task_space: spaces.Box, reward_feature_dim: int) -> None:
        """Refuse a model that was made for another family."""
        if self.task_space != task_space or self.reward_feature_dim != reward_feature_dim:
            raise ValueError(
                f"the model was trained for tasks in {task_space} with {reward_feature_dim} reward "
                f"features, but env ({self.env_id}) has tasks in {self.task_space} with "
                f"{self.reward_feature_dim}. Pass an environment of the model's own family."
            )


def demanded(features: np.ndarray | None) -> np.ndarray:
    """Reward features, which must be there."""
    if features is None:
        raise ValueError(
            'the environment gives no info["reward_features"], from which returns are computed; '
            "it must be a task family (poem_envs.TaskFamily)"
        )
    return features


def reward_features(env: VecEnv, infos: Sequence[dict[str, Any]]) -> np.ndarray | None:
    """(num_envs, feat_dim) of the last step; None where the environment gives none."""
    fast: np.ndarray | None = getattr(env, "last_reward_features", None)
    if fast is not None:
        return fast
    if any("reward_features" not in info for info in infos):
        return None
    return np.stack([info["reward_features"] for info in infos])


def seed_copies(vec_env: VecEnv, seeds: Sequence[int]) -> None:
    """Seed every copy's next reset by itself: ``VecEnv.seed(s)`` gives copy i the seed s + i."""
    base = vec_env.unwrapped
    base.seed(seeds[0])
    # SB3's own list of "seeds to be used in the next call to env.reset()"
    base._seeds = list(seeds)


def _equal(one: Any, other: Any) -> bool:
    """Whether two arguments are the same, of what can be told so; a dictionary may hold arrays."""
    return one is other or (not isinstance(other, dict) and np.array_equal(one, other))
