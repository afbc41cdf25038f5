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

import torch as th
from common import DEVICE, ZOO, arguments, table, write

from sb3_poem import POEMSAC
from sb3_poem.adaptation import evaluate_adaptation, named_rule
from sb3_poem.benchmark.suites import family_name
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.callbacks import EpochCallback
from sb3_poem.resources import zoo_entry

N_TASKS, N_EPISODES, N_QUERIES = 30, 10, 10


class Clock(EpochCallback):
    """Times training, evaluates between epochs, and ends it at the target.

    :param given: What the command line says
    :param test_seed: Seed of the test tasks
    """

    def __init__(self, given: argparse.Namespace, test_seed: int) -> None:
        super().__init__(given.every)
        self.given, self.test_seed = given, test_seed
        self.env = make_task_vec_env(given.env, 2 * N_TASKS)
        self.seconds, self.started = 0.0, time.perf_counter()
        self.evaluations: list[dict[str, Any]] = []
        self.reached = False

    def _on_epoch(self) -> None:
        if self.reached or self.num_timesteps < self.given.from_step:
            return
        self.seconds += time.perf_counter() - self.started
        found = {"seconds": self.seconds, "env_steps": self.model.num_timesteps}
        found["updates"] = self.model._n_updates
        how: dict[str, Any] = {"record_at": (N_QUERIES,), "n_episodes": N_EPISODES}
        how["seed"] = self.test_seed
        for rule in self.given.rules:
            result = evaluate_adaptation(
                self.model, self.env, N_TASKS, rule=named_rule(rule), **how
            )
            found[rule] = result.after(N_QUERIES)
        self.evaluations.append(found)
        self.reached = max(found[rule] for rule in self.given.rules) >= self.given.target
        print({key: round(value, 1) for key, value in found.items()}, flush=True)
        self.started = time.perf_counter()

    def _on_step(self) -> bool:
        return not self.reached


def main() -> None:
    given = arguments(
        __doc__,
        env="poem/HalfCheetahVel-v0",
        target=-46.0,
        seeds=[0, 1, 2],
        rules=["paper", "bayes"],
        from_step=0,
        every=1,
        threads=1,
        device=DEVICE,
        save={"type": Path, "help": "folder for the models"},
        conf=ZOO / "poem_sac.yml",
    )
    th.set_num_threads(given.threads)
    entry = zoo_entry(given.conf, given.env)
    if given.from_step > entry["n_timesteps"]:
        raise SystemExit(
            f"--from-step {given.from_step}: training ends after {entry['n_timesteps']:.0f} steps"
        )
    results, rows = [], []
    header = ["seed", f"reached {given.target:g}", "seconds", "environment steps", "updates"]
    name = f"time-to-result-{family_name(given.env)}"
    name += "" if given.device == "cpu" else f"-{given.device}"
    kept = {key: str(v) for key, v in vars(given).items() if key not in ("out", "conf", "save")}
    title = f"Time to {given.target:g} on {given.env}"
    for seed in given.seeds:
        clock = Clock(given, 300 + seed)
        model = POEMSAC.from_zoo(given.env, **{**entry, "seed": seed, "device": given.device})
        clock.started = time.perf_counter()
        model.learn(callback=clock)
        if given.save:
            model.save(given.save / f"seed{seed}.zip")
        last, reached = clock.evaluations[-1], clock.reached
        result = {"seed": seed, "reached": reached, "evaluations": clock.evaluations}
        results.append({**result, "entry": entry})
        figures = (round(last["seconds"]), last["env_steps"], last["updates"])
        returns = [f"{last[rule]:.1f}" for rule in given.rules]
        rows.append([seed, "yes" if reached else "no", *figures, *returns])
        # after every seed, since the next may be interrupted
        sections = [DESCRIPTION, table([*header, *given.rules], rows)]
        write(name, title, sections, results, given.out, kept, given.threads)


DESCRIPTION = (__doc__ or "").split("\n\n")[-1].strip()

if __name__ == "__main__":
    main()
