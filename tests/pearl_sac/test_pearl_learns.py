"""PEARLSAC learns: its policies know their tasks."""

import numpy as np
import torch as th
from meta_toys import LEARN, LEARN_EPOCH, POINT_GOAL, experience_of, point_goal_bounds

from sb3_poem import PEARLSAC
from sb3_poem.adaptation.evaluation import evaluate_episodes
from sb3_poem.common.vec_env import make_task_vec_env


def test_pearl_learns_point_goal() -> None:
    """A fifth of the way from the best that a policy can do blindly to the best that there is."""
    quick = {**LEARN, "kl_coef": 0.02, "tau": 0.1}
    model = PEARLSAC("MlpPolicy", POINT_GOAL, **quick).learn(7 * LEARN_EPOCH)
    tasks, latents = model.train_tasks.tasks, model.task_latents
    env = make_task_vec_env(POINT_GOAL, len(tasks))
    own = evaluate_episodes(model, env, latents, tasks, n_episodes=2, seed=5).returns.mean()
    blind, known = point_goal_bounds(tasks)
    assert own > blind + 0.2 * (known - blind)
    # and it is the latent that tells: with those of other tasks the policies go elsewhere
    foreign = evaluate_episodes(
        model, env, np.roll(latents, 7, axis=0), tasks, n_episodes=2, seed=5
    ).returns.mean()
    assert foreign < blind
    # the decoder knows a reward to a tenth: rewards deviate by about 0.35, distances are about 1
    assert model.predicted_rewards_error < 0.2
    rewards = th.cat(
        [experience_of(model.replay_buffer, task).rewards for task in range(len(tasks))], dim=1
    )
    assert model.predicted_rewards_error < 0.5 * rewards.std().item()
