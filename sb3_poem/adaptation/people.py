"""Who answers: a grid of people, told apart by how often they err and by what they call better and
much better. Which of them it is is inferred with the task.
"""

from itertools import product

import numpy as np

from sb3_poem.adaptation.noise import LAPSE, ExactNoise, GradedNoiseModel, Values
from sb3_poem.adaptation.preference import ANSWERS, BEST_OF_FOUR

INFER = "infer"

# What people may be like, and how many of them are so before the first answer: rates, and standard
# deviations, widths and differences in units of the family's spread of returns, the root mean
# square difference of two random policies' returns on a random task.
MISTAKES = {0.0: 0.8, 0.25: 0.2}
DOUBTS = {0.0: 0.8, 2.0: 0.2}
INDIFFERENCES = {0.0: 0.4, 0.12: 0.4, 0.4: 0.2}
MUCH = {0.45: 0.3, 1.0: 0.5, 2.0: 0.2}


class People:
    """A prior over people, each with a number g of G, who answer questions of one kind.

    Somebody perceives the difference of the two returns with a doubt of their own, says EQUAL if it
    is smaller than their width of indifference, MUCH_LEFT or MUCH_RIGHT if it exceeds what they
    call much, and LEFT or RIGHT else; that is turned round with their rate of mistakes. This is an
    ordered logistic regression (McCullagh 1980) on the predicted difference, whose error is folded
    into the doubt. Of four the best one is chosen by Luce's rule (1959), which of two is the same;
    EQUAL is that none leads all others by the width of indifference (Rao & Kupper 1967), and a
    mistake is any other one.

    The prior is a product of independent ones, ``MISTAKES``, ``DOUBTS``, ``INDIFFERENCES`` and
    ``MUCH``. A width of 0 is that of somebody who never says EQUAL. One answer in a hundred is a
    slip, which may be any.

    :param kind: Of the questions, see :class:`~sb3_poem.adaptation.preference.Query`.
    :param noise: How they err, if that is known: then only their widths are not.
    """

    def __init__(self, kind: str, noise: GradedNoiseModel | None) -> None:
        self.kind, self.answers = kind, ANSWERS[kind]
        self.noise = noise
        known = {0.0: 1.0}
        priors = (
            known if noise is not None else MISTAKES,
            known if noise is not None else DOUBTS,
            INDIFFERENCES,
            MUCH if kind == "graded" else known,
        )
        grid = list(product(*(prior.items() for prior in priors)))
        values, shares = np.moveaxis(np.array(grid), 2, 0)  # (G, 4) each
        self.mistakes, self.doubts, indifferences, much = values.T
        if noise is not None:
            self.mistakes = np.full(len(grid), noise.mistakes)
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
        ``error`` and ``magnitude``, numbers or (m,), are as in :meth:`NoiseModel.probability_left`,
        in their unit as is the family's ``spread``.
        """
        error, magnitude = (np.asarray(value)[..., None] for value in (error, magnitude))
        noise: GradedNoiseModel = self.noise or ExactNoise()
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
            ends = np.ones((1, *above.shape[1:])), np.zeros((1, *above.shape[1:]))
            perceived = -np.diff(np.concatenate([ends[0], above, ends[1]]), axis=0)
            said = perceived + self.mistakes * (perceived[::-1] - perceived)
        return (1.0 - LAPSE) * said + LAPSE / len(said)
