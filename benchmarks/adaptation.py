"""How far do ten answers take a model? Trains it where it is missing, adapts it under both rules,
and records every figure.

    python benchmarks/adaptation.py poem/HalfCheetahVel-v0 --seeds 0 1 2

For every seed: ``sb3-poem train`` (continued from its checkpoint if it was interrupted, skipped if
it is done), then ``sb3-poem adapt`` for each rule and source of candidates, on 30 fresh test tasks
with 10 episodes each. The result is ``benchmarks/results/<Family>/adaptation.json`` and a table of
the same name in Markdown.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from sb3_poem.benchmark.provenance import commit, machine

RESULTS = Path(__file__).parent / "results"
PROGRAM = [sys.executable, "-m", "sb3_poem.cli"]
RULES = (("paper", "prior"), ("paper", "aggregate"), ("bayes", "prior"), ("bayes", "aggregate"))
COLUMNS = (0, 1, 2, 3, 5, 10)


def family_of(env_id: str) -> str:
    """AntGoal of poem/AntGoal-v0."""
    return env_id.split("/")[-1].split("-")[0]


def shown(command: list[str]) -> str:
    """A command as a reader types it."""
    return " ".join(["sb3-poem", *command])


def train(
    env_id: str, seed: int, folder: Path, algorithm: str, extra: list[str]
) -> tuple[Path, dict[str, Any]]:
    """Train one model, or find it; returns its file and how it was made."""
    name = env_id.replace("/", "-")
    record_file, finished = (
        folder / "training.json",
        sorted(folder.glob(f"{algorithm}/*/{name}.zip")),
    )
    if record_file.exists() and finished:
        return finished[-1], json.loads(record_file.read_text())
    checkpoints = sorted(
        folder.glob(f"{algorithm}/*/checkpoint.zip"), key=lambda path: path.stat().st_mtime
    )
    command = [
        "train",
        "--algo",
        algorithm,
        "--env",
        env_id,
        "--seed",
        str(seed),
        "--eval-freq",
        "-1",
        *extra,
    ]
    logging = [
        "-f",
        str(folder),
        "--save-freq",
        "120000",
        *(["-i", str(checkpoints[-1])] if checkpoints else []),
    ]
    started = time.time()
    subprocess.run([*PROGRAM, *command, *logging], check=True)
    record = {
        "command": shown(command),
        "seed": seed,
        "commit": commit() or "unknown",
        "machine": machine(),
        "wall_seconds": None if checkpoints else round(time.time() - started),
    }
    record_file.write_text(json.dumps(record, indent=2))
    return sorted(folder.glob(f"{algorithm}/*/{name}.zip"))[-1], record


def adapt(
    env_id: str, model: Path, rule: str, candidates: str, test_seed: int, out: Path
) -> dict[str, Any]:
    """Adapt one model to 30 fresh tasks under one rule."""
    command = [
        "adapt",
        "--env",
        env_id,
        "--tasks",
        "30",
        "--episodes",
        "10",
        "--queries",
        "10",
        "--seed",
        str(test_seed),
    ]
    command += ["--record", *map(str, COLUMNS), "--inference", rule, "--candidates", candidates]
    if not out.exists():
        subprocess.run([*PROGRAM, *command, "--model", str(model), "--json", str(out)], check=True)
    return {
        **json.loads(out.read_text()),
        "command": shown([*command, "--model", model.name]),
        "model": model.name,
    }


def order_on_test_tasks(env_id: str, model_file: Path, test_seed: int) -> dict[str, float]:
    """Property 1 on test tasks: preference accuracy and Kendall's tau."""
    from sb3_poem.adaptation.evaluation import known_task_return, preference_order
    from sb3_poem.common.family_view import FamilyView
    from sb3_poem.common.vec_env import make_task_vec_env
    from sb3_poem.loading import load_model

    model = load_model(str(model_file))
    env = make_task_vec_env(env_id, 60)
    family = FamilyView(env)
    tasks = family.all_tasks
    if tasks is None:
        tasks = family.sample_tasks(30, np.random.default_rng([test_seed, 77]))
    known = known_task_return(model, env, tasks, seed=test_seed, selection_episodes=3)
    accuracy, tau = preference_order(model, known)
    env.close()
    return {
        "preference_accuracy": accuracy,
        "kendall_tau": tau,
        "env_steps": model.num_timesteps,
        "updates": model._n_updates,
    }


def table(env_id: str, runs: list[dict[str, Any]]) -> str:
    """Markdown: one row per seed and rule, and the mean over seeds."""
    lines = [
        f"# Adaptation, {env_id}",
        "",
        "Mean true return on 30 fresh test tasks, 10 episodes each, after k error-free answers.",
        "",
    ]
    header = ["seed", "rule", "candidates", *(f"k = {k}" for k in COLUMNS), "task known"]
    lines += ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for run in runs:
        for result in run["adaptations"]:
            cells = [f"{value:.1f}" for value in result["mean_return"]]
            cells = [
                str(run["training"]["seed"]),
                result["inference"],
                result["candidates"],
                *cells,
            ]
            lines.append("| " + " | ".join([*cells, f"{result['known_task_return']:.1f}"]) + " |")
        limit = [f"{value:.1f}" for value in run["adaptations"][-1]["limit"]]
        lines.append(
            "| " + " | ".join([str(run["training"]["seed"]), "*limit*", "", *limit, ""]) + " |"
        )
    lines += success_table(runs)
    lines += [
        "",
        "| seed | environment steps | updates | wall time, s | preference accuracy | Kendall's tau |",
        "|---|---|---|---|---|---|",
    ]
    for run in runs:
        order, training = run["order"], run["training"]
        lines.append(
            f"| {training['seed']} | {order['env_steps']:,} | {order['updates']:,} | {training['wall_seconds']} "
            f"| {order['preference_accuracy']:.3f} | {order['kendall_tau']:.3f} |"
        )
    others = " (and the other seeds)" if len(runs) > 1 else ""
    lines += ["", f"Trained with `{runs[0]['training']['command']}`{others},"]
    lines += [f"adapted with `{runs[0]['adaptations'][0]['command']}` (and the other rules)."]
    lines += [
        "Commits: "
        + ", ".join(run["training"]["commit"] for run in runs)
        + f". Machine: {runs[0]['training']['machine']}."
    ]
    notes = sorted({run["training"]["note"] for run in runs if "note" in run["training"]})
    return "\n".join([*lines, *notes]) + "\n"


def success_table(runs: list[dict[str, Any]]) -> list[str]:
    """Markdown lines of the success rates beside the returns; none for a family that has no
    successes.
    """
    if any("success_rate" not in result for run in runs for result in run["adaptations"]):
        return []
    header = ["seed", "rule", "candidates", *(f"k = {k}" for k in COLUMNS), "task known"]
    lines = [
        "",
        "Success rate on the same episodes.",
        "",
        "| " + " | ".join(header) + " |",
        "|" + "---|" * len(header),
    ]
    for run in runs:
        for result in run["adaptations"]:
            cells = [str(run["training"]["seed"]), result["inference"], result["candidates"]]
            cells += [
                f"{rate:.2f}"
                for rate in [*result["success_rate"], result["known_task_success_rate"]]
            ]
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def main() -> None:
    """Train, adapt, record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env_id")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--algo", default="poem_sac")
    parser.add_argument(
        "--runs",
        type=Path,
        default=Path("logs/benchmark"),
        help="where models and checkpoints are kept",
    )
    parser.add_argument(
        "--adaptations",
        nargs="+",
        default=["-".join(pair) for pair in RULES],
        choices=["-".join(pair) for pair in RULES],
        help="inference rules and their sources of candidates",
    )
    parser.add_argument(
        "--train-args",
        nargs=argparse.REMAINDER,
        default=[],
        help="further arguments of sb3-poem train",
    )
    arguments = parser.parse_args()
    family = family_of(arguments.env_id)
    record = RESULTS / family / "adaptation.json"
    by_seed = (
        {run["training"]["seed"]: run for run in json.loads(record.read_text())["runs"]}
        if record.exists()
        else {}
    )
    for seed in arguments.seeds:
        folder = arguments.runs / family / f"seed{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        model, training = train(
            arguments.env_id, seed, folder, arguments.algo, arguments.train_args
        )
        test_seed = 100 + seed
        adaptations = [
            adapt(
                arguments.env_id,
                model,
                rule,
                candidates,
                test_seed,
                folder / f"adapt-{rule}-{candidates}.json",
            )
            for rule, candidates in (pair.split("-") for pair in arguments.adaptations)
        ]
        by_seed[seed] = {
            "training": training,
            "adaptations": adaptations,
            "order": order_on_test_tasks(arguments.env_id, model, test_seed),
        }
        runs = [by_seed[key] for key in sorted(by_seed)]
        record.parent.mkdir(parents=True, exist_ok=True)
        record.write_text(json.dumps({"env_id": arguments.env_id, "runs": runs}))
        record.with_suffix(".md").write_text(table(arguments.env_id, runs))
    print(record.with_suffix(".md").read_text())


if __name__ == "__main__":
    main()
