"""Families vectorised over processes."""

import os
import signal

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from poem_envs import TaskFamily, TaskFamilyVector


class Walk(TaskFamily):
    """Its observation tells the process that it runs in, behind what matters."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    task_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    reward_feature_dim = 1

    def __init__(self, step_length=0.1, **kwargs):
        super().__init__(**kwargs)
        self.step_length = step_length

    def _begin_episode(self, rng):
        self.x = rng.normal(0.0, 0.1, size=1)
        return np.append(self.x, os.getpid())

    def _simulate(self, action):
        if action[0] == 0.125:
            raise ArithmeticError(f"no such step at {self._describe_episode()}")
        if action[0] == 0.375:
            os.kill(os.getpid(), signal.SIGKILL)
        self.x = self.x + self.step_length * action
        return np.append(self.x, os.getpid()), self.x.copy(), bool(abs(self.x[0]) > 0.3)

    def _step_info(self):
        return {"success": bool(self.x[0] > 0.1)}

    def _reward(self, tasks, features):
        return -np.abs(features[..., 0] - tasks[..., 0])


def run(envs, actions, seed=3):
    """What happens, without the process numbers."""
    observations, _ = envs.reset(seed=seed)
    seen = [observations[:, 0]]
    for action in actions:
        observations, rewards, terminations, truncations, infos = envs.step(action)
        seen += [
            observations[:, 0],
            rewards,
            terminations,
            truncations,
            infos["success"],
            infos["is_success"],
            envs.tasks,
        ]
    return seen


def test_the_number_of_processes_changes_nothing(rng):
    actions = rng.uniform(-1, 1, (40, 5, 1)).astype(np.float32)
    results = []
    for nthread in (1, 2, 9):
        envs = TaskFamilyVector(
            Walk, num_envs=5, nthread=nthread, max_episode_steps=15, step_length=0.2
        )
        processes = np.unique(envs.reset(seed=0)[0][:, 1])
        assert len(processes) == min(nthread, 5)
        assert os.getpid() in processes
        results.append(run(envs, actions))
        envs.close()
    for other in results[1:]:
        assert all(np.array_equal(one, two) for one, two in zip(results[0], other, strict=True))
    assert any(done.any() for done in results[0][3::7])  # some episodes ended early


class Windy(Walk):
    """Its steps are random, too."""

    keeps = False

    def _begin_episode(self, rng):
        self.rng = rng
        return super()._begin_episode(rng)

    def _simulate(self, action):
        rng = self.rng if self.keeps else self.np_random
        return super()._simulate(action + rng.normal(0.0, 0.1, size=1))


class WindyByItsOwn(Windy):
    keeps = True


@pytest.mark.parametrize("family", [Windy, WindyByItsOwn])
def test_steps_may_be_random(family):
    action, seen = np.zeros((3, 1), dtype=np.float32), []
    singles = [family() for _ in range(3)]
    seen.append([[one.reset(seed=4 + i)[0][0]] for i, one in enumerate(singles)])
    for one, places in zip(singles, seen[0], strict=True):
        for _ in range(2):
            places += [one.step(action[0])[0][0] for _ in range(4)]
            places.append(one.reset()[0][0])
    for nthread in (1, 2):
        envs = TaskFamilyVector(family, num_envs=3, nthread=nthread)
        places = [envs.reset(seed=4)[0]]
        for _ in range(2):
            places += [envs.step(action)[0] for _ in range(4)]
            places.append(envs.reset()[0])
        seen.append(np.array(places)[..., 0].T)
        envs.close()
    np.testing.assert_array_equal(seen[1], seen[0])
    np.testing.assert_array_equal(seen[2], seen[0])


class Interrupted(Walk):
    """Its user presses Ctrl-C while this process steps its own copies."""

    armed = 0

    def _simulate(self, action):
        if Interrupted.armed and action[0] == 0.625:
            Interrupted.armed -= 1
            raise KeyboardInterrupt
        return super()._simulate(action)


def test_after_an_interrupt_the_environment_can_be_reset_and_is_right(rng):
    actions = rng.uniform(-1, 1, (9, 4, 1)).astype(np.float32)
    reference = TaskFamilyVector(Walk, num_envs=4, nthread=2, max_episode_steps=6)
    envs = TaskFamilyVector(Interrupted, num_envs=4, nthread=2, max_episode_steps=6)
    envs.reset(seed=123)
    Interrupted.armed = 1
    with pytest.raises(KeyboardInterrupt):
        envs.step(np.full((4, 1), 0.625, dtype=np.float32))
    with pytest.raises(ResetNeeded, match="was interrupted"):
        envs.step(actions[0])
    mine, truth = (run(each, actions) for each in (envs, reference))
    assert all(np.array_equal(one, two) for one, two in zip(mine, truth, strict=True))


def test_attributes_of_the_family_are_read_and_set_on_every_copy():
    envs = TaskFamilyVector(Walk, num_envs=4, nthread=2, step_length=0.2)
    assert envs.step_length == 0.2
    with pytest.raises(AttributeError, match="no_such_thing"):
        envs.no_such_thing  # noqa: B018
    envs.set_attribute("step_length", 0.05)
    assert envs.step_length == 0.05
    before = envs.reset(seed=0)[0][:, 0]
    after = envs.step(np.ones((4, 1), dtype=np.float32))[0][:, 0]
    np.testing.assert_allclose(after - before, 0.05)


def test_attributes_outlive_an_interrupt():
    envs = TaskFamilyVector(Interrupted, num_envs=4, nthread=2, step_length=0.2)
    envs.reset(seed=0)
    envs.set_attribute("step_length", 0.05)
    Interrupted.armed = 1
    with pytest.raises(KeyboardInterrupt):
        envs.step(np.full((4, 1), 0.625, dtype=np.float32))
    before = envs.reset(seed=0)[0][:, 0]
    np.testing.assert_allclose(envs.step(np.ones((4, 1), dtype=np.float32))[0][:, 0] - before, 0.05)


def test_copies_that_could_not_be_made_are_tried_again(tmp_path):
    class Sulking(Walk):
        def __init__(self, **kwargs):
            super().__init__(**kwargs)
            if os.getpid() != parent and not (tmp_path / "sulked").exists():
                (tmp_path / "sulked").touch()
                raise OSError("not today")

    parent = os.getpid()
    envs = TaskFamilyVector(Sulking, num_envs=2, nthread=2)
    with pytest.raises(RuntimeError, match="not today"):
        envs.reset(seed=0)
    assert envs.reset(seed=0)[0].shape == (2, 2)


class Single(Walk):
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def _begin_episode(self, rng):
        return super()._begin_episode(rng).astype(np.float32)

    def _simulate(self, action):
        observation, features, terminated = super()._simulate(action)
        return observation.astype(np.float32), features, terminated


def test_observations_have_the_type_of_their_space():
    envs = TaskFamilyVector(Single, num_envs=3, nthread=2)
    assert envs.reset(seed=0)[0] in envs.observation_space
    assert envs.step(np.zeros((3, 1), dtype=np.float32))[0] in envs.observation_space


@pytest.mark.parametrize("wrong", [0, 3])
def test_an_error_names_the_copy_and_leaves_nothing_behind(wrong):
    envs = TaskFamilyVector(Walk, num_envs=4, nthread=2)
    envs.reset(seed=10)
    actions = np.zeros((4, 1))
    envs.step(actions)
    actions[wrong] = 0.125
    episode = rf"step 2 of episode 1 since reset\(seed=1{wrong}\)"
    message = f"environment copy {wrong}: ArithmeticError: no such step at {episode}"
    with pytest.raises(RuntimeError, match=message):
        envs.step(actions)
    expected = run(TaskFamilyVector(Walk, num_envs=4, nthread=1), np.zeros((3, 4, 1)))
    assert all(
        np.array_equal(a, b) for a, b in zip(run(envs, np.zeros((3, 4, 1))), expected, strict=True)
    )
    envs.close()


def test_a_worker_that_was_killed_is_reported():
    envs = TaskFamilyVector(Walk, num_envs=2, nthread=2)
    envs.reset(seed=0)
    with pytest.raises(
        RuntimeError, match="worker process of the environment ended with exit status -9"
    ):
        envs.step(np.array([[0.375], [0.0]]))
    envs.close()


def test_closing_ends_the_workers():
    envs = TaskFamilyVector(Walk, num_envs=2, nthread=2)
    worker = next(pid for pid in envs.reset(seed=0)[0][:, 1].astype(int) if pid != os.getpid())
    envs.close()
    envs.close()
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


def test_constructor_arguments():
    with pytest.raises(ValueError, match="nthread=0 must be at least 1"):
        TaskFamilyVector(Walk, num_envs=2, nthread=0)
    with pytest.raises(ValueError, match="num_envs=0"):
        TaskFamilyVector(Walk, num_envs=0)
    with pytest.raises(TypeError, match=r"makes a Box, but it must make a poem_envs\.TaskFamily"):
        TaskFamilyVector(lambda: Walk.task_space)
