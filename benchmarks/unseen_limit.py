"""What k answers allow a method that knows the family but not the test tasks, beside the limit that
has these in sight.

    python benchmarks/unseen_limit.py --family HalfCheetahVel --seeds 0 1 2 --models M0 M1 M2

The tables' limit takes the 2^k policies that are best for the 30 test tasks. Here they are the 2^k
that are best for many other tasks of the family; then each test task gets the best of them, as if k
answers could tell which that is. Policies, episodes and test tasks are those of the benchmark's
cells. Writes ``benchmarks/results/<Family>/unseen-limit.md``.
"""

from pathlib import Path

import numpy as np
from common import RESULTS, arguments, table, write

from sb3_poem.adaptation.evaluation import evaluation_seed
from sb3_poem.adaptation.known_task import known_task_return, return_matrix
from sb3_poem.adaptation.limits import best_codebook
from sb3_poem.benchmark.cells import SEED_STRIDE, SELECTION_EPISODES
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


def main() -> None:
    given = arguments(
        __doc__,
        family={"required": True},
        models={"nargs": "+", "type": Path, "required": True, "help": "one for each seed"},
        seeds={"nargs": "+", "type": int, "required": True, "help": "at least two"},
        others={"type": int, "default": 600, "help": "tasks that the policies are chosen on"},
    )
    if not 2 <= len(given.seeds) == len(given.models):
        raise SystemExit("--seeds and --models: name at least two seeds, and a model for each")
    env_id = f"poem/{given.family}-v0"
    measured = [
        limits(env_id, model, seed, given.others)
        for model, seed in zip(given.models, given.seeds, strict=True)
    ]
    rows = []
    names = ("the test tasks (the limit of the tables)", f"{given.others} other tasks")
    for name, values in zip(names, np.swapaxes(np.array(measured), 0, 1), strict=True):
        figures = zip(values.mean(axis=0), values.std(axis=0, ddof=1), strict=True)
        rows.append([name, *(f"{mean:.1f} ± {deviation:.1f}" for mean, deviation in figures)])
    sections = [
        f"Mean and deviation over seeds {', '.join(map(str, given.seeds))}; 30 test tasks, POEM's "
        "policies.",
        table(["policies chosen for", *(f"k = {k}" for k in COLUMNS)], rows),
    ]
    title = f"What k exact answers allow, {given.family}"
    write("unseen-limit", title, sections, None, RESULTS / given.family, {})


if __name__ == "__main__":
    main()
