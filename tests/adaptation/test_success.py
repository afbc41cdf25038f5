"""Success rates beside returns: in evaluation, the callback's log, the command line and the
benchmark's table.
"""

import functools
import json

import gymnasium as gym
import numpy as np
import pytest
from worlds import Walk1D

from poem_envs import TaskFamilyVector
from sb3_poem import POEMSAC, AdaptationEvalCallback
from sb3_poem.adaptation import evaluate_adaptation, evaluate_episodes, known_task_return
from sb3_poem.cli import main
from sb3_poem.common.vec_env import make_task_vec_env

SMALL = {"net_arch": {"pi": [16], "qf": [16], "encoder": [16], "decoder": [16], "embedding": [8]}}


class Walk(Walk1D):
    def _step_info(self):
        return {"success": bool(abs(self.x[0] - self._task[0]) < 0.1)}


@pytest.fixture(scope="module")
def env_id():
    for name, vectorised in (("test/WalkToSuccess-v0", True), ("test/WalkOneByOne-v0", False)):
        vector = (
            {"vector_entry_point": functools.partial(TaskFamilyVector, Walk, nthread=1)}
            if vectorised
            else {}
        )
        gym.register(name, entry_point=Walk, max_episode_steps=10, **vector)
    yield "test/WalkToSuccess-v0"
    for name in ("test/WalkToSuccess-v0", "test/WalkOneByOne-v0"):
        del gym.registry[name]


def make_model(env_id, env=None):
    options = {
        "batch_size": 8,
        "context_size": 8,
        "meta_batch_size": 4,
        "gradient_steps": 2,
        "policy_kwargs": SMALL,
    }
    return POEMSAC(
        "MlpPolicy", env or make_task_vec_env(env_id, 4), n_train_tasks=4, seed=0, **options
    )


def by_hand(model, latent, task, seed):
    """Whether one episode is a success, from its positions."""
    env = gym.make("test/WalkToSuccess-v0")
    observation, _ = env.reset(seed=seed, options={"task": task})
    reached, truncated = False, False
    while not truncated:
        action, _ = model.predict(observation[None], state=latent[None], deterministic=True)
        observation, _, _, truncated, _ = env.step(action[0])
        reached |= bool(abs(observation[0] - task[0]) < 0.1)
    return reached


def test_successes_are_those_of_the_evaluated_episodes(env_id):
    from sb3_poem.adaptation.evaluation import evaluation_seed

    model = make_model(env_id)
    tasks = np.linspace(-0.6, 0.6, 6)[:, None]
    result = evaluate_adaptation(model, model.env, tasks, record_at=(0, 2), n_episodes=2, seed=1)
    expected = np.array(
        [
            [
                [
                    by_hand(model, result.latents[i, k], task, evaluation_seed(1) + 6 * episode + i)
                    for episode in range(2)
                ]
                for k in range(2)
            ]
            for i, task in enumerate(tasks)
        ]
    )
    assert 0 < expected.mean() < 1
    assert np.array_equal(result.successes, expected)
    assert result.success_rates == pytest.approx(expected.mean(axis=(0, 2)))
    data = result.to_dict()
    assert data["success_rate"] == pytest.approx(expected.mean(axis=(0, 2)).tolist())
    assert np.array(data["task_success_rates"]) == pytest.approx(expected.mean(axis=2))
    known = known_task_return(
        model, model.env, tasks, n_latents=5, n_episodes=3, seed=1, limits=False
    )
    assert known.successes.shape == (6, 3)
    assert known.success_rate == known.successes.mean()


def test_a_family_without_successes_has_no_rates():
    model = POEMSAC(
        "MlpPolicy",
        make_task_vec_env("poem/PointGoal-v0", 4),
        n_train_tasks=4,
        seed=0,
        policy_kwargs=SMALL,
    )
    tasks = np.array([[0.5], [1.0]])
    result = evaluate_adaptation(model, model.env, tasks, record_at=(0,), n_episodes=1)
    assert result.successes is None
    assert result.success_rates is None
    assert "success_rate" not in result.to_dict()
    assert evaluate_episodes(model, model.env, np.zeros((2, 5)), tasks, 1).returns.shape == (2, 1)


@pytest.mark.parametrize("name", ["test/WalkToSuccess-v0", "test/WalkOneByOne-v0"])
def test_the_callback_logs_them(env_id, name, tmp_path):
    callback = AdaptationEvalCallback(every=1, n_tasks=3, record_at=(0, 1), n_episodes=2)
    env = None if name == env_id else gym.make(name)
    model = make_model(env_id, env).learn(80, callback=callback)
    metrics = callback.last_evaluation
    for key in (
        "success_rate_after_0_queries",
        "success_rate_after_1_queries",
        "known_task_success_rate",
    ):
        assert 0.0 <= metrics[key] <= 1.0
        assert metrics[key] * 6 == pytest.approx(round(metrics[key] * 6))  # of 3 tasks x 2 episodes
    assert model.ep_success_buffer  # SB3's own rollout/success_rate


def test_the_command_line_reports_them(env_id, tmp_path, capsys):
    model = make_model(env_id)
    model.save(tmp_path / "model.zip")
    out = tmp_path / "adapt.json"
    command = [
        "adapt",
        "--model",
        str(tmp_path / "model.zip"),
        "--env",
        env_id,
        "--tasks",
        "3",
        "--queries",
        "2",
    ]
    assert main([*command, "--episodes", "2", "--json", str(out)]) in (None, 0)
    data = json.loads(out.read_text())
    assert len(data["success_rate"]) == 3
    assert np.array(data["task_success_rates"]).shape == (3, 3)
    assert np.mean(data["task_success_rates"], axis=0) == pytest.approx(data["success_rate"])
    assert 0.0 <= data["known_task_success_rate"] <= 1.0
    assert "success rate" in capsys.readouterr().out
