"""Algorithm 2: which candidates are kept, what happens when there are none, and which one is
chosen.
"""

import numpy as np
import pytest
from worlds import SpeedModel

from sb3_poem.adaptation.paper import Paper
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.rule import Setting

LEFT, RIGHT, EQUAL = Preference.LEFT, Preference.RIGHT, Preference.EQUAL


def latent(first, dim=5):
    z = np.zeros(dim)
    z[0] = first
    return z


def make(epsilon=0.1, seed=0, **kwargs):
    return Paper(epsilon=epsilon, **kwargs).start(
        SpeedModel(), np.random.default_rng(seed), Setting()
    )


def differences(inference, latents):
    """S(z, preferred) - S(z, other), one answer a column, from the model's own definition."""
    model = inference.model
    columns = []
    for answer in inference.answers:
        left, right = model.similarities(latents, np.stack(answer.shown)).T
        columns.append(left - right if answer.preference is LEFT else right - left)
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("epsilon", [0.0, 0.1, 0.4])
def test_candidates_satisfy_every_answer_within_the_tolerance(epsilon):
    inference = make(epsilon)
    inference.tell(LEFT, latent(0.5), latent(-0.5))
    inference.tell(RIGHT, latent(1.5), latent(0.2))
    inference.ask()
    odds = 1.0 / (1.0 + np.exp(-differences(inference, inference.candidates)))
    assert inference.candidates.shape == (100, 5)
    latents, weights = inference.posterior()
    assert latents is inference.candidates
    np.testing.assert_array_equal(weights, np.full(100, 0.01))
    assert np.all(odds >= 0.5 - epsilon - 1e-12)
    # ... and the half-spaces are not narrower than eq. 9 says: on a grid, exactly those satisfy
    # all.
    grid = np.stack([latent(x) for x in np.linspace(-3, 3, 301)])
    odds = 1.0 / (1.0 + np.exp(-differences(inference, grid)))
    np.testing.assert_array_equal(
        inference.satisfied(grid) == 2, np.all(odds >= 0.5 - epsilon, axis=1)
    )


def test_equal_excludes_nobody():
    inference = make(epsilon=0.0)
    assert np.all(inference.satisfied(inference.candidates) == 0)  # there are no answers yet
    inference.tell(EQUAL, latent(0.5), latent(-0.5))
    grid = np.stack([latent(x) for x in np.linspace(-3, 3, 31)])
    assert np.all(inference.satisfied(grid) == 1)
    # but the most likely latent lies midway between the two
    inference.ask()
    model = inference.model
    estimate = model.speed(inference.estimate())
    midway = 0.5 * (model.speed(latent(0.5)) + model.speed(latent(-0.5)))
    nearest = np.abs(model.speed(inference.candidates) - midway).min()
    assert abs(estimate - midway) == pytest.approx(nearest)


def test_line_17_takes_the_candidate_of_highest_likelihood():
    inference = make()
    inference.ask()
    inference.tell(LEFT, latent(0.5), latent(-0.5))
    inference.ask()
    inference.tell(RIGHT, latent(1.5), latent(0.2))
    # Candidates are those drawn before the last answer; the likelihood counts it (lines 3 to 17 in
    # order).
    likelihood = np.prod(
        1.0 / (1.0 + np.exp(-differences(inference, inference.candidates))), axis=1
    )
    np.testing.assert_array_equal(inference.estimate(), inference.candidates[np.argmax(likelihood)])


def test_contradicting_answers_fall_back_in_the_defined_order():
    inference = make(epsilon=0.0)
    for _ in range(
        2
    ):  # nobody satisfies all three; whoever satisfies two satisfies the pair of equal answers
        inference.tell(LEFT, latent(0.5), latent(-0.5))
    inference.tell(RIGHT, latent(0.5), latent(-0.5))
    inference.ask()
    satisfied = inference.satisfied(inference.candidates)
    assert inference.candidates.shape == (100, 5)
    assert np.all(satisfied == 2)
    # of all draws with two satisfied answers these are the likeliest, best first
    likelihood = np.sum(-np.logaddexp(0.0, -differences(inference, inference.candidates)), axis=1)
    assert np.all(np.diff(likelihood) <= 1e-12)


def test_few_survivors_are_kept_and_filled_up():
    # The left policy is extreme: hardly any draw prefers it, but those that do come first.
    inference = make(epsilon=0.0)
    inference.tell(LEFT, latent(3.2), latent(2.4))
    inference.ask()
    satisfied = inference.satisfied(inference.candidates)
    survivors = int(satisfied.sum())
    assert 0 < survivors < 100
    assert np.all(satisfied[:survivors] == 1)
    assert np.all(np.isfinite(inference.candidates))


def test_the_query_is_eq_10s():
    inference = make()
    left, right = inference.ask()
    model, z = inference.model, inference.candidates
    best = 101
    for i in range(100):
        for j in range(i + 1, 100):
            difference = model.scale * (
                2 * model.speed(z) * (model.speed(z[i]) - model.speed(z[j]))
                - model.speed(z[i]) ** 2
                + model.speed(z[j]) ** 2
            )
            odds = 1 / (1 + np.exp(-difference))
            best = min(best, max(np.sum(odds >= 0.4), np.sum(1 - odds >= 0.4)))
    s = model.similarities(z, np.stack([left, right]))
    odds = 1 / (1 + np.exp(s[:, 1] - s[:, 0]))
    assert max(np.sum(odds >= 0.4), np.sum(1 - odds >= 0.4)) == best


def test_reproducible_and_restorable():
    first, second = make(seed=3), make(seed=3)
    for inference in (first, second):
        inference.ask()
        inference.tell(LEFT, latent(0.5), latent(-0.5))
    third = make(seed=99)
    third.restore(first.snapshot(), first.answers)
    for inference in (second, third):
        np.testing.assert_array_equal(first.candidates, inference.candidates)
    asked = [np.stack(inference.ask()) for inference in (first, second, third)]
    np.testing.assert_array_equal(asked[0], asked[1])
    np.testing.assert_array_equal(asked[0], asked[2])
