"""Does an environment keep the contract of a task family? A check of our families and of yours,
like SB3's ``check_env``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from poem_envs.family import TaskFamily, definition_problem
from poem_envs.registration import plain_id
from poem_envs.vector import TaskFamilyVector

MakeFamily = Callable[..., Any]

#: Steps whose images are compared: drawing is slow.
N_IMAGES = 3


def check_task_family(
    env: str | Callable[..., gym.Env],
    *,
    n_steps: int = 12,
    seed: int = 0,
    render: bool = True,
    **env_kwargs: Any,
) -> None:
    """Check that an environment keeps the contract of a task family, so that training, relabelling
    and adaptation are right.

    It checks the spaces, the drawing of tasks, seeds, when a task takes effect, that the task is
    hidden, that relabelling is exact, the potential and the symmetries (of a family that has them),
    the vectorised version (of a registered id that has one), rendering and closing, in this order.

    :param env: The id of a registered environment, or a class or function that makes one
    :param n_steps: How many steps of an episode to compare; the episode may be shorter
    :param seed: Of the episodes, tasks and actions
    :param render: Whether to check rendering, which needs OpenGL for MuJoCo environments
    :param env_kwargs: Arguments of the environment
    :raises AssertionError: At the first violation; the message says what to change
    """
    if isinstance(env, str):
        env = plain_id(env)
    elif not callable(env):
        raise TypeError(
            f"env is {env!r}, but must be a class or a function that makes it, or a registered id"
        )
    make = partial(_make, env, **env_kwargs)
    check_spaces(make, seed)
    check_sampling(make, seed)
    check_seeds(make, n_steps, seed)
    check_set_task(make, seed)
    check_hidden_task(make, n_steps, seed)
    check_relabelling(make, n_steps, seed)
    check_potential(make, n_steps, seed)
    check_symmetries(make)
    if isinstance(env, str):
        check_registration(env)
        if gym.spec(env).vector_entry_point is not None:
            check_vector_parity(env, env_kwargs, n_steps, seed)
    if render:
        check_rendering(make, n_steps, seed)
    check_closing(make, seed)


@dataclass
class Episode:
    """What a run of actions gave: arrays with one row a step, and of observations one more."""

    observations: np.ndarray
    rewards: np.ndarray
    features: np.ndarray


def check_spaces(make: MakeFamily, seed: int) -> None:
    """Boxes of the right shapes and types, which hold what the environment returns."""
    env = make()
    problem = definition_problem(env)
    assert problem is None, problem
    dim = env.reward_feature_dim
    observation, _ = env.reset(seed=seed)
    _check_observation(observation, env, "reset")
    observation, reward, _, _, info = env.step(_actions(env, 1, seed)[0])
    _check_observation(observation, env, "step")
    ok = isinstance(reward, float) and np.isfinite(reward)
    assert ok, f"step must return a finite float as reward, but gave {reward!r}"
    features = info["reward_features"]
    ok = (
        isinstance(features, np.ndarray)
        and features.dtype == np.float64
        and features.shape == (dim,)
    )
    assert ok, (
        f'info["reward_features"] must be a float64 array of shape (reward_feature_dim,) = ({dim},), but is {features!r}; '
        "return it from _simulate"
    )
    if "success" in info:
        ok = isinstance(info["success"], (bool, np.bool_))
        assert ok, (
            f'info["success"] must be a bool, but is {info["success"]!r}; convert it in _step_info'
        )


def check_sampling(make: MakeFamily, seed: int) -> None:
    """Tasks come from the given generator alone, and are tasks."""
    env = make()
    env.reset(seed=seed)
    before = env.np_random.bit_generator.state
    n = 8 if env.all_tasks is None else len(env.all_tasks)
    tasks = env.sample_tasks(n, np.random.default_rng(seed))
    expected = (n, *env.task_space.shape)
    ok = isinstance(tasks, np.ndarray) and tasks.shape == expected and tasks.dtype == np.float64
    assert ok, (
        f"sample_tasks({n}, rng) must return a float64 array of shape {expected}, but gave {tasks!r}"
    )
    for task in tasks:
        assert task in env.task_space, (
            f"sample_tasks drew {task}, which is not in task_space {env.task_space}; widen task_space"
        )
    assert len(np.unique(tasks, axis=0)) > 1, (
        "sample_tasks must draw different tasks, but all of them are equal"
    )
    again = env.sample_tasks(n, np.random.default_rng(seed))
    assert np.array_equal(tasks, again), (
        "sample_tasks must draw from the generator that it is given, but gave other tasks for an equal one; "
        "use no other randomness in _draw_tasks"
    )
    assert env.np_random.bit_generator.state == before, (
        "sample_tasks must leave the environment's own generator alone; draw from its argument rng in place of self.np_random"
    )


def check_seeds(make: MakeFamily, n_steps: int, seed: int) -> None:
    """A seed determines the task and the episode, in this environment as in another, whatever was
    done before.
    """
    env, other = make(), make()
    actions = _actions(env, n_steps, seed)
    first = _run(env, actions, seed=seed)
    task = env.task
    _run(other, actions[::-1], seed=seed + 1)
    for again, where in (
        (_run(env, actions, seed=seed), "again"),
        (_run(other, actions, seed=seed), "in another copy"),
    ):
        assert _equal(first, again), (
            f"reset(seed={seed}) and the same actions must give the same episode {where}, but did not: draw all randomness "
            "from the rng that _begin_episode is given, and reset the whole state of the simulator there"
        )
    for family in (env, other):
        assert np.array_equal(family.task, task), (
            f"reset(seed={seed}) must draw the same task every time"
        )


def check_set_task(make: MakeFamily, seed: int) -> None:
    """A task takes effect at the next reset, and stays."""
    env = make()
    first, second = _two_tasks(env, seed)
    actions = _actions(env, 2, seed)
    env.set_task(first)
    env.reset(seed=seed)
    assert np.array_equal(env.task, first), (
        f"after set_task and reset, task must be {first}, but is {env.task}"
    )
    env.step(actions[0])
    env.set_task(second)
    _, reward, _, _, info = env.step(actions[1])
    kept, changed = (
        float(env.compute_rewards(task, info["reward_features"])) for task in (first, second)
    )
    ok = np.array_equal(env.task, first) and not (reward == changed != kept)
    assert ok, (
        "set_task must take effect at the next reset only, but it changed the episode under way"
    )
    env.reset()
    assert np.array_equal(env.task, second), (
        "a reset after set_task must bring the new task into effect, but it did not"
    )
    env.reset(seed=seed)
    assert np.array_equal(env.task, second), (
        "a chosen task must stay chosen over resets with a seed, but another was drawn"
    )
    env.reset(options={"task": first})
    assert np.array_equal(env.task, first), (
        'reset(options={"task": task}) must set the task, but did not'
    )


def check_hidden_task(make: MakeFamily, n_steps: int, seed: int) -> None:
    """Where tasks differ in the reward alone, nothing that the agent sees depends on them."""
    env = make()
    if not env.shared_dynamics:
        return
    actions = _actions(env, n_steps, seed)
    first, second = (
        _run(env, actions, seed=seed, options={"task": task}) for task in _two_tasks(env, seed)
    )
    n = min(len(first.rewards), len(second.rewards))
    assert np.array_equal(first.observations[0], second.observations[0]), (
        "the first observation must not depend on the task, but two tasks with the same seed begin differently: leave the "
        "task out of the observation and out of the start, or set shared_dynamics = False"
    )
    assert np.array_equal(first.observations[: n + 1], second.observations[: n + 1]), (
        "observations must not depend on the task, but two tasks with the same seed and actions give different ones: leave "
        "the task out of the observation and the dynamics, or set shared_dynamics = False"
    )
    assert np.array_equal(first.features[:n], second.features[:n]), (
        "reward features must not depend on the task, but two tasks with the same seed and actions give different ones: "
        "return what the reward is computed from, and let _reward combine it with the task (or set shared_dynamics = False)"
    )
    assert len(first.rewards) == len(second.rewards), (
        "an episode's end must not depend on the task, but two tasks with the same seed and actions end differently: leave "
        "the task out of `terminated`, or set shared_dynamics = False"
    )


def check_relabelling(make: MakeFamily, n_steps: int, seed: int) -> None:
    """Rewards are exactly a pure function of task and features."""
    env, other = make(), make()
    other.reset(seed=seed + 1)
    actions = _actions(env, n_steps, seed)
    tasks = np.stack(_two_tasks(env, seed))
    episodes = [_run(env, actions, seed=seed, options={"task": task}) for task in tasks]
    for task, episode in zip(tasks, episodes, strict=True):
        for source, name in ((env, "this"), (other, "another")):
            rewards = np.array(
                [float(source.compute_rewards(task, row)) for row in episode.features]
            )
            assert np.array_equal(rewards, episode.rewards), (
                f"step must return exactly compute_rewards(task, info['reward_features']), but {name} environment's gives "
                f"{rewards.tolist()} for the rewards {episode.rewards.tolist()}: compute the reward in _reward alone, from "
                "its arguments alone, with no state of the environment, and return new arrays of features"
            )
    features = episodes[0].features
    try:
        together = env.compute_rewards(tasks[:, None, :], features[None, :, :])
    except Exception as error:
        raise AssertionError(
            "compute_rewards must broadcast tasks (n, 1, task_dim) against features (1, m, reward_feature_dim), but raised "
            f"{type(error).__name__}: {error}; index the last dimension in _reward by tasks[..., i] and features[..., i]"
        ) from error
    one_by_one = np.array(
        [[float(env.compute_rewards(task, row)) for row in features] for task in tasks]
    )
    assert np.array_equal(together, one_by_one), (
        "compute_rewards must give many rewards at once exactly as one after another, but does not: "
        "use elementwise operations in _reward, on the last dimension by tasks[..., i] and features[..., i]"
    )


def check_potential(make: MakeFamily, n_steps: int, seed: int) -> None:
    """A potential is a finite, pure function of task and observation, for many at once as for one."""
    env = make()
    if not env.has_potential:
        return
    tasks = np.stack(_two_tasks(env, seed))
    observations = _run(
        env, _actions(env, n_steps, seed), seed=seed, options={"task": tasks[0]}
    ).observations
    try:
        together = np.asarray(env.compute_potential(tasks[:, None, :], observations[None, :, :]))
    except Exception as error:
        raise AssertionError(
            "compute_potential must broadcast tasks (n, 1, task_dim) against observations (1, m, obs_dim), but raised "
            f"{type(error).__name__}: {error}; in _potential index the last dimension, as in tasks[..., i]"
        ) from error
    env.reset(seed=seed + 1)
    one_by_one = np.array(
        [[float(env.compute_potential(task, row)) for row in observations] for task in tasks]
    )
    ok = together.shape == one_by_one.shape and np.allclose(together, one_by_one, rtol=1e-6)
    assert ok, (
        "compute_potential must give many potentials at once as one after another, but does not: compute them in _potential "
        "from its arguments alone, by elementwise operations on the last dimension"
    )
    assert np.isfinite(together).all(), (
        f"compute_potential must give finite numbers, but gave {together.tolist()}"
    )


def check_symmetries(make: MakeFamily) -> None:
    """Symmetries fit the spaces. Whether the dynamics have them cannot be seen from outside:
    compare steps from a state and from its mirror image in a test of your own.
    """
    env = make()
    observation_space, action_space = env.observation_space, env.action_space
    parts = (
        (
            "observations",
            observation_space.shape[0],
            (observation_space.low, observation_space.high),
        ),
        ("actions", action_space.shape[0], (action_space.low, action_space.high)),
        ("features", env.reward_feature_dim, None),
    )
    for number, symmetry in enumerate(env.symmetries):
        for name, width, bounds in parts:
            what, permutation = f"symmetries[{number}].{name}", getattr(symmetry, name)
            assert sorted(permutation.order) == list(range(width)), (
                f"{what}.order must hold each of the indices 0 to {width - 1} once, but is {permutation.order}"
            )
            assert (
                len(permutation.signs) == width == sum(abs(sign) == 1 for sign in permutation.signs)
            ), f"{what}.signs must be {width} of 1 and -1, but is {permutation.signs}"
            if bounds is not None:
                given, mirrored = (
                    np.stack(bounds),
                    np.sort([permutation(bound) for bound in bounds], axis=0),
                )
                assert np.array_equal(mirrored, given), (
                    f"{what} must leave the bounds of the space as they are, but makes {mirrored.tolist()} of {given.tolist()}"
                )


def check_registration(env_id: str) -> None:
    """An id says how long episodes are."""
    assert gym.spec(env_id).max_episode_steps is not None, (
        f"{env_id} must have a time limit, the horizon of training: register it with max_episode_steps=<steps>"
    )


def check_vector_parity(env_id: str, env_kwargs: dict[str, Any], n_steps: int, seed: int) -> None:
    """The vectorised version equals single environments bit for bit, over ends of episodes and a
    change of tasks.
    """
    n, horizon = 3, max(2, n_steps // 2)
    arguments = {**env_kwargs, "max_episode_steps": horizon}
    vector_env = gym.make_vec(
        env_id, num_envs=n, vectorization_mode="vector_entry_point", **arguments
    )
    assert isinstance(vector_env, TaskFamilyVector), (
        f"the vector_entry_point of {env_id} must make a poem_envs.TaskFamilyVector, but makes a {type(vector_env).__name__}; "
        "use functools.partial(poem_envs.ProcessFamilyVector, YourFamily)"
    )
    singles = [_make(env_id, **env_kwargs) for _ in range(n)]  # whose time limit is counted here
    lengths = np.zeros(n, dtype=int)
    advice = (
        "must equal the single environment's bit for bit, but do not: let both run the same code"
    )
    tasks = np.stack([*_two_tasks(singles[0], seed)] * 2)[:n]
    observations, _ = vector_env.reset(seed=seed)
    expected = np.stack([single.reset(seed=seed + i)[0] for i, single in enumerate(singles)])
    assert np.array_equal(observations, expected), (
        f"observations of the vectorised version's reset {advice}"
    )
    for step, actions in enumerate(
        np.stack([_actions(singles[0], n_steps + 2, seed + i) for i in range(n)], axis=1)
    ):
        if step == 1:
            vector_env.set_tasks(tasks)
            for single, task in zip(singles, tasks, strict=True):
                single.set_task(task)
        observations, rewards, terminations, truncations, infos = vector_env.step(actions)
        for i, single in enumerate(singles):
            observation, reward, terminated, _, info = single.step(actions[i])
            lengths[i] += 1
            truncated = lengths[i] == horizon
            assert reward == rewards[i], f"rewards of the vectorised version {advice}"
            assert (terminated, truncated) == (terminations[i], truncations[i]), (
                f"ends of the vectorised version {advice}"
            )
            for key, value in info.items():
                assert np.array_equal(value, infos[key][i]), (
                    f"infos[{key!r}] of the vectorised version {advice}"
                )
            if terminated or truncated:
                observation, _ = single.reset()
                lengths[i] = 0
            assert np.array_equal(observation, observations[i]), (
                f"observations of the vectorised version {advice}"
            )
    vector_env.close()
    for single in singles:
        single.close()


def check_rendering(make: MakeFamily, n_steps: int, seed: int) -> None:
    """Images are images, show no task unless asked to, and drawing them changes nothing."""
    plain = make()
    if "rgb_array" not in plain.metadata.get("render_modes", []):
        return
    env = make(render_mode="rgb_array")
    actions = _actions(env, n_steps, seed)[:N_IMAGES]
    first, second = _two_tasks(env, seed)
    silent = _run(plain, actions, seed=seed, options={"task": first})
    images: list[np.ndarray] = []
    drawn = _run(
        env,
        actions,
        seed=seed,
        options={"task": first},
        each_step=lambda: images.append(env.render()),
    )
    ok = all(
        isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.shape[2:] == (3,)
        for image in images
    )
    assert ok, (
        'render() with render_mode="rgb_array" must return a uint8 array of shape (height, width, 3)'
    )
    assert _equal(silent, drawn), (
        "rendering must not change the episode, but it did: leave the simulator's state in render() as it was"
    )
    if env.shared_dynamics and not env.render_task:
        others: list[np.ndarray] = []
        _run(
            env,
            actions,
            seed=seed,
            options={"task": second},
            each_step=lambda: others.append(env.render()),
        )
        assert np.array_equal(images[: len(others)], others[: len(images)]), (
            "images must not show the task unless render_task=True, but two tasks with the same seed and actions look "
            "different: draw what marks the task only if self.render_task"
        )
    env.close()


def check_closing(make: MakeFamily, seed: int) -> None:
    """``close`` can be called twice."""
    env = make()
    env.reset(seed=seed)
    env.close()
    try:
        env.close()
    except Exception as error:
        raise AssertionError(
            f"close() must be callable twice, but the second call raised {type(error).__name__}: {error}; release what is "
            "held and forget it"
        ) from error


def _make(env: str | Callable[..., gym.Env], **kwargs: Any) -> TaskFamily:
    made = (
        gym.make(env, disable_env_checker=True, **kwargs) if isinstance(env, str) else env(**kwargs)
    )
    family = made.unwrapped
    assert isinstance(family, TaskFamily), (
        f"{made} must be a task family, but is a {type(family).__name__}: subclass poem_envs.TaskFamily, or turn a "
        "goal-conditioned environment into one with poem_envs.GoalFamily"
    )
    return family


def _check_observation(observation: Any, env: TaskFamily, origin: str) -> None:
    space = env.observation_space
    ok = (
        isinstance(observation, np.ndarray)
        and observation.shape == space.shape
        and observation.dtype == space.dtype
    )
    assert ok, (
        f"{origin} must return an observation of observation_space's shape {space.shape} and dtype {space.dtype}, but gave "
        f"{getattr(observation, 'shape', type(observation))} of dtype {getattr(observation, 'dtype', None)}"
    )
    assert observation in space, (
        f"{origin} returned {observation}, which is not inside observation_space {space}; widen it"
    )


def _actions(env: gym.Env, n: int, seed: int) -> np.ndarray:
    space = env.action_space
    assert isinstance(space, spaces.Box)
    draws = np.random.default_rng([seed, 1]).uniform(space.low, space.high, size=(n, *space.shape))
    return draws.astype(space.dtype)


def _two_tasks(env: Any, seed: int) -> tuple[np.ndarray, np.ndarray]:
    first, second = env.sample_tasks(2, np.random.default_rng([seed, 2]))
    return first, second


def _run(
    env: TaskFamily,
    actions: np.ndarray,
    each_step: Callable[[], Any] = lambda: None,
    **reset_arguments: Any,
) -> Episode:
    """An episode, whose arrays are kept as they came: one that the environment reuses is caught by
    the comparison.
    """
    observation, _ = env.reset(**reset_arguments)
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
    return Episode(np.array(observations), np.array(rewards), np.array(features))


def _equal(one: Episode, other: Episode) -> bool:
    pairs = (
        (one.observations, other.observations),
        (one.rewards, other.rewards),
        (one.features, other.features),
    )
    return all(np.array_equal(a, b) for a, b in pairs)
