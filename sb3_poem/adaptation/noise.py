"""How an oracle errs, as the Bayesian rule sees it: P(answer | returns of the two trajectories).

The doubt about *predicted* returns is folded into the oracle's own noise by averaging over it: a
step function and a Gaussian error give a probit, a logistic function nearly one of a shrunken
argument (MacKay 1992). Both are evaluated as logistic functions, whose tails are heavier: an answer
that the prediction calls impossible should not veto a latent.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

# A probit of unit scale is nearest to a logistic function of this slope.
PROBIT_SLOPE = 1.702
# Share of answers that no model explains (a slip, a trajectory that the decoder has never seen the
# like of). It bounds what one answer can do to the posterior, and costs an error-free oracle's ten
# answers nothing to speak of.
LAPSE = 0.01

Values = np.ndarray | float


class NoiseModel(Protocol):
    """P(LEFT) from the difference of two returns.

    >>> ExactNoise().to_dict()
    {'kind': 'exact'}
    """

    def probability_left(self, difference: Values, error: Values, magnitude: Values) -> Any:
        """P(LEFT), given that the oracle says LEFT or RIGHT, in (0, 1); arguments broadcast.

        :param difference: Predicted return of the left trajectory minus that of the right one.
        :param error: Standard deviation of that prediction, same unit.
        :param magnitude: The sum of both returns' absolute values, same unit.
        """

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready; :func:`noise_model_from_dict` reads it."""


class GradedNoiseModel(NoiseModel, Protocol):
    """One that also knows answers of degrees: what somebody says follows from a difference that
    they perceive, and some say the opposite of that.
    """

    @property
    def mistakes(self) -> float:
        """The share of answers that are turned round."""

    def probability_above(self, difference: Values, error: Values, magnitude: Values) -> Any:
        """P(the perceived difference is positive), slips aside; arguments as in
        :meth:`NoiseModel.probability_left`.
        """


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


def _with_lapse(probability: np.ndarray) -> np.ndarray:  # in place
    probability *= 1.0 - LAPSE
    probability += LAPSE / 2
    return probability


class _Noise:
    """The larger return is perceived to be larger, unless a subclass says otherwise."""

    kind: str

    @property
    def mistakes(self) -> float:
        return 0.0

    def probability_above(self, difference: Values, error: Values, magnitude: Values) -> Any:
        return _logistic(difference, PROBIT_SLOPE / np.maximum(error, 1e-12))

    def probability_left(self, difference: Values, error: Values, magnitude: Values) -> Any:
        return _with_lapse(self.probability_above(difference, error, magnitude))

    def to_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, **vars(self)}


@dataclass(frozen=True)
class ExactNoise(_Noise):
    """The larger return always wins; what doubt there is comes from the prediction.

    >>> p = ExactNoise().probability_left(difference=3.0, error=3.0, magnitude=20.0)
    >>> round(float(p), 2)
    0.84
    """

    kind = "exact"


@dataclass(frozen=True)
class MistakeNoise(_Noise):
    """The right answer, flipped with a fixed probability, in [0, 0.5].

    >>> p = MistakeNoise(0.1).probability_left(difference=3.0, error=0.0, magnitude=20.0)
    >>> round(float(p), 2)
    0.9
    """

    rate: float = 0.2
    kind = "mistake"

    def __post_init__(self) -> None:
        if not 0.0 <= self.rate <= 0.5:
            raise ValueError(f"`rate` must lie in [0, 0.5], but is {self.rate}")

    @property
    def mistakes(self) -> float:
        return self.rate

    def probability_left(self, difference: Values, error: Values, magnitude: Values) -> Any:
        right = super().probability_left(difference, error, magnitude)
        return self.rate + (1.0 - 2.0 * self.rate) * right


@dataclass(frozen=True)
class BoltzmannNoise(_Noise):
    """LEFT with probability 1 / (1 + exp(-beta (R_left - R_right))) (C.6 of Xu & Zhu 2025); a beta
    of None is the paper's ``1 / (|R_left| + |R_right|)``.

    >>> p = BoltzmannNoise().probability_left(difference=3.0, error=0.0, magnitude=20.0)
    >>> round(float(p), 2)
    0.54
    """

    beta: float | None = None
    kind = "boltzmann"

    def __post_init__(self) -> None:
        if self.beta is not None and not (np.isfinite(self.beta) and self.beta > 0):
            raise ValueError(f"`beta` must be positive and finite, or None, but is {self.beta}")

    def probability_above(self, difference: Values, error: Values, magnitude: Values) -> Any:
        beta = 1.0 / np.maximum(magnitude, 1e-12) if self.beta is None else self.beta
        shrink = np.sqrt(1.0 + np.pi / 8.0 * (beta * np.asarray(error)) ** 2)
        return _logistic(difference, beta / shrink)


_KINDS: dict[str, type] = {cls.kind: cls for cls in (ExactNoise, MistakeNoise, BoltzmannNoise)}


def noise_model_from_dict(data: dict[str, Any]) -> NoiseModel:
    """Read what a noise model's ``to_dict`` wrote."""
    arguments, kind = {k: v for k, v in data.items() if k != "kind"}, data.get("kind")
    if kind not in _KINDS:
        raise ValueError(f"unknown noise model {kind!r}; known are {sorted(_KINDS)}")
    return _KINDS[kind](**arguments)
