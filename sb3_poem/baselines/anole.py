"""ANOLE and its two variants: candidates told apart by the reward decoder (Ren et al. 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import floor
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sb3_poem.adaptation.adapter import Oracle, PreferenceAdapter
from sb3_poem.adaptation.environments import Env, check_model_fits
from sb3_poem.adaptation.inference import SIGNS, Answer, LatentInference, Shown
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.priors import SOURCES, make_prior
from sb3_poem.adaptation.queries import random_pair
from sb3_poem.adaptation.state import plain
from sb3_poem.baselines.berlekamp import n_distinguishable, worst_case_volumes
from sb3_poem.baselines.fragments import default_fragment_length, replay_fragments
from sb3_poem.common.checks import check_whole
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.trajectory import Trajectory

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

STRATEGIES = ("berlekamp", "greedy", "random")
MAX_GREEDY_QUERIES = 14  # 2^K candidates, each with a predicted return for every fragment


@dataclass(frozen=True)
class ANOLEOptions:
    """How ANOLE adapts; the arguments are explained at :class:`ANOLEAdapter`."""

    n_queries: int = 10
    strategy: str = "berlekamp"
    n_candidates: int = 100
    mistake_rate: float = 0.2
    n_pairs: int = 100
    fragment_length: int | None = None
    candidates: str = "prior"
    deterministic: bool = True

    def __post_init__(self) -> None:
        for name in ("n_queries", "n_candidates", "n_pairs", "fragment_length"):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name), 1)
        if self.strategy not in STRATEGIES:
            raise ValueError(f"`strategy` must be one of {STRATEGIES}, but is {self.strategy!r}")
        if self.candidates not in SOURCES:
            raise ValueError(f"`candidates` must be one of {SOURCES}, but is {self.candidates!r}")
        if not 0.0 <= self.mistake_rate < 0.5:
            raise ValueError(f"`mistake_rate` must lie in [0, 0.5), but is {self.mistake_rate}")
        if self.strategy == "greedy" and self.n_queries > MAX_GREEDY_QUERIES:
            raise ValueError(
                f'`n_queries` must be at most {MAX_GREEDY_QUERIES} with strategy="greedy", which keeps 2^n_queries '
                f"candidates, but is {self.n_queries}"
            )

    @property
    def budget(self) -> int:
        """Mistakes that all answers together may hold, E."""
        return floor(self.mistake_rate * self.n_queries + 1e-9)

    @property
    def total_candidates(self) -> int:
        """How many candidates are drawn."""
        if self.strategy == "greedy":
            return 2**self.n_queries
        return max(self.n_candidates, n_distinguishable(self.n_queries, self.budget))

    def check(
        self, model: Any, vec_env: VecEnv, library: Sequence[Trajectory] | None = None
    ) -> None:
        """Refuse what ANOLE cannot run with.

        :param vec_env: The environment to adapt in.
        :param library: Trajectories to ask about, or None.
        :raises ValueError: Without a trained reward decoder, without experience to ask about, and
            for a family whose tasks do not share their dynamics.
        """
        check_model_fits(model, vec_env)
        if not hasattr(model, "predicted_returns") or getattr(model, "reward_coef", 1.0) == 0:
            raise ValueError(
                f"`model` needs a trained reward decoder, which this {type(model).__name__} does not have; "
                "train a PEARLSAC with reward_coef > 0"
            )
        if library is not None:
            if len(library) < 2:
                raise ValueError(
                    f"`library` must hold at least 2 trajectories, but holds {len(library)}"
                )
            return
        buffer = getattr(model, "replay_buffer", None)
        if buffer is None or not buffer.counts.any():
            raise ValueError(
                "`model` has no experience to ask about, because its replay buffer is empty (a loaded model has none): "
                "call load_replay_buffer, or pass "
                "library=sb3_poem.baselines.training_rollouts(model, env, 200), of another copy of the environment"
            )
        family = FamilyView.of(vec_env)
        if family is not None and not family.shared_dynamics:
            raise ValueError(
                "`env` must be of a family whose tasks share their dynamics: ANOLE asks which fragment of the training "
                "tasks is better on the new task, and here these show another world; pass a `library` from the new task"
            )

    def make_inference(
        self, model: Any, rng: np.random.Generator, library: Sequence[Trajectory] | None = None
    ) -> ANOLEInference:
        """The inference that these options describe.

        :param model: A trained model.
        :param rng: Its generator.
        :param library: Trajectories to ask about; None draws fragments of the model's replay
            buffer.
        :return: The inference.
        """
        if library is None:
            length = self.fragment_length or default_fragment_length(model.horizon)
            library = replay_fragments(model, 2 * self.n_pairs, length, rng)
        return ANOLEInference(model, self, rng, library)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return plain(asdict(self))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> ANOLEOptions:
        """Read what :meth:`to_dict` wrote.

        :param data: The dictionary.
        :return: The options.
        """
        return cls(**data)


class ANOLEInference(LatentInference):
    """Ask and tell on fragments. A candidate predicts an answer by the decoder's returns of the
    two, and what counts is how many answers it contradicts; equal returns, and answers of EQUAL,
    contradict nothing.

    :param model: A model with a reward decoder.
    :param rng: The only source of randomness.
    :param library: The fragments, at least 2.
    """

    library: list[Trajectory]

    def __init__(
        self,
        model: Any,
        options: ANOLEOptions,
        rng: np.random.Generator,
        library: Sequence[Trajectory],
    ) -> None:
        self.model = model
        self.options = options
        self.rng = rng
        self.library = list(library)
        self.answers: list[Answer] = []
        n = options.total_candidates
        self.candidates = make_prior(model, options.candidates, rng).sample(n, rng)
        # Ties are broken at random, but always alike: looking at the estimate must not change what
        # comes after.
        self.priority = rng.permutation(n)
        self.contradictions = np.zeros(n, dtype=np.int64)
        self.alive = np.ones(n, dtype=bool)
        self._library_returns: np.ndarray | None = None

    @property
    def budget(self) -> int:
        """Mistakes allowed, E; raised to the smallest count of contradictions if all candidates
        exceed it.
        """
        return max(self.options.budget, int(self.contradictions.min()))

    def ask_library(self) -> tuple[int, int]:
        """See :class:`LatentInference`: the best of random pairs, or one random pair."""
        if self.options.strategy == "random":
            return random_pair(len(self.library), self.rng)
        pairs = np.array(
            [random_pair(len(self.library), self.rng) for _ in range(self.options.n_pairs)]
        )
        if self._library_returns is None:
            self._library_returns = self.model.predicted_returns(self.candidates, self.library)
        returns = self._library_returns
        first, second = pairs[
            np.argmin(self.scores(returns[:, pairs[:, 0]] - returns[:, pairs[:, 1]]))
        ]
        return int(first), int(second)

    def scores(self, differences: np.ndarray) -> np.ndarray:
        """How much of the candidates the worse answer leaves.

        :param differences: (n_candidates, n_pairs) predicted return of the left fragment minus that
            of the right one.
        :return: (n_pairs,) Berlekamp volumes; for "greedy" numbers of candidates.
        """
        if self.options.strategy == "greedy":
            # Without a budget for mistakes the volume of a candidate is 1 until it is contradicted.
            return worst_case_volumes(differences, (~self.alive).astype(np.int64), 0, 0)
        left = max(0, self.options.n_queries - len(self.answers) - 1)
        return worst_case_volumes(differences, self.contradictions, left, self.budget)

    def ask_latents(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`LatentInference`."""
        first, second = self.ask_library()
        return self.library[first].latent.copy(), self.library[second].latent.copy()

    def tell(self, preference: Preference, left: Shown, right: Shown) -> None:
        """See :class:`LatentInference`.

        :raises ValueError: If no trajectories are given.
        """
        if not (isinstance(left, Trajectory) and isinstance(right, Trajectory)):
            raise ValueError(
                "ANOLE needs the two trajectories that were shown, not their latents alone"
            )
        returns = self.model.predicted_returns(self.candidates, [left, right])
        contradicted = SIGNS[preference] * (returns[:, 0] - returns[:, 1]) < 0
        self.contradictions = self.contradictions + contradicted
        if np.any(self.alive & ~contradicted):
            self.alive = self.alive & ~contradicted
        self.answers.append(Answer(preference, left, right))

    def estimate(self) -> np.ndarray:
        """See :class:`LatentInference`: the candidate of fewest contradictions, or for "greedy" one
        that is left.
        """
        worse = ~self.alive if self.options.strategy == "greedy" else self.contradictions
        return self.candidates[np.lexsort((self.priority, worse))[0]].copy()

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "candidates": self.candidates,
            "priority": self.priority,
            "contradictions": self.contradictions,
            "alive": self.alive,
        }

    def _set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        self.candidates, self.priority = arrays["candidates"], arrays["priority"]
        self.contradictions, self.alive = arrays["contradictions"], arrays["alive"]
        self._library_returns = None


class ANOLEAdapter(PreferenceAdapter):
    """Adapts a model by ANOLE (Ren et al. 2022), with the face of :class:`PreferenceAdapter`.

    It asks about fragments of what the training tasks' policies did, and never rolls out on the new
    task. Candidates are latents; each predicts the answers by the reward decoder.

    - "berlekamp" (ANOLE): of random pairs the one whose worse answer leaves the smallest Berlekamp volume.
    - "greedy" (greedy binary search): 2^K candidates, the pair that splits them most evenly; what disagrees is dropped,
      unless nothing would be left.
    - "random": one random pair, else as ANOLE.

    :param model: A trained ``PEARLSAC`` with its reward decoder and, unless there is a library, its
        replay buffer.
    :param env: See :class:`PreferenceAdapter`.
    :param n_queries: How many answers are asked for at most (K).
    :param strategy: "berlekamp", "greedy" or "random".
    :param n_candidates: Candidates at least; "greedy" takes 2^K.
    :param mistake_rate: The share of answers that may be mistakes: E = floor(rate K).
    :param n_pairs: Random pairs to choose from for each question; they are drawn from twice as many
        fragments.
    :param fragment_length: Steps of a fragment from the replay buffer; None takes 50, or an episode
        that is shorter (the paper gives none).
    :param candidates: Where candidates come from: "prior" or "aggregate".
    :param oracle: See :class:`PreferenceAdapter`.
    :param seed: See :class:`PreferenceAdapter`.
    :param deterministic: Whether the adapted policy is rolled out by its mode.
    :param library: Trajectories to ask about instead of fragments from the replay buffer.
    :raises ValueError: If an argument is out of its range, or the model or family does not do, see
        :meth:`ANOLEOptions.check`.
    """

    options_class: ClassVar[Any] = ANOLEOptions

    def __init__(
        self,
        model: Any,
        env: Env,
        *,
        n_queries: int = 10,
        strategy: str = "berlekamp",
        n_candidates: int = 100,
        mistake_rate: float = 0.2,
        n_pairs: int = 100,
        fragment_length: int | None = None,
        candidates: str = "prior",
        oracle: Oracle | None = None,
        seed: int | None = None,
        deterministic: bool = True,
        library: Sequence[Trajectory] | None = None,
    ) -> None:
        options = ANOLEOptions(
            n_queries,
            strategy,
            n_candidates,
            mistake_rate,
            n_pairs,
            fragment_length,
            candidates,
            deterministic,
        )
        self._start(model, env, options, oracle, seed, library)

    @classmethod
    def make_options(cls, oracle: Any = None, **options: Any) -> ANOLEOptions:
        """See :class:`PreferenceAdapter`. ANOLE takes no notice of the oracle: its budget for
        mistakes is fixed.

        :param oracle: Who will answer.
        :param options: Those of the constructor.
        :return: The options.
        """
        return ANOLEOptions(**options)
