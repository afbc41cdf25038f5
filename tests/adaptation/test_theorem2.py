"""Theorem 2 of Xu & Zhu (2025), in the full form of its Theorem 3, on a family that satisfies the
assumptions.

The density of the candidates at the true latent is p(z*) / P_k as long as z* satisfies all answers,
where P_k is the prior's mass of the latents that do; and 0 otherwise. The theorem says P_k <= (1 -
c) / 2^k + c with c = sqrt(2 / pi) L_r log((1 + 2 epsilon) / (1 - 2 epsilon)).

The family: latents are N(0, I) in R^3; a policy is a point of the sphere of radius R (its
features); task z earns the inner product of a point with A z. So the best policy of task z is R A z
/ |A z|, which makes S(z, z') = <A z, R A z' / |A z'|> the return of that policy itself: Property 1
holds exactly, f_r is linear and bijective, and L_r = 1 / sigma_min(A). The proof's mild condition
is |f_pi(z') - f_pi(z'')| >= 1 for the pair asked; with R = 4 eq. 10's pairs have it.

The proof takes eq. 10's counts over N_z candidates for probabilities. They are estimates: the
better half by count holds up to about 1/2 + 1/sqrt(N_z) by mass (two standard deviations). The
bound is tested with that in place of 1/2.
"""

import numpy as np
import pytest

from sb3_poem.adaptation import paper as paper_module
from sb3_poem.adaptation.paper import Paper
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.rule import Setting

RADIUS = 4.0
N_CANDIDATES = 200
K = 6


class SphereModel:
    latent_dim = 3

    def __init__(self):
        rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
        self.matrix = rotation @ np.diag([3.0, 4.0, 5.0])
        self.lipschitz = 1.0 / 3.0  # of the inverse of f_r

    def reward_embedding(self, latents):
        return latents @ self.matrix.T

    def policy_embedding(self, latents):
        direction = self.reward_embedding(latents)
        return RADIUS * direction / np.linalg.norm(direction, axis=1, keepdims=True)

    def similarities(self, task, policy_latents):
        return self.reward_embedding(task) @ self.policy_embedding(policy_latents).T


def slack(epsilon):
    return np.log((1 + 2 * epsilon) / (1 - 2 * epsilon))


def surviving_mass(model, inference, epsilon, draws):
    """P_k by Monte Carlo: eq. 9 written out, independent of the code under test."""
    alive = np.ones(len(draws), dtype=bool)
    for answer in inference.answers:
        s = model.similarities(draws, np.stack(answer.shown))
        better, worse = (
            (s[:, 0], s[:, 1]) if answer.preference is Preference.LEFT else (s[:, 1], s[:, 0])
        )
        with np.errstate(over="ignore"):
            alive &= 1.0 / (1.0 + np.exp(worse - better)) >= 0.5 - epsilon
    return alive.mean()


def run(epsilon, seed):
    """Masses P_0 ... P_K, and whether the truth satisfied all answers, under the worst oracle
    within the tolerance.
    """
    model = SphereModel()
    rng = np.random.default_rng([seed, 1])
    truth, draws = rng.standard_normal((1, 3)), rng.standard_normal((30_000, 3))
    inference = Paper(N_CANDIDATES, epsilon).start(model, np.random.default_rng(seed), Setting())
    masses, alive, distances = [1.0], True, []
    for _ in range(K):
        left, right = inference.ask()
        difference = np.subtract(*model.similarities(truth, np.stack([left, right]))[0])
        # Assumption 2: it errs only where eq. 9 still holds for the truth. There it always errs.
        errs = abs(difference) <= slack(epsilon) * (1 - 1e-9)
        inference.tell(
            Preference.LEFT if (difference > 0) != errs else Preference.RIGHT, left, right
        )
        distances.append(
            np.linalg.norm(np.subtract(*model.policy_embedding(np.stack([left, right]))))
        )
        masses.append(surviving_mass(model, inference, epsilon, draws))
        alive &= inference.satisfied(truth)[0] == len(inference.answers)
    assert (
        epsilon == 0.0 or min(distances) >= 1.0
    )  # the proof's mild condition, on the width of the strip of tolerance
    return np.array(masses), alive


def bound(epsilon):
    """Theorem 3's bound on P_k for k = 0 ... K, with eq. 10's sampling error."""
    strip = SphereModel().lipschitz / np.sqrt(2 * np.pi) * slack(epsilon)
    masses = [1.0]
    for _ in range(K):
        masses.append((0.5 + 1 / np.sqrt(N_CANDIDATES)) * masses[-1] + strip)
    return np.array(masses)


@pytest.mark.parametrize("epsilon", [0.0, 0.05, 0.2])
def test_the_density_at_the_truth_grows_as_the_bound_says(epsilon):
    for seed in range(4):
        masses, alive = run(epsilon, seed)
        assert alive
        assert np.all(np.diff(masses) <= 0)  # monotonically
        assert np.all(masses <= bound(epsilon) + 3 * np.sqrt(masses / 30_000))
        if epsilon == 0.0:  # exponentially: 2^k, up to the sampling error
            assert masses[K] == pytest.approx(2.0**-K, rel=0.6)


def test_it_can_fail_with_the_sign_of_the_papers_proof(monkeypatch):
    """The appendix's inequality shrinks the half-spaces. Then the truth is thrown out, and its
    density is 0.
    """
    widening = paper_module.tolerance
    monkeypatch.setattr(paper_module, "tolerance", lambda epsilon: -widening(epsilon))
    assert not all(run(0.2, seed)[1] for seed in range(3))


def test_it_can_fail_with_random_questions():
    """The rate is eq. 10's doing: random pairs keep more than the bound allows."""
    model = SphereModel()
    draws = np.random.default_rng(5).standard_normal((20_000, 3))
    masses = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth = rng.standard_normal((1, 3))
        inference = Paper(N_CANDIDATES, 0.0, query_rule="random").start(model, rng, Setting())
        for _ in range(K):
            left, right = inference.ask()
            s = model.similarities(truth, np.stack([left, right]))[0]
            inference.tell(Preference.LEFT if s[0] > s[1] else Preference.RIGHT, left, right)
        masses.append(surviving_mass(model, inference, 0.0, draws))
    assert max(masses) > bound(0.0)[K]


def test_candidates_converge_to_the_truth():
    """Part (b), epsilon = 0: the directions of A z, which are all that answers can tell, close in
    on the truth's.
    """
    model = SphereModel()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = rng.standard_normal((1, 3))
        inference = Paper(100, 0.0).start(model, rng, Setting())
        angles = []
        for _ in range(11):
            left, right = inference.ask()
            cosine = (
                model.policy_embedding(inference.candidates)
                @ model.policy_embedding(truth)[0]
                / RADIUS**2
            )
            angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
            s = model.similarities(truth, np.stack([left, right]))[0]
            inference.tell(Preference.LEFT if s[0] > s[1] else Preference.RIGHT, left, right)
        assert angles[0] > 60
        assert angles[10] < 12
