"""Whatever the oracle says, every step is bounded and a usable policy comes out."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from worlds import HORIZON, SpeedEnv, SpeedModel

from sb3_poem import Bayes, Paper
from sb3_poem.adaptation import (
    BoltzmannNoise,
    ExactNoise,
    MistakeNoise,
    Preference,
    PreferenceAdapter,
)
from sb3_poem.adaptation.bayes import DECODER_MOVE_STEPS, SPREAD_LATENTS
from sb3_poem.adaptation.preference import ANSWERS, PLACES
from sb3_poem.adaptation.rule import Setting
from sb3_poem.common.trajectory import Trajectory

LEFT, RIGHT, EQUAL = Preference.LEFT, Preference.RIGHT, Preference.EQUAL


class RandomModel(SpeedModel):
    """Random networks: S is asymmetric, of any scale, and keeps no property; the decoder has
    nothing to do with it. It counts its work.
    """

    def __init__(self, seed: int, latent_dim: int = 5, scale: float = 3.0):
        super().__init__(latent_dim=latent_dim)
        rng = np.random.default_rng(seed)
        self.weights = [rng.normal(size=(latent_dim, 16)) for _ in range(2)]
        self.scale = scale
        self.similarity_rows = self.decoder_steps = 0

    def similarities(self, task, policy_latents):
        self.similarity_rows += len(task) + len(policy_latents)
        embeddings = [
            np.tanh(z @ w) for z, w in zip((task, policy_latents), self.weights, strict=True)
        ]
        return self.scale * embeddings[0] @ embeddings[1].T

    def predicted_returns(self, latents, trajectories, max_steps=None):
        steps = [
            len(trajectory) if max_steps is None else min(len(trajectory), max_steps)
            for trajectory in trajectories
        ]
        self.decoder_steps += len(latents) * sum(steps)
        features = np.stack(
            [np.tanh(t.observations[:-1].sum(axis=0) + t.latent[:2]) for t in trajectories]
        )
        return 10.0 * np.tanh(latents @ self.weights[0][:, :2]) @ features.T


def liar(left, right):
    difference = (
        np.abs(left.observations[1:, 1] - 2.2).sum() - np.abs(right.observations[1:, 1] - 2.2).sum()
    )
    return LEFT if difference > 0 else RIGHT


class Contradicts:
    """Left, right, left, right, ..."""

    def __init__(self):
        self.said = RIGHT

    def __call__(self, left, right):
        self.said = LEFT if self.said is RIGHT else RIGHT
        return self.said


rules = st.sampled_from(
    [
        Paper(),
        Paper(epsilon=0.0),
        Paper(query_rule="information-gain", candidates="aggregate"),
        Bayes(),
        Bayes(likelihood="similarity"),
        Bayes(question="graded"),
        Bayes(question="graded", noise_model="infer", likelihood="similarity"),
        Bayes(question="best-of-four"),
        Bayes(question="best-of-four", noise_model="infer", likelihood="similarity"),
        Bayes(candidates="aggregate", query_rule="worst-case"),
        Bayes(candidates="aggregate", likelihood="similarity", decision="posterior-mean"),
        Bayes(query_rule="random", decision="most-likely"),
    ]
)


@given(
    answers=st.lists(st.integers(0, 4), min_size=1, max_size=12),
    rule=rules,
    noise=st.sampled_from([ExactNoise(), MistakeNoise(0.2), BoltzmannNoise()]),
    seed=st.integers(0, 2**31 - 1),
    dim=st.sampled_from([1, 5, 32]),
    scale=st.sampled_from([1e-6, 3.0, 1e6]),
)
@example([0, 0, 1], Bayes(question="graded"), BoltzmannNoise(), 0, 5, 1e-6)
@settings(max_examples=30, suppress_health_check=list(HealthCheck))
def test_any_answers_end_in_a_finite_latent_with_bounded_work(
    answers, rule, noise, seed, dim, scale
):
    model = RandomModel(seed, dim, scale)
    rule = rule.answered_by(SimpleNamespace(noise_model=noise))
    inference = rule.start(model, np.random.default_rng(seed), Setting())
    n_candidates = rule.n_candidates if isinstance(rule, Paper) else rule.n_particles
    kinds = ANSWERS["graded" if rule.question == "pair" else rule.question]
    for number, answer in enumerate(answers, 1):
        model.similarity_rows = model.decoder_steps = 0
        asked = inference.ask()
        assert len({latent.tobytes() for latent in asked}) == len(PLACES[rule.question])
        shown = [Trajectory(np.ones((6, 2)), np.zeros((5, 1)), z) for z in asked]
        inference.tell(kinds[answer], *shown)
        latent = inference.estimate()
        assert latent.shape == (dim,)
        assert np.all(np.isfinite(latent))
        # Bounded whatever the answers are, and in the number of answers at most linear.
        assert model.similarity_rows <= 40_000 + 200 * number
        decoded = 5 * len(shown)
        # The spread of returns where S does not tell it, once and in each evaluation of a move
        spread = 5 * SPREAD_LATENTS * decoded * number if rule.question != "pair" else 0
        assert model.decoder_steps <= decoded * n_candidates + DECODER_MOVE_STEPS + spread


@pytest.mark.parametrize(
    ("rule", "oracle"),
    [
        (Bayes(), liar),
        (Bayes(likelihood="similarity"), Contradicts()),
        (Paper(), Contradicts()),
    ],
)
def test_a_usable_policy_comes_out(rule, oracle):
    env = SpeedEnv()
    adapter = PreferenceAdapter(SpeedModel(), env, seed=0, oracle=oracle, rule=rule)
    policy = adapter.adapt()
    assert adapter.done
    actions, _ = policy.predict(np.zeros((3, 2)))
    assert env.action_space.contains(actions[0])


@pytest.mark.parametrize(
    "rule",
    [
        Bayes(),
        Bayes(likelihood="similarity"),
        Paper(epsilon=0.0),
    ],
    ids=["decoder", "similarity", "paper"],
)
@pytest.mark.parametrize("preference", [LEFT, EQUAL])
def test_ask_and_tell_take_less_than_50_ms(rule, preference):
    """At N_z = 100, d = 5, k = 10, apart from rollouts; in processor time, as other programs share
    the machine.
    """
    model = RandomModel(0)
    for seed in range(5):  # the fastest counts
        inference = rule.start(model, np.random.default_rng(seed), Setting())
        slowest = 0.0
        for _ in range(10):
            start = time.process_time()
            left, right = inference.ask()
            asked = time.process_time()
            shown = [
                Trajectory(np.ones((HORIZON + 1, 2)), np.zeros((HORIZON, 1)), z)
                for z in (left, right)
            ]
            shown_at = time.process_time()
            inference.tell(preference, *shown)
            inference.estimate()
            slowest = max(slowest, asked - start, time.process_time() - shown_at)
        if slowest < 0.05:
            return
    pytest.fail(f"{slowest} s in the last of five runs")
