"""What graded answers, the best of four and an inferred person are worth: returns after some
answers, and after some films watched, by how is asked and by who answers.

    python benchmarks/graded_answers.py --models pretrained/HalfCheetahVel pretrained/AntDir2D

Each model adapts to 30 tasks that no table uses. Questions are pairs, graded ("much better", too)
or about the best of four; the rule is told how the oracle errs, or infers it with the task. Graded
oracles call equal what differs by less than 0.12, and much better what differs by more than 1 of
the family's spread of returns ("other thresholds": 0.3 and 1.6). Of the ``--oracles`` "20 %
mistakes, told 10 %" and "Boltzmann, told exact" the rule is told wrongly, beside told rightly and
inferred, with pairs and graded answers. Writes ``<OUT>/answers.md`` and ``answers.json``; cells
that the latter holds of the same model and settings are not run again. Without ``--models`` only
the table is made anew.
"""

import json
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from common import RESULTS, arguments, table, write

from poem_envs.registration import family_name
from sb3_poem import Bayes, BoltzmannOracle, MistakeOracle, ReturnOracle
from sb3_poem.adaptation import ExactNoise, MistakeNoise, evaluate_adaptation, return_spread
from sb3_poem.adaptation.preference import PLACES
from sb3_poem.benchmark.provenance import commit
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.label.families import find_models
from sb3_poem.loading import load_model

ORACLES = {
    "exact": ReturnOracle,
    "10 % mistakes": partial(MistakeOracle, 0.1),
    "20 % mistakes": partial(MistakeOracle, 0.2),
    "Boltzmann": BoltzmannOracle,
}
# What a rule is told of who answers, and who answers where that is wrong.
TOLD = {
    **{"told": None, "inferred": "infer"},
    **{"told 10 %": MistakeNoise(0.1), "told exact": ExactNoise()},
}
WRONGLY = {
    f"{who}, {told}": (who, told)
    for who, told in (("20 % mistakes", "told 10 %"), ("Boltzmann", "told exact"))
}
USUAL, OTHER = (0.12, 1.0), (0.3, 1.6)
ANSWERS = (0, 1, 2, 5, 10)
# Films watched that answers of either number of films, 2 or 4, come to
FILMS = (4, 20)


def cells(oracles: list[str]) -> list[tuple[str, str, str, tuple[float, float]]]:
    """Who answers which kind of question, what the rule is told, and their thresholds."""
    found = []
    for name in oracles:
        who, *wrongly = WRONGLY.get(name, (name,))
        kinds = ["pair", "graded"] if wrongly else PLACES
        found += product([who], kinds, ["told", "inferred", *wrongly], [USUAL])
    if "exact" in oracles:
        found += product(["exact"], ["graded"], ["told", "inferred"], [OTHER])
    return found


def save(record: dict[str, Any], file: Path) -> None:
    """A line for each cell."""
    lines = (f"{json.dumps(key)}: {json.dumps(cell)}" for key, cell in record.items())
    file.write_text('{"results": {\n' + ",\n".join(lines) + "\n}}\n")


def main() -> None:
    args = arguments(
        __doc__,
        models={"nargs": "*", "default": []},
        oracles={"nargs": "+", "default": [*ORACLES, *WRONGLY], "choices": [*ORACLES, *WRONGLY]},
        tasks=30,
        episodes=5,
        seed=300,
        out={"type": Path, "default": RESULTS / "answers"},
    )
    file = args.out / "answers.json"
    record = json.loads(file.read_text())["results"] if file.exists() else {}
    args.out.mkdir(parents=True, exist_ok=True)
    settings = {"tasks": args.tasks, "episodes": args.episodes, "seed": args.seed}
    for path in args.models:
        model = load_model(path)
        env = make_task_vec_env(model.env_id, 30)
        spread = return_spread(model, env)
        made_of = {"model": model.digest, **settings}
        for who, kind, told, shares in cells(args.oracles):
            name = who + (", other thresholds" if shares is OTHER else "")
            key = f"{model.env_id} | {name} | {kind} | {told}"
            if key in record and made_of.items() <= record[key].items():
                continue
            how = {"question": kind} if len(PLACES[kind]) > 2 else {}
            if kind == "graded":
                how["thresholds"] = tuple(spread * share for share in shares)
            evaluation = evaluate_adaptation(
                model,
                env,
                args.tasks,
                partial(ORACLES[who], **how),
                rule=Bayes(question=kind, noise_model=TOLD[told]),
                record_at=ANSWERS,
                n_episodes=args.episodes,
                seed=args.seed,
            )
            found = {"returns": evaluation.mean_returns, "per_task": evaluation.task_returns}
            found = {name: values.round(2).tolist() for name, values in found.items()}
            record[key] = {**made_of, "commit": commit(), **found}
            print(key, record[key]["returns"], flush=True)
            save(record, file)
        env.close()
    ships = {load_model(info.folder).digest for info in find_models()}
    rows = []
    for key, cell in record.items():
        words, values = key.split(" | "), cell["returns"]
        answers = [n // len(PLACES[words[2]]) for n in FILMS]
        age = "ships" if cell["model"] in ships else "earlier"
        by_films = (values[ANSWERS.index(k)] for k in answers)
        rows.append([family_name(words[0]), *words[1:], age, *values, *by_films])
    head = ["family", "oracle", "question", "how it errs", "model"]
    head += [*(f"{n} answers" for n in ANSWERS), *(f"{n} films" for n in FILMS)]
    about = (
        "Mean returns over tasks that no other table uses, after some answers and after some\n"
        "films watched: a pair, graded or not, shows two, a best of four four. Models that ship,\n"
        "or *earlier* ones of the same family. One run; missing rows were not run.\n"
        "`answers.json` says of each row its model, settings and commit, where they were noted."
    )
    title = "Graded answers, the best of four and an inferred person"
    write("answers", title, [about, table(head, rows)], None, args.out, settings)


if __name__ == "__main__":
    main()
