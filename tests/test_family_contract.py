"""Every registered family keeps the contract, and ``check_task_family`` finds what breaks it."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from poem_envs import BatchFamily, TaskFamily, TaskFamilyVector
from poem_envs.testing import check_task_family

SMALL = {"width": 64, "height": 64}
FAST = {**SMALL, "render_quality": "fast"}  # Meta-World's scenes take a second each in full
FAMILIES = [
    *(
        (f"poem/{name}-v0", SMALL)
        for name in (
            *("PointGoal", "HalfCheetahVel", "HalfCheetahFwdBack", "AntVel", "AntFwdBack"),
            *("AntDir2D", "AntGoal", "HumanoidDir2D", "FetchReach", "AntMaze"),
        )
    ),
    ("poem/FetchPush-v0", {**SMALL, "reward_type": "sparse"}),
    ("poem/MetaWorldML1-v0", FAST),
    ("poem/MetaWorldML1-v0", {**FAST, "env_name": "push"}),
    ("poem/MetaWorldML10-v0", FAST),
    ("poem/MetaWorldML10-v0", {**FAST, "split": "held-out"}),
]


def marked(env_id, kwargs):
    marks = [pytest.mark.metaworld] if "MetaWorld" in env_id else []
    return pytest.param(env_id, kwargs, marks=marks)


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [marked(*family) for family in FAMILIES],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_every_registered_family_keeps_the_contract(env_id, kwargs):
    check_task_family(env_id, n_steps=8, **kwargs)


def test_no_registered_family_is_left_out():
    assert {env_id for env_id, _ in FAMILIES} == {
        env_id for env_id in gym.registry if env_id.startswith("poem/")
    }


class Walk(TaskFamily):
    """A good family, which each of the following breaks in one way."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = spaces.Box(-10.0, 10.0, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    task_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    reward_feature_dim = 1

    def _begin_episode(self, rng):
        self.x = rng.normal(0.0, 0.1, size=1)
        return self._observe()

    def _observe(self):
        return np.append(self.x, 0.0)

    def _simulate(self, action):
        self.x = self.x + 0.1 * action
        return self._observe(), self.x.copy(), False

    def _reward(self, tasks, features):
        return -np.abs(features[..., 0] - tasks[..., 0])

    def render(self):
        image = np.zeros((8, 8, 3), np.uint8)
        image[4, int(np.clip(4 + 4 * self.x[0], 0, 7))] = 255
        return image


class WalkVector(TaskFamilyVector):
    def __init__(self, **kwargs):
        super().__init__(Walk, **kwargs)


class NoFamily(gym.Env):
    observation_space, action_space = Walk.observation_space, Walk.action_space


class ObservationsInADict(Walk):
    observation_space = spaces.Dict(x=Walk.observation_space)


class ObservationsInRows(Walk):
    observation_space = spaces.Box(-10.0, 10.0, (1, 2), np.float64)


class NumberedActions(Walk):
    action_space = spaces.Discrete(3)


class UnboundedActions(Walk):
    action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)


class ActionsBoundedBelow(Walk):
    action_space = spaces.Box(0.0, np.inf, (1,), np.float32)


class ActionsBoundedAbove(Walk):
    action_space = spaces.Box(-np.inf, 0.0, (1,), np.float32)


class Float32Tasks(Walk):
    task_space = spaces.Box(-1.0, 1.0, (1,), np.float32)


class NoFeatureDim(Walk):
    reward_feature_dim = 0


class TwiceTheSameTask(Walk):
    all_tasks = np.array([[0.5], [0.5]])


class NoTasks(Walk):
    all_tasks = np.zeros((0, 1))


class TasksOutsideTheirSpace(Walk):
    all_tasks = np.array([[0.5], [1.5]])


class Float32Observations(Walk):
    def _observe(self):
        return super()._observe().astype(np.float32)


class ObservationsOutsideTheirSpace(Walk):
    def _observe(self):
        return super()._observe() + 11.0


class NotANumber(Walk):
    def _reward(self, tasks, features):
        return super()._reward(tasks, features) * np.nan


class FeaturesOfAnotherWidth(Walk):
    def _simulate(self, action):
        observation, _, terminated = super()._simulate(action)
        return observation, np.zeros(3), terminated

    def _reward(self, tasks, features):
        return np.zeros(np.broadcast_shapes(tasks.shape, features.shape)[:-1])

    compute_rewards = _reward  # without the check of the base class


class FeaturesThatAreNotNumbers(FeaturesOfAnotherWidth):
    def _simulate(self, action):
        observation, features, terminated = Walk._simulate(self, action)
        return observation, features * np.nan, terminated


class SuccessAsANumber(Walk):
    def _step_info(self):
        return {"success": 1.0}


class TasksOfTheGlobalGenerator(Walk):
    def _draw_tasks(self, n, rng):
        return np.random.uniform(-1, 1, (n, 1))  # noqa: NPY002


class TasksOfTheEpisodesGenerator(Walk):
    def _draw_tasks(self, n, rng):
        self.np_random.uniform()
        return super()._draw_tasks(n, rng)


class TasksBeyondTheirSpace(Walk):
    def _draw_tasks(self, n, rng):
        return super()._draw_tasks(n, rng) + 2.0


class OneTaskOnly(Walk):
    def _draw_tasks(self, n, rng):
        return np.zeros((n, 1))


class FlatTasks(Walk):
    def sample_tasks(self, n, rng):
        tasks = super().sample_tasks(n, rng)
        return tasks[:, 0] if n > 1 else tasks


class DrawnWithoutTheirDimension(Walk):
    def _draw_tasks(self, n, rng):
        return rng.uniform(-1, 1, n)


class UnseededStart(Walk):
    def _begin_episode(self, rng):
        return super()._begin_episode(np.random.default_rng())


class StartAfterTheLastEpisode(Walk):
    x = np.zeros(1)

    def _begin_episode(self, rng):
        self.x = self.x + rng.normal(0.0, 0.1, size=1)
        return self._observe()


class TaskAtOnce(Walk):
    def set_task(self, task):
        super().set_task(task)
        self._task = self._next_task


class TaskThatIsForgotten(Walk):
    def reset(self, *, seed=None, options=None):
        if seed is not None and not options:
            self._next_task = None
        return super().reset(seed=seed, options=options)


class TaskThatIsIgnored(Walk):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)


class TaskInTheStart(Walk):
    def _begin_episode(self, rng):
        super()._begin_episode(rng)
        self.x = self.x + self._task
        return self._observe()


class TaskInTheObservation(Walk):
    def _simulate(self, action):
        observation, features, terminated = super()._simulate(action)
        observation[1] = self._task[0]
        return observation, features, terminated


class TaskInTheFeatures(Walk):
    def _simulate(self, action):
        observation, features, terminated = super()._simulate(action)
        return observation, features - self._task, terminated

    def _reward(self, tasks, features):
        return -np.abs(features[..., 0])


class TaskInTheEnd(Walk):
    def _simulate(self, action):
        observation, features, _ = super()._simulate(action)
        return observation, features, bool(self._elapsed_steps > 1 + 5 * abs(self._task[0]))


class RewardOfItsOwnState(Walk):
    def _reward(self, tasks, features):
        return -np.abs(self.x[0] - tasks[..., 0])


class FeaturesThatAreReused(Walk):
    buffer = np.zeros(1)

    def _simulate(self, action):
        observation, features, terminated = super()._simulate(action)
        self.buffer[:] = features
        return observation, self.buffer, terminated


class RewardThatDoesNotBroadcast(Walk):
    def _reward(self, tasks, features):
        return (
            -np.abs(features[0] - tasks[0])
            if features.ndim == 1
            else -np.abs(features - tasks[:, 0])
        )


class RewardThatRounds(Walk):
    def _reward(self, tasks, features):
        reward = super()._reward(tasks, features)
        return reward if reward.ndim == 0 else reward * (1 + 1e-15)


class RewardWithoutItsCosts(Walk):
    """What ``step`` takes off is not in ``compute_rewards``."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward - 1.0, terminated, truncated, info


class RenderingThatMoves(Walk):
    def render(self):
        self.x = self.x + 0.01
        return super().render()


class RenderingOfTheTask(Walk):
    def render(self):
        image = super().render()
        image[0, int(3 + 3 * self._task[0])] = 255
        return image


class RenderingOfNothing(Walk):
    def render(self):
        return None


class ClosedOnce(Walk):
    def close(self):
        del self.x


class PotentialThatDoesNotBroadcast(Walk):
    def _potential(self, tasks, observations):
        return -float(abs(observations[0] - tasks[0]))


class PotentialOfItsOwnState(Walk):
    def _potential(self, tasks, observations):
        return -np.abs(observations[..., 0] - tasks[..., 0]) - np.abs(self.x[0])


class InfinitePotential(Walk):
    def _potential(self, tasks, observations):
        return np.full(np.broadcast_shapes(tasks.shape[:-1], observations.shape[:-1]), -np.inf)


BROKEN = [
    (NoFamily, "must be a task family.*subclass poem_envs.TaskFamily"),
    (ObservationsInADict, "observation_space must be a flat .*Box, but is Dict"),
    (ObservationsInRows, "observation_space must be a flat .*Box, but is Box"),
    (NumberedActions, r"action_space must be .* bounded .*, but is Discrete\(3\)"),
    (UnboundedActions, "action_space must be .* bounded below and above, but is"),
    (ActionsBoundedBelow, "action_space must be .* bounded below and above, but is"),
    (ActionsBoundedAbove, "action_space must be .* bounded below and above, but is"),
    (Float32Tasks, "task_space must be a .*Box of shape .* float64"),
    (NoFeatureDim, "reward_feature_dim must be a whole number"),
    (TwiceTheSameTask, "all_tasks must have shape .* hold every task once"),
    (NoTasks, r"all_tasks must have shape \(n, 1\), .*, but is \[\]"),
    (TasksOutsideTheirSpace, "all_tasks must have shape .* lie in task_space"),
    (
        Float32Observations,
        "reset must return an observation of observation_space's shape .* dtype float32",
    ),
    (ObservationsOutsideTheirSpace, "reset returned .* not inside observation_space .* widen it"),
    (NotANumber, "finite float as reward, but gave nan"),
    (FeaturesOfAnotherWidth, r'info\["reward_features"\] must be .* shape \(reward_feature_dim,\)'),
    (FeaturesThatAreNotNumbers, r'info\["reward_features"\] must be a finite .* array\(\[nan\]\)'),
    (SuccessAsANumber, r'info\["success"\] must be a bool'),
    (TasksOfTheGlobalGenerator, "sample_tasks must draw from the generator that it is given"),
    (TasksOfTheEpisodesGenerator, "sample_tasks must leave the environment's own generator alone"),
    (TasksBeyondTheirSpace, "not in task_space"),
    (OneTaskOnly, "must draw different tasks"),
    (DrawnWithoutTheirDimension, r"sample_tasks\(8, rng\) must return a .* shape \(8, 1\)"),
    (FlatTasks, r"sample_tasks\(8, rng\) must return a float64 array of shape \(8, 1\)"),
    (UnseededStart, "the same episode again, but did not: draw all randomness"),
    (StartAfterTheLastEpisode, "the same episode again, but did not: .*reset the whole state"),
    (TaskAtOnce, "set_task must take effect at the next reset only"),
    (TaskThatIsForgotten, "after set_task and reset, task must be"),
    (TaskThatIsIgnored, r"after reset\(options=.*\), task must be"),
    (TaskInTheStart, "first observation must not depend on the task"),
    (TaskInTheObservation, "observations must not depend on the task"),
    (TaskInTheFeatures, "reward features must not depend on the task"),
    (TaskInTheEnd, "end must not depend on the task"),
    (RewardOfItsOwnState, "must return exactly compute_rewards.* with no state of the environment"),
    (
        FeaturesThatAreReused,
        "of step 0: those of all steps are alike: return new arrays of features",
    ),
    (RewardThatDoesNotBroadcast, "compute_rewards must broadcast"),
    (RewardThatRounds, "exactly as one after another"),
    (PotentialThatDoesNotBroadcast, "compute_potential must broadcast"),
    (PotentialOfItsOwnState, "potentials at once as one after another"),
    (InfinitePotential, "compute_potential must give finite numbers"),
    (RewardWithoutItsCosts, "step must return exactly compute_rewards"),
    (RenderingThatMoves, "rendering must not change the episode"),
    (RenderingOfTheTask, "images must not show the task unless render_task=True"),
    (RenderingOfNothing, r"render\(\) .* must return a uint8 array"),
    (ClosedOnce, r"close\(\) must be callable twice"),
]


def test_the_good_family_passes():
    check_task_family(Walk)


@pytest.mark.parametrize(
    ("family", "message"), BROKEN, ids=lambda value: getattr(value, "__name__", "")
)
def test_each_violation_has_its_message(family, message):
    with pytest.raises((AssertionError, TypeError), match=f"(?s){message}"):
        check_task_family(family)


class _Batch(BatchFamily):
    """A batch whose copies are not quite alike."""

    observation_space, action_space = Walk.observation_space, Walk.action_space
    task_space, reward_feature_dim = Walk.task_space, 1
    wrong = ""

    def _allocate(self, n):
        self._x = np.zeros((n, 2))

    def _begin_episodes(self, copies, rngs):
        for copy, rng in zip(copies, rngs, strict=True):
            self._x[copy, 0] = rng.normal()
            if self.wrong == "start" and len(self._x) > 1:
                self._x[copy, 0] += 1e-9

    def _advance(self, actions):
        self._x[:, :1] += 0.1 * actions
        if self.wrong == "step" and len(self._x) > 1:
            self._x[:, 0] += 1e-9
        features = self._x[:, :1].copy()
        if self.wrong == "reward" and len(self._x) > 1:
            features += 1e-9
        return features, np.full(len(actions), self.wrong == "end" and len(self._x) > 1)

    def _observations(self):
        return self._x.copy()

    def _reward(self, tasks, features):
        return -np.abs(features[..., 0] - tasks[..., 0])


def test_a_batch_that_does_not_draw_its_copies():
    family = type("Family", (_Batch,), {"metadata": Walk.metadata})
    with pytest.raises(NotImplementedError, match=r"Family has no _render_copy\(copy, "):
        check_task_family(family)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("start", "observations of the vectorised version's reset"),
        ("step", "rewards of the vectorised version"),
        ("reward", "rewards of the vectorised version"),
        ("end", "ends of the vectorised version"),
    ],
)
def test_a_vectorised_version_that_differs(wrong, message):
    family = type("Family", (_Batch,), {"wrong": wrong})
    vector = functools.partial(TaskFamilyVector, family)
    gym.register(
        "test/Differs-v0", entry_point=family, vector_entry_point=vector, max_episode_steps=5
    )
    try:
        with pytest.raises(AssertionError, match=f"{message} must equal the single environment's"):
            check_task_family("test/Differs-v0")
    finally:
        del gym.registry["test/Differs-v0"]


@pytest.mark.parametrize(
    ("registration", "message"),
    [
        ({"vector_entry_point": WalkVector}, "must have a time limit.*max_episode_steps"),
        (
            {
                "vector_entry_point": lambda **kwargs: gym.vector.SyncVectorEnv([Walk]),
                "max_episode_steps": 5,
            },
            "must make a poem_envs.TaskFamilyVector.*functools.partial",
        ),
    ],
)
def test_registrations_that_do_not_do(registration, message):
    gym.register("test/Registered-v0", entry_point=Walk, **registration)
    try:
        with pytest.raises(AssertionError, match=message):
            check_task_family("test/Registered-v0")
    finally:
        del gym.registry["test/Registered-v0"]


def test_a_good_registration():
    gym.register(
        "test/Good-v0",
        entry_point=Walk,
        vector_entry_point=functools.partial(TaskFamilyVector, Walk),
        max_episode_steps=5,
    )
    try:
        check_task_family("test/Good-v0")
    finally:
        del gym.registry["test/Good-v0"]


def test_an_import_of_rl_zoo3_changes_nothing():
    """It replaces Gymnasium's TimeLimit by one that tells of time limits in another way."""
    import rl_zoo3  # noqa: F401

    check_task_family("poem/PointGoal-v0")
