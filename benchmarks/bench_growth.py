"""How time grows: steps against copies and threads, an update against tasks in its batch, the
matrix J against tasks.

Writes ``growth.png`` beside the table.
"""

from functools import partial
from pathlib import Path
from typing import Any

import common
import numpy as np
import torch as th

from poem_envs.vector import available_cores
from sb3_poem import POEMSAC, TaskVecEnv
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.collector import relabelled_returns

COPIES = (1, 4, 16, 64, 256, 1024)
BATCH_TASKS, TASKS = (2, 4, 8, 16, 32, 64), (120, 300, 1000)
IDS = ("poem/HalfCheetahVel-v0", "poem/AntVel-v0")
Rows = list[dict[str, Any]]


def steps(env: TaskVecEnv, actions: np.ndarray) -> None:
    """A step for each row of actions."""
    for row in actions:
        env.step(row)


def copies_and_threads(env_id: str, thread_counts: list[int], repeats: int) -> Rows:
    """Environment steps per second of TaskVecEnv under random actions."""
    rows = []
    for copies in COPIES:
        rng, contenders, turns = np.random.default_rng(0), {}, max(1, 1000 // copies)
        for threads in thread_counts:
            env = make_task_vec_env(env_id, copies, nthread=threads)
            env.seed(0)
            env.reset()
            actions = rng.uniform(-1.0, 1.0, (turns, copies, *env.action_space.shape))

            contenders[f"{threads} threads"] = partial(steps, env, actions.astype(np.float32))
        seconds = common.seconds_in_turns(contenders, repeats)
        rates = {name: turns * copies / float(np.median(taken)) for name, taken in seconds.items()}
        rows.append({"family": env_id, "copies": copies, **rates})
    return rows


def update_against_tasks(repeats: int, steps: int = 10) -> Rows:
    """Milliseconds of one gradient step, 128 transitions a task, by ``model.train`` after one epoch
    of ``learn``.
    """
    settings = {"n_train_tasks": 120, "gradient_steps": 1, "seed": 0, "device": "cpu"}
    contenders: dict[str, Any] = {}
    for tasks in BATCH_TASKS:
        model = POEMSAC("MlpPolicy", IDS[0], meta_batch_size=tasks, **settings).learn(1)
        contenders[str(tasks)] = partial(model.train, gradient_steps=steps, batch_size=128)
    contenders["0"] = partial(model.train, gradient_steps=0, batch_size=128)
    seconds = common.seconds_in_turns(contenders, repeats)
    median = {int(tasks): float(np.median(values)) for tasks, values in seconds.items()}
    nothing = median.pop(0)
    return [{"tasks": n, "ms": 1000.0 * (taken - nothing) / steps} for n, taken in median.items()]


def returns_matrix(repeats: int) -> Rows:
    """Milliseconds of J[i, j] for N tasks with a trajectory of 200 steps each."""
    rng, rows = np.random.default_rng(0), []
    for env_id in IDS:
        family = FamilyView(make_task_vec_env(env_id, 1))
        for n_tasks in TASKS:
            tasks = family.sample_tasks(n_tasks, rng)
            features = rng.standard_normal((n_tasks, 200, family.reward_feature_dim))
            mask = np.ones((n_tasks, 200), dtype=bool)
            call = partial(relabelled_returns, family.compute_rewards, tasks, features, mask)
            turns = repeats if n_tasks < 1000 else 1
            [taken] = common.seconds_in_turns({"": call}, turns, warm_up=0).values()
            milliseconds = 1000.0 * float(np.median(taken))
            rows.append({"family": env_id, "tasks": n_tasks, "ms": milliseconds})
    return rows


def plot(copies: Rows, updates: Rows, returns: Rows, path: Path) -> None:
    """Three panels, one for each question."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    for family in IDS:
        name, rows = family.split("/")[1], [row for row in copies if row["family"] == family]
        for threads in [key for key in copies[0] if key.endswith(" threads")]:
            rates = [row[threads] for row in rows]
            left.plot([row["copies"] for row in rows], rates, "o-", label=f"{name}, {threads}")
        rows = [row for row in returns if row["family"] == family]
        right.plot([row["tasks"] for row in rows], [row["ms"] for row in rows], "o-", label=name)
    middle.plot([row["tasks"] for row in updates], [row["ms"] for row in updates], "o-")
    left.set(xscale="log", yscale="log", xlabel="copies", ylabel="environment steps / s")
    middle.set(xlabel="tasks in a batch (128 transitions each)", ylabel="ms", ylim=(0, None))
    right.set(xscale="log", yscale="log", xlabel="tasks N", ylabel="ms")
    right.set_xticks(TASKS, labels=[str(n) for n in TASKS], minor=False)
    right.set_xticks([], minor=True)
    titles = ("Stepping, by threads", "A gradient step", "The N x N returns, relabelled")
    for axes, title in zip((left, middle, right), titles, strict=True):
        axes.set_title(title)
        axes.grid(alpha=0.3)
    left.legend(fontsize=8)
    right.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    threads = [n for n in (1, 2) if n <= available_cores()]
    given = common.arguments(__doc__, repeats=3, threads=threads)
    th.set_num_threads(1)
    copies = [
        row for env_id in IDS for row in copies_and_threads(env_id, given.threads, given.repeats)
    ]
    updates, returns = update_against_tasks(given.repeats), returns_matrix(given.repeats)
    plot(copies, updates, returns, given.out / "growth.png")
    of_threads = [f"steps / s, {n} threads" for n in given.threads]
    names = (
        ["family", "copies", *of_threads],
        ["tasks in a batch of 128 each", "ms of a gradient step"],
        ["family", "tasks N", "ms of J, N x N"],
    )
    tables = [
        common.table(header, [[*row.values()] for row in rows])
        for header, rows in zip(names, (copies, updates, returns), strict=True)
    ]
    data = {"copies": copies, "updates": updates, "returns": returns}
    settings = {"threads of torch": 1, "turns": given.repeats, "steps of a trajectory": 200}
    sections = ["![growth](growth.png)", *tables]
    common.write("growth", "Growth", sections, data, given.out, settings, max(given.threads))


if __name__ == "__main__":
    main()
