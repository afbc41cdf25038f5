"""How who answers errs, as the Bayesian rule sees it: P(answer | returns of what was shown).

The doubt about *predicted* returns is folded into the oracle's own noise by averaging over it: a
step function and a Gaussian error give a probit, a logistic function nearly one of a shrunken
argument (MacKay 1992). Both are evaluated as logistic functions, whose tails are heavier: an answer
that the prediction calls impossible should not veto a latent.
"""

from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar

import numpy as np

from sb3_poem.adaptation.preference import ANSWERS, BEST_OF_FOUR
from sb3_poem.common.checks import check_number

# A probit of unit scale is nearest to a logistic function of this slope.
PROBIT_SLOPE = 1.702
# Share of answers that no model explains (a slip, a trajectory that the decoder has never seen the
# like of). It bounds what one answer can do to the posterior, and costs an error-free oracle's ten
# answers nothing to speak of.
LAPSE = 0.01
#: In the place of a noise model: it is inferred.
INFER = "infer"

# What people may be like, and how many of them are so before the first answer: rates, and standard
# deviations, widths and differences in units of the family's spread of returns, the root mean
# square difference of two random policies' returns on a random task.
MISTAKES = {0.0: 0.8, 0.25: 0.2}
DOUBTS = {0.0: 0.8, 2.0: 0.2}
INDIFFERENCES = {0.0: 0.4, 0.12: 0.4, 0.4: 0.2}
MUCH = {0.45: 0.3, 1.0: 0.5, 2.0: 0.2}

Values = np.ndarray | float


class NoiseModel:
    """What somebody says follows from a difference of two returns that they perceive, and a share
    ``rate`` of answers is turned round. One of your own has a ``kind``, and overrides
    :meth:`probability_above`; as it is here the larger return is perceived to be larger.

    >>> ExactNoise().to_dict()
    {'kind': 'exact'}
    """

    kind: str
    rate = 0.0

    _known: ClassVar[dict[str, "type[NoiseModel]"]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        NoiseModel._known[vars(cls).get("kind", cls.__name__)] = cls

    def probability_above(self, difference: Values, error: Values, magnitude: Values) -> np.ndarray:
        """P(the perceived difference is positive), in [0, 1]; arguments broadcast.

        :param difference: Predicted return of the left trajectory minus that of the right one.
        :param error: Standard deviation of that prediction, same unit.
        :param magnitude: The sum of both returns' absolute values, same unit.
        """
        return _logistic(difference, PROBIT_SLOPE / np.maximum(error, 1e-12))

    def probability_left(self, difference: Values, error: Values, magnitude: Values) -> np.ndarray:
        """P(LEFT), given that the oracle says LEFT or RIGHT, in (0, 1)."""
        left = (1.0 - LAPSE) * self.probability_above(difference, error, magnitude)
        left += LAPSE / 2
        return left if self.rate == 0.0 else self.rate + (1.0 - 2.0 * self.rate) * left

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready; :func:`noise_model_from_dict` reads it."""
        own = {k: v.item() if isinstance(v, np.generic) else v for k, v in vars(self).items()}
        return {"kind": self.kind, **own}


def _logistic(x: Values, slope: Values) -> np.ndarray:
    # It stays float32 if it is; whole numbers would cut the slope off.
    x = np.asarray(x)
    x = x.astype(np.result_type(x.dtype, np.float32), copy=False)
    with np.errstate(over="ignore"):  # infinity is as good as 80, where lapses hide what is left
        y = np.asarray(x * np.asarray(-slope, dtype=x.dtype))
    # In place: new memory for every operation on a question's pairs takes longer than it.
    np.exp(np.clip(y, -80.0, 80.0, out=y), out=y)
    y += 1.0
    return np.reciprocal(y, out=y)


@dataclass(frozen=True)
class ExactNoise(NoiseModel):
    """The larger return always wins; what doubt there is comes from the prediction.

    >>> p = ExactNoise().probability_left(difference=3.0, error=3.0, magnitude=20.0)
    >>> round(float(p), 2)
    0.84
    """

    kind = "exact"


@dataclass(frozen=True)
class MistakeNoise(NoiseModel):
    """The right answer, flipped with a fixed probability, in [0, 0.5].

    >>> p = MistakeNoise(0.1).probability_left(difference=3.0, error=0.0, magnitude=20.0)
    >>> round(float(p), 2)
    0.9
    """

    rate: float = 0.2
    kind = "mistake"

    def __post_init__(self) -> None:
        check_number("rate", self.rate, 0.0, 0.5)


@dataclass(frozen=True)
class BoltzmannNoise(NoiseModel):
    """LEFT with probability 1 / (1 + exp(-beta (R_left - R_right))) (C.6 of Xu & Zhu 2025); a beta
    of None is the paper's ``1 / (|R_left| + |R_right|)``.

    >>> p = BoltzmannNoise().probability_left(difference=3.0, error=0.0, magnitude=20.0)
    >>> round(float(p), 2)
    0.54
    """

    beta: float | None = None
    kind = "boltzmann"

    def __post_init__(self) -> None:
        if self.beta is not None:
            check_number("beta", self.beta, above=0.0)

    def probability_above(self, difference: Values, error: Values, magnitude: Values) -> np.ndarray:
        beta = 1.0 / np.maximum(magnitude, 1e-12) if self.beta is None else self.beta
        shrink = np.sqrt(1.0 + np.pi / 8.0 * (beta * np.asarray(error)) ** 2)
        return _logistic(difference, beta / shrink)


def noise_model_from_dict(data: dict[str, Any]) -> NoiseModel:
    """Read what ``to_dict`` of any imported noise model wrote."""
    kinds = NoiseModel._known
    arguments, kind = {k: v for k, v in data.items() if k != "kind"}, data.get("kind")
    if kind not in kinds:
        known = f"known are {sorted(kinds)}, and others once they are imported"
        raise ValueError(f"unknown noise model {kind!r}; {known}")
    return kinds[kind](**arguments)


class People:
    """A prior over people, each with a number g of G, who answer questions of one kind; which of
    them it is is inferred with the task.

    Somebody perceives the difference of the two returns with a doubt of their own, says EQUAL if it
    is smaller than their width of indifference, MUCH_LEFT or MUCH_RIGHT if it exceeds what they
    call much, and LEFT or RIGHT else (McCullagh 1980); that is turned round with their rate of
    mistakes. Of four the best one is chosen by Luce's rule (1959); EQUAL is that none leads all
    others by the width of indifference (Rao & Kupper 1967), and a mistake is any other one.

    :param kind: Of the questions, see :class:`~sb3_poem.adaptation.preference.Query`.
    :param noise: How they err, if that is known: then only their widths are not.
    """

    def __init__(self, kind: str, noise: NoiseModel | None) -> None:
        self.kind, self.answers, self.noise = kind, ANSWERS[kind], noise
        known = {0.0: 1.0}
        priors = (
            MISTAKES if noise is None else {noise.rate: 1.0},
            DOUBTS if noise is None else known,
            INDIFFERENCES,
            MUCH if kind == "graded" else known,
        )
        grid = list(product(*(prior.items() for prior in priors)))
        values, shares = np.moveaxis(np.array(grid), 2, 0)  # (G, 4) each
        self.mistakes, self.doubts, indifferences, much = values.T
        self.log_prior = np.log(shares).sum(axis=1)
        inner = (-indifferences, indifferences)
        # (G, answers - 1), ascending: what the perceived difference must exceed for the next answer
        self.thresholds = np.stack((-much, *inner, much) if kind == "graded" else inner, axis=1)

    def __len__(self) -> int:
        return len(self.log_prior)

    def probabilities(
        self, difference: np.ndarray, error: Values, magnitude: Values, spread: float
    ) -> np.ndarray:
        """P(answer), (answers, m, G), of differences (m,) of predicted returns, or of the first
        one's to n - 1 others' (m, n - 1), where the answers are EQUAL and the n from last to first.
        ``error`` and ``magnitude``, numbers or (m,), are as in
        :meth:`NoiseModel.probability_above`, in their unit as is the family's ``spread``.
        """
        error, magnitude = (np.asarray(value)[..., None] for value in (error, magnitude))
        noise = self.noise or ExactNoise()
        if self.noise is None:
            error = np.hypot(error, spread * self.doubts)
        differences = np.reshape(difference, (len(difference), -1))
        thresholds = spread * self.thresholds.T[:, None, :]  # (answers - 1, 1, G)
        if self.kind == BEST_OF_FOUR:
            values = np.pad(-differences[:, ::-1].T, ((0, 1), (0, 0)))
            behind = (values - values.max(axis=0))[:, :, None]
            odds = noise.probability_above(behind, error, magnitude)
            odds = odds / (1.0 - odds)  # (n, m, G) of each against the best
            below, beyond = (noise.probability_above(x, error, magnitude) for x in thresholds)
            handicap = np.minimum(beyond / below, 1e30).astype(odds.dtype)
            best = odds / (odds + handicap * (odds.sum(axis=0) - odds))
            others = (best.sum(axis=0) - best) / (len(best) - 1)
            equal = np.maximum(1.0 - best.sum(axis=0, keepdims=True), 0.0)
            best += self.mistakes.astype(odds.dtype) * (others - best)
            said = np.concatenate([equal, best])
        else:
            above = noise.probability_above(differences - thresholds, error, magnitude)
            perceived = -np.diff(above, axis=0, prepend=1.0, append=0.0)
            said = perceived + self.mistakes * (perceived[::-1] - perceived)
        return (1.0 - LAPSE) * said + LAPSE / len(said)
