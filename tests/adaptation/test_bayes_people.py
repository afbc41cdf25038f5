"""Who answers is inferred with the task, and what the other answers contradict."""

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from bayes_world import EQUAL, LEFT, RIGHT, at_speed, crowd, logistic, make
from scipy.special import ndtri
from worlds import HORIZON, SpeedEnv, SpeedModel

from sb3_poem import set_task
from sb3_poem.adaptation import MistakeOracle, PreferenceAdapter, ReturnOracle
from sb3_poem.adaptation.bayes import (
    ERROR_CORRELATION,
    Bayes,
)
from sb3_poem.adaptation.noise import LAPSE, BoltzmannNoise, ExactNoise, MistakeNoise
from sb3_poem.adaptation.preference import ANSWERS as ANSWERS_OF
from sb3_poem.adaptation.preference import Preference
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.vec_env import make_task_vec_env

MUCH_LEFT, MUCH_RIGHT = Preference.MUCH_LEFT, Preference.MUCH_RIGHT


@pytest.mark.parametrize(
    ("question", "noise"), [("graded", "infer"), ("graded", MistakeNoise(0.1)), ("pair", "infer")]
)
@pytest.mark.parametrize("likelihood", ["decoder", "similarity"])
def test_latent_and_person_have_a_joint_posterior(question, noise, likelihood):
    """Against the sum over all people of the product of their answers' probabilities."""
    model = SpeedModel()
    options = {"question": question, "noise_model": noise, "likelihood": likelihood}
    inference = make(model, n_particles=30, **options)
    inference._rejuvenate = lambda: None  # the weights alone
    strongest = MUCH_LEFT if question == "graded" else LEFT
    told = [(strongest, 1.9, 0.3), (RIGHT, 2.6, 1.4), (EQUAL, 2.5, 1.9), (LEFT, 1.5, 2.9)]
    shown = []
    for preference, *speeds in told:
        pair = [at_speed(model, v, np.full(5, ndtri(v / 3))) for v in speeds]
        inference.tell(preference, *pair)
        shown.append(pair)
    people, spread = inference.people, inference.scale[0]
    if likelihood == "decoder":
        cross, square = inference.calibration[:2]
        spread *= cross / square
    expected = np.zeros((30, len(people)))
    for i, z in enumerate(inference.particles):
        for (preference, *_), pair in zip(told, shown, strict=True):
            if likelihood == "decoder":
                left, right = model.predicted_returns(z[None], pair)[0]
                error = model.predicted_rewards_error * math.sqrt(2 * HORIZON * ERROR_CORRELATION)
            else:
                left, right = model.similarities(z[None], np.stack([t.latent for t in pair]))[0]
                error = inference.scale[1] * 1.702
            doubts = np.hypot(error, spread * people.doubts)

            def above(cut, difference=left - right, doubts=doubts):
                return logistic(1.702 * (difference - spread * cut) / doubts)

            equal = people.thresholds[:, people.thresholds.shape[1] // 2]
            much = people.thresholds[:, -1] if question == "graded" else np.inf
            of_left = above(equal) - above(much), 1 - above(-equal) - (1 - above(-much))
            straight, turned = {
                MUCH_LEFT: (above(much), 1 - above(-much)),
                LEFT: of_left,
                RIGHT: of_left[::-1],
                EQUAL: (above(-equal) - above(equal),) * 2,
            }[preference]
            p = (1 - people.mistakes) * straight + people.mistakes * turned
            kinds = 5 if question == "graded" else 3
            expected[i] += np.log((1 - LAPSE) * p + LAPSE / kinds)
    joint = np.exp(expected + people.log_prior)
    if likelihood == "similarity":
        weights = joint.sum(axis=1)
        np.testing.assert_allclose(inference.weights, weights / weights.sum(), rtol=5e-3)
        shares = joint.sum(axis=0) / joint.sum()
        np.testing.assert_allclose(inference.people_shares, shares, atol=1e-3)
    else:  # S was tied to returns anew by each answer, so the spread differed a little
        weights = joint.sum(axis=1)
        assert np.corrcoef(np.log(weights), inference.log_weights)[0, 1] > 0.98


@pytest.mark.parametrize("noise", [ExactNoise(), MistakeNoise(0.1), BoltzmannNoise()])
def test_the_best_of_four_on_point_goal_against_enumeration(noise):
    """The posterior over particles after each of three answers, from formulas alone."""
    task = np.array([2.0])  # the goal's angle
    env = gym.make("poem/PointGoal-v0")
    set_task(env, task)
    oracle = ReturnOracle(env, task, question="best-of-four")
    rule = Bayes(300, question="best-of-four", noise_model=noise)
    adapter = PreferenceAdapter("PointGoal", env, rule=rule, n_queries=3, seed=0)
    inference, model = adapter.inference, adapter.model
    inference._rejuvenate = lambda: None  # the weights alone
    widths = np.array([0.0, 0.12, 0.4])
    joint = np.tile(np.log([0.4, 0.4, 0.2]), (300, 1))
    while not adapter.done:
        query = adapter.ask()
        answer = oracle(*query.shown)
        best = ["first", "second", "third", "fourth"].index(answer.value)
        adapter.tell(answer)
        values = model.predicted_returns(inference.particles, query.shown)
        cross, square = inference.calibration[:2]
        spread = inference.scale[0] * cross / square
        error = model.predicted_rewards_error * math.sqrt(2 * 25 * ERROR_CORRELATION)
        if isinstance(noise, BoltzmannNoise):
            beta = 1 / (2 * np.abs(values).mean(axis=1, keepdims=True))
            slope = beta / np.sqrt(1 + np.pi / 8 * (beta * error) ** 2)
        else:
            slope = 1.702 / error
        odds = np.exp(slope * (values - values.max(axis=1, keepdims=True)))
        handicap = np.exp(slope * spread * widths)
        winner = np.stack([odds[:, i, None] for i in range(4)])  # (4, m, 1)
        p = winner / (winner + handicap * (odds.sum(axis=1)[None, :, None] - winner))
        rate = getattr(noise, "rate", 0.0)
        p = (1 - rate) * p[best] + rate / 3 * (p.sum(axis=0) - p[best])
        joint += np.log((1 - LAPSE) * p + LAPSE / 5)
        expected = np.exp(joint).sum(axis=1)
        np.testing.assert_allclose(inference.weights, expected / expected.sum(), rtol=0.02)
    goal = np.array([np.cos(task[0]), np.sin(task[0])])
    near = np.linalg.norm(_ends(model, inference.particles) - goal, axis=1) < 0.35
    grew = inference.weights[near].sum() / near.mean()
    assert grew > (1.05 if isinstance(noise, BoltzmannNoise) else 2.5)


def _ends(model, latents):
    """(m, 2) where PointGoal's policies come to."""
    env = make_task_vec_env("poem/PointGoal-v0", 50)
    clips = rollout_latents(model, env, latents, None, [0] * len(latents), True)
    return np.stack([clip.observations[-1] for clip in clips])


@pytest.mark.parametrize("question", ["pair", "graded", "best-of-four"])
def test_who_answers_is_found_out(question):
    kinds = {"graded": {"thresholds": (20.0, 200.0)}, "best-of-four": {"question": question}}
    told = kinds.get(question, {})

    def mistakes(oracle):
        rule = Bayes(50, question=question, noise_model="infer")
        adapter = PreferenceAdapter(
            SpeedModel(), SpeedEnv(), rule=rule, n_queries=20, oracle=oracle, seed=0
        )
        adapter.adapt()
        inference = adapter.inference
        return inference.people_shares @ inference.people.mistakes

    exact = mistakes(ReturnOracle(**told))
    often = mistakes(MistakeOracle(0.25, seed=0, **told))
    assert exact < 0.02 < 0.05 < often  # 0.05 before the first answer


@pytest.mark.parametrize(
    ("question", "noise"), [("graded", "infer"), ("pair", "infer"), ("pair", MistakeNoise(0.1))]
)
def test_the_probability_of_an_answer_given_the_others(question, noise):
    """Of one that was left out in truth."""
    answers = [(LEFT, 0.7, -0.4), (RIGHT, 0.2, 0.9), (EQUAL, 0.1, 0.8)]
    if question == "graded":
        answers[0] = (MUCH_LEFT, *answers[0][1:])

    def told(answers):
        options = {"question": question, "noise_model": noise, "likelihood": "similarity"}
        inference = make(n_particles=40, **options)
        particles = crowd(inference, 1.88)
        for preference, *sides in answers:
            inference.tell(preference, *(np.full(5, side) for side in sides))
        np.testing.assert_array_equal(inference.particles, particles)
        return inference

    found = told(answers).agreements()
    for i, (preference, *sides) in enumerate(answers):
        others = told(answers[:i] + answers[i + 1 :])
        if preference is EQUAL:
            assert found[i, 0] == 1.0
            continue
        side = (RIGHT, MUCH_RIGHT) if preference is RIGHT else (LEFT, MUCH_LEFT)
        expected = 0.0
        for each in side if others.people is None else (*side, EQUAL):
            if each not in ANSWERS_OF[question]:
                continue
            more = told([*answers[:i], *answers[i + 1 :], (each, *sides)])
            expected += others.weights @ np.exp(more.log_weights - others.log_weights)
        assert found[i, 0] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("question", "seed", "wrong"), [("graded", 1, 3), ("pair", 2, 4)])
def test_what_the_other_answers_contradict_is_found_and_asked_again(question, seed, wrong):
    graded = question == "graded"
    env = SpeedEnv()
    oracle = ReturnOracle(env, thresholds=(20.0, 200.0) if graded else None)
    opposite = {LEFT: RIGHT, MUCH_LEFT: MUCH_RIGHT, RIGHT: LEFT, MUCH_RIGHT: MUCH_LEFT}
    for turned in (None, wrong):
        adapter = PreferenceAdapter(
            SpeedModel(), env, rule=Bayes(question=question, noise_model="infer"), seed=seed
        )
        assert adapter.contradicted is None
        for number in range(9):
            query = adapter.ask()
            answer = oracle(query.left, query.right)
            adapter.tell(opposite[answer] if number == turned else answer)
        assert adapter.contradicted == turned
    asked = adapter.answers[wrong]
    with pytest.raises(ValueError, match="from 0 to 8, but is 9"):
        adapter.ask_again(9)
    adapter.ask()
    again = adapter.ask_again(wrong)
    assert adapter.ask() is again
    np.testing.assert_array_equal(again.left.observations, asked.shown[0].observations)
    adapter.tell(oracle(again.left, again.right))
    assert adapter.contradicted is None
    kept = [adapter.answers[number].preference for number in (wrong, -1)]
    assert kept == [asked.preference, opposite[asked.preference]]  # the first stays
    with pytest.raises(RuntimeError, match="all 10 questions"):
        adapter.ask_again(wrong)


def test_fragments_of_one_policy_are_told_apart():
    """Their latents are the same, and what was asked about them is not asked twice."""
    oracle = ReturnOracle(SpeedEnv(), task=[1.5])
    source = PreferenceAdapter(SpeedModel(), SpeedEnv(), rule=Bayes(query_rule="random"), seed=3)
    source.adapt(oracle)
    seen = [item for answer in source.answers for item in answer.shown]
    library = [replace(item, latent=np.zeros(5)) for item in seen]
    rule = Bayes(noise_model="infer")
    adapter = PreferenceAdapter(SpeedModel(), SpeedEnv(), rule=rule, library=library, seed=0)
    for number in range(9):
        left, right = adapter.ask().shown
        adapter.tell(oracle(right, left) if number == 2 else oracle(left, right))
    assert adapter.contradicted == 2


def test_a_choice_that_the_others_contradict_is_found():
    env = SpeedEnv()
    oracle = ReturnOracle(env, question="best-of-four")
    for turned in (None, 3):
        rule = Bayes(question="best-of-four", noise_model="infer")
        adapter = PreferenceAdapter(SpeedModel(), env, rule=rule, seed=1)
        for number in range(8):
            shown = adapter.ask().shown
            worst = int(np.argmin([oracle.true_return(item) for item in shown]))
            wrong = ["first", "second", "third", "fourth"][worst]
            adapter.tell(wrong if number == turned else oracle(*shown))
        assert adapter.contradicted == turned
        agreements = adapter.inference.agreements()
        assert np.all((agreements >= 0) & (agreements <= 1))
