"""POEMSAC learns: its policies know their tasks, and its embeddings order them as the tasks'
preferences do.
"""

from __future__ import annotations

import numpy as np
import pytest
from meta_toys import LEARN, LEARN_EPOCH, POINT_GOAL, Unequal, point_goal_bounds, small, walks

from sb3_poem import POEMSAC
from sb3_poem.adaptation.evaluation import evaluate_episodes
from sb3_poem.adaptation.known_task import known_task_return, preference_order, return_matrix
from sb3_poem.common.vec_env import TaskVecEnv, make_task_vec_env

QUICK = {**LEARN, "kl_coef": 0.02, "tau": 0.1}
STEPS = 8 * LEARN_EPOCH


def preference_accuracy(model: POEMSAC, env: TaskVecEnv) -> float:
    """Share of all (i, j, k) of the training tasks that S puts in the order of fresh episodes'
    returns.
    """
    returns = return_matrix(
        model, env, model.train_tasks.tasks, model.task_latents, n_episodes=2, seed=9
    )
    similarity = model.similarities(model.task_latents, model.task_latents)
    truth = np.sign(returns[:, :, None] - returns[:, None, :])
    guess = np.sign(similarity[:, :, None] - similarity[:, None, :])
    return float((truth == guess)[truth != 0].mean())


def test_poem_learns_point_goal() -> None:
    """A third of the way from the best that a policy can do blindly to the best that there is."""
    model = POEMSAC("MlpPolicy", POINT_GOAL, **QUICK).learn(STEPS)
    env = make_task_vec_env(POINT_GOAL, 20)
    own = evaluate_episodes(
        model, env, model.task_latents, model.train_tasks.tasks, n_episodes=2, seed=5
    ).returns.mean()
    blind, known = point_goal_bounds(model.train_tasks.tasks)
    assert own > blind + 0.35 * (known - blind)
    assert preference_accuracy(model, env) > 0.8
    # on tasks that it never saw, too (Property 1)
    unseen = model.family.sample_tasks(20, np.random.default_rng(77))
    accuracy, tau = preference_order(
        model, known_task_return(model, env, unseen, n_latents=50, n_episodes=1)
    )
    assert accuracy > 0.75
    assert tau > 0.5


@pytest.mark.slow
def test_preferences_are_ordered_by_the_preference_loss_alone() -> None:
    """Without its loss, the embeddings order at random: actor, critics and decoder do not do it for
    them.
    """
    model = POEMSAC("MlpPolicy", POINT_GOAL, **QUICK, preference_coef=0.0).learn(STEPS)
    assert preference_accuracy(model, make_task_vec_env(POINT_GOAL, 20)) < 0.7


def test_tasks_of_small_rewards_are_learned_beside_others() -> None:
    """They lie to the left: with one scale for all tasks their policies stay where they begin, or
    go to the right. Who stays earns minus the distance, ten times.
    """
    quick = {"gradient_steps": 50, "learning_rate": 6e-3, "tau": 0.1, "gamma": 0.9, "seed": 1}
    model = small(
        POEMSAC, walks(8, Unequal), n_train_tasks=8, horizon=10, reward_scale="per-task", **quick
    ).learn(1_000)
    goals = model.train_tasks.tasks[:, 0]
    places, distances = np.zeros(8), np.zeros(8)
    for step in range(10):
        seen = np.stack([places, np.full(8, 0.1 * step)], axis=1)
        actions, _ = model.predict(seen, state=model.task_latents, deterministic=True)
        places = places + 0.1 * actions[:, 0]
        distances += np.abs(places - goals)
    far = goals < -0.2
    assert distances[far].mean() < 0.5 * 10 * np.abs(goals[far]).mean()
