"""ANOLE and its two variants: twenty questions with a liar (Ren et al. 2022; Berlekamp 1968)."""

from dataclasses import dataclass
from math import comb, floor

import numpy as np

from sb3_poem.adaptation import Answer, Inference, Rule, Setting
from sb3_poem.adaptation.meta_model import HasRewardDecoder, MetaModel
from sb3_poem.adaptation.preference import SIGNS, Preference
from sb3_poem.adaptation.priors import SOURCES, make_prior
from sb3_poem.adaptation.queries import random_set
from sb3_poem.adaptation.rule import Shown, equally_weighted, seen
from sb3_poem.baselines.fragments import (
    check_shared_dynamics,
    default_fragment_length,
    replay_fragments,
)
from sb3_poem.common.checks import check_choice, check_number, check_whole
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.pearl_sac import PEARLSAC

STRATEGIES = ("berlekamp", "greedy", "random")
MAX_CANDIDATES = 2**14  # each has a predicted return for every fragment


@dataclass(frozen=True, repr=False)
class ANOLE(Rule):
    """ANOLE (Ren et al. 2022) asks about fragments of what the training tasks' policies did, and
    never rolls out on the new task. Each candidate, a latent, predicts an answer by the reward
    decoder's returns of the two fragments, and what counts is how many answers it contradicts.

    It takes a ``PEARLSAC`` or ``POEMSAC`` with its replay buffer, unless the adapter has a
    ``library``.

    >>> from sb3_poem import PreferenceAdapter
    >>> from sb3_poem.baselines import rollout_fragments
    >>> name, env = "PointGoal", "poem/PointGoal-v0"  # the model, which ships without its buffer
    >>> library = rollout_fragments(name, env, 40, length=10)
    >>> adapter = PreferenceAdapter(name, env, rule=ANOLE(), library=library, seed=0)
    >>> adapter.ask().left.actions.shape
    (10, 2)

    :param strategy: "berlekamp" (ANOLE) asks the pair whose worse answer leaves the smallest
        Berlekamp volume, "random" a random one; "greedy" (binary search) the pair that splits 2^K
        candidates most evenly, and drops what disagrees.
    :param n_candidates: Candidates at least.
    :param mistake_rate: The share of answers that may be mistakes: E = floor(rate K).
    :param n_pairs: Random pairs to choose from for each question, of twice as many fragments.
    :param fragment_length: Steps of a fragment from the replay buffer; None takes 50, or an episode
        that is shorter.
    :param candidates: Where candidates come from: "prior" or "aggregate".
    :raises ValueError: If an option is out of its range.
    """

    strategy: str = "berlekamp"
    n_candidates: int = 100
    mistake_rate: float = 0.2
    n_pairs: int = 100
    fragment_length: int | None = None
    candidates: str = "prior"

    def __post_init__(self) -> None:
        for name in ("n_candidates", "n_pairs", "fragment_length"):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name), 1)
        check_choice("strategy", self.strategy, STRATEGIES)
        check_choice("candidates", self.candidates, SOURCES)
        check_number("mistake_rate", self.mistake_rate, 0.0, below=0.5)

    def budget(self, n_queries: int) -> int:
        """Mistakes that all answers together may hold, E."""
        return floor(self.mistake_rate * n_queries + 1e-9)

    def total_candidates(self, n_queries: int) -> int:
        """How many candidates are drawn for so many questions."""
        if self.strategy == "greedy":
            return 2**n_queries
        return max(self.n_candidates, n_distinguishable(n_queries, self.budget(n_queries)))

    def check(self, model: MetaModel, setting: Setting) -> None:
        """See :class:`Rule`: it needs a decoder, experience, and tasks that share dynamics."""
        super().check(model, setting)
        n, most = setting.n_queries, max(MAX_CANDIDATES, self.n_candidates)
        if self.total_candidates(n) > most:
            allowed = max(k for k in range(n) if self.total_candidates(k) <= most)
            raise ValueError(
                f"`n_queries` must be at most {allowed} with {self}, which keeps no more than "
                f"{most:,} candidates, but is {n}"
            )
        untrained = isinstance(model, PEARLSAC) and model.reward_coef == 0
        if untrained or not isinstance(model, HasRewardDecoder):
            raise ValueError(
                f"`model` needs a trained reward decoder, which this {type(model).__name__} does "
                "not have; train a PEARLSAC with reward_coef > 0"
            )
        if setting.library is not None:
            return
        if not has_experience(model):
            raise ValueError(
                "`model` has no experience to ask about, as its replay buffer is empty (a loaded "
                "model has none): call load_replay_buffer, or pass library="
                "sb3_poem.baselines.training_rollouts(model, env, 200), of another copy of env"
            )
        check_shared_dynamics(
            setting,
            "ANOLE asks which fragment of the training tasks is better on the new task, and here "
            "these show another world; pass a `library` from the new task",
        )

    def start(self, model: MetaModel, rng: np.random.Generator, setting: Setting) -> Inference:
        return ANOLEInference(self, model, rng, setting)


class ANOLEInference(Inference):
    """See :class:`ANOLE`."""

    state = ("candidates", "priority", "contradictions", "alive")
    library: list[Trajectory]

    def __init__(
        self, rule: ANOLE, model: MetaModel, rng: np.random.Generator, setting: Setting
    ) -> None:
        super().__init__(rng)
        assert isinstance(model, HasRewardDecoder)
        self.rule, self.model, self.n_queries = rule, model, setting.n_queries
        if setting.library is None:
            assert isinstance(model, PEARLSAC)
            length = rule.fragment_length or default_fragment_length(model.horizon)
            self.library = replay_fragments(model, 2 * rule.n_pairs, length, rng)
        else:
            self.library = list(setting.library)
        n = rule.total_candidates(self.n_queries)
        self.candidates = make_prior(model, rule.candidates, rng).sample(n, rng)
        # Ties are broken at random, but always alike.
        self.priority = rng.permutation(n)
        self.contradictions = np.zeros(n, dtype=np.int64)
        self.alive = np.ones(n, dtype=bool)

    @property
    def budget(self) -> int:
        """Mistakes allowed, E, or the fewest of a candidate if all exceed it."""
        return max(self.rule.budget(self.n_queries), int(self.contradictions.min()))

    def ask(self) -> tuple[Shown, Shown]:
        """The best of random pairs, or one random pair."""
        n_pairs = 1 if self.rule.strategy == "random" else self.rule.n_pairs
        pairs = np.array([random_set(len(self.library), 2, self.rng) for _ in range(n_pairs)])
        best = 0
        if n_pairs > 1:
            if self._library_returns is None:
                self._library_returns = self.model.predicted_returns(self.candidates, self.library)
            returns = self._library_returns
            scores = self._scores(returns[:, pairs[:, 0]] - returns[:, pairs[:, 1]])
            best = int(np.argmin(scores))
        first, second = pairs[best]
        return self.library[first], self.library[second]

    def _scores(self, differences: np.ndarray) -> np.ndarray:
        """(n_pairs,) Berlekamp volumes that the worse answer leaves, or for "greedy" the number of
        candidates; ``differences`` (n_candidates, n_pairs) are of predicted returns.
        """
        if self.rule.strategy == "greedy":
            # Without a budget for mistakes the volume of a candidate is 1 until it is contradicted.
            return worst_case_volumes(differences, (~self.alive).astype(np.int64), 0, 0)
        left = max(0, self.n_queries - len(self.answers) - 1)
        return worst_case_volumes(differences, self.contradictions, left, self.budget)

    def tell(self, preference: Preference, *shown: Shown) -> None:
        returns = self.model.predicted_returns(self.candidates, seen(shown))
        contradicted = SIGNS[preference] * (returns[:, 0] - returns[:, 1]) < 0
        self.contradictions = self.contradictions + contradicted
        if np.any(self.alive & ~contradicted):
            self.alive = self.alive & ~contradicted
        self.answers.append(Answer(preference, shown))

    def estimate(self) -> np.ndarray:
        """A candidate of fewest contradictions; for "greedy" one that is left."""
        worse = ~self.alive if self.rule.strategy == "greedy" else self.contradictions
        return self.candidates[np.lexsort((self.priority, worse))[0]].copy()

    def posterior(self) -> tuple[np.ndarray, np.ndarray]:
        return equally_weighted(self.candidates)


def has_experience(model: MetaModel) -> bool:
    """Whether a model has steps in its replay buffer; a loaded one has none."""
    return isinstance(model, PEARLSAC) and bool(model.replay_buffer.counts.any())


def berlekamp_volumes(contradictions: np.ndarray, n_left: int, budget: int) -> np.ndarray:
    """In how many ways the ``n_left`` answers to come may lie within the budget E, if a candidate
    is the truth that contradicts m answers: sum over e = 0, ..., E - m of C(n_left, e).
    """
    by_lies_left = np.cumsum([float(comb(n_left, lies)) for lies in range(budget + 1)])
    lies_left = budget - np.asarray(contradictions)
    return np.where(lies_left >= 0, by_lies_left[np.maximum(lies_left, 0)], 0.0)


def worst_case_volumes(
    differences: np.ndarray, contradictions: np.ndarray, n_left: int, budget: int
) -> np.ndarray:
    """(n_pairs,) the volume that the worse of two answers leaves, with ``n_left`` questions to come
    after it; ``differences`` (n_candidates, n_pairs) are of predicted returns, left minus right.
    """
    kept = berlekamp_volumes(contradictions, n_left, budget)
    lost = kept - berlekamp_volumes(contradictions + 1, n_left, budget)
    after_left = kept.sum() - lost @ (differences < 0)
    after_right = kept.sum() - lost @ (differences > 0)
    return np.maximum(after_left, after_right)


def n_distinguishable(n_queries: int, budget: int) -> int:
    """Candidates that so many answers with so many lies can tell apart (sphere-packing bound)."""
    return 2**n_queries // sum(comb(n_queries, lies) for lies in range(budget + 1))
