"""How time grows: steps against copies and threads, an update against tasks in its batch, the
matrix J against tasks.

Writes ``growth.png`` beside the table.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import common
import numpy as np
import torch as th

from sb3_poem import POEMSAC, TaskVecEnv
from sb3_poem.common.collection import relabelled_returns
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env

COPIES = (1, 4, 16, 64, 256, 1024)
BATCH_TASKS, TASKS = (2, 4, 8, 16, 32, 64), (120, 300, 1000)
IDS = ("poem/HalfCheetahVel-v0", "poem/AntVel-v0")


def copies_and_threads(env_id: str, thread_counts: list[int], repeats: int) -> list[dict[str, Any]]:
    """Environment steps per second of TaskVecEnv under random actions."""
    rows = []
    for copies in COPIES:
        rng, contenders = np.random.default_rng(0), {}
        for threads in thread_counts:
            env = make_task_vec_env(env_id, copies, nthread=threads)
            env.seed(0)
            env.reset()
            actions = rng.uniform(
                -1.0, 1.0, (max(1, 1000 // copies), copies, *env.action_space.shape)
            ).astype(np.float32)

            def steps(env: TaskVecEnv = env, actions: np.ndarray = actions) -> None:
                for row in actions:
                    env.step(row)

            contenders[str(threads)] = steps
        seconds = common.seconds_in_turns(contenders, repeats)
        n_steps = max(1, 1000 // copies) * copies
        row = {
            f"{threads} threads": n_steps / float(np.median(values))
            for threads, values in seconds.items()
        }
        rows.append({"family": env_id, "copies": copies, **row})
    return rows


def update_against_tasks(repeats: int, steps: int = 10) -> list[dict[str, Any]]:
    """Milliseconds of one gradient step, 128 transitions a task, by ``model.train`` after one epoch
    of ``learn``.
    """
    contenders, models = {}, []
    for tasks in BATCH_TASKS:
        model = POEMSAC(
            "MlpPolicy",
            "poem/HalfCheetahVel-v0",
            n_train_tasks=120,
            meta_batch_size=tasks,
            gradient_steps=1,
            seed=0,
            device="cpu",
        )
        model.learn(1)
        models.append(model)
        contenders[str(tasks)] = lambda model=model: model.train(
            gradient_steps=steps, batch_size=128
        )
    seconds = common.seconds_in_turns(contenders, repeats)
    nothing = common.seconds_in_turns(
        {"0": lambda: models[0].train(gradient_steps=0, batch_size=128)}, repeats
    )["0"]
    return [
        {
            "tasks": int(tasks),
            "ms": 1000.0 * (float(np.median(values)) - float(np.median(nothing))) / steps,
        }
        for tasks, values in seconds.items()
    ]


def returns_matrix(repeats: int) -> list[dict[str, Any]]:
    """Milliseconds of J[i, j] for N tasks with a trajectory of 200 steps each."""
    rng, rows = np.random.default_rng(0), []
    for env_id in IDS:
        family = FamilyView(make_task_vec_env(env_id, 1))
        for n_tasks in TASKS:
            tasks = family.sample_tasks(n_tasks, rng)
            features = rng.standard_normal((n_tasks, 200, family.reward_feature_dim))
            mask = np.ones((n_tasks, 200), dtype=bool)
            times = []
            for _ in range(repeats if n_tasks < 1000 else 1):
                started = time.perf_counter()
                relabelled_returns(family.compute_rewards, tasks, features, mask)
                times.append(time.perf_counter() - started)
            rows.append(
                {"family": env_id, "tasks": n_tasks, "ms": 1000.0 * float(np.median(times))}
            )
    return rows


def plot(
    copies: list[dict[str, Any]],
    updates: list[dict[str, Any]],
    returns: list[dict[str, Any]],
    path: Path,
) -> None:
    """Three panels, one for each question."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    for family in IDS:
        name, rows = family.split("/")[1], [row for row in copies if row["family"] == family]
        for threads in [int(key.split()[0]) for key in copies[0] if key.endswith(" threads")]:
            left.plot(
                [r["copies"] for r in rows],
                [r[f"{threads} threads"] for r in rows],
                marker="o",
                label=f"{name}, {threads}",
            )
        rows = [row for row in returns if row["family"] == family]
        right.plot([r["tasks"] for r in rows], [r["ms"] for r in rows], marker="o", label=name)
    left.set(
        xscale="log",
        yscale="log",
        xlabel="copies",
        ylabel="environment steps / s",
        title="Stepping, by threads",
    )
    middle.plot([r["tasks"] for r in updates], [r["ms"] for r in updates], marker="o")
    middle.set(
        xlabel="tasks in a batch (128 transitions each)",
        ylabel="ms",
        title="A gradient step",
        ylim=(0, None),
    )
    right.set(
        xscale="log",
        yscale="log",
        xlabel="tasks N",
        ylabel="ms",
        title="The N x N returns, relabelled",
    )
    right.set_xticks(TASKS, labels=[str(n) for n in TASKS], minor=False)
    right.set_xticks([], minor=True)
    for axes in (left, right):
        axes.legend(fontsize=8)
    for axes in (left, middle, right):
        axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure, plot and write."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--repeats", type=int, default=3)
        parser.add_argument(
            "--threads", type=int, nargs="+", default=[n for n in (1, 2) if n <= common.cores()]
        )

    options = common.arguments(__doc__, add)
    th.set_num_threads(1)
    copies = [
        row
        for env_id in IDS
        for row in copies_and_threads(env_id, options.threads, options.repeats)
    ]
    updates, returns = update_against_tasks(options.repeats), returns_matrix(options.repeats)
    plot(copies, updates, returns, options.out / "growth.png")
    sections = [
        "![growth](growth.png)",
        common.table(
            [
                "family",
                "copies",
                *(
                    f"steps / s, {threads} threads"
                    for threads in [
                        int(key.split()[0]) for key in copies[0] if key.endswith(" threads")
                    ]
                ),
            ],
            [
                [
                    r["family"],
                    r["copies"],
                    *(
                        r[f"{threads} threads"]
                        for threads in [
                            int(key.split()[0]) for key in copies[0] if key.endswith(" threads")
                        ]
                    ),
                ]
                for r in copies
            ],
        ),
        common.table(
            ["tasks in a batch of 128 each", "ms of a gradient step"],
            [[r["tasks"], r["ms"]] for r in updates],
        ),
        common.table(
            ["family", "tasks N", "ms of J, N x N"],
            [[r["family"], r["tasks"], r["ms"]] for r in returns],
        ),
    ]
    data = {"copies": copies, "updates": updates, "returns": returns}
    settings = {"threads of torch": 1, "turns": options.repeats, "steps of a trajectory": 200}
    common.write("growth", "Growth", sections, data, options.out, settings, max(options.threads))


if __name__ == "__main__":
    main()
