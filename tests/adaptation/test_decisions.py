"""Which latent to act on."""

import numpy as np
import pytest

from sb3_poem.adaptation.decisions import decide, standard_scores


class SignOf:
    """Forwards or backwards: the middle fits neither."""

    def similarities(self, tasks, policies):
        return np.sign(tasks[:, :1]) * np.where(
            np.abs(policies[:, 0]) > 0.5, np.sign(policies[:, 0]), 0.0
        )


class ProductOf:
    """A policy looks the fitter the more extreme it is."""

    def similarities(self, tasks, policies):
        return tasks[:, :1] * policies[:, 0]


class EitherOf:
    """Two kinds of policy are as good as each other, and what lies between them is not."""

    def similarities(self, tasks, policies):
        return np.repeat(-np.abs(np.abs(policies[:, 0]) - 2.0)[None, :], len(tasks), axis=0)


class NearestTo:
    """A policy that lies between all others looks best by far."""

    def similarities(self, tasks, policies):
        return np.repeat(-np.abs(policies[:, 0] - 0.8)[None, :], len(tasks), axis=0)


TWO_CLUSTERS = np.concatenate([np.linspace(-2.4, -1.6, 30), np.linspace(1.6, 2.4, 30)])[:, None]


def test_the_decision_is_between_the_modes_only_if_that_is_fit():
    particles = np.array([[-1.0]] * 30 + [[1.0]] * 70)
    weights = np.full(100, 0.01)
    assert decide("posterior-mean", SignOf(), particles, weights, None, TWO_CLUSTERS)[
        0
    ] == pytest.approx(0.4)
    assert decide(
        "expected-fitness", SignOf(), particles, weights, np.array([[0.2]]), TWO_CLUSTERS
    )[0] == pytest.approx(1.0)
    assert (
        decide("most-likely", SignOf(), particles, np.arange(100) / 4950, None, TWO_CLUSTERS)[0]
        == 1.0
    )


def test_the_decision_is_the_middle_of_what_looks_alike():
    cluster = TWO_CLUSTERS[30:]
    weights = np.full(30, 1 / 30)
    assert decide("expected-fitness", ProductOf(), cluster, weights, None, TWO_CLUSTERS)[
        0
    ] == pytest.approx(2.0)
    lopsided = np.r_[np.full(30, 0.3 / 30), np.full(30, 0.7 / 30)]
    assert decide("expected-fitness", ProductOf(), TWO_CLUSTERS, lopsided, None, TWO_CLUSTERS)[
        0
    ] == pytest.approx(2.0)


def test_the_decision_is_not_between_policies_that_are_alike_where_the_middle_is_not():
    weights = np.full(60, 1 / 60)
    reference = np.linspace(-4.0, 4.0, 101)[:, None]
    chosen = decide("expected-fitness", EitherOf(), TWO_CLUSTERS, weights, None, reference)
    assert abs(chosen[0]) == pytest.approx(2.0, abs=0.02)


def test_a_mean_in_a_hole_of_the_prior_is_not_acted_on():
    lopsided = np.r_[
        np.full(30, 0.3 / 30), np.full(30, 0.7 / 30)
    ]  # S thinks as much of their mean, 0.8, as of 2
    args = "expected-fitness", SignOf(), TWO_CLUSTERS, lopsided, None, TWO_CLUSTERS
    assert decide(*args)[0] == pytest.approx(0.8)
    assert decide(*args, has_holes=True)[0] == pytest.approx(2.0)
    args = "expected-fitness", NearestTo(), TWO_CLUSTERS, lopsided, None, TWO_CLUSTERS
    assert decide(*args)[0] == pytest.approx(0.8)
    assert 1.6 <= decide(*args, has_holes=True)[0] <= 2.4


def test_a_training_task_that_fits_best_by_far_is_the_decision():
    particles, weights = np.linspace(0.9, 1.1, 20)[:, None], np.full(20, 0.05)
    chosen = decide(
        "expected-fitness", ProductOf(), particles, weights, np.array([[5.0], [-5.0]]), TWO_CLUSTERS
    )
    assert chosen[0] == 5.0


def test_fitness_is_in_standard_scores_of_the_reference():
    similarities, reference = (
        np.array([[1.0, 4.0], [50.0, 20.0]]),
        np.array([[1.0, 2.0, 6.0], [50.0, 20.0, 20.0]]),
    )
    expected = [
        [(x - np.mean(row)) / np.std(row) for x in line]
        for line, row in zip(similarities, reference, strict=True)
    ]
    np.testing.assert_allclose(standard_scores(similarities, reference), expected)
