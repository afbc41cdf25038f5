"""Inferring a latent from answers by Bayes' rule, with weighted particles that are moved before
they thin out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_poem.adaptation.decisions import DECISIONS, decide
from sb3_poem.adaptation.inference import (
    Answer,
    LatentInference,
    Shown,
    latent_of,
    preference_log_likelihood,
)
from sb3_poem.adaptation.moves import (
    WIDENING,
    elliptical_slice_moves,
    fit_gaussian,
    kernel_neighbours,
    systematic_resample,
)
from sb3_poem.adaptation.noise import PROBIT_SLOPE, BoltzmannNoise, ExactNoise, NoiseModel
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.queries import most_informative_pair, worst_case_pair
from sb3_poem.adaptation.queries import random_pair as draw_random_pair
from sb3_poem.common.trajectory import Trajectory

LIKELIHOODS = ("decoder", "similarity")

# Policies that a question may compare: the posterior's own, and as many from the prior. The pair
# that splits a narrow posterior best usually lies outside it (to tell 1.0 from 1.1 show 0.8 and
# 1.3), where the two can also be told apart.
QUERY_POLICIES = 64
# Particles that a question's gain is averaged over.
QUERY_PARTICLES = 128
# The prior's policies that tell, at a decision, how widely S spreads.
REFERENCE_POLICIES = 128
# Smallest resolvable difference of S, as a share of the spread of its differences over random
# triples. A Gaussian error of that size turns over 3 % of random preferences, which is what
# well-trained models were seen to get wrong.
SIMILARITY_RESOLUTION = 0.1
# The same for choosing a question. It only has to keep apart policies that do the same; a coarser
# one would not tell a pair that halves a narrow posterior from one that lies beside it.
QUERY_RESOLUTION = 0.02
# Steps over which the decoder's residuals stay correlated: a return's error grows with their
# number, not with that of the steps.
ERROR_CORRELATION = 10.0
# Moves by S: sweeps over all particles, and tries in each.
MOVE_SWEEPS = 2
MOVE_TRIES = 6
# Moves by the decoder: tries of a particle, and the decoder's evaluations (latents times decoded
# steps) that one answer may spend on them: half of what the answer's own two trajectories take with
# 100 particles. On a family of known truth budgets from nothing to many times this one differed by
# no more than seeds do.
DECODER_TRIES = 2
DECODER_MOVE_STEPS = 2_500
# Steps of a trajectory that the decoder sees. From every eighth of HalfCheetah's the returns'
# difference was within 4.0 of that from all (every fourth: 2.5), where the decoder's own error is
# 3.5 and the differences spread over 155. A robot that runs at 10 m/s swings through its speeds
# within eight steps, and a difference came out as 24 that had the other sign. So what thinning does
# is measured for each answer.
DECODED_STEPS = 25
# Particles whose returns are predicted from all steps as well, which tells that.
FULLY_DECODED = 8
# Width of the kernel that replaces a copy of a particle by a neighbour, as a share of the
# particles' own spread.
KERNEL_WIDTH = 0.3


class Thinning(NamedTuple):
    """What decoding all steps adds to a difference x of returns that was decoded from some:
    intercept + slope x, give or take ``error``, a standard deviation.
    """

    intercept: float = 0.0
    slope: float = 0.0
    error: float = 0.0

    @classmethod
    def fit(cls, thin: np.ndarray, full: np.ndarray) -> Thinning:
        """By ridge regression: the more is added to differences that hardly vary, the flatter the
        line.

        :param thin: (n,) differences decoded from some steps.
        :param full: (n,) the same decoded from all.
        :return: The line.
        """
        added = full - thin
        covariance = np.mean((thin - thin.mean()) * added)
        slope = covariance / max(thin.var() + np.square(added).mean(), 1e-12)
        intercept = added.mean() - slope * thin.mean()
        return cls(
            float(intercept),
            float(slope),
            float(np.sqrt(np.square(added - intercept - slope * thin).mean())),
        )


class BayesInference(LatentInference):
    """Posterior weights proportional to the prior times the likelihood of the answers under the
    oracle's own noise model; questions by expected information gain; the latent of highest expected
    fitness.

    *Likelihood from the decoder*: the reward decoder predicts, for every particle, the returns of the two trajectories
    that were shown; the noise model turns the difference into the probability of the answer. The
    predicted difference is trusted only as far as the decoder's own residual allows.

    *Likelihood from S*: S(z, z_left) - S(z, z_right) takes the place of the returns' difference. S has an order but no
    unit: for error-free answers every positive multiple of it makes the same predictions. What
    scale it has comes from training, where it is the log-odds of being right about error-free
    labels. So the model's doubt is one logistic unit of S while training is young. Once training
    separates nearly all pairs, however, the cross-entropy is lowered by scaling S up without end,
    and its odds turn overconfident. So the unit is never taken smaller than a fixed share of the
    spread of S.

    *Thinning*: when half of the particles carry no weight they are resampled and moved by elliptical slice sampling around
    the posterior's own mean and covariance. Moves are bounded. One by the decoder evaluates all
    trajectories that were ever shown, so only as many particles move as a budget allows; the copies
    that are left over are replaced by neighbours, drawn from a kernel that keeps the particles'
    mean and covariance (Liu & West 2001). A pool of fixed draws would be empty after a few answers;
    this one has as many different particles after fifty, in any dimension.

    :param model: A trained model.
    :param n_candidates: Number of particles.
    :param epsilon: Tolerated error of eq. 9, used by query_rule="worst-case" alone.
    :param candidates: "prior" or "aggregate".
    :param query_rule: "information-gain", "worst-case" or "random".
    :param rng: The generator.
    :param likelihood: "decoder" or "similarity"; None takes the decoder where the model has one and
        knows its error.
    :param decision: See :data:`sb3_poem.adaptation.decisions.DECISIONS`.
    :param noise_model: How the oracle errs; None stands for an error-free one.
    :param library: Trajectories to ask about instead of new rollouts (for instance those of the
        training policies on this robot): the decoder tells beforehand what each is worth to every
        particle.
    :raises ValueError: If an option is unknown, or needs what the model does not have.
    """

    def __init__(
        self,
        model: Any,
        n_candidates: int = 400,
        epsilon: float = 0.1,
        candidates: str = "prior",
        query_rule: str = "information-gain",
        rng: np.random.Generator | None = None,
        likelihood: str | None = None,
        decision: str = "expected-fitness",
        noise_model: NoiseModel | None = None,
        library: Sequence[Trajectory] | None = None,
    ) -> None:
        super().__init__(
            model, n_candidates, epsilon, candidates, query_rule, rng or np.random.default_rng()
        )
        self.has_similarity = hasattr(model, "similarities")
        self.likelihood = _check_likelihood(model, likelihood)
        if decision not in DECISIONS:
            raise ValueError(f"`decision` must be one of {DECISIONS}, but is {decision!r}")
        self.decision = decision
        self.noise_model: NoiseModel = ExactNoise() if noise_model is None else noise_model
        self.library = None if library is None else list(library)
        self._check_options()
        self.particles = self.prior.balanced_sample(n_candidates, self.rng)
        self.log_weights = np.zeros(n_candidates)
        # Of a generator of its own: it must not move the particles', and is the same after a
        # restart.
        self._reference = self.prior.balanced_sample(REFERENCE_POLICIES, np.random.default_rng(0))
        self._spread, self._unit = self._similarity_scale()
        # Sums over answers that tie S to the decoder's returns: S dS, S dR, |R| and their number.
        self._calibration = np.zeros(4)
        self._thinning: list[Thinning] = []
        self._library_returns: np.ndarray | None = None

    @property
    def weights(self) -> np.ndarray:
        """(n_candidates,) posterior weights, summing to one."""
        weights = np.exp(self.log_weights - self.log_weights.max())
        return weights / weights.sum()

    @property
    def effective_size(self) -> float:
        """How many equally weighted particles the weighted ones are worth."""
        return float(1.0 / np.square(self.weights).sum())

    def ask_latents(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`LatentInference`."""
        if self.library is not None:
            first, second = self.ask_library()
            return self.library[first].latent.copy(), self.library[second].latent.copy()
        policies = self._query_policies()
        if self.query_rule == "random":
            first, second = draw_random_pair(len(policies), self.rng)
            return policies[first], policies[second]
        particles, weights = self._query_particles()
        similarities = self.model.similarities(particles, policies)
        if self.query_rule == "worst-case":
            first, second = worst_case_pair(similarities, self.epsilon, weights)
        else:
            slope, magnitude, noise = self._return_unit()
            error = QUERY_RESOLUTION * self._spread
            first, second = most_informative_pair(
                slope * similarities, weights, noise, slope * error, magnitude
            )
        return policies[first], policies[second]

    def ask_library(self) -> tuple[int, int]:
        """See :class:`LatentInference`."""
        if self.library is None:
            return super().ask_library()
        if self.query_rule == "random":
            return draw_random_pair(len(self.library), self.rng)
        if self._library_returns is None:
            self._library_returns = self.model.predicted_returns(
                self.particles, self.library, DECODED_STEPS
            )
        returns = self._library_returns
        steps = float(np.mean([len(trajectory) for trajectory in self.library]))
        magnitude = float(2.0 * np.abs(returns).mean())
        return most_informative_pair(
            returns, self.weights, self.noise_model, self._decoder_error(2.0 * steps), magnitude
        )

    def tell(self, preference: Preference, left: Shown, right: Shown) -> None:
        """See :class:`LatentInference`."""
        if self.likelihood == "decoder" and not (
            isinstance(left, Trajectory) and isinstance(right, Trajectory)
        ):
            raise ValueError(
                'likelihood="decoder" needs the two trajectories that were shown, not their latents alone; '
                'pass them, or choose likelihood="similarity"'
            )
        answer = Answer(preference, left, right)
        self.log_weights = self.log_weights + self._answer_log_likelihoods(
            self.particles, [answer], new=True
        )
        self.answers.append(answer)
        if self.effective_size < self.n_candidates / 2:
            self._rejuvenate()

    def estimate(self) -> np.ndarray:
        """See :class:`LatentInference`."""
        training = getattr(self.model, "task_latents", None)
        model, has_holes = self.model if self.has_similarity else None, self.prior.has_holes
        return decide(
            self.decision, model, self.particles, self.weights, training, self._reference, has_holes
        )

    def _check_options(self) -> None:
        if (
            self.likelihood == "similarity"
            and isinstance(self.noise_model, BoltzmannNoise)
            and self.noise_model.beta
        ):
            raise ValueError(
                f"a Boltzmann oracle of fixed beta ({self.noise_model.beta}) needs returns, which S does not give: "
                'choose likelihood="decoder"'
            )
        if self.library is not None:
            if len(self.library) < 2:
                raise ValueError(
                    f"`library` must hold at least 2 trajectories, but holds {len(self.library)}"
                )
            if not hasattr(self.model, "predicted_returns"):
                raise ValueError(
                    "`library` needs a model with a reward decoder (predicted_returns)"
                )
            if self.query_rule == "worst-case":
                raise ValueError(
                    'query_rule="worst-case" compares candidates by S; with a library use "information-gain"'
                )
        elif not self.has_similarity and self.query_rule != "random":
            raise ValueError(
                f'query_rule="{self.query_rule}" needs a model with a similarity S or a `library` of trajectories, '
                f'and {type(self.model).__name__} has no similarity; choose query_rule="random" or pass a library'
            )

    def _similarity_scale(self) -> tuple[float, float]:
        """The spread of S's differences, and the unit in which a difference counts as one logistic
        unit of doubt.
        """
        if not self.has_similarity:
            return 1.0, 1.0
        similarities = self.model.similarities(self.particles, self.particles)
        # Twice the variance within a row is the mean squared difference of two of its entries.
        spread = float(np.sqrt(2.0 * similarities.var(axis=1).mean()))
        return max(spread, 1e-12), max(1.0, SIMILARITY_RESOLUTION * spread / PROBIT_SLOPE)

    def _return_unit(self) -> tuple[float, float, NoiseModel]:
        """Slope from S to returns, the returns' typical magnitude, and the noise model that fits
        this unit.
        """
        cross, square, magnitude, count = self._calibration
        if count and cross > 0:
            return float(cross / square), float(magnitude / count), self.noise_model
        # No trajectory has tied S to returns yet (or none can). Noise models that only ask for the
        # sign need no unit, and the paper's temperature is relative: it is told that returns are as
        # large as their spread. A fixed one has to wait.
        fixed = isinstance(self.noise_model, BoltzmannNoise) and self.noise_model.beta is not None
        return 1.0, 2.0 * self._spread, ExactNoise() if fixed else self.noise_model

    def _decoder_error(self, steps: np.ndarray | float) -> Any:
        return self.model.predicted_rewards_error * np.sqrt(steps * ERROR_CORRELATION)

    def _answer_log_likelihoods(
        self, latents: np.ndarray, answers: Sequence[Answer], new: bool = False
    ) -> np.ndarray:
        """(m,) log P(answers | latent); of a new one, on the particles, what else it tells is
        noted.
        """
        shown = [item for answer in answers for item in (answer.left, answer.right)]
        error: np.ndarray | float
        magnitude: np.ndarray | float
        if self.likelihood == "decoder":
            values = self.model.predicted_returns(latents, shown, DECODED_STEPS)  # (m, 2 k)
            left, right = values[:, 0::2], values[:, 1::2]
            steps = np.array([len(item) for item in shown], dtype=np.float64)
            if new:
                self._thinning.append(self._measure_thinning(shown, values))
            intercepts, slopes, errors = self._thinning_of(len(answers)).T
            error = np.hypot(self._decoder_error(steps[0::2] + steps[1::2]), errors)
            magnitude = np.abs(left) + np.abs(right)
            difference = left - right
            difference = difference + intercepts + slopes * difference
            if new and self.has_similarity:
                self._calibrate(latents, shown, values)
        else:
            values = self.model.similarities(latents, np.stack([latent_of(item) for item in shown]))
            difference = values[:, 0::2] - values[:, 1::2]
            error, magnitude = self._unit * PROBIT_SLOPE, 2.0 * self._spread
        probability = self.noise_model.probability_left(difference, error, magnitude)
        return preference_log_likelihood(
            np.log(probability), np.log1p(-probability), [a.preference for a in answers]
        )

    def _measure_thinning(self, shown: Sequence[Shown], thin: np.ndarray) -> Thinning:
        if max(map(len, shown)) <= DECODED_STEPS:
            return Thinning()
        quantiles = (np.arange(FULLY_DECODED) + 0.5) / FULLY_DECODED
        some = np.searchsorted(np.cumsum(self.weights), quantiles).clip(max=self.n_candidates - 1)
        full = self.model.predicted_returns(self.particles[some], shown)
        return Thinning.fit(thin[some, 0] - thin[some, 1], full[:, 0] - full[:, 1])

    def _thinning_of(self, n: int) -> np.ndarray:
        """(n, 3), of the last n answers; none where it was not measured."""
        known = self._thinning[-n:]
        return np.array([Thinning()] * (n - len(known)) + known)

    def _calibrate(self, latents: np.ndarray, shown: Sequence[Shown], returns: np.ndarray) -> None:
        similarities = self.model.similarities(
            latents, np.stack([latent_of(item) for item in shown])
        )
        s = similarities[:, 0] - similarities[:, 1]
        magnitude = np.abs(returns).sum(axis=1).mean()
        self._calibration += [s @ (returns[:, 0] - returns[:, 1]), s @ s, magnitude, 1.0]

    def _query_policies(self) -> np.ndarray:
        """(QUERY_POLICIES, d): draws of the posterior and of the prior."""
        posterior = self.particles[systematic_resample(self.weights, QUERY_POLICIES // 2, self.rng)]
        return np.concatenate([posterior, self.prior.sample(QUERY_POLICIES // 2, self.rng)])

    def _query_particles(self) -> tuple[np.ndarray, np.ndarray]:
        if self.n_candidates <= QUERY_PARTICLES:
            return self.particles, self.weights
        chosen = systematic_resample(self.weights, QUERY_PARTICLES, self.rng)
        return self.particles[chosen], np.full(QUERY_PARTICLES, 1.0 / QUERY_PARTICLES)

    def _rejuvenate(self) -> None:
        """Resample, and replace what is now double, at bounded cost."""
        mean, factor = fit_gaussian(self.particles, self.weights)
        chosen = systematic_resample(self.weights, self.n_candidates, self.rng)
        copies = np.flatnonzero(np.concatenate([[False], chosen[1:] == chosen[:-1]]))
        self.particles = self.particles[chosen]
        self.log_weights = np.zeros(self.n_candidates)
        self._library_returns = None
        if self.likelihood == "similarity":
            self._move(np.arange(self.n_candidates), MOVE_SWEEPS, MOVE_TRIES, mean, factor)
            return
        # One evaluation more than tries: where a particle stands now has to be weighed, too.
        steps = sum(
            min(len(item), DECODED_STEPS)
            for answer in self.answers
            for item in (answer.left, answer.right)
        )
        affordable = DECODER_MOVE_STEPS // (steps * (DECODER_TRIES + 1))
        order = self.rng.permutation(len(copies))
        self._move(copies[order[:affordable]], 1, DECODER_TRIES, mean, factor)
        left_over = copies[order[affordable:]]
        log_prior = self.prior.log_density if self.prior.has_holes else None
        self.particles[left_over] = kernel_neighbours(
            self.particles[left_over], mean, factor, KERNEL_WIDTH, log_prior, self.rng
        )

    def _move(
        self, moved: np.ndarray, sweeps: int, tries: int, mean: np.ndarray, factor: np.ndarray
    ) -> None:
        if not len(moved):
            return
        particles = self.particles[moved]
        log_likelihoods = self._answer_log_likelihoods(particles, self.answers)
        for _ in range(sweeps):
            particles, log_likelihoods = elliptical_slice_moves(
                particles,
                log_likelihoods,
                lambda latents: self._answer_log_likelihoods(latents, self.answers),
                self.prior.log_density,
                mean,
                WIDENING * factor,
                tries,
                self.rng,
            )
        self.particles[moved] = particles

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "particles": self.particles,
            "log_weights": self.log_weights,
            "scale": np.array([self._spread, self._unit]),
            "calibration": self._calibration,
            "thinning": np.array(self._thinning).reshape(-1, 3),
        }

    def _set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        self.particles = arrays["particles"]
        self.log_weights = arrays["log_weights"]
        self._spread, self._unit = (float(value) for value in arrays["scale"])
        self._calibration = arrays["calibration"].copy()
        self._thinning = [
            Thinning(*row) for row in arrays.get("thinning", np.zeros((0, 3))).tolist()
        ]
        self._library_returns = None


def _check_likelihood(model: Any, likelihood: str | None) -> str:
    error = float(getattr(model, "predicted_rewards_error", np.nan))
    decoder_is_known = hasattr(model, "predicted_returns") and np.isfinite(error)
    if likelihood is None:
        likelihood = "decoder" if decoder_is_known else "similarity"
    if likelihood not in LIKELIHOODS:
        raise ValueError(f"`likelihood` must be one of {LIKELIHOODS}, but is {likelihood!r}")
    name = type(model).__name__
    if likelihood == "similarity" and not hasattr(model, "similarities"):
        raise ValueError(
            f'likelihood="similarity" needs a model with `similarities` (POEMSAC); {name} has none'
        )
    if likelihood == "decoder" and not decoder_is_known:
        raise ValueError(
            f'likelihood="decoder" needs a model with `predicted_returns` and a finite `predicted_rewards_error`, which is '
            f"{error} for this {name}: it is known once a model has been trained on tasks that share their dynamics"
        )
    return likelihood
