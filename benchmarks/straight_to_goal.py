"""What MetaWorldML1 (reach) allows: a controller that sees the goal moves the hand straight to it.

    python benchmarks/straight_to_goal.py

On the benchmark's 30 test tasks, an episode each; writes
``benchmarks/results/MetaWorldML1/straight-to-goal.md``.
"""

import gymnasium as gym
import numpy as np
from common import RESULTS, table, write

import sb3_poem  # noqa: F401  registers the families
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env

ENV_ID = "poem/MetaWorldML1-v0"
GAINS = (3.0, 10.0, 30.0)


def episode(env: gym.Env, goal: np.ndarray, gain: float) -> tuple[float, bool]:
    """Return, and whether the hand ended within 5 cm of the goal."""
    obs, _ = env.reset(seed=0, options={"task": goal})
    total, over, info = 0.0, False, {}
    while not over:
        action = np.append(np.clip(gain * (goal - obs[:3]), -1.0, 1.0), 0.0).astype(np.float32)
        obs, reward, terminated, truncated, info = env.step(action)
        total, over = total + float(reward), terminated or truncated
    return total, bool(info["success"])


def main() -> None:
    tasks = FamilyView(make_task_vec_env(ENV_ID, 1)).test_tasks(30, 100)
    env = gym.make(ENV_ID)
    rows = []
    for gain in GAINS:
        outcomes = [episode(env, goal, gain) for goal in tasks]
        returns = np.array([total for total, _ in outcomes])
        figures = [f"{value:.1f}" for value in (returns.mean(), returns.min(), returns.max())]
        rows.append([gain, *figures, f"{np.mean([success for _, success in outcomes]):.2f}"])
    sections = ["`action = gain (goal - hand)`, clipped; 30 test tasks."]
    sections.append(table(["gain", "mean return", "least", "most", "success"], rows))
    title = "MetaWorldML1 (reach): straight to the goal"
    write("straight-to-goal", title, sections, None, RESULTS / "MetaWorldML1", {})


if __name__ == "__main__":
    main()
