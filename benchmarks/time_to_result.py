"""How long does training take until ten answers are enough? The clock stops for evaluations.

python benchmarks/time_to_result.py [--env poem/HalfCheetahVel-v0] [--target -46] [--seeds 0 1 2]

Trains with the hyperparameters of `zoo_configs/poem_sac.yml` (or `--conf`). After the epochs that
`--from-step` and `--every` name, the model is adapted to 30 test tasks by ten error-free answers
each; training ends when their mean return reaches the target.
"""

import time
from pathlib import Path
from typing import Any

import torch as th
from common import DEVICE, ZOO, arguments, table, write
from rl_zoo3.utils import linear_schedule

from sb3_poem import POEMSAC
from sb3_poem.adaptation import evaluate_adaptation, named_rule
from sb3_poem.benchmark.suites import family_name
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.callbacks import EpochCallback
from sb3_poem.resources import zoo_entry

N_TASKS, N_EPISODES, N_QUERIES = 30, 10, 10


class Clock(EpochCallback):
    """Times training, evaluates between epochs, and ends it at the target.

    :param target: Mean return that ends training, by whichever of the rules
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
        self.target, self.rules = target, rules
        self.test_seed, self.from_step = test_seed, from_step
        self.env = make_task_vec_env(env_id, 2 * N_TASKS)
        self.tasks = FamilyView(self.env).test_tasks(N_TASKS, test_seed)
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
                rule=named_rule(rule),
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
    n_timesteps, policy, n_envs = (entry.pop(key) for key in ("n_timesteps", "policy", "n_envs"))
    rate = entry.get("learning_rate")
    if isinstance(rate, str):
        entry["learning_rate"] = linear_schedule(rate.removeprefix("lin_"))
    model = POEMSAC(policy, make_task_vec_env(env_id, n_envs), seed=seed, device=device, **entry)
    clock.started = time.perf_counter()
    return model.learn(int(n_timesteps), callback=clock)


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
        where = (given.target, given.rules, 300 + seed, given.from_step, given.every)
        clock = Clock(given.env, *where)
        model = train(given.env, entry, seed, clock, given.device)
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
