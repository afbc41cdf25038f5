"""What a known task would give, and Property 1 on held-out tasks."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation.environments import Env, model_and_env
from sb3_poem.adaptation.evaluation import (
    EpisodeOutcomes,
    choose_test_tasks,
    evaluate_episodes,
    evaluation_seed,
)
from sb3_poem.adaptation.limits import AnswerLimits
from sb3_poem.adaptation.meta_model import HasSimilarity, MetaModel
from sb3_poem.adaptation.noise import NoiseModel
from sb3_poem.common.checks import check_choice, check_whole
from sb3_poem.common.family_view import FamilyView, demanded
from sb3_poem.common.rollouts import rollout_episodes

# Latents to try for each task, where every one must be rolled out in every task, and where one
# rollout serves all of them.
LATENTS_WITH_OWN_DYNAMICS, LATENTS_WITH_SHARED_DYNAMICS = 30, 300
#: Episodes for choosing a task's best latent, where nothing more exact is asked for: the fewer,
#: the more luck counts in what is found
SELECTION_EPISODES = 3
SPREAD_TASKS = 40
#: Draws around the best latent of each task, in each of two rounds, and how far from it they go, as
#: a share of the first latents' deviation
REFINING_DRAWS, REFINING_WIDTHS = 3, (0.5, 0.2)
#: Tasks that a limit's codebooks are chosen on
OTHER_TASKS = 500
OTHER_TASK_STREAM = 7


@dataclass(frozen=True, eq=False)
class KnownTaskReturn(EpisodeOutcomes):
    """What the model's repertoire holds for each task: outcomes of its best latent, on episodes
    that had no part in choosing it; :func:`known_task_return` measures it.

    >>> found = known_task_return("PointGoal", "poem/PointGoal-v0", 3, n_latents=20, n_episodes=1)
    >>> found.returns.shape, found.candidate_returns.shape
    ((3, 1), (3, 20))

    :param tasks: (n_tasks, task_dim).
    :param latents: (n_tasks, latent_dim) the best ones.
    :param candidate_latents: (n_latents, latent_dim) all that were tried for all tasks alike.
    :param candidate_returns: (n_tasks, n_latents) their returns on every task (J).
    :param limits: What k answers allow among the candidates; None if that was not asked for.
    """

    tasks: np.ndarray
    latents: np.ndarray
    candidate_latents: np.ndarray
    candidate_returns: np.ndarray
    limits: AnswerLimits | None = None

    def __repr__(self) -> str:
        latents = f"the best of {len(self.candidate_latents)} latents, refined"
        found = f"mean return {self.mean_return:.1f} of {latents}"
        return f"KnownTaskReturn({len(self.tasks)} tasks, {found})"

    def limit(self, k: int, noise_model: NoiseModel | None = None, n_answers: int = 2) -> float:
        """:meth:`AnswerLimits.after`."""
        if self.limits is None:
            raise ValueError("`limits` were not measured: call known_task_return(..., limits=True)")
        return self.limits.after(k, noise_model, n_answers)


def known_task_return(
    model: MetaModel | str | Path,
    env: Env,
    tasks: np.ndarray | int | None = None,
    n_latents: int | None = None,
    n_episodes: int = 10,
    seed: int = 0,
    *,
    selection_episodes: int = 1,
    deterministic: bool = True,
    limits: bool | str = True,
) -> KnownTaskReturn:
    """The return if the task were known: for each task the best of many latents, half of N(0, I)
    and half of the training tasks', refined by two rounds of draws around it. Winners are rolled
    out anew, so that the luck of having been chosen does not count.

    The *limit* is what the best 2^k of the latents that were tried at first earn on these tasks
    (:class:`AnswerLimits`). They are chosen on other tasks, for which the same rollouts are
    relabelled (where tasks do not share their dynamics, on the test tasks themselves), and scored
    by fresh episodes.

    :param model: And ``env``: see :func:`adapt_tasks`.
    :param tasks: See :func:`evaluate_adaptation`.
    :param n_latents: How many to try at first; None for 300, or 30 where dynamics differ.
    :param n_episodes: Fresh episodes per winner.
    :param selection_episodes: Episodes per latent (and task, where dynamics differ) for choosing.
    :param deterministic: Whether policies act by their mode.
    :param limits: Whether to measure limits, which takes one more rollout of all latents; "exact"
        leaves out those of answers with errors, which take longest.
    """
    check_choice("limits", limits, (True, False, "exact"))
    model, vec_env = model_and_env(model, env)
    tasks = choose_test_tasks(model, vec_env, tasks, seed)
    family = FamilyView(vec_env)
    shared = family.shared_dynamics
    if n_latents is None:
        n_latents = LATENTS_WITH_SHARED_DYNAMICS if shared else LATENTS_WITH_OWN_DYNAMICS
    check_whole("n_latents", n_latents, 1)
    check_whole("n_episodes", n_episodes, 1)
    check_whole("selection_episodes", selection_episodes, 1)
    rng = np.random.default_rng([seed, 2])
    candidates = _draw_latents(model, n_latents, rng)
    others = tasks[:0]
    if limits and shared:
        n = OTHER_TASKS if family.all_tasks is None else len(family.all_tasks)
        drawn = family.sample_tasks(n, np.random.default_rng([seed, OTHER_TASK_STREAM]))
        others = np.unique(drawn, axis=0)
    every = np.concatenate([tasks, others])

    def returns_of(tasks: np.ndarray, latents: np.ndarray, stream: int) -> np.ndarray:
        how = selection_episodes, evaluation_seed(seed, stream), deterministic
        return return_matrix(model, vec_env, tasks, latents, *how)

    returns, on_others = np.split(returns_of(every, candidates, 1), [len(tasks)])
    best = candidates[np.argmax(returns, axis=1)]
    for stream, width in enumerate(REFINING_WIDTHS, start=2):
        # The best so far takes part again: that it was the best by luck must not keep it.
        steps = rng.standard_normal((len(tasks), 1 + REFINING_DRAWS, candidates.shape[1]))
        steps[:, 0] = 0.0
        draws = best[:, None] + width * candidates.std(axis=0) * steps
        if shared:
            flat = draws.reshape(-1, draws.shape[2])
            best = flat[np.argmax(returns_of(tasks, flat, stream), axis=1)]
            continue
        rows = np.repeat(tasks, draws.shape[1], axis=0)
        how = selection_episodes, evaluation_seed(seed, stream), deterministic
        found = evaluate_episodes(model, vec_env, draws.reshape(len(rows), -1), rows, *how)
        picks = np.argmax(found.returns.mean(axis=1).reshape(draws.shape[:2]), axis=1)
        best = draws[np.arange(len(tasks)), picks]
    measured = None
    if limits:
        how = 1, evaluation_seed(seed, 4), deterministic
        fresh = return_matrix(model, vec_env, tasks, candidates, *how)
        chosen_on, along = (on_others, others) if shared else (returns, tasks)
        ordered = along.shape[1] == 1
        if ordered:
            chosen_on = chosen_on[np.argsort(along[:, 0])]
        extent = {"ordered": ordered, "erring": limits != "exact"}
        measured = AnswerLimits.measure(chosen_on, returns, fresh, **extent)
    how = n_episodes, evaluation_seed(seed), deterministic
    outcomes = evaluate_episodes(model, vec_env, best, tasks, *how)
    own = {"tasks": tasks, "latents": best, "candidate_latents": candidates}
    return KnownTaskReturn(**vars(outcomes), **own, candidate_returns=returns, limits=measured)


def return_spread(model: MetaModel | str | Path, env: Env, seed: int = 0) -> float:
    """The family's spread of returns: the root mean square difference of the returns of two random
    policies of a model on a random task, in units of return. For ``model`` and ``env`` see
    :func:`adapt_tasks`.
    """
    model, vec_env = model_and_env(model, env)
    tasks = choose_test_tasks(model, vec_env, SPREAD_TASKS, seed)
    rng, start = np.random.default_rng([seed, 4]), evaluation_seed(seed, 2)
    if FamilyView(vec_env).shared_dynamics:
        latents = _draw_latents(model, SPREAD_TASKS, rng)
        returns = return_matrix(model, vec_env, tasks, latents, seed=start)
    else:
        latents = _draw_latents(model, 2 * SPREAD_TASKS, rng)
        outcomes = evaluate_episodes(model, vec_env, latents, np.tile(tasks, (2, 1)), 1, start)
        returns = outcomes.returns.reshape(2, SPREAD_TASKS).T
    return float(np.sqrt(2.0 * returns.var(axis=1, ddof=1).mean()))


def return_matrix(
    model: MetaModel,
    vec_env: VecEnv,
    tasks: np.ndarray,
    latents: np.ndarray,
    n_episodes: int = 1,
    seed: int = 0,
    deterministic: bool = True,
) -> np.ndarray:
    """J[i, j], (n_tasks, n_latents), the mean true return of latent j (n_latents, latent_dim) on
    task i (n_tasks, task_dim), over episodes whose reset seeds start at ``seed``.
    """
    tasks, latents = np.asarray(tasks, dtype=np.float64), np.asarray(latents, dtype=np.float64)
    family, shape = FamilyView(vec_env), (len(tasks), len(latents))
    if not family.shared_dynamics:
        every, rows = np.tile(latents, (shape[0], 1)), np.repeat(tasks, shape[1], axis=0)
        found = evaluate_episodes(model, vec_env, every, rows, n_episodes, seed, deterministic)
        return found.returns.mean(axis=1).reshape(shape)
    # The task in effect does not matter, and it must be one that every copy accepts.
    some_task = np.repeat(tasks[:1], n_episodes * shape[1], axis=0)
    every = np.tile(latents, (n_episodes, 1))
    episodes = rollout_episodes(model, vec_env, every, some_task, seed, deterministic)
    features = [demanded(seen.reward_features)[None] for seen, _ in episodes]
    totals = [family.compute_rewards(tasks[:, None], each).sum(axis=1) for each in features]
    return np.stack(totals, axis=1).reshape(shape[0], n_episodes, shape[1]).mean(axis=1)


def property_one(similarities: np.ndarray, returns: np.ndarray) -> tuple[float, float]:
    """How well S(z_i, z_j), (n_tasks, n_policies), orders policies as true returns J[i, j] do
    (Property 1).

    >>> similarities, returns = np.array([[0.1, 0.5, 0.9]]), np.array([[-3.0, -1.0, -2.0]])
    >>> accuracy, tau = property_one(similarities, returns)  # of three pairs two are in order
    >>> round(accuracy, 2), round(tau, 2)
    (0.67, 0.33)

    :return: The share of pairs of policies with different returns that S puts in the right order (a
        tie of S counts one half); and Kendall's tau-b, averaged over tasks. NaN if no task tells
        any two policies apart.
    """
    similarities, returns = (np.asarray(x, dtype=np.float64) for x in (similarities, returns))
    if similarities.shape != returns.shape or similarities.ndim != 2:
        raise ValueError(
            "`similarities` and `returns` must have the same shape (n_tasks, n_policies), but have "
            f"{similarities.shape} and {returns.shape}"
        )
    first, second = np.triu_indices(returns.shape[1], 1)
    order = np.sign(returns[:, first] - returns[:, second])
    guess = np.sign(similarities[:, first] - similarities[:, second])
    if not order.any():
        return float("nan"), float("nan")
    agreement = order * guess
    accuracy = float((0.5 * (1.0 + agreement))[order != 0].mean())
    norms = np.sqrt(np.abs(order).sum(axis=1) * np.abs(guess).sum(axis=1))
    told = np.abs(order).sum(axis=1) > 0
    tau = np.divide(agreement.sum(axis=1), norms, out=np.zeros(len(norms)), where=norms > 0)
    return accuracy, float(tau[told].mean())


def preference_order(model: HasSimilarity, known: KnownTaskReturn) -> tuple[float, float]:
    """:func:`property_one` on held-out tasks, whose latents are the best of the candidates."""
    best, latents = np.argmax(known.candidate_returns, axis=1), known.candidate_latents
    policies = np.unique(best)
    similarities = model.similarities(latents[best], latents[policies])
    return property_one(similarities, known.candidate_returns[:, policies])


def _draw_latents(model: MetaModel, n: int, rng: np.random.Generator) -> np.ndarray:
    numbers = {"prior": n - n // 2, "aggregate": n // 2}
    drawn = [model.sample_latents(k, rng, source=source) for source, k in numbers.items() if k]
    return np.concatenate(drawn)
