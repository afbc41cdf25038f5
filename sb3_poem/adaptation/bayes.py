"""Inferring a latent from answers by Bayes' rule, with weighted particles that are moved before
they thin out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import log_softmax, logsumexp

from sb3_poem.adaptation import queries
from sb3_poem.adaptation.decisions import DECISIONS, decide
from sb3_poem.adaptation.meta_model import HasRewardDecoder, HasSimilarity, MetaModel
from sb3_poem.adaptation.noise import (
    INFER,
    PROBIT_SLOPE,
    BoltzmannNoise,
    ExactNoise,
    NoiseModel,
    People,
    Values,
    noise_model_from_dict,
)
from sb3_poem.adaptation.oracles import HasNoiseModel, Oracle
from sb3_poem.adaptation.particles import (
    WIDENING,
    Gaussian,
    elliptical_slice_moves,
    fit_gaussian,
    kernel_neighbours,
    systematic_resample,
)
from sb3_poem.adaptation.preference import (
    ANSWERS,
    BEST_OF_FOUR,
    PLACES,
    Preference,
    preference_log_likelihood,
)
from sb3_poem.adaptation.priors import SOURCES, make_prior
from sb3_poem.adaptation.rule import Answer, Inference, Rule, Setting, Shown, latents_of, seen
from sb3_poem.common.checks import check_choice, check_number, check_whole
from sb3_poem.common.trajectory import Trajectory

LIKELIHOODS = ("decoder", "similarity")

# Nats from the aggregate posterior to N(0, I) up to which draws of the latter do as well.
PRIOR_COVERS = 0.3

# Policies that a question may compare: the posterior's own, and as many from the prior. The pair
# that splits a narrow posterior best usually lies outside it (to tell 1.0 from 1.1 show 0.8 and
# 1.3). Four of which each is best for some of a narrow posterior are rarer.
QUERY_POLICIES = {"pair": 64, "graded": 64, BEST_OF_FOUR: 128}
# Differences at which the answers' probabilities are tabulated for choosing a question.
TABLE_POINTS = 1025
# Particles that a question's gain is averaged over.
QUERY_PARTICLES = 128
# The prior's policies that tell, at a decision, how widely S spreads.
REFERENCE_POLICIES = 128
# Smallest resolvable difference of S, as a share of the spread of its differences over random
# triples. A Gaussian error of that size turns over 3 % of random preferences.
SIMILARITY_RESOLUTION = 0.1
# The same for choosing a question: a coarser one would not tell a pair that halves a narrow
# posterior from one that lies beside it.
QUERY_RESOLUTION = 0.02
# Steps over which the decoder's residuals stay correlated: a return's error grows with their
# number, not with that of the steps.
ERROR_CORRELATION = 10.0
# Moves by S: sweeps over all particles, and tries in each.
MOVE_SWEEPS = 2
MOVE_TRIES = 6
# Moves by the decoder: tries of a particle, and the decoder's evaluations (latents times decoded
# steps) that one answer may spend on them.
DECODER_TRIES = 2
DECODER_MOVE_STEPS = 2_500
# Steps of a trajectory that the decoder sees; what is lost by leaving out the others is measured
# for each answer, by so many particles whose returns are predicted from all steps.
DECODED_STEPS = 25
FULLY_DECODED = 8
# The prior's latents by which the spread of returns is told where S does not tell it.
SPREAD_LATENTS = 32
# An answer whose side is less probable than this, given all others, contradicts them, unless it is
# believed all the same.
CONTRADICTED, BELIEVED = 0.2, 0.5


@dataclass(frozen=True, repr=False)
class Bayes(Rule):
    """Posterior weights proportional to the prior times the likelihood of the answers under the
    oracle's own noise model, by the returns that the reward decoder predicts of what was shown, or
    by S; questions by expected information gain; the latent of highest expected fitness.

    Particles are moved when half of them carry no weight. With ``noise_model="infer"``, and where
    answers are more than left or right, a grid of people stands in the place of each particle.
    Where a person answers, what a question tells is multiplied by how much of the difference can be
    seen (:meth:`poem_envs.TaskFamily.visible_difference`), with ``"information-gain"``.

    >>> from sb3_poem import PreferenceAdapter
    >>> rule = Bayes(n_particles=100)
    >>> adapter = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", rule=rule, seed=0)
    >>> adapter.inference.particles.shape
    (100, 5)

    :param n_particles: How many, at least 2.
    :param query_rule: "information-gain", "worst-case" (eq. 10) or "random".
    :param candidates: Where particles come from: "prior" (N(0, I)) or "aggregate" (the training
        tasks' posteriors and what lies between neighbours); None takes the prior, unless the
        aggregate is far from it.
    :param likelihood: "decoder" or "similarity"; None takes the decoder where the model knows its
        error, which takes tasks that share their dynamics.
    :param decision: "expected-fitness", "posterior-mean" or "most-likely", see
        :func:`sb3_poem.adaptation.decisions.decide`.
    :param noise_model: How the oracle errs, or "infer", by the prior over people that
        docs/algorithms/bayes.md tabulates; None takes the oracle's own, else no error.
    :param epsilon: Tolerated error of eq. 9, in [0, 0.5), for ``query_rule="worst-case"``.
    :param question: "pair" (left, right or equal), "graded" (much better, too) or "best-of-four".
    :raises ValueError: If an option is out of its range.
    """

    n_particles: int = 400
    query_rule: str = "information-gain"
    candidates: str | None = None
    likelihood: str | None = None
    decision: str = "expected-fitness"
    noise_model: NoiseModel | str | None = None
    epsilon: float = 0.1
    question: str = "pair"

    def __post_init__(self) -> None:
        check_whole("n_particles", self.n_particles, 2)  # a question compares two
        check_choice("query_rule", self.query_rule, queries.QUERY_RULES)
        check_choice("candidates", self.candidates, (*SOURCES, None))
        check_choice("likelihood", self.likelihood, (*LIKELIHOODS, None))
        check_choice("decision", self.decision, DECISIONS)
        check_number("epsilon", self.epsilon, 0.0, below=0.5)
        check_choice("question", self.question, tuple(ANSWERS))
        if self.question == BEST_OF_FOUR and self.query_rule == "worst-case":
            raise ValueError(
                'query_rule="worst-case" (eq. 10) chooses pairs: with question="best-of-four" use '
                '"information-gain" or "random"'
            )
        if isinstance(self.noise_model, dict):  # of a file
            object.__setattr__(self, "noise_model", noise_model_from_dict(self.noise_model))
        if self.noise_model not in (None, INFER) and not isinstance(self.noise_model, NoiseModel):
            raise ValueError(
                '`noise_model` must be None, "infer" or a NoiseModel as MistakeNoise(0.2), '
                f"but is {self.noise_model!r}"
            )

    def answered_by(self, oracle: Oracle | None) -> Self:
        """See :class:`Rule`: with the oracle's own noise model, unless one was chosen."""
        super().answered_by(oracle)
        own = oracle.noise_model if isinstance(oracle, HasNoiseModel) else None
        return replace(self, noise_model=self.noise_model or own or ExactNoise())

    def check(self, model: MetaModel, setting: Setting) -> None:
        """See :class:`Rule`: the likelihood and the questions need what not all models have."""
        super().check(model, setting)
        name, noise = type(model).__name__, self.noise_model
        compares, likelihood = isinstance(model, HasSimilarity), self.likelihood_with(model)
        if likelihood == "decoder" and not _knows_its_decoder(model):
            error = getattr(model, "predicted_rewards_error", np.nan)
            raise ValueError(
                'likelihood="decoder" needs a model with `predicted_returns` and a finite '
                f"`predicted_rewards_error`, which is {error} for this {name}: it is known once a "
                "model has been trained on tasks that share their dynamics"
            )
        if likelihood == "similarity" and not compares:
            without = "which takes training on tasks that share their dynamics"
            known = (
                f", nor a decoder whose error is known, {without}" if not self.likelihood else ""
            )
            raise ValueError(
                f'likelihood="similarity" needs a model with `similarities` (POEMSAC); this {name} '
                f"has none{known}"
            )
        if likelihood == "similarity" and isinstance(noise, BoltzmannNoise) and noise.beta:
            raise ValueError(
                f"a Boltzmann oracle of fixed beta ({noise.beta}) needs returns, which S does not "
                'give: choose likelihood="decoder"'
            )
        if setting.library is None:
            if not compares and self.query_rule != "random":
                raise ValueError(
                    f'query_rule="{self.query_rule}" needs a model with a similarity S or a '
                    f"`library` of trajectories, and {name} has no similarity; choose "
                    'query_rule="random" or pass a library'
                )
        elif not isinstance(model, HasRewardDecoder):
            raise ValueError("`library` needs a model with a reward decoder (predicted_returns)")
        elif self.query_rule == "worst-case":
            raise ValueError(
                'query_rule="worst-case" compares candidates by S; with a library use '
                '"information-gain"'
            )
        elif self.query_rule != "random" and not _knows_its_decoder(model):
            raise ValueError(
                f'query_rule="{self.query_rule}" with a `library` needs a finite '
                f"`predicted_rewards_error`, which is {model.predicted_rewards_error} for this "
                f'{name}; choose query_rule="random", or leave the library out'
            )

    def likelihood_with(self, model: MetaModel) -> str:
        """Which one is used with a model."""
        return self.likelihood or ("decoder" if _knows_its_decoder(model) else "similarity")

    def start(self, model: MetaModel, rng: np.random.Generator, setting: Setting) -> Inference:
        return BayesInference(self, model, rng, setting)


class BayesInference(Inference):
    """See :class:`Bayes`."""

    state: tuple[str, ...] = ("particles", "log_weights", "scale", "calibration", "thinning")

    def __init__(
        self, rule: Bayes, model: MetaModel, rng: np.random.Generator, setting: Setting
    ) -> None:
        super().__init__(rng)
        self.rule, self.model, self.visibility = rule, model, setting.visibility
        self.n_shown = len(PLACES[rule.question])
        self.similarity = model if isinstance(model, HasSimilarity) else None
        self.likelihood = rule.likelihood_with(model)
        noise = rule.noise_model or ExactNoise()
        #: How the oracle errs, if that is told
        self.noise_model = noise if isinstance(noise, NoiseModel) else None
        told = self.noise_model is not None and rule.question == "pair"
        self.people = None if told else People(rule.question, self.noise_model)
        self.library = None if setting.library is None else list(setting.library)
        far = model.aggregate_to_prior_kl > PRIOR_COVERS
        self.prior = make_prior(model, rule.candidates or ("aggregate" if far else "prior"), rng)
        self.particles = self.prior.balanced_sample(rule.n_particles, rng)
        self.log_weights = np.zeros(rule.n_particles)
        if self.people is not None:
            # (n, G) the posterior of who answers if this particle is the task's latent
            shares = np.tile(self.people.log_prior, (rule.n_particles, 1))
            self.people_log_shares = shares.astype(np.float16)
            self.state = (*self.state, "people_log_shares")
        # Of a generator of its own, which leaves the particles' alone.
        self._reference = self.prior.balanced_sample(REFERENCE_POLICIES, np.random.default_rng(0))
        self.scale = self._similarity_scale()
        # Sums over answers that tie S to the decoder's returns: S dS, S dR, |R| and their number.
        self.calibration = np.zeros(4)
        self.thinning = np.zeros((0, 3))  # see fit_thinning, of each answer
        self._library_spread: float | None = None

    @property
    def weights(self) -> np.ndarray:
        weights = np.exp(self.log_weights - self.log_weights.max())
        return weights / weights.sum()

    def posterior(self) -> tuple[np.ndarray, np.ndarray]:
        return self.particles, self.weights

    @property
    def effective_size(self) -> float:
        """How many equally weighted particles the weighted ones are worth."""
        return float(1.0 / np.square(self.weights).sum())

    @property
    def people_shares(self) -> np.ndarray:
        """(G,) the posterior of which of :attr:`people` answers."""
        return self.weights @ np.exp(self.people_log_shares.astype(np.float64))

    def ask(self) -> tuple[Shown, ...]:
        shown = self._query_policies() if self.library is None else self.library
        if self.rule.query_rule == "random":
            chosen = queries.random_set(len(shown), self.n_shown, self.rng)
        elif self.library is not None:
            chosen = self._ask_about(self.library)
        else:
            chosen = self._compare(np.asarray(shown))
        return tuple(shown[i] for i in chosen)

    def _compare(self, policies: np.ndarray) -> tuple[int, ...]:
        """Which of these (n, d) to roll out, by S."""
        particles, weights = self.particles, self.weights
        if len(particles) > QUERY_PARTICLES:
            particles = particles[systematic_resample(weights, QUERY_PARTICLES, self.rng)]
            weights = np.full(QUERY_PARTICLES, 1.0 / QUERY_PARTICLES)
        similarities = self._similarities(particles, policies)
        if self.rule.query_rule == "worst-case":
            return queries.worst_case_pair(similarities, self.rule.epsilon, weights)
        slope, magnitude, noise = self._return_unit()
        unit = slope * (QUERY_RESOLUTION * self._spread), magnitude, slope * self._spread
        return self._most_informative(list(policies), slope * similarities, weights, noise, unit)

    def _ask_about(self, library: list[Trajectory]) -> tuple[int, ...]:
        if self._library_returns is None:
            decode = self._decoder.predicted_returns
            self._library_returns = decode(self.particles, library, DECODED_STEPS)
        returns = self._library_returns
        error = self._decoder_error(2.0 * float(np.mean([len(item) for item in library])))
        unit = error, float(2.0 * np.abs(returns).mean()), self._return_spread(library)
        return self._most_informative(library, returns, self.weights, self.noise_model, unit)

    def _most_informative(
        self,
        shown: Sequence[Shown],
        values: np.ndarray,
        weights: np.ndarray,
        noise: NoiseModel | None,
        unit: tuple[Values, float, float],
    ) -> tuple[int, ...]:
        """Of what is shown, by its predicted fitness (m, n) under m latents of these weights.

        :param unit: A predicted difference's error, the typical sum of both returns' absolute
            values, and the family's spread of returns.
        """
        see = self.visibility
        visibility: queries.Visibility | None = (
            None if see is None else lambda first, second: see(shown[first], shown[second])
        )
        if self.people is None:
            assert noise is not None
            differences = queries.pair_differences(values)
            probabilities = noise.probability_left(differences, *unit[:2])
            gains = queries.information_gains(probabilities, weights)
            return queries.best_pair(gains, values.shape[1], visibility)
        people = self.people
        if noise is not self.noise_model:
            people = People(self.rule.question, noise)
        shares, largest = self.people_shares, float(np.ptp(values, axis=1).max())

        def said(differences: np.ndarray) -> np.ndarray:
            told = people.probabilities(differences, *unit)
            return told @ shares.astype(told.dtype)

        differences = np.linspace(-largest, largest, TABLE_POINTS)
        table = differences, said(differences)
        pair = queries.most_telling_pair(values, weights, *table, visibility)
        return queries.most_telling_set(pair, self.n_shown, values, weights, said)

    def tell(self, preference: Preference, *shown: Shown) -> None:
        answer = Answer(preference, seen(shown) if self.likelihood == "decoder" else shown)
        told = self._log_likelihoods(self.particles, [answer], new=True)
        if self.people is not None:
            before = self.people_log_shares.astype(np.float64)
            joint = before + told
            told = logsumexp(joint, axis=1) - logsumexp(before, axis=1)
            self.people_log_shares = log_softmax(joint, axis=1).astype(np.float16)
        self.log_weights = self.log_weights + told
        self.answers.append(answer)
        if self.effective_size < len(self.particles) / 2:
            self._rejuvenate()

    def estimate(self) -> np.ndarray:
        known = self.model.task_latents, self._reference, self.prior.has_holes
        return decide(self.rule.decision, self.similarity, self.particles, self.weights, *known)

    def agreements(self) -> np.ndarray:
        """(k, 2) how well each answer agrees with the others: P(better on its side, or EQUAL),
        given all others and given all; 1 for EQUAL. Of four it is P(better than another one), on
        average. The posterior without an answer is that of all, each latent and person divided by
        their probability of it (Gelfand, Dey & Chang 1992).
        """
        found = np.ones((len(self.answers), 2))
        if not self.answers:
            return found
        joint = self.weights[:, None]  # (m, 1) or (m, G)
        if self.people is not None:
            joint = joint * np.exp(self.people_log_shares.astype(np.float64))
        kinds = ANSWERS[self.rule.question]
        middle = kinds.index(Preference.EQUAL)
        difference, error, magnitude, spread = self._differences(self.particles, self.answers)
        for i, answer in enumerate(self.answers):
            place, about = kinds.index(answer.preference), (error[:, i], magnitude[:, i])
            if place == middle:
                continue
            if self.people is not None:
                said = self.people.probabilities(difference[:, i], *about, spread)
            else:
                assert self.noise_model is not None
                left = self.noise_model.probability_left(difference[:, i, 0], *about)[:, None]
                said = np.stack([1.0 - left, np.zeros_like(left), left])
            if self.n_shown > 2:
                side, other = said[place], (said[1:].sum(axis=0) - said[place]) / (len(said) - 2)
            else:
                side = (said[: middle + 1] if place < middle else said[middle:]).sum(axis=0)
                other = 1.0 - side
            for j, weights in enumerate((joint / said[place], joint)):
                for_it, against = np.sum(weights * side), np.sum(weights * other)
                found[i, j] = for_it / (for_it + against)
        return found

    def contradicted(self) -> int | None:
        """The answer that agrees least with all others, see :meth:`agreements`, if that is less
        than 0.2, and less than 0.5 given all. What was asked about twice is left alone.
        """
        asked = [list(map(_identity, answer.shown)) for answer in self.answers]
        asked_twice = np.array([asked.count(shown) > 1 for shown in asked], dtype=bool)
        others, everything = self.agreements().T
        found = np.where(asked_twice | (everything >= BELIEVED), 1.0, others)
        return int(np.argmin(found)) if np.any(found < CONTRADICTED) else None

    def _similarity_scale(self) -> np.ndarray:
        """The spread of S's differences, and the one that is a logistic unit of doubt: 1, as S is
        the log-odds of being right about labels without errors; but once nearly all pairs are
        separated training scales S up without end, so it is at least a share of the spread.
        """
        if self.similarity is None:
            return np.ones(2)
        similarities = self.similarity.similarities(self.particles, self.particles)
        # Twice the variance within a row is the mean squared difference of two of its entries.
        spread = float(np.sqrt(2.0 * similarities.var(axis=1).mean()))
        unit = SIMILARITY_RESOLUTION * spread / PROBIT_SLOPE
        return np.array([max(spread, 1e-12), max(1.0, unit)])

    @property
    def _spread(self) -> float:
        return float(self.scale[0])

    def _return_spread(self, shown: Sequence[Trajectory]) -> float:
        """The family's spread of returns, for people, by the decoder: from S, once it is tied to
        returns, else from what was shown.
        """
        if self.people is None:
            return 1.0
        cross, square = self.calibration[:2]
        if self.library is None and cross > 0:
            return float(cross / square) * self._spread
        if self.library is None or self._library_spread is None:
            returns = self._decoder.predicted_returns(
                self._reference[:SPREAD_LATENTS], self.library or shown, DECODED_STEPS
            )
            spread = float(np.sqrt(2.0 * returns.var(axis=1, ddof=1).mean()))
            self._library_spread = max(spread, 1e-12)
        return self._library_spread

    def _return_unit(self) -> tuple[float, float, NoiseModel | None]:
        """Slope from S to returns, their typical magnitude, and a noise model for this unit."""
        cross, square, magnitude, count = self.calibration
        if count and cross > 0:
            return float(cross / square), float(magnitude / count), self.noise_model
        # Nothing has tied S to returns yet. Noise models that only ask for the sign need no unit,
        # and the paper's temperature is relative: it is told that returns are as large as their
        # spread. A fixed one has to wait.
        fixed = isinstance(self.noise_model, BoltzmannNoise) and self.noise_model.beta is not None
        return 1.0, 2.0 * self._spread, ExactNoise() if fixed else self.noise_model

    @property
    def _decoder(self) -> HasRewardDecoder:
        assert isinstance(self.model, HasRewardDecoder)
        return self.model

    def _decoder_error(self, steps: Values) -> np.ndarray:
        return self._decoder.predicted_rewards_error * np.sqrt(steps * ERROR_CORRELATION)

    def _differences(
        self, latents: np.ndarray, answers: Sequence[Answer], new: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """What each of (m, d) latents predicts of k answers about n: (m, k, n - 1) differences of
        the first one's to the others' returns, their error and magnitude (m, k), and the family's
        spread.
        """
        shown = [item for answer in answers for item in answer.shown]
        grouped, shape = (-1, len(answers), self.n_shown), (len(latents), len(answers))
        if self.likelihood == "decoder":
            clips = seen(shown)
            values = self._decoder.predicted_returns(latents, clips, DECODED_STEPS)  # (m, k n)
            steps = np.array([len(item) for item in clips], dtype=np.float64).reshape(grouped[1:])
            if new:
                self.thinning = np.vstack([self.thinning, self._measure_thinning(clips, values)])
            fits = self.thinning[-len(answers) * (self.n_shown - 1) :]
            intercepts, slopes, errors = fits.T.reshape(3, len(answers), self.n_shown - 1)
            error = np.hypot(self._decoder_error(steps[:, :1] + steps[:, 1:]), errors).mean(axis=1)
            difference = first_to_others(values.reshape(grouped))
            difference = difference + intercepts + slopes * difference
            if new and self.similarity is not None:
                s = first_to_others(self._similarities(latents, latents_of(shown))).ravel()
                typical = 2.0 * np.abs(values).mean(axis=1).mean()
                self.calibration += [s @ first_to_others(values).ravel(), s @ s, typical, 1.0]
            magnitude = 2.0 * np.abs(values).reshape(grouped).mean(axis=2)
            return difference, np.broadcast_to(error, shape), magnitude, self._return_spread(clips)
        values = self._similarities(latents, latents_of(shown))
        error = np.full(shape, self.scale[1] * PROBIT_SLOPE)
        magnitude = np.full(shape, 2.0 * self._spread)
        return first_to_others(values.reshape(grouped)), error, magnitude, self._spread

    def _log_likelihoods(
        self, latents: np.ndarray, answers: Sequence[Answer], new: bool = False
    ) -> np.ndarray:
        """(m,) log P(answers | latent) of (m, d), or (m, G) for each of the people; what else a new
        answer tells is noted.
        """
        difference, error, magnitude, spread = self._differences(latents, answers, new)
        if self.people is None:
            assert self.noise_model is not None
            probability = self.noise_model.probability_left(difference[..., 0], error, magnitude)
            told = [answer.preference for answer in answers]
            return preference_log_likelihood(np.log(probability), np.log1p(-probability), told)
        sums = np.zeros((len(latents), len(self.people)))
        for i, answer in enumerate(answers):
            about = difference[:, i], error[:, i], magnitude[:, i], spread
            place = self.people.answers.index(answer.preference)
            sums += np.log(self.people.probabilities(*about)[place])
        return sums

    def _answer_log_likelihoods(self, latents: np.ndarray) -> np.ndarray:
        """(m,) log P(all answers | latent), whoever answers."""
        told = self._log_likelihoods(latents, self.answers)
        return told if self.people is None else logsumexp(told + self.people.log_prior, axis=1)

    def _measure_thinning(self, shown: Sequence[Trajectory], thin: np.ndarray) -> np.ndarray:
        """(n - 1, 3) of the first one's difference to each other."""
        if max(map(len, shown)) <= DECODED_STEPS:
            return np.zeros((len(shown) - 1, 3))
        quantiles = (np.arange(FULLY_DECODED) + 0.5) / FULLY_DECODED
        some = np.searchsorted(np.cumsum(self.weights), quantiles).clip(max=len(self.particles) - 1)
        full = self._decoder.predicted_returns(self.particles[some], shown)
        pairs = zip(first_to_others(thin[some]).T, first_to_others(full).T, strict=True)
        return np.array([fit_thinning(*pair) for pair in pairs])

    def _similarities(self, latents: np.ndarray, policies: np.ndarray) -> np.ndarray:
        assert self.similarity is not None
        return self.similarity.similarities(latents, policies)

    def _query_policies(self) -> np.ndarray:
        """(n, d): half of them draws of the posterior, half of the prior."""
        half = QUERY_POLICIES[self.rule.question] // 2
        posterior = self.particles[systematic_resample(self.weights, half, self.rng)]
        return np.concatenate([posterior, self.prior.sample(half, self.rng)])

    def _rejuvenate(self) -> None:
        """Resample, and replace what is now double, at bounded cost."""
        fitted = fit_gaussian(self.particles, self.weights)
        chosen = systematic_resample(self.weights, len(self.particles), self.rng)
        copies = np.flatnonzero(np.concatenate([[False], chosen[1:] == chosen[:-1]]))
        self.particles = self.particles[chosen]
        if self.people is not None:
            self.people_log_shares = self.people_log_shares[chosen]
        self.log_weights = np.zeros(len(self.particles))
        self._library_returns = None
        if self.likelihood == "similarity":
            self._move(np.arange(len(self.particles)), MOVE_SWEEPS, MOVE_TRIES, fitted)
            return
        # One more than tries: where a particle stands is weighed, too; and another for who answers.
        evaluations = DECODER_TRIES + (1 if self.people is None else 2)
        shown = [item for answer in self.answers for item in answer.shown]
        steps = sum(min(len(item), DECODED_STEPS) for item in shown)
        affordable = DECODER_MOVE_STEPS // (steps * evaluations)
        order = self.rng.permutation(len(copies))
        self._move(copies[order[:affordable]], 1, DECODER_TRIES, fitted)
        rest = copies[order[affordable:]]
        prior = self.prior.log_density if self.prior.has_holes else None
        self.particles[rest] = kernel_neighbours(self.particles[rest], fitted, prior, self.rng)

    def _move(self, moved: np.ndarray, sweeps: int, tries: int, fitted: Gaussian) -> None:
        if not len(moved):
            return
        particles = self.particles[moved]
        told = self._answer_log_likelihoods(particles)
        reference = Gaussian(fitted.mean, WIDENING * fitted.factor)
        target = self._answer_log_likelihoods, self.prior.log_density, reference, tries, self.rng
        for _ in range(sweeps):
            particles, told = elliptical_slice_moves(particles, told, *target)
        self.particles[moved] = particles
        if self.people is not None:
            told = self._log_likelihoods(particles, self.answers) + self.people.log_prior
            self.people_log_shares[moved] = log_softmax(told, axis=1)


def fit_thinning(thin: np.ndarray, full: np.ndarray) -> tuple[float, float, float]:
    """What decoding all steps adds to a difference x of returns that was decoded from some:
    intercept + slope x, give or take an error, a standard deviation; by ridge regression on (n,).
    """
    added = full - thin
    covariance = np.mean((thin - thin.mean()) * added)
    slope = covariance / max(thin.var() + np.square(added).mean(), 1e-12)
    intercept = added.mean() - slope * thin.mean()
    error = np.sqrt(np.square(added - intercept - slope * thin).mean())
    return float(intercept), float(slope), float(error)


def first_to_others(values: np.ndarray) -> np.ndarray:
    """(..., n - 1) the first one's value (..., n) minus each other."""
    return values[..., :1] - values[..., 1:]


def _identity(shown: Shown) -> bytes:
    """Fragments of one policy differ, and have one latent: they are told by what was seen."""
    return (shown.observations if isinstance(shown, Trajectory) else shown).tobytes()


def _knows_its_decoder(model: MetaModel) -> bool:
    return isinstance(model, HasRewardDecoder) and bool(np.isfinite(model.predicted_rewards_error))
