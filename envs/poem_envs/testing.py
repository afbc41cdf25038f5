"""Does an environment keep the contract of a task family? A check like SB3's ``check_env``."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import gymnasium as gym
import numpy as np

from poem_envs.family import TaskFamily
from poem_envs.registration import plain_id
from poem_envs.vector import TaskFamilyVector

#: Steps whose images are compared: drawing is slow.
N_IMAGES = 3
#: Of an episode: observations, of which there is one more than steps, rewards and reward features.
Episode = tuple[np.ndarray, np.ndarray, np.ndarray]


def check_task_family(
    env: str | Callable[..., gym.Env],
    *,
    n_steps: int = 12,
    seed: int = 0,
    render: bool = True,
    **env_kwargs: Any,
) -> None:
    """Check that an environment keeps the contract of a task family: the drawing of tasks, the
    spaces, seeds, when a task takes effect, that the task is hidden, that relabelling is exact, the
    potential (of a family that has one), the vectorised version (of a registered id that has one),
    rendering and closing, in this order.

    >>> check_task_family("poem_envs:poem/PointGoal-v0")  # it keeps the contract

    :param env: The id of a registered environment, or a class or function that makes one
    :param n_steps: How many steps of an episode to compare; the episode may be shorter
    :param seed: Of the episodes, tasks and actions
    :param render: Whether to check rendering, which needs OpenGL for MuJoCo environments
    :raises AssertionError: At the first violation; the message says what to change
    :raises TypeError: If the family cannot be made, for what it lacks
    """
    if isinstance(env, str):
        env = plain_id(env)
    elif not callable(env):
        raise TypeError(f"env is {env!r}, but must be a class, a function, or a registered id")
    case = Case(partial(_make, env, **env_kwargs), n_steps, seed)
    check_sampling(case)
    check_spaces(case)
    check_seeds(case)
    check_set_task(case)
    check_hidden_task(case)
    check_relabelling(case)
    check_potential(case)
    if isinstance(env, str):
        assert gym.spec(env).max_episode_steps is not None, (
            f"{env} must have a time limit, the horizon of training: register it with "
            "max_episode_steps=<steps>"
        )
        if gym.spec(env).vector_entry_point is not None:
            check_vector_parity(case, env, env_kwargs)
    if render:
        check_rendering(case)
    check_closing(case)


class Case:
    """A family that is checked: how it is made, and what its copies are made to do."""

    def __init__(self, make: Callable[..., Any], n_steps: int, seed: int) -> None:
        self.make, self.n_steps, self.seed = make, n_steps, seed
        self.player = make()

    def draw_actions(self, n: int, seed: int) -> np.ndarray:
        space, rng = self.player.action_space, np.random.default_rng([seed, 1])
        return rng.uniform(space.low, space.high, size=(n, *space.shape)).astype(space.dtype)

    @cached_property
    def actions(self) -> np.ndarray:
        return self.draw_actions(self.n_steps, self.seed)

    @cached_property
    def tasks(self) -> np.ndarray:
        """Two."""
        return self.player.sample_tasks(2, np.random.default_rng([self.seed, 2]))

    @cached_property
    def episodes(self) -> list[Episode]:
        """One in each of the two tasks, with the same seed and the same actions."""
        return [self.play(self.player, self.actions, options={"task": task}) for task in self.tasks]

    def play(
        self,
        env: TaskFamily,
        actions: np.ndarray,
        each_step: Callable[[], Any] = lambda: None,
        **reset_arguments: Any,
    ) -> Episode:
        """An episode, whose arrays are kept as they came, so that one that is reused is caught."""
        observation, _ = env.reset(**{"seed": self.seed, **reset_arguments})
        observations, rewards, features = [observation], [], []
        each_step()
        for action in actions:
            observation, reward, terminated, _, info = env.step(action)
            observations.append(observation)
            rewards.append(reward)
            features.append(info["reward_features"])
            each_step()
            if terminated:
                break
        return np.array(observations), np.array(rewards), np.array(features)


def check_spaces(case: Case) -> None:
    """Boxes of the right shapes and types, which hold what the environment returns."""
    env = case.make()
    observation, _ = env.reset(seed=case.seed)
    _check_observation(observation, env, "reset")
    simulated = env._simulate(case.actions[0])
    ok = isinstance(simulated, tuple) and len(simulated) == 3
    assert ok, (
        "_simulate must return three values, observation, reward features and whether the episode "
        f"ends, but gave {simulated!r}"
    )
    features, shape = simulated[1], (env.reward_feature_dim,)
    ok = _is_array(features, shape, np.float64) and np.isfinite(features).all()
    assert ok, (
        'info["reward_features"] must be a finite float64 array of shape (reward_feature_dim,) = '
        f"{shape}, but is {features!r}; return it from _simulate"
    )
    reward = np.asarray(env.compute_rewards(env.task, features))
    assert reward.shape == (), (
        "_reward must give one number, of shape (), for one task and its features, but gave shape "
        f"{reward.shape}: index the last dimension by tasks[..., i] and features[..., i]"
    )
    env.reset(seed=case.seed)
    observation, reward, _, _, info = env.step(case.actions[0])
    _check_observation(observation, env, "step")
    ok = isinstance(reward, float) and np.isfinite(reward)
    assert ok, f"step must return a finite float as reward, but gave {reward!r}"
    success = info.get("success", True)
    ok = isinstance(success, (bool, np.bool_))
    assert ok, f'info["success"] must be a bool, but is {success!r}; convert it in _step_info'


def check_sampling(case: Case) -> None:
    """Tasks come from the given generator alone, and are tasks."""
    env = case.make()
    env.reset(seed=case.seed)
    before = env.np_random.bit_generator.state
    n = 8 if env.all_tasks is None else len(env.all_tasks)
    tasks, again = (env.sample_tasks(n, np.random.default_rng(case.seed)) for _ in range(2))
    shape = (n, *env.task_space.shape)
    assert _is_array(tasks, shape, np.float64), (
        f"sample_tasks({n}, rng) must return a float64 array of shape {shape}, but gave {tasks!r}"
    )
    for task in tasks:
        assert task in env.task_space, (
            f"sample_tasks drew {task}, which is not in task_space {env.task_space}; widen it"
        )
    assert len(np.unique(tasks, axis=0)) > 1, (
        "sample_tasks must draw different tasks, but all of them are equal"
    )
    assert np.array_equal(tasks, again), (
        "sample_tasks must draw from the generator that it is given, but gave other tasks for an "
        "equal one; use no other randomness in _draw_tasks"
    )
    assert env.np_random.bit_generator.state == before, (
        "sample_tasks must leave the environment's own generator alone; draw from its argument rng "
        "in place of self.np_random"
    )


def check_seeds(case: Case) -> None:
    """A seed determines the task and the episode, whatever was done before."""
    env, other = case.make(), case.make()
    first, task = case.play(env, case.actions), env.task
    case.play(other, case.actions[::-1], seed=case.seed + 1)
    for family, where in ((env, "again"), (other, "in another copy")):
        assert _equal(case.play(family, case.actions), first), (
            f"reset(seed={case.seed}) and the same actions must give the same episode {where}, but "
            "did not: draw all randomness from the rng that _begin_episode is given, and reset the "
            "whole state of the simulator there"
        )
        assert np.array_equal(family.task, task), f"reset(seed={case.seed}) must draw one task"


def check_set_task(case: Case) -> None:
    """A task takes effect at the next reset, and stays."""
    env = case.make()

    def in_effect(task: np.ndarray, after: str) -> None:
        assert np.array_equal(env.task, task), f"after {after}, task must be {task}, not {env.task}"

    first, second = case.tasks
    env.set_task(first)
    env.reset(seed=case.seed)
    in_effect(first, "set_task and reset")
    actions = case.draw_actions(2, case.seed)
    env.step(actions[0])
    env.set_task(second)
    _, reward, _, _, info = env.step(actions[1])
    kept, changed = (env.compute_rewards(task, info["reward_features"]) for task in case.tasks)
    ok = np.array_equal(env.task, first) and not (reward == changed != kept)
    assert ok, "set_task must take effect at the next reset only, but changed the episode under way"
    env.reset()
    in_effect(second, "set_task in an episode and reset")
    env.reset(seed=case.seed)
    in_effect(second, "a reset with a seed, over which a chosen task stays")
    env.reset(options={"task": first})
    in_effect(first, 'reset(options={"task": task})')


def check_hidden_task(case: Case) -> None:
    """Where tasks differ in the reward alone, nothing that the agent sees depends on them."""
    if not case.player.shared_dynamics:
        return
    (seen, rewards, features), (its_seen, its_rewards, its_features) = case.episodes
    n = min(len(seen), len(its_seen))
    combine = "return what the reward is computed from, and let _reward combine it with the task"
    for mine, its, what, advice in (
        (seen[0], its_seen[0], "the first observation", "leave the task out of it and the start"),
        (seen[:n], its_seen[:n], "observations", "leave the task out of them and the dynamics"),
        (features[: n - 1], its_features[: n - 1], "reward features", combine),
        (len(rewards), len(its_rewards), "an episode's end", "leave the task out of `terminated`"),
    ):
        assert np.array_equal(mine, its), (
            f"{what} must not depend on the task, but differs between two with the same seed and "
            f"actions: {advice}, or set shared_dynamics = False"
        )


def check_relabelling(case: Case) -> None:
    """Rewards are exactly a pure function of task and features."""
    other = case.make()
    other.reset(seed=case.seed + 1)
    for task, (_, rewards, features) in zip(case.tasks, case.episodes, strict=True):
        for source, name in ((case.player, "this"), (other, "another")):
            given = np.array([float(source.compute_rewards(task, row)) for row in features])
            wrong = np.flatnonzero(given != rewards)
            same = len(features) > 1 and not np.ptp(features, axis=0).any()
            assert not len(wrong), (
                "step must return exactly compute_rewards(task, info['reward_features']), but "
                f"{name} environment's gives {given[wrong[0]]} for the reward {rewards[wrong[0]]} "
                f"of step {wrong[0]}: "
                + (
                    "those of all steps are alike: return new arrays of features"
                    if same
                    else "compute the reward in _reward alone, from its arguments alone, with no "
                    "state of the environment"
                )
            )
    features = case.episodes[0][2]
    together, one_by_one = _both_ways(case.player, other, "compute_rewards", case.tasks, features)
    assert np.array_equal(together, one_by_one), (
        "compute_rewards must give many rewards at once exactly as one after another, but does "
        "not: use elementwise operations in _reward, on the last dimension by tasks[..., i] and "
        "features[..., i]"
    )


def check_potential(case: Case) -> None:
    """A potential is a finite, pure function of task and observation, which broadcasts."""
    if not case.player.has_potential:
        return
    other, observations = case.make(), case.episodes[0][0]
    other.reset(seed=case.seed + 1)
    about = (case.player, other, "compute_potential", case.tasks, observations)
    together, one_by_one = _both_ways(*about)
    ok = together.shape == one_by_one.shape and np.allclose(together, one_by_one, rtol=1e-6)
    assert ok, (
        "compute_potential must give many potentials at once as one after another, but does not: "
        "compute them in _potential from its arguments alone, by elementwise operations on the "
        "last dimension"
    )
    assert np.isfinite(together).all(), (
        f"compute_potential must give finite numbers, but gave {together.tolist()}"
    )


def check_vector_parity(case: Case, env_id: str, env_kwargs: dict[str, Any]) -> None:
    """The vectorised version equals single environments bit for bit, over ends and other tasks."""
    n, horizon = 3, max(2, case.n_steps // 2)
    arguments = {**env_kwargs, "max_episode_steps": horizon}
    vector_env = gym.make_vec(env_id, n, vectorization_mode="vector_entry_point", **arguments)
    assert isinstance(vector_env, TaskFamilyVector), (
        f"the vector_entry_point of {env_id} must make a poem_envs.TaskFamilyVector, but makes a "
        f"{type(vector_env).__name__}; use functools.partial(poem_envs.TaskFamilyVector, "
        "YourFamily)"
    )

    def compare(mine: Any, its: Any, what: str, where: str = "") -> None:
        assert np.array_equal(mine, its), (
            f"{what} of the vectorised version{where} must equal the single environment's bit for "
            "bit, but do not: let both run the same code"
        )

    singles = [case.make() for _ in range(n)]  # whose time limit is counted here
    lengths = np.zeros(n, dtype=int)
    observations, _ = vector_env.reset(seed=case.seed)
    for i, single in enumerate(singles):
        compare(single.reset(seed=case.seed + i)[0], observations[i], "observations", "'s reset")
    actions = [case.draw_actions(case.n_steps + 2, case.seed + i) for i in range(n)]
    for step, together in enumerate(np.stack(actions, axis=1)):
        if step == 1:
            tasks = case.tasks[[0, 1, 0]]
            vector_env.set_tasks(tasks)
            for single, task in zip(singles, tasks, strict=True):
                single.set_task(task)
        observations, rewards, terminations, truncations, infos = vector_env.step(together)
        lengths += 1
        for i, single in enumerate(singles):
            observation, reward, terminated, _, info = single.step(together[i])
            truncated = lengths[i] == horizon
            compare(reward, rewards[i], "rewards")
            compare((terminated, truncated), (terminations[i], truncations[i]), "ends")
            for key, value in info.items():
                compare(value, infos[key][i], f"infos[{key!r}]")
            if terminated or truncated:
                observation, _ = single.reset()
                lengths[i] = 0
            compare(observation, observations[i], "observations")
    for env in (vector_env, *singles):
        env.close()


def check_rendering(case: Case) -> None:
    """Images are images, show no task unless asked to, and drawing them changes nothing."""
    plain, actions = case.make(), case.actions[:N_IMAGES]
    if "rgb_array" not in plain.metadata.get("render_modes", []):
        return
    env = case.make(render_mode="rgb_array")
    drawn: list[Episode] = []
    images: list[list[np.ndarray]] = []
    for task in case.tasks:
        images.append([])
        each_step = lambda: images[-1].append(env.render())  # noqa: E731
        drawn.append(case.play(env, actions, each_step, options={"task": task}))
    assert all(_is_image(image) for image in images[0]), (
        'render() with render_mode="rgb_array" must return a uint8 array of shape (height, width, '
        "3)"
    )
    assert _equal(case.play(plain, actions, options={"task": case.tasks[0]}), drawn[0]), (
        "rendering must not change the episode, but it did: leave the simulator's state in "
        "render() as it was"
    )
    if env.shared_dynamics and not env.render_task:
        assert _equal(*images), (
            "images must not show the task unless render_task=True, but two tasks with the same "
            "seed and actions look different: draw what marks the task only if self.render_task"
        )
    env.close()


def check_closing(case: Case) -> None:
    """``close`` can be called twice."""
    env = case.make()
    env.reset(seed=case.seed)
    env.close()
    try:
        env.close()
    except Exception as error:
        raise AssertionError(
            f"close() must be callable twice, but the second call raised {type(error).__name__}: "
            f"{error}; release what is held and forget it"
        ) from error


def _make(env: str | Callable[..., gym.Env], **kwargs: Any) -> TaskFamily:
    make = partial(gym.make, env, disable_env_checker=True) if isinstance(env, str) else env
    made = make(**kwargs)
    family = made.unwrapped
    assert isinstance(family, TaskFamily), (
        f"{made} must be a task family, but is a {type(family).__name__}: subclass "
        "poem_envs.TaskFamily, or turn a goal-conditioned environment into one with "
        "poem_envs.GoalFamily"
    )
    return family


def _equal(first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> bool:
    return all(map(np.array_equal, first, second))


def _is_array(value: Any, shape: tuple[int, ...], dtype: Any) -> bool:
    return isinstance(value, np.ndarray) and value.shape == shape and value.dtype == dtype


def _is_image(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.shape[2:] == (3,)


def _check_observation(observation: Any, env: TaskFamily, origin: str) -> None:
    space = env.observation_space
    assert _is_array(observation, space.shape, space.dtype), (
        f"{origin} must return an observation of observation_space's shape {space.shape} and dtype "
        f"{space.dtype}, but gave {getattr(observation, 'shape', type(observation))} of dtype "
        f"{getattr(observation, 'dtype', None)}"
    )
    assert observation in space, (
        f"{origin} returned {observation}, which is not inside observation_space {space}; widen it"
    )


def _both_ways(
    family: Any, other: Any, method: str, tasks: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What a method gives for all tasks and rows at once, and another's one by one."""
    single = getattr(other, method)
    one_by_one = np.array([[float(single(task, row)) for row in rows] for task in tasks])
    try:
        return np.asarray(getattr(family, method)(tasks[:, None, :], rows[None, :, :])), one_by_one
    except Exception as error:
        raise AssertionError(
            f"{method} must broadcast tasks {tasks[:, None, :].shape} against "
            f"{rows[None, :, :].shape}, but raised {type(error).__name__}: {error}; index the last "
            "dimension, as in tasks[..., i]"
        ) from error
