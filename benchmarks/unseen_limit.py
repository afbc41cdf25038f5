"""What k answers allow a method that knows the family but not the test tasks, beside the limit that
has these in sight.

    python benchmarks/unseen_limit.py HalfCheetahVel --seeds 0 1 2 --models M0.zip M1.zip M2.zip

The tables' limit takes the 2^k policies that are best for the 30 test tasks. Here they are the 2^k
that are best for many other tasks of the family; then each test task gets the best of them, as if k
answers could tell which that is. Policies, episodes and test tasks are those of the benchmark's
cells. Writes ``benchmarks/results/<Family>/unseen-limit.md``.
"""

import argparse
from pathlib import Path

import numpy as np
from common import RESULTS

from sb3_poem.adaptation.evaluation import evaluation_seed, known_task_return, return_matrix
from sb3_poem.adaptation.limits import best_codebook
from sb3_poem.benchmark.cells import SEED_STRIDE, SELECTION_EPISODES
from sb3_poem.benchmark.provenance import commit, machine
from sb3_poem.benchmark.suites import Budget
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.loading import load_model

COLUMNS = (0, 1, 2, 3, 5)


def limits(
    env_id: str, model_file: Path, seed: int, n_others: int
) -> tuple[list[float], list[float]]:
    """The limits with the test tasks in sight, and without, after :data:`COLUMNS` answers."""
    model, env, budget = load_model(str(model_file)), make_task_vec_env(env_id, 120), Budget()
    family = FamilyView(env)
    tasks = family.test_tasks(budget.tasks, budget.task_seed)
    others = family.sample_tasks(n_others, np.random.default_rng([budget.task_seed, seed, 1]))
    stream = budget.task_seed + SEED_STRIDE * seed
    known = known_task_return(
        model, env, tasks, n_episodes=1, seed=stream, selection_episodes=SELECTION_EPISODES
    )
    on_others = return_matrix(
        model, env, others, known.candidate_latents, SELECTION_EPISODES, evaluation_seed(stream, 1)
    )
    env.close()
    ordered = others.shape[1] == 1
    if ordered:
        on_others = on_others[np.argsort(others[:, 0])]
    books = [best_codebook(on_others, 2**k, ordered=ordered) for k in COLUMNS]
    return [known.limit(k) for k in COLUMNS], [
        float(known.candidate_returns[:, book].max(axis=1).mean()) for book in books
    ]


def row(name: str, values: np.ndarray) -> str:
    """Mean and deviation over seeds."""
    cells = [
        f"{mean:.1f} ± {deviation:.1f}"
        for mean, deviation in zip(values.mean(0), values.std(0, ddof=1), strict=True)
    ]
    return f"| {name} | " + " | ".join(cells) + " |"


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("family")
    parser.add_argument("--models", nargs="+", type=Path, required=True, help="one for each seed")
    parser.add_argument("--seeds", nargs="+", type=int, required=True, help="at least two")
    parser.add_argument(
        "--others", type=int, default=600, help="tasks that the policies are chosen on"
    )
    given = parser.parse_args()
    if not 2 <= len(given.seeds) == len(given.models):
        parser.error("--seeds and --models: name at least two seeds, and a model for each")
    measured = [
        limits(f"poem/{given.family}-v0", model, seed, given.others)
        for model, seed in zip(given.models, given.seeds, strict=True)
    ]
    seen, unseen = np.swapaxes(np.array(measured), 0, 1)
    lines = [
        f"# What k exact answers allow, {given.family}",
        "",
        f"Mean and deviation over seeds {', '.join(map(str, given.seeds))}; 30 test tasks, POEM's policies.",
        "",
        "| policies chosen for | " + " | ".join(f"k = {k}" for k in COLUMNS) + " |",
        "|---" * (len(COLUMNS) + 1) + "|",
        row("the test tasks (the limit of the tables)", seen),
        row(f"{given.others} other tasks", unseen),
        "",
        f"By `benchmarks/unseen_limit.py {given.family} --seeds {' '.join(map(str, given.seeds))} --others {given.others} "
        f"--models ...` at {commit()}. Machine: {machine()}.",
    ]
    out = RESULTS / given.family / "unseen-limit.md"
    out.parent.mkdir(exist_ok=True)
    out.write_text("\n".join(lines) + "\n")
    print(out.read_text())


if __name__ == "__main__":
    main()
