"""Inferring a latent from answers, without an environment: the paper's rule, and what both rules
share.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.priors import SOURCES, make_prior
from sb3_poem.adaptation.queries import (
    QUERY_RULES,
    information_gains,
    pair_at,
    pair_differences,
    tolerance,
    worst_case_pair,
)
from sb3_poem.adaptation.queries import random_pair as draw_random_pair
from sb3_poem.adaptation.state import generator_from_state, generator_state
from sb3_poem.common.checks import check_whole
from sb3_poem.common.trajectory import Trajectory, decode_array, encode_array

# What a question compares: a trajectory, or where no trajectory is at hand the latent of the policy
# that would make it.
Shown = Trajectory | np.ndarray


SIGNS = {Preference.LEFT: 1.0, Preference.RIGHT: -1.0, Preference.EQUAL: 0.0}


@dataclass(frozen=True, eq=False)
class Answer:
    """One answered question.

    :param preference: The answer.
    :param left: What stood on the left.
    :param right: What stood on the right.
    """

    preference: Preference
    left: Shown
    right: Shown


def latent_of(shown: Shown) -> np.ndarray:
    """The latent behind what was shown.

    :param shown: A trajectory or a latent.
    :return: (d,).
    """
    return shown.latent if isinstance(shown, Trajectory) else np.asarray(shown, dtype=np.float64)


def preference_log_likelihood(
    log_left: np.ndarray, log_right: np.ndarray, answers: list[Preference]
) -> np.ndarray:
    """Log-likelihood of answers from the log-probabilities of LEFT and RIGHT.

    EQUAL has the geometric mean of both: it is largest where neither is more probable and, other
    than half of each, it tells a latent that calls the two alike from one that is sure of either.

    :param log_left: (m, k) log P(LEFT) of k questions under m latents.
    :param log_right: (m, k) log P(RIGHT).
    :param answers: k answers.
    :return: (m,) sums over the questions.
    """
    left_share = 0.5 + 0.5 * np.array([SIGNS[answer] for answer in answers])
    return log_left @ left_share + log_right @ (1.0 - left_share)


class LatentInference(ABC):
    """Ask and tell on latents alone: ``ask_latents()`` names two policies, ``tell()`` takes the
    answer, ``estimate()`` gives the latent.

    :param model: A trained model: ``latent_dim``, ``sample_latents``, ``similarity`` and, depending
        on the options, ``predicted_returns``, ``predicted_rewards_error`` and ``task_latents``.
    :param n_candidates: How many candidate latents are kept (N_z).
    :param epsilon: Tolerated error of eq. 9, in [0, 0.5).
    :param candidates: Where they come from: "prior" (N(0, I)) or "aggregate" (the training tasks'
        posteriors).
    :param query_rule: "worst-case" (eq. 10), "information-gain" or "random".
    :param rng: The only source of randomness.
    :raises ValueError: If an argument is out of its range.
    """

    #: Trajectories to ask about; None where questions are new rollouts.
    library: list[Trajectory] | None = None

    def __init__(
        self,
        model: Any,
        n_candidates: int,
        epsilon: float,
        candidates: str,
        query_rule: str,
        rng: np.random.Generator,
    ) -> None:
        check_inference_options(n_candidates, epsilon, candidates, query_rule)
        self.model = model
        self.n_candidates = n_candidates
        self.epsilon = epsilon
        self.query_rule = query_rule
        self.rng = rng
        self.prior = make_prior(model, candidates, rng)
        self.answers: list[Answer] = []

    @abstractmethod
    def ask_latents(self) -> tuple[np.ndarray, np.ndarray]:
        """The two policies to compare next.

        :return: Two latents (d,).
        """

    def ask_library(self) -> tuple[int, int]:
        """The two trajectories of the library to compare next.

        :return: Two different indices.
        :raises RuntimeError: If there is no library.
        """
        raise RuntimeError("there is no library to ask about; pass `library`")

    def same_latents(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The policies of a pending question that was read from a file.

        :param left: The latent in the file.
        :param right: The other.
        :return: The same ones; others where a latent means something to one model object alone.
        """
        return left, right

    @abstractmethod
    def tell(self, preference: Preference, left: Shown, right: Shown) -> None:
        """Take an answer.

        :param preference: The answer.
        :param left: What stood on the left: its trajectory, or its latent where the likelihood
            needs no trajectory.
        :param right: The same for the right.
        """

    @abstractmethod
    def estimate(self) -> np.ndarray:
        """The latent to act on, given the answers so far.

        :return: (d,).
        """

    @abstractmethod
    def _arrays(self) -> dict[str, np.ndarray]:
        """What changes while answers come in, beside the answers and the generator."""

    @abstractmethod
    def _set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Put back what :meth:`_arrays` gave."""

    def snapshot(self) -> Snapshot:
        """The posterior and the random state, as they are now.

        :return: A copy that :meth:`restore` takes.
        """
        return Snapshot(
            generator_state(self.rng),
            {name: array.copy() for name, array in self._arrays().items()},
        )

    def restore(self, snapshot: Snapshot, answers: list[Answer]) -> None:
        """Go back, or on, to a snapshot.

        :param snapshot: What :meth:`snapshot` gave.
        :param answers: The answers up to then.
        :raises ValueError: If the snapshot belongs to another kind of inference.
        """
        try:
            self._set_arrays({name: array.copy() for name, array in snapshot.arrays.items()})
        except KeyError as error:
            raise ValueError(
                f"not a snapshot of {type(self).__name__}: {error} is missing"
            ) from error
        self.rng = generator_from_state(snapshot.random_state)
        self.answers = list(answers)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """An inference between two answers.

    :param random_state: Of its generator.
    :param arrays: Everything else that changes, by name.
    """

    random_state: dict[str, Any]
    arrays: dict[str, np.ndarray]

    def to_dict(self) -> dict[str, Any]:
        """Write it as JSON-ready data.

        :return: A dictionary that :meth:`from_dict` reads.
        """
        return {
            "random_state": self.random_state,
            "arrays": {name: encode_array(array) for name, array in self.arrays.items()},
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Snapshot:
        """Read what :meth:`to_dict` wrote.

        :param data: The dictionary.
        :return: The snapshot.
        :raises ValueError: If it is incomplete or broken.
        """
        try:
            arrays = {str(name): decode_array(array) for name, array in data["arrays"].items()}
            return cls(dict(data["random_state"]), arrays)
        except (KeyError, AttributeError, TypeError) as error:
            raise ValueError(f"not a stored posterior: {error!r}") from error


class PaperInference(LatentInference):
    """Algorithm 2 of Xu & Zhu (2025): candidates that satisfy every answer within the tolerance of
    eq. 9, the pair of eq. 10, and the candidate of highest Bradley-Terry likelihood (line 17).

    The paper's loop draws until N_z candidates are found, which need not happen: contradicting
    answers leave no such latent, and the accepted share halves with every answer. Here the draws
    are bounded; what is missing is filled up by the draws that satisfy most answers, and among
    those by the highest likelihood. EQUAL excludes nobody.

    :param model: A trained model.
    :param n_candidates: N_z.
    :param epsilon: Tolerated error of eq. 9.
    :param candidates: "prior" (the paper's) or "aggregate".
    :param query_rule: "worst-case" (the paper's), "information-gain" or "random".
    :param rng: The generator.
    :param max_draws: Bound on the draws per question.
    """

    def __init__(
        self,
        model: Any,
        n_candidates: int = 100,
        epsilon: float = 0.1,
        candidates: str = "prior",
        query_rule: str = "worst-case",
        rng: np.random.Generator | None = None,
        max_draws: int = 16384,
    ) -> None:
        super().__init__(
            model, n_candidates, epsilon, candidates, query_rule, rng or np.random.default_rng()
        )
        self.max_draws = max(max_draws, n_candidates)
        self.candidates = self.prior.sample(n_candidates, self.rng)
        self._fresh = True

    def ask_latents(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`LatentInference`. Draws the candidate set anew, as lines 3 to 9 do."""
        if not self._fresh:
            self.candidates = self._draw_candidates()
            self._fresh = True
        if self.query_rule == "random":
            first, second = draw_random_pair(self.n_candidates, self.rng)
        else:
            similarities = self.model.similarities(self.candidates, self.candidates)
            if self.query_rule == "worst-case":
                first, second = worst_case_pair(similarities, self.epsilon)
            else:
                first, second = self._most_informative(similarities)
        return self.candidates[first].copy(), self.candidates[second].copy()

    def tell(self, preference: Preference, left: Shown, right: Shown) -> None:
        """See :class:`LatentInference`."""
        self.answers.append(Answer(preference, left, right))
        self._fresh = False

    def estimate(self) -> np.ndarray:
        """Line 17: of the candidates that were drawn for the last question, the one under which the
        answers, the last one included, are most likely. Before any answer all are equally likely;
        then the one nearest to their centre.

        :return: (d,).
        """
        if not self.answers:
            centre = self.candidates.mean(axis=0)
            return self.candidates[
                np.argmin(np.linalg.norm(self.candidates - centre, axis=1))
            ].copy()
        differences = self._differences(self.candidates)
        return self.candidates[np.argmax(self._log_likelihoods(differences))].copy()

    def satisfied(self, latents: np.ndarray) -> np.ndarray:
        """How many answers each latent satisfies within the tolerance (eq. 9).

        :param latents: (m, d).
        :return: (m,) integers, at most the number of answers.
        """
        if not self.answers:
            return np.zeros(len(latents), dtype=np.int64)
        return self._satisfied(self._differences(latents))

    def _most_informative(self, similarities: np.ndarray) -> tuple[int, int]:
        probabilities = np.exp(log_sigmoid(pair_differences(similarities)))  # eq. 7
        gains = information_gains(
            probabilities, np.full(self.n_candidates, 1.0 / self.n_candidates)
        )
        return pair_at(int(np.argmax(gains)), self.n_candidates)

    def _differences(self, latents: np.ndarray) -> np.ndarray:
        """(m, k) S(z, z_left) - S(z, z_right) of every answered question."""
        shown = np.stack(
            [latent_of(item) for answer in self.answers for item in (answer.left, answer.right)]
        )
        similarities = self.model.similarities(latents, shown)
        return similarities[:, 0::2] - similarities[:, 1::2]

    def _satisfied(self, differences: np.ndarray) -> np.ndarray:
        slack = tolerance(self.epsilon)
        signs = np.array([SIGNS[answer.preference] for answer in self.answers])
        return np.count_nonzero(differences * signs >= -slack, axis=1)

    def _log_likelihoods(self, differences: np.ndarray) -> np.ndarray:
        answers = [answer.preference for answer in self.answers]
        return preference_log_likelihood(
            log_sigmoid(differences), log_sigmoid(-differences), answers
        )

    def _draw_candidates(self) -> np.ndarray:
        """Lines 3 to 9, bounded. The last question's candidates take part in the fall-back alone:
        line 3 starts afresh.
        """
        rest = [(self.candidates, self._differences(self.candidates))]
        found: list[np.ndarray] = []
        n_found, drawn, batch = 0, 0, max(1024, self.n_candidates)
        while n_found < self.n_candidates and drawn < self.max_draws:
            latents = self.prior.sample(min(batch, self.max_draws - drawn), self.rng)
            drawn += len(latents)
            batch *= 2
            differences = self._differences(latents)
            accepted = self._satisfied(differences) == len(self.answers)
            found.append(latents[accepted])
            rest.append((latents[~accepted], differences[~accepted]))
            n_found += int(np.count_nonzero(accepted))
        if n_found < self.n_candidates:
            latents, differences = (np.concatenate(parts) for parts in zip(*rest, strict=True))
            found.append(latents[self._best(differences, self.n_candidates - n_found)])
        return np.concatenate(found)[: self.n_candidates]

    def _best(self, differences: np.ndarray, n: int) -> np.ndarray:
        """Rows of the n latents that satisfy most answers, and among equals are the likeliest; best
        first.
        """
        satisfied = self._satisfied(differences)
        contenders = np.flatnonzero(
            satisfied >= np.partition(satisfied, len(satisfied) - n)[len(satisfied) - n]
        )
        likelihoods = self._log_likelihoods(differences[contenders])
        return contenders[np.lexsort((-likelihoods, -satisfied[contenders]))[:n]]

    def _arrays(self) -> dict[str, np.ndarray]:
        return {"candidates": self.candidates, "fresh": np.array(self._fresh)}

    def _set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        self.candidates = arrays["candidates"]
        self._fresh = bool(arrays["fresh"])


def check_inference_options(
    n_candidates: int, epsilon: float, candidates: str, query_rule: str
) -> None:
    """Check what both rules share.

    :param n_candidates: At least 2.
    :param epsilon: In [0, 0.5).
    :param candidates: One of ``SOURCES``.
    :param query_rule: One of ``QUERY_RULES``.
    :raises ValueError: If one is out of its range.
    """
    check_whole("n_candidates", n_candidates, 2)  # a question compares two
    if not 0.0 <= epsilon < 0.5:
        raise ValueError(f"`epsilon` must lie in [0, 0.5), but is {epsilon}")
    if candidates not in SOURCES:
        raise ValueError(f"`candidates` must be one of {SOURCES}, but is {candidates!r}")
    if query_rule not in QUERY_RULES:
        raise ValueError(f"`query_rule` must be one of {QUERY_RULES}, but is {query_rule!r}")


def log_sigmoid(x: np.ndarray) -> np.ndarray:
    """log(1 / (1 + exp(-x))) without overflow.

    :param x: Any shape.
    :return: The same shape.
    """
    return np.minimum(x, 0.0) - np.log1p(np.exp(-np.abs(x)))
