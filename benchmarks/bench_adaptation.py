"""Milliseconds of ``ask`` and ``tell`` without rollouts: latent dimensions, answers, candidates,
rules, and 30 tasks at once.

The model is untrained, of POEMSAC's default size; trajectories of 200 steps are random. Neither
changes the work, but for how often particles thin out. Figures are the means over the first k
questions.
"""

import time
from typing import Any

import common
import numpy as np
import torch as th

from sb3_poem import POEMSAC, Preference
from sb3_poem.adaptation import Rule, named_rule
from sb3_poem.adaptation.rule import Setting, inference_rng
from sb3_poem.common.trajectory import Trajectory

# The paper's candidates, what Bayesian inference takes unless told otherwise, and many.
DIMENSIONS, CANDIDATES = (5, 16, 32), (100, 400, 1000)
# With so many candidates a question of Algorithm 2 weighs up to half a million pairs: there ten
# have to do.
ANSWERS = {100: (1, 10, 50), 400: (1, 10), 1000: (1, 10)}
RULES: dict[str, dict[str, Any]] = {
    "bayes, decoder": {"inference": "bayes", "likelihood": "decoder"},
    "bayes, similarity": {"inference": "bayes", "likelihood": "similarity"},
    "paper": {"inference": "paper"},
}
STEPS = 200


def make_model(latent_dim: int) -> POEMSAC:
    settings = {"n_train_tasks": 2, "latent_dim": latent_dim, "seed": 0, "device": "cpu"}
    model = POEMSAC("MlpPolicy", "poem/HalfCheetahVel-v0", **settings)
    model.predicted_rewards_error = 0.05  # a trained model's; an untrained one has measured none
    means = np.random.default_rng(0).standard_normal((120, latent_dim))
    model.train_tasks.latent_means = means
    model.train_tasks.latent_variances = np.full((120, latent_dim), 0.01)
    return model


def trajectory(latent: np.ndarray, rng: np.random.Generator) -> Trajectory:
    actions = rng.uniform(-1.0, 1.0, (STEPS, 6))
    return Trajectory(rng.standard_normal((STEPS + 1, 17)), actions, latent)


def milliseconds(model: POEMSAC, n_answers: int, n_tasks: int, seed: int, rule: Rule) -> np.ndarray:
    """Of ``ask`` and ``tell``, for all tasks together, (n_answers, 2)."""
    inferences = [rule.start(model, inference_rng(seed + i), Setting()) for i in range(n_tasks)]
    rng = np.random.default_rng(seed)
    taken = np.zeros((n_answers, 2))
    for question in range(n_answers):
        started = time.perf_counter()
        pairs = [inference.ask() for inference in inferences]
        taken[question, 0] = time.perf_counter() - started
        shown = [(trajectory(left, rng), trajectory(right, rng)) for left, right in pairs]
        answers = [Preference.LEFT if rng.random() < 0.5 else Preference.RIGHT for _ in pairs]
        started = time.perf_counter()
        for inference, answer, (left, right) in zip(inferences, answers, shown, strict=True):
            inference.tell(answer, left, right)
        taken[question, 1] = time.perf_counter() - started
    return 1000.0 * taken


def main() -> None:
    repeats = (given := common.arguments(__doc__, repeats=3)).repeats
    th.set_num_threads(1)
    results: list[dict[str, Any]] = []
    for dim in DIMENSIONS:
        model = make_model(dim)
        for n in CANDIDATES:
            runs: dict[str, list[np.ndarray]] = {name: [] for name in RULES}
            for repeat in range(repeats if n == CANDIDATES[0] else 1):
                for name, options in RULES.items():  # in turns
                    rule = named_rule(n_candidates=n, **options)
                    taken = milliseconds(model, max(ANSWERS[n]), 1, repeat, rule)
                    runs[name].append(taken.sum(axis=1))
            for name, of_rule in runs.items():
                taken = np.median(of_rule, axis=0)
                means = {f"k = {k}": float(taken[:k].mean()) for k in ANSWERS[n]}
                worst = {"worst": float(taken.max())}
                results.append({"rule": name, "d": dim, "candidates": n, **worst, **means})
    model = make_model(5)
    many = {}
    for name, options in RULES.items():
        taken = milliseconds(model, 10, 30, 0, named_rule(n_candidates=100, **options))
        many[name] = float(taken.sum(axis=1).mean())
    shown = ["rule", "d", "candidates", *(f"k = {k}" for k in ANSWERS[100]), "worst"]
    sections = [
        "Milliseconds of `ask` + `tell`, mean over the first k questions.",
        common.table(shown, [[row.get(name, "not run") for name in shown] for row in results]),
        "30 tasks at once, d = 5, 100 candidates, k = 10: milliseconds a question for all of them.",
        common.table(
            ["rule", "30 tasks", "each"], [[rule, ms, ms / 30] for rule, ms in many.items()]
        ),
    ]
    settings = {"threads of torch": 1, "steps of a trajectory": STEPS, "runs": repeats}
    settings["precision"] = "auto"
    data = {"one task": results, "30 tasks": many}
    title = "Adaptation: time without rollouts"
    common.write("adaptation-speed", title, sections, data, given.out, settings)


if __name__ == "__main__":
    main()
