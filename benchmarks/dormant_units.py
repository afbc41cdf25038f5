"""Count the hidden units of shipped models that are active on no transition.

    python benchmarks/dormant_units.py HalfCheetahFwdBack AntFwdBack

Transitions are those of one epoch of training at a learning rate of 0. Writes ``benchmarks/results/dormant-units.md``.
"""

import argparse
from pathlib import Path

import torch as th
from common import arguments, table, write
from stable_baselines3.common.utils import ConstantSchedule

from sb3_poem.common.callbacks import DormantUnitsCallback
from sb3_poem.common.vec_env import TaskVecEnv
from sb3_poem.loading import load_model

COPIES = 60


def count(env_id: str, source: str, transitions: int) -> dict[str, tuple[int, int]]:
    """Dormant units and all units of each hidden layer of a model's actor and critics."""
    env, model = TaskVecEnv.from_id(env_id, COPIES), load_model(source)
    model.set_env(env)
    model.lr_schedule, model.gradient_steps = ConstantSchedule(0.0), 1
    callback = DormantUnitsCallback(recycle=False, transitions=transitions)
    model.learn(model.horizon * COPIES, callback=callback, log_interval=None, reset_num_timesteps=False)
    env.close()
    return callback.counts


def add(parser: argparse.ArgumentParser) -> None:
    """The script's own arguments."""
    parser.add_argument("families", nargs="+")
    parser.add_argument("--models", nargs="+", type=Path, help="one for each family instead of those that ship")
    parser.add_argument("--transitions", type=int, default=2000, help="of each training task")


def main() -> None:
    """Count, and write."""
    given = arguments(__doc__, add)
    models = given.models or given.families
    if len(models) != len(given.families):
        raise SystemExit("--models: name one for each family")
    th.set_num_threads(1)
    results = {}
    for family, source in zip(given.families, models, strict=True):
        results[family] = count(f"poem/{family}-v0", str(source), given.transitions)
        print(family, results[family], flush=True)
    rows = [[family, layer, *counts] for family, layers in results.items() for layer, counts in layers.items()]
    sections = [table(["model", "hidden layer", "dormant", "units"], rows)]
    settings = {"transitions of each training task": given.transitions, "threads": 1}
    write("dormant-units", "Hidden units that are active on no transition", sections, results, given.out, settings)


if __name__ == "__main__":
    main()
