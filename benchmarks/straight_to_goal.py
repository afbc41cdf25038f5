"""What MetaWorldML1 (reach) allows: a controller that sees the goal moves the hand straight to it.

    python benchmarks/straight_to_goal.py

On the benchmark's 30 test tasks, an episode each; writes
``benchmarks/results/MetaWorldML1/straight-to-goal.md``.
"""

import gymnasium as gym
import numpy as np
from common import RESULTS

import sb3_poem  # noqa: F401  registers the families
from sb3_poem.benchmark.provenance import commit, machine
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
    """Measure and write."""
    tasks = FamilyView(make_task_vec_env(ENV_ID, 1)).test_tasks(30, 100)
    env = gym.make(ENV_ID)
    lines = [
        "# MetaWorldML1 (reach): straight to the goal",
        "",
        "`action = gain (goal - hand)`, clipped; 30 test tasks.",
        "",
    ]
    lines += ["| gain | mean return | least | most | success |", "|---|---|---|---|---|"]
    for gain in GAINS:
        outcomes = [episode(env, goal, gain) for goal in tasks]
        returns = np.array([total for total, _ in outcomes])
        success = np.mean([succeeded for _, succeeded in outcomes])
        lines.append(
            f"| {gain:g} | {returns.mean():.1f} | {returns.min():.1f} | {returns.max():.1f} | {success:.2f} |"
        )
    lines += ["", f"By `benchmarks/straight_to_goal.py` at {commit()}. Machine: {machine()}."]
    (RESULTS / "MetaWorldML1" / "straight-to-goal.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
