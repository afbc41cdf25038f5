"""A model of a family against Stable-Baselines3's SAC that is trained on one known task, with as
many updates, once for each of a few tasks.

    python benchmarks/single_task_sac.py --model MODEL.zip --gym-packages gymnasium_robots

Both earn the mean return of deterministic episodes on the same tasks. SAC has its own defaults and
makes an update a step; the model adapts by ten exact answers (``adapted``), or takes the best of
its latents (``known``). ``random`` is SAC before its first update, the zero of shares.
"""

import importlib
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from common import arguments
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy

from poem_envs import set_task
from sb3_poem import Bayes
from sb3_poem.adaptation import evaluate_adaptation, known_task_return
from sb3_poem.loading import load_model


def main() -> None:
    args = arguments(
        __doc__,
        model={"required": True},
        gym_packages={"nargs": "*", "default": []},
        tasks=5,
        episodes=10,
        seed=0,
        out={"type": Path, "help": "write the figures to this file, as JSON"},
    )
    for package in args.gym_packages:
        importlib.import_module(package)
    th.set_num_threads(1)
    model = load_model(args.model)
    env = gym.make(model.env_id, **model.env_kwargs)
    tasks = env.unwrapped.sample_tasks(args.tasks, np.random.default_rng(args.seed))
    measured = {"n_episodes": args.episodes, "seed": args.seed}
    adapted = evaluate_adaptation(model, env, tasks, rule=Bayes(), record_at=(0, 10), **measured)
    known = known_task_return(model, env, tasks, selection_episodes=3, **measured)
    record = {
        "env_id": model.env_id,
        "updates": model._n_updates,
        "before": adapted.mean_returns[0],
        "adapted": adapted.mean_returns[-1],
        "known": known.mean_return,
        "sac": [],
        "random": [],
    }
    for task in tasks:
        set_task(env, task)
        agent = SAC("MlpPolicy", env, seed=args.seed)
        record["random"].append(evaluate_policy(agent, env, args.episodes, deterministic=False)[0])
        agent.learn(agent.learning_starts + model._n_updates)
        record["sac"].append(evaluate_policy(agent, env, args.episodes)[0])
        print(task, record["random"][-1], record["sac"][-1], flush=True)
    sac, nothing = np.mean(record["sac"]), np.mean(record["random"])
    for name in ("before", "adapted", "known"):
        record[f"{name}_share"] = (record[name] - nothing) / (sac - nothing)
    print(json.dumps(record, indent=1))
    if args.out is not None:
        args.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
