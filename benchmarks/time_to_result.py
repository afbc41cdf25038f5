"""How long does training take until ten answers are enough? The clock stops for evaluations.

python benchmarks/time_to_result.py [--env poem/HalfCheetahVel-v0] [--target -46] [--seeds 0 1 2]

Trains with the hyperparameters of `zoo_configs/poem_sac.yml` (or `--conf`). After the epochs that
`--from-step` and `--every` name, the model is adapted to 30 test tasks by ten error-free answers
each; training ends when their mean return reaches the target.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from common import arguments, available_device, table, write
from rl_zoo3.utils import linear_schedule

from sb3_poem import POEMSAC
from sb3_poem.adaptation.evaluation import evaluate_adaptation
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.callbacks import EpochCallback
from sb3_poem.resources import zoo_entry

N_TASKS, N_EPISODES, N_QUERIES = 30, 10, 10


class Clock(EpochCallback):
    """Times training, evaluates between epochs, and ends it at the target.

    :param env_id: The family
    :param target: Mean return that ends training
    :param rules: Inference rules, any of which may reach it
    :param test_seed: Seed of the test tasks
    :param from_step: Environment steps before the first evaluation
    :param every: Epochs between two evaluations
    """

    def __init__(
        self,
        env_id: str,
        target: float,
        rules: list[str],
        test_seed: int,
        from_step: int,
        every: int,
    ) -> None:
        super().__init__(every)
        self.target, self.rules, self.test_seed, self.from_step = (
            target,
            rules,
            test_seed,
            from_step,
        )
        self.env = make_task_vec_env(env_id, 2 * N_TASKS)
        self.tasks = FamilyView(self.env).sample_tasks(
            N_TASKS, np.random.default_rng([test_seed, 77])
        )
        self.seconds, self.started = 0.0, time.perf_counter()
        self.evaluations: list[dict[str, Any]] = []
        self.reached = False

    def _on_epoch(self) -> None:
        if self.reached or self.num_timesteps < self.from_step:
            return
        self.seconds += time.perf_counter() - self.started
        found = {
            "seconds": self.seconds,
            "env_steps": self.model.num_timesteps,
            "updates": self.model._n_updates,
        }
        for rule in self.rules:
            result = evaluate_adaptation(
                self.model,
                self.env,
                self.tasks,
                record_at=(N_QUERIES,),
                n_episodes=N_EPISODES,
                seed=self.test_seed,
                inference=rule,
            )
            found[rule] = result.after(N_QUERIES)
        self.evaluations.append(found)
        self.reached = max(found[rule] for rule in self.rules) >= self.target
        print({key: round(value, 1) for key, value in found.items()}, flush=True)
        self.started = time.perf_counter()

    def _on_step(self) -> bool:
        return not self.reached


def train(env_id: str, entry: dict[str, Any], seed: int, clock: Clock, device: str) -> POEMSAC:
    """Train with an entry of hyperparameters until the clock ends it; returns the model."""
    entry = dict(entry)
    n_timesteps, policy, n_envs = (
        int(entry.pop("n_timesteps")),
        entry.pop("policy"),
        entry.pop("n_envs"),
    )
    rate = entry.get("learning_rate")
    if isinstance(rate, str):
        entry["learning_rate"] = linear_schedule(rate.removeprefix("lin_"))
    model = POEMSAC(policy, make_task_vec_env(env_id, n_envs), seed=seed, device=device, **entry)
    clock.started = time.perf_counter()
    return model.learn(n_timesteps, callback=clock)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The script's own arguments."""
    parser.add_argument("--env", default="poem/HalfCheetahVel-v0")
    parser.add_argument("--target", type=float, default=-46.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--rules", nargs="+", default=["paper", "bayes"])
    parser.add_argument("--from-step", type=int, default=0)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", type=available_device, default="cpu")
    parser.add_argument("--save", type=Path, help="folder for the models")
    parser.add_argument(
        "--conf", type=Path, default=Path(__file__).parents[1] / "zoo_configs" / "poem_sac.yml"
    )


def main() -> None:
    """Measure, print, write."""
    given = arguments(__doc__, add_arguments)
    th.set_num_threads(given.threads)
    entry = zoo_entry(given.conf, given.env)
    if given.from_step > entry["n_timesteps"]:
        raise SystemExit(
            f"--from-step {given.from_step}: training ends after {entry['n_timesteps']:.0f} steps"
        )
    results, rows = [], []
    for seed in given.seeds:
        clock = Clock(
            given.env, given.target, given.rules, 300 + seed, given.from_step, given.every
        )
        model = train(given.env, entry, seed, clock, given.device)
        if given.save:
            model.save(given.save / f"seed{seed}.zip")
        last = clock.evaluations[-1]
        results.append(
            {
                "seed": seed,
                "reached": clock.reached,
                "evaluations": clock.evaluations,
                "entry": entry,
            }
        )
        returns = [f"{last[rule]:.1f}" for rule in given.rules]
        reached = "yes" if clock.reached else "no"
        rows.append(
            [seed, reached, round(last["seconds"]), last["env_steps"], last["updates"], *returns]
        )
        report(given, results, rows)  # after every seed, since the next may be interrupted


def report(given: argparse.Namespace, results: list[dict[str, Any]], rows: list[list[Any]]) -> None:
    """Write what there is so far."""
    text = table(
        [
            "seed",
            f"reached {given.target:g}",
            "seconds",
            "environment steps",
            "updates",
            *given.rules,
        ],
        rows,
    )
    name = f"time-to-result-{given.env.split('/')[-1].split('-')[0]}{'' if given.device == 'cpu' else f'-{given.device}'}"
    settings = {
        key: str(value) for key, value in vars(given).items() if key not in ("out", "conf", "save")
    }
    write(
        name,
        f"Time to {given.target:g} on {given.env}",
        [DESCRIPTION, text],
        results,
        given.out,
        settings,
        given.threads,
    )


DESCRIPTION = (__doc__ or "").split("\n\n")[-1].strip()

if __name__ == "__main__":
    main()
