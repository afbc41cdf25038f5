"""The paper's own rule, Algorithm 2 of Xu & Zhu (2025)."""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_expit

from sb3_poem.adaptation import queries
from sb3_poem.adaptation.meta_model import HasSimilarity, MetaModel
from sb3_poem.adaptation.preference import SIGNS, Preference, preference_log_likelihood
from sb3_poem.adaptation.priors import SOURCES, Prior, make_prior
from sb3_poem.adaptation.queries import tolerance
from sb3_poem.adaptation.rule import (
    Answer,
    Inference,
    Rule,
    Setting,
    Shown,
    equally_weighted,
    latents_of,
)
from sb3_poem.common.checks import check_choice, check_number, check_whole

# Bound on the draws for a question.
MAX_DRAWS = 16384


@dataclass(frozen=True, repr=False)
class Paper(Rule):
    """Algorithm 2 of Xu & Zhu (2025): candidates that satisfy every answer within the tolerance of
    eq. 9, the pair of eq. 10, and the candidate of highest Bradley-Terry likelihood (line 17).

    Draws are bounded; what is missing of N_z candidates is filled up by those that satisfy most
    answers, among these by the likeliest. EQUAL excludes nobody.

    >>> from sb3_poem import PreferenceAdapter
    >>> rule = Paper(n_candidates=50, epsilon=0.2)
    >>> adapter = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", rule=rule, seed=0)
    >>> adapter.inference.candidates.shape
    (50, 5)

    :param n_candidates: N_z, at least 2.
    :param epsilon: Tolerated error of eq. 9, in [0, 0.5).
    :param candidates: Where they come from: "prior" (the paper's N(0, I)) or "aggregate" (the
        training tasks' posteriors).
    :param query_rule: "worst-case" (the paper's), "information-gain" or "random".
    :raises ValueError: If an option is out of its range.
    """

    n_candidates: int = 100
    epsilon: float = 0.1
    candidates: str = "prior"
    query_rule: str = "worst-case"

    refuses_library = "Algorithm 2 compares its own candidates; Bayes() asks about a library"

    def __post_init__(self) -> None:
        check_whole("n_candidates", self.n_candidates, 2)  # a question compares two
        check_number("epsilon", self.epsilon, 0.0, below=0.5)
        check_choice("candidates", self.candidates, SOURCES)
        check_choice("query_rule", self.query_rule, queries.QUERY_RULES)

    def check(self, model: MetaModel, setting: Setting) -> None:
        """See :class:`Rule`: Algorithm 2 needs S."""
        super().check(model, setting)
        if not isinstance(model, HasSimilarity):
            raise ValueError(
                f"rule=Paper() needs a model with a similarity S; {type(model).__name__} has none"
            )

    def start(self, model: MetaModel, rng: np.random.Generator, setting: Setting) -> Inference:
        assert isinstance(model, HasSimilarity)
        return PaperInference(self, model, make_prior(model, self.candidates, rng), rng)


class PaperInference(Inference):
    """See :class:`Paper`."""

    state = ("candidates", "fresh")

    def __init__(
        self, rule: Paper, model: HasSimilarity, prior: Prior, rng: np.random.Generator
    ) -> None:
        super().__init__(rng)
        self.rule, self.model, self.prior = rule, model, prior
        self.candidates = prior.sample(rule.n_candidates, rng)
        self.fresh = np.array([True])

    def ask(self) -> tuple[Shown, Shown]:
        """Draws the candidate set anew, as lines 3 to 9 do."""
        if not self.fresh:
            self.candidates = self._draw_candidates()
            self.fresh = np.array([True])
        if self.rule.query_rule == "random":
            first, second = queries.random_set(len(self.candidates), 2, self.rng)
        else:
            similarities = self.model.similarities(self.candidates, self.candidates)
            if self.rule.query_rule == "worst-case":
                first, second = queries.worst_case_pair(similarities, self.rule.epsilon)
            else:
                n = len(self.candidates)
                left = np.exp(log_expit(queries.pair_differences(similarities)))  # eq. 7
                gains = queries.information_gains(left, np.full(n, 1.0 / n))
                first, second = queries.best_pair(gains, n)
        return self.candidates[first].copy(), self.candidates[second].copy()

    def tell(self, preference: Preference, *shown: Shown) -> None:
        self.answers.append(Answer(preference, shown))
        self.fresh = np.array([False])

    def estimate(self) -> np.ndarray:
        """Line 17: of the candidates of the last question the one under which all answers are most
        likely; before any answer the one nearest to their centre.
        """
        if not self.answers:
            distances = np.linalg.norm(self.candidates - self.candidates.mean(axis=0), axis=1)
            return self.candidates[np.argmin(distances)].copy()
        differences = self._differences(self.candidates)
        return self.candidates[np.argmax(self._log_likelihoods(differences))].copy()

    def posterior(self) -> tuple[np.ndarray, np.ndarray]:
        return equally_weighted(self.candidates)

    def satisfied(self, latents: np.ndarray) -> np.ndarray:
        """(m,) how many answers each latent (m, d) satisfies within the tolerance (eq. 9)."""
        if not self.answers:
            return np.zeros(len(latents), dtype=np.int64)
        return self._satisfied(self._differences(latents))

    def _differences(self, latents: np.ndarray) -> np.ndarray:
        """(m, k) S(z, z_left) - S(z, z_right) of every answered question."""
        shown = [item for answer in self.answers for item in answer.shown]
        similarities = self.model.similarities(latents, latents_of(shown))
        return similarities[:, 0::2] - similarities[:, 1::2]

    def _satisfied(self, differences: np.ndarray) -> np.ndarray:
        slack = tolerance(self.rule.epsilon)
        signs = np.array([SIGNS[answer.preference] for answer in self.answers])
        return np.count_nonzero(differences * signs >= -slack, axis=1)

    def _log_likelihoods(self, differences: np.ndarray) -> np.ndarray:
        told = [answer.preference for answer in self.answers]
        return preference_log_likelihood(log_expit(differences), log_expit(-differences), told)

    def _draw_candidates(self) -> np.ndarray:
        """Lines 3 to 9, bounded; the last question's candidates take part in the fall-back."""
        rest = [(self.candidates, self._differences(self.candidates))]
        found: list[np.ndarray] = []
        max_draws = max(MAX_DRAWS, self.rule.n_candidates)
        n_found, drawn, batch = 0, 0, max(1024, self.rule.n_candidates)
        while n_found < self.rule.n_candidates and drawn < max_draws:
            latents = self.prior.sample(min(batch, max_draws - drawn), self.rng)
            drawn += len(latents)
            batch *= 2
            differences = self._differences(latents)
            accepted = self._satisfied(differences) == len(self.answers)
            found.append(latents[accepted])
            rest.append((latents[~accepted], differences[~accepted]))
            n_found += int(np.count_nonzero(accepted))
        if n_found < self.rule.n_candidates:
            latents, differences = (np.concatenate(parts) for parts in zip(*rest, strict=True))
            found.append(latents[self._best(differences, self.rule.n_candidates - n_found)])
        return np.concatenate(found)[: self.rule.n_candidates]

    def _best(self, differences: np.ndarray, n: int) -> np.ndarray:
        """Rows of the n latents that satisfy most answers, among equals the likeliest."""
        satisfied = self._satisfied(differences)
        worst = len(satisfied) - n
        contenders = np.flatnonzero(satisfied >= np.partition(satisfied, worst)[worst])
        likelihoods = self._log_likelihoods(differences[contenders])
        return contenders[np.lexsort((-likelihoods, -satisfied[contenders]))[:n]]
