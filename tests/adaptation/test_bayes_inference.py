"""The Bayesian rule: the likelihood of answers by the direct formula, and what it needs of a model."""

import math

import numpy as np
import pytest
from bayes_world import EQUAL, LEFT, RIGHT, at_speed, crowd, logistic, make
from scipy.special import ndtr
from worlds import HORIZON, STEP_WEIGHT, SpeedModel

from sb3_poem.adaptation.bayes import (
    DECODED_STEPS,
    ERROR_CORRELATION,
    SIMILARITY_RESOLUTION,
    fit_thinning,
)
from sb3_poem.adaptation.noise import LAPSE, BoltzmannNoise, ExactNoise, MistakeNoise
from sb3_poem.adaptation.preference import preference_log_likelihood
from sb3_poem.common.trajectory import Trajectory

ANSWERS = [(LEFT, 2.0, 1.0), (RIGHT, 2.6, 1.4), (EQUAL, 2.5, 1.3)]


@pytest.mark.parametrize(
    ("noise", "probability"),
    [
        (ExactNoise(), lambda d, m, e: LAPSE / 2 + (1 - LAPSE) * logistic(1.702 * d / e)),
        (
            MistakeNoise(0.1),
            lambda d, m, e: 0.1 + 0.8 * (LAPSE / 2 + (1 - LAPSE) * logistic(1.702 * d / e)),
        ),
        (
            BoltzmannNoise(),
            lambda d, m, e: (
                LAPSE / 2
                + (1 - LAPSE) * logistic(d / m / math.sqrt(1 + math.pi / 8 * (e / m) ** 2))
            ),
        ),
    ],
)
def test_the_decoders_likelihood_is_the_direct_formula(noise, probability):
    model = SpeedModel()
    inference = make(model, noise_model=noise, n_particles=50)
    particles = crowd(inference, 1.8)
    for preference, left, right in ANSWERS:
        inference.tell(preference, at_speed(model, left), at_speed(model, right))
    np.testing.assert_array_equal(inference.particles, particles)
    error = model.predicted_rewards_error * math.sqrt(2 * HORIZON * ERROR_CORRELATION)
    for z, weight in zip(inference.particles, inference.log_weights, strict=True):
        goal, expected = 3 * ndtr(z[0]), 0.0
        for preference, left, right in ANSWERS:
            r_left, r_right = (
                -STEP_WEIGHT * HORIZON * abs(speed - goal) for speed in (left, right)
            )
            p = probability(r_left - r_right, abs(r_left) + abs(r_right), error)
            expected += {
                LEFT: math.log(p),
                RIGHT: math.log(1 - p),
                EQUAL: 0.5 * math.log(p * (1 - p)),
            }[preference]
        assert weight == pytest.approx(expected, rel=1e-6)
    assert inference.weights.sum() == pytest.approx(1.0)


def test_the_likelihood_from_s_is_the_direct_formula():
    model = SpeedModel()
    inference = make(model, likelihood="similarity", n_particles=50)
    particles = inference.particles.copy()
    s = model.similarities(particles, particles)
    spread = math.sqrt(
        np.mean([(row[i] - row[j]) ** 2 for row in s for i in range(50) for j in range(50)])
    )
    unit = max(1.0, SIMILARITY_RESOLUTION * spread / 1.702)
    left, right = np.full(5, -0.4), np.full(5, -1.7)
    expected = np.log(
        LAPSE / 2
        + (1 - LAPSE)
        * logistic((model.similarities(particles, np.stack([left, right])) @ [1, -1]) / unit)
    )
    inference.tell(LEFT, left, right)
    np.testing.assert_array_equal(inference.particles, particles)
    np.testing.assert_allclose(inference.log_weights, expected, rtol=1e-9)


def test_error_free_answers_do_not_care_for_the_scale_of_s():
    # Beyond the scale at which S's own odds are certain, a hundredfold S changes nothing.
    weights = []
    for scale in (100.0, 10_000.0):
        inference = make(SpeedModel(scale=scale), likelihood="similarity")
        inference.tell(LEFT, np.full(5, -0.4), np.full(5, -1.7))
        weights.append(inference.weights)
    assert np.ptp(weights[0]) > 0  # as none was moved
    np.testing.assert_allclose(weights[0], weights[1], rtol=1e-6)


def test_equal_is_neither_left_nor_right():
    log_left, log_right = np.log([[0.9], [0.5], [0.1]]), np.log([[0.1], [0.5], [0.9]])
    equal = preference_log_likelihood(log_left, log_right, [EQUAL])
    np.testing.assert_allclose(equal, np.log([0.3, 0.5, 0.3]))


def test_a_library_is_asked_about_without_similarity():
    class DecoderOnly(SpeedModel):
        similarities = None  # as PEARLSAC: there is none

    model = DecoderOnly(latent_dim=1)
    library = [at_speed(model, speed) for speed in np.linspace(0, 3, 13)]
    inference = make(model, library=library, decision="posterior-mean")
    goal = 2.05
    for _ in range(8):
        left, right = inference.ask()
        speeds = [shown.observations[1, 1] for shown in (left, right)]
        inference.tell(
            LEFT if abs(speeds[0] - goal) < abs(speeds[1] - goal) else RIGHT,
            left,
            right,
        )
    assert model.speed(inference.estimate()) == pytest.approx(goal, abs=0.15)


def test_a_snapshot_continues_exactly():
    model = SpeedModel()
    first, second = make(model, seed=1), make(model, seed=2)
    for _ in range(3):
        left, right = first.ask()
        first.tell(
            LEFT,
            at_speed(model, model.speed(left), left),
            at_speed(model, model.speed(right), right),
        )
    second.restore(first.snapshot(), first.answers)
    np.testing.assert_array_equal(first.estimate(), second.estimate())
    np.testing.assert_array_equal(first.ask(), second.ask())
    with pytest.raises(ValueError, match="snapshot of BayesInference"):
        first.restore({**first.snapshot(), "arrays": {}}, [])


class NoDecoder(SpeedModel):
    predicted_returns = None


class Untrained(SpeedModel):
    predicted_rewards_error = float("nan")

    def __init__(self):
        super().__init__()
        del self.predicted_rewards_error


def test_the_likelihood_follows_what_the_model_has():
    assert make().likelihood == "decoder"
    assert make(NoDecoder()).likelihood == "similarity"


@pytest.mark.parametrize(
    ("model", "arguments", "message"),
    [
        (SpeedModel(), {"likelihood": "exact"}, "`likelihood` must be one of .*, but is 'exact'"),
        (SpeedModel(), {"decision": "best"}, "`decision` must be one of .*, but is 'best'"),
        (NoDecoder(), {"likelihood": "decoder"}, "needs a model with `predicted_returns`"),
        (
            SpeedModel(error=float("nan")),
            {"likelihood": "decoder"},
            "finite `predicted_rewards_error`, which is nan",
        ),
        (
            SpeedModel(),
            {"likelihood": "similarity", "noise_model": BoltzmannNoise(2.0)},
            "fixed beta",
        ),
        (SpeedModel(), {"library": []}, "`library` must hold at least 2"),
        (SpeedModel(), {"library": [1, 2], "query_rule": "worst-case"}, "worst-case"),
        (NoDecoder(), {"library": [1, 2]}, "`library` needs a model with a reward decoder"),
        (
            SpeedModel(error=float("nan")),
            {"library": [1, 2]},
            "with a `library` needs a finite `predicted_rewards_error`, which is nan",
        ),
    ],
)
def test_bad_options(model, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(model, **arguments)


def test_a_library_is_asked_about_at_random_where_the_decoders_error_is_not_known():
    model = SpeedModel(error=float("nan"))
    library = [at_speed(model, speed) for speed in np.linspace(0, 3, 13)]
    inference = make(model, library=library, query_rule="random")
    asked = {tuple(id(shown) for shown in inference.ask()) for _ in range(20)}
    assert len(asked) > 10


def test_the_decoder_needs_trajectories_and_s_latents():
    with pytest.raises(ValueError, match="needs the trajectories"):
        make().tell(LEFT, np.zeros(5), np.ones(5))
    inference = make(likelihood="similarity")
    inference.tell(LEFT, np.zeros(5), np.ones(5))
    assert inference.contradicted() is None


class Misled(SpeedModel):
    """From some steps alone it takes the left trajectories for better than they are, by as much for
    every latent.
    """

    def predicted_returns(self, latents, trajectories, max_steps=None):
        returns = super().predicted_returns(latents, trajectories)
        if max_steps is not None and len(trajectories[0]) > max_steps:
            returns[:, ::2] += 30.0
        return returns


def test_what_some_steps_alone_mislead_to_is_put_right():
    steps = 2 * DECODED_STEPS
    left, right = (
        Trajectory(
            np.column_stack([np.zeros(steps + 1), np.full(steps + 1, v)]),
            np.zeros((steps, 1)),
            np.zeros(5),
        )
        for v in (1.0, 1.04)
    )
    truth, misled = make(SpeedModel()), make(Misled())
    for inference in (truth, misled):
        inference.tell(RIGHT, left, right)
    np.testing.assert_allclose(misled.particles, truth.particles)
    np.testing.assert_allclose(misled.weights, truth.weights)
    restored = make(Misled(), seed=1)  # which must know it, too, when particles are weighed again
    restored.restore(misled.snapshot(), misled.answers)
    for inference in (truth, misled, restored):
        inference.tell(RIGHT, left, right)
        np.testing.assert_allclose(inference.particles, truth.particles)
        np.testing.assert_allclose(inference.agreements(), truth.agreements())
    prior = make()
    assert (
        SpeedModel.speed(truth.estimate()) > SpeedModel.speed(prior.estimate()) + 0.2
    )  # it says something


def test_thinning_is_a_line_and_what_is_off_it():
    thin = np.linspace(-100.0, 100.0, 8)
    signs = np.array([1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0])  # orthogonal to a line
    intercept, slope, error = fit_thinning(thin, thin + 7.0 + 0.01 * thin + 2.0 * signs)
    assert intercept == pytest.approx(7.0)
    assert slope == pytest.approx(0.01, rel=0.02)
    assert error == pytest.approx(2.0, rel=0.01)
    # differences that hardly vary tell no slope
    assert abs(fit_thinning(thin / 1e4, thin / 1e4 + 20.0 * signs + thin)[1]) < 0.01
