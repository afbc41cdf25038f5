"""Goal-conditioned environments as families, against those environments themselves."""

import functools

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium_robotics.envs.maze import maps

from poem_envs import GoalFamily, TaskFamilyVector

gym.register_envs(gymnasium_robotics)


@pytest.mark.parametrize(
    ("env_id", "own_id", "reward_type"),
    [
        ("poem/FetchReach-v0", "FetchReach-v4", "sparse"),
        ("poem/FetchPush-v0", "FetchPush-v4", "dense"),
    ],
)
def test_rewards_are_the_environments_own(env_id, own_id, reward_type, rng):
    family = gym.make(env_id, reward_type=reward_type).unwrapped
    own = gym.make(own_id, reward_type=reward_type).unwrapped
    played, other = family.sample_tasks(2, rng)
    observation, _ = family.reset(seed=5, options={"task": played})
    # The family draws the environment's seed from its own generator.
    own_observation, _ = own.reset(seed=int(np.random.default_rng(5).integers(2**31)))
    assert np.array_equal(observation, own_observation["observation"])
    own.goal = other
    for _ in range(20):
        action = np.append(
            np.clip(10 * (other - family.env._get_obs()["achieved_goal"]), -1, 1), 0.0
        ).astype(np.float32)
        observation, _, _, _, info = family.step(action)
        own_observation, own_reward, _, _, _ = own.step(action)
        assert np.array_equal(observation, own_observation["observation"])
        assert family.compute_rewards(other, info["reward_features"]) == pytest.approx(
            float(own_reward), abs=1e-12
        )


@pytest.mark.parametrize("env", ["FetchSlide-v4", "HandReach-v3"])
def test_other_environments_of_gymnasium_robotics(env):
    family = GoalFamily(f"gymnasium_robotics:{env}")
    family.reset(seed=0)
    family.step(family.action_space.sample())


def test_the_goal_is_reached_where_the_task_says(rng):
    env = gym.make("poem/FetchReach-v0").unwrapped
    for task in env.sample_tasks(3, rng):
        env.reset(seed=0, options={"task": task})
        infos = []
        for _ in range(30):
            towards = task - env.env._get_obs()["achieved_goal"]
            infos.append(env.step(np.append(np.clip(10 * towards, -1, 1), 0.0))[4])
        assert not infos[0]["success"]
        assert infos[-1]["success"]
        assert infos[-1]["is_success"]


def test_tasks_are_distributed_as_the_environments_goals():
    tasks = gym.make("poem/AntMaze-v0").unwrapped.sample_tasks(300, np.random.default_rng(0))
    own = gym.make("AntMaze_UMaze-v5").unwrapped
    goals = np.array([own.reset(seed=seed)[0]["desired_goal"] for seed in range(300)])
    assert tasks.mean(axis=0) == pytest.approx(goals.mean(axis=0), abs=0.8)
    assert tasks.std(axis=0) == pytest.approx(goals.std(axis=0), rel=0.15)


def test_a_larger_maze_takes_wider_bounds(rng):
    larger = {"maze_map": maps.MEDIUM_MAZE, "goal_low": -15.0, "goal_high": 15.0}
    env = gym.make("poem/AntMaze-v0", **larger).unwrapped
    assert np.abs(env.sample_tasks(20, rng)).max() > 6.0


class Reach(gym.Env):
    """A goal-conditioned environment that can be spoilt."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self):
        box = spaces.Box(-2.0, 2.0, (2,), np.float64)
        self.observation_space = spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.x = np.zeros(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.goal = np.zeros(2), self.np_random.uniform(-1.0, 1.0, 2)
        return self._observation(), {}

    def step(self, action):
        self.x = self.x + 0.1 * action
        return self._observation(), self.compute_reward(self.x, self.goal, {}), False, False, {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.abs(achieved_goal - desired_goal).sum(axis=-1)

    def _observation(self):
        return {
            "observation": self.x.copy(),
            "achieved_goal": self.x.copy(),
            "desired_goal": self.goal.copy(),
        }


class OneRewardAtATime(Reach):
    def compute_reward(self, achieved_goal, desired_goal, info):
        return -float(
            abs(achieved_goal.ravel()[0] - desired_goal.ravel()[0]) + abs(achieved_goal.ravel()[1])
        )


def test_a_reward_function_for_one_goal_at_a_time_is_called_for_one_after_another(rng):
    family = GoalFamily(OneRewardAtATime)
    goals, achieved = rng.uniform(-1, 1, (5, 2)), rng.uniform(-1, 1, (4, 2))
    expected = [[-(abs(a[0] - g[0]) + abs(a[1])) for a in achieved] for g in goals]
    assert family.compute_rewards(goals[:, None], achieved[None]) == pytest.approx(
        np.array(expected)
    )


def test_what_the_observation_holds():
    family, without = GoalFamily(Reach), GoalFamily(Reach, observe_achieved_goal=False)
    assert family.observation_space.shape == (4,)
    assert without.observation_space.shape == (2,)
    family.reset(seed=0)
    observation, _, _, _, info = family.step(np.array([1.0, -1.0]))
    assert observation == pytest.approx([0.1, -0.1, 0.1, -0.1])
    assert info.keys() == {"reward_features"}  # it tells of no success


class NoReward(Reach):
    compute_reward = None


class NoGoals(Reach):
    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Dict(observation=self.observation_space["observation"])


class Pixels(Reach):
    def __init__(self):
        super().__init__()
        self.observation_space["observation"] = spaces.Box(0, 255, (8, 8, 3), np.uint8)


class GoalsOfAnotherWidth(Reach):
    def __init__(self):
        super().__init__()
        self.observation_space["achieved_goal"] = spaces.Box(-1, 1, (3,), np.float64)


class Buttons(Reach):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(3)


class RewardOfTheInfo(Reach):
    def compute_reward(self, achieved_goal, desired_goal, info):
        return info["energy"]

    def step(self, action):
        return self._observation(), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (NoReward, r"has no compute_reward\(achieved_goal, desired_goal, info\)"),
        (
            NoGoals,
            r"space must be a Dict of .*'desired_goal', but is a Dict of \['observation'\]",
        ),
        (lambda: gym.make("CartPole-v1"), "observation space must be a Dict"),
        (Pixels, "the space of 'observation' must be a flat Box"),
        (GoalsOfAnotherWidth, "must have the same shape"),
        (Buttons, "the action space must be a Box"),
        (RewardOfTheInfo, "and an empty info: KeyError: 'energy'"),
    ],
)
def test_environments_that_are_not_goal_conditioned(env, message):
    with pytest.raises(ValueError, match=message):
        GoalFamily(env)


def length_of_an_episode(env):
    env.reset(seed=0)
    for step in range(1, 100):
        if env.step(np.zeros(2))[3]:
            return step
    return None


@pytest.fixture
def reach_id():
    family = functools.partial(GoalFamily, "test/Reach-v0")
    gym.register("test/Reach-v0", Reach, max_episode_steps=7)
    gym.register(
        "test/ReachFamily-v0",
        family,
        vector_entry_point=functools.partial(TaskFamilyVector, family),
    )
    gym.register("test/LongReachFamily-v0", family, max_episode_steps=11)
    yield "test/ReachFamily-v0"
    for name in ("test/Reach-v0", "test/ReachFamily-v0", "test/LongReachFamily-v0"):
        del gym.registry[name]


def test_the_environments_time_limit_is_the_familys(reach_id):
    vector_env = gym.make_vec(reach_id, num_envs=2, nthread=1)
    vector_env.reset(seed=0)
    ends = [vector_env.step(np.zeros((2, 2)))[3].all() for _ in range(7)]
    assert ends == [False] * 6 + [True]
    env = gym.make(reach_id)
    assert env.spec.max_episode_steps == gym.spec(reach_id).max_episode_steps == 7
    assert length_of_an_episode(env) == length_of_an_episode(GoalFamily("test/Reach-v0")) == 7
    assert length_of_an_episode(GoalFamily(lambda: gym.wrappers.TimeLimit(Reach(), 5))) == 5
    assert length_of_an_episode(GoalFamily(Reach)) is None


def test_a_time_limit_of_ones_own_goes_before_it(reach_id):
    assert length_of_an_episode(gym.make("test/LongReachFamily-v0")) == 11
    assert length_of_an_episode(gym.make(reach_id, max_episode_steps=12)) == 12


def test_wrappers_that_would_have_no_effect():
    bare = GoalFamily(lambda: gym.wrappers.TimeLimit(Reach(), 5))
    assert isinstance(bare.env, Reach)
    with pytest.raises(ValueError, match="its ClipAction would have no effect"):
        GoalFamily(lambda: gym.wrappers.ClipAction(Reach()))


def test_an_environment_in_place_of_what_makes_it():
    with pytest.raises(ValueError, match="pass its id, or a function that makes it"):
        GoalFamily(Reach())


class TargetInPlaceOfGoal(Reach):
    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.x, self.target = np.zeros(2), self.np_random.uniform(-1.0, 1.0, 2)
        return self._observation(), {}

    def step(self, action):
        self.x = self.x + 0.1 * action
        return self._observation(), self.compute_reward(self.x, self.target, {}), False, False, {}

    def _observation(self):
        return {
            "observation": self.x.copy(),
            "achieved_goal": self.x.copy(),
            "desired_goal": self.target.copy(),
        }


def test_a_goal_that_is_set_in_another_way():
    with pytest.raises(ValueError, match="has no attribute 'goal' to set; pass set_goal=f"):
        GoalFamily(TargetInPlaceOfGoal)
    family = GoalFamily(
        TargetInPlaceOfGoal, set_goal=lambda env, goal: setattr(env, "target", goal)
    )
    family.reset(seed=0, options={"task": [0.5, -0.5]})
    _, reward, *_ = family.step(np.zeros(2))
    assert reward == -1.0


class GoalThatMoves(Reach):
    def step(self, action):
        self.goal = self.goal + 0.1
        return super().step(action)


class RewardWithCosts(Reach):
    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, reward - 0.1 * np.abs(action).sum(), *rest


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (GoalThatMoves, "the goal must stay for the whole episode"),
        (RewardWithCosts, "must depend on the two goals alone"),
    ],
)
def test_episodes_that_cannot_be_relabelled(env, message):
    family = GoalFamily(env)
    family.reset(seed=0)
    with pytest.raises(RuntimeError, match=message):
        family.step(np.ones(2))


def test_bounds_that_are_too_narrow():
    family = GoalFamily(Reach, goal_low=-2.0, goal_high=2.0)
    assert family.task_space == spaces.Box(-2.0, 2.0, (2,), np.float64)
    with pytest.raises(ValueError, match=r"goal_low and goal_high span .* widen them"):
        GoalFamily(Reach, goal_low=-0.1, goal_high=0.1)


def test_unknown_reward_type():
    with pytest.raises(ValueError, match="reward_type='shaped' must be 'dense' or 'sparse'"):
        gym.make("poem/FetchReach-v0", reward_type="shaped")
