"""What graded answers, the best of four and an inferred person are worth: returns after some
answers, and after some films watched, by how is asked and by who answers.

    python benchmarks/graded_answers.py --models pretrained/HalfCheetahVel pretrained/AntDir2D

Each model adapts to 30 tasks that no table uses. Questions are pairs, graded ("much better", too)
or about the best of four; the rule is told how the oracle errs, or infers it with the task. Graded
oracles call equal what differs by less than 0.12, and much better what differs by more than 1 of
the family's spread of returns ("other thresholds": 0.3 and 1.6). Writes ``<OUT>/answers.md`` and
``answers.json``; cells that the latter holds are not run again.
"""

import json
from functools import partial
from pathlib import Path

from common import RESULTS, arguments, table, write

from sb3_poem import Bayes, BoltzmannOracle, MistakeOracle, ReturnOracle
from sb3_poem.adaptation import evaluate_adaptation, return_spread
from sb3_poem.adaptation.preference import PLACES
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.loading import load_model

ORACLES = {
    "exact": ReturnOracle,
    "10 % mistakes": partial(MistakeOracle, 0.1),
    "20 % mistakes": partial(MistakeOracle, 0.2),
    "Boltzmann": BoltzmannOracle,
}
USUAL, OTHER = (0.12, 1.0), (0.3, 1.6)
ANSWERS = (0, 1, 2, 5, 10)
# Films watched that answers of either number of films, 2 or 4, come to
FILMS = (4, 20)


def main() -> None:
    args = arguments(
        __doc__,
        models={"nargs": "+", "required": True},
        oracles=[*ORACLES],
        tasks=30,
        episodes=5,
        seed=300,
        out={"type": Path, "default": RESULTS / "answers"},
    )
    file = args.out / "answers.json"
    record = json.loads(file.read_text())["results"] if file.exists() else {}
    args.out.mkdir(parents=True, exist_ok=True)
    for path in args.models:
        model = load_model(path)
        env = make_task_vec_env(model.env_id, 30)
        spread = return_spread(model, env)
        ways = [(kind, infer) for infer in (False, True) for kind in PLACES]
        cells = [(who, *way, USUAL) for who in args.oracles for way in ways]
        if "exact" in args.oracles:
            cells += [("exact", "graded", infer, OTHER) for infer in (False, True)]
        for who, kind, infer, shares in cells:
            name = who + (", other thresholds" if shares is OTHER else "")
            key = f"{model.env_id} | {name} | {kind} | {'inferred' if infer else 'told'}"
            if key in record:
                continue
            how = {"question": kind} if len(PLACES[kind]) > 2 else {}
            if kind == "graded":
                how["thresholds"] = tuple(spread * share for share in shares)
            evaluation = evaluate_adaptation(
                model,
                env,
                args.tasks,
                partial(ORACLES[who], **how),
                rule=Bayes(question=kind, noise_model="infer" if infer else None),
                record_at=ANSWERS,
                n_episodes=args.episodes,
                seed=args.seed,
            )
            record[key] = [round(float(value), 2) for value in evaluation.mean_returns]
            print(key, record[key], flush=True)
            file.write_text(json.dumps({"results": record}, indent=1))
        env.close()
    rows = []
    for key, values in record.items():
        words = key.split(" | ")
        answers = [n // len(PLACES[words[2]]) for n in FILMS]
        rows.append([*words, *values, *(values[ANSWERS.index(k)] for k in answers)])
    head = ["family", "oracle", "question", "how it errs", *(f"{n} answers" for n in ANSWERS)]
    head += [f"{n} films" for n in FILMS]
    settings = {"tasks": args.tasks, "episodes": args.episodes, "seed": args.seed}
    title = "Graded answers, the best of four and an inferred person"
    write("answers", title, [table(head, rows)], record, args.out, settings)


if __name__ == "__main__":
    main()
