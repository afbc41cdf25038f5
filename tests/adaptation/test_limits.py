"""The information limit against closed forms, brute force and another solver."""

import itertools

import numpy as np
import pytest
from scipy.optimize import brentq, minimize

from sb3_poem.adaptation import (
    AnswerLimits,
    BoltzmannNoise,
    ExactNoise,
    MistakeNoise,
    answer_capacity,
    best_codebook,
    information_limit,
    known_task_return,
    rate_distortion_limit,
)
from sb3_poem.adaptation.limits import best_intervals

N_GOALS = 480
GRID = (np.arange(N_GOALS) + 0.5) * 3 / N_GOALS
SPEEDS = -200 * np.abs(GRID[:, None] - GRID[None, :])


def value(returns, book):
    return returns[:, book].max(axis=1).mean()


def entropy(p):
    return 0.0 if p <= 0 or p >= 1 else -p * np.log2(p) - (1 - p) * np.log2(1 - p)


@pytest.mark.parametrize("seed", range(6))
def test_the_codebook_against_brute_force(seed, monkeypatch):
    returns = np.random.default_rng(seed).normal(size=(9, 11))
    best = {
        size: max(
            returns[:, book].max(axis=1).mean() for book in itertools.combinations(range(11), size)
        )
        for size in (1, 2, 4)
    }
    for size in (1, 2, 4):
        assert returns[:, best_codebook(returns, size)].max(axis=1).mean() == pytest.approx(
            best[size]
        )
        assert information_limit(returns, int(np.log2(size))) == pytest.approx(best[size])
    # The greedy choice with swaps alone: never better than the optimum, and hardly worse.
    monkeypatch.setattr("sb3_poem.adaptation.limits.EXACT_CODEBOOKS", 0)
    for size in (1, 2, 4):
        book = best_codebook(returns, size)
        assert len(set(book)) == size
        value = returns[:, book].max(axis=1).mean()
        assert best[size] - 0.1 <= value <= best[size] + 1e-12


def test_enough_policies_or_tasks_are_trivial():
    returns = np.random.default_rng(0).normal(size=(5, 40))
    assert information_limit(returns, 3) == pytest.approx(returns.max(axis=1).mean())
    for k in (200, *np.arange(40, 44)):
        found = information_limit(returns, k, n_answers=5)
        assert found == pytest.approx(returns.max(axis=1).mean())
    np.testing.assert_array_equal(best_codebook(returns, 99), np.arange(40))


@pytest.mark.parametrize("k", [0, 1, 2, 3, 5, 6])
def test_on_a_line_dynamic_programming_finds_the_closed_form(k):
    # On a grid the best speed for an interval of n goals is its median; its error is n / 4 cells,
    # less 1 / (4 n) if n is odd. 2^k does not always divide 480; then the best cut has intervals of
    # two lengths.
    short, longer = N_GOALS // 2**k, N_GOALS % 2**k
    lengths = np.full(2**k, short)
    lengths[:longer] += 1
    errors = sum(float(np.abs(np.arange(n) - n // 2).sum()) for n in lengths)
    limit = information_limit(SPEEDS, k, ordered=True)
    assert limit == pytest.approx(-200 * 3 / N_GOALS * errors / N_GOALS, rel=1e-9)
    assert limit == pytest.approx(-150 / 2**k, rel=1e-9 if longer == 0 and short % 2 == 0 else 1e-2)
    # The general solver on the same problem: never better, and hardly worse.
    general = information_limit(SPEEDS, k)
    assert 1.03 * limit <= general <= limit + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_dynamic_programming_against_brute_force_on_uneven_lines(seed):
    rng = np.random.default_rng(seed)
    goals, speeds = (
        np.sort(rng.uniform(0, 3, 14)),
        rng.uniform(0, 3, 11),
    )  # the policies need no order
    returns = -(
        np.abs(goals[:, None] - speeds[None, :]) ** rng.uniform(1.0, 2.0)
    )  # convex: two policies cross once
    for size in (1, 2, 3, 4):
        best = max(value(returns, book) for book in itertools.combinations(range(11), size))
        book = best_intervals(returns, size)
        assert len(book) <= size
        assert value(returns, book) == pytest.approx(best)


def test_an_order_that_means_nothing_does_no_harm(monkeypatch):
    monkeypatch.setattr("sb3_poem.adaptation.limits.EXACT_CODEBOOKS", 0)
    returns = np.random.default_rng(0).normal(size=(40, 30))
    for size in (2, 4, 8):
        book = best_codebook(returns, size, ordered=True)
        assert len(set(book)) == size
        assert value(returns, book) >= value(returns, best_codebook(returns, size))


@pytest.mark.parametrize("bits", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_rate_distortion_of_a_fair_coin(bits):
    # D(R) = h^-1(1 - R) (Cover & Thomas, theorem 10.3.1).
    error = brentq(lambda p: entropy(p) - (1 - bits), 0.0, 0.5)
    assert rate_distortion_limit(np.eye(2), bits) == pytest.approx(1 - error, abs=1e-4)


@pytest.mark.parametrize("bits", [0.3, 1.0, 1.7])
def test_rate_distortion_of_a_fair_die(bits):
    # Hamming distortion on m equally likely letters: R(D) = log m - h(D) - D log(m - 1).
    error = brentq(lambda p: np.log2(6) - entropy(p) - p * np.log2(5) - bits, 1e-12, 5 / 6)
    assert rate_distortion_limit(7 * np.eye(6) - 3, bits) == pytest.approx(
        7 * (1 - error) - 3, abs=1e-3
    )


def test_rate_distortion_against_another_solver():
    returns = np.random.default_rng(3).normal(size=(4, 3))

    def information(p):
        p = p.reshape(4, 3)
        return float(
            (p * np.log2(np.maximum(p, 1e-300) / np.maximum(p.mean(axis=0), 1e-300))).sum() / 4
        )

    for bits in (0.2, 0.6):
        found = minimize(
            lambda p: -(p.reshape(4, 3) * returns).sum() / 4,
            np.full(12, 1 / 3) + 0.01 * np.random.default_rng(0).normal(size=12),
            bounds=[(1e-9, 1)] * 12,
            constraints=[
                {"type": "eq", "fun": lambda p: p.reshape(4, 3).sum(axis=1) - 1},
                {"type": "ineq", "fun": lambda p, bits=bits: bits - information(p)},
            ],
            method="SLSQP",
            options={"maxiter": 500},
        )
        assert found.success
        assert rate_distortion_limit(returns, bits) == pytest.approx(-found.fun, abs=2e-3)


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_rate_distortion_on_a_line_lies_between_shannon_and_the_codebook(bits):
    # Shannon's lower bound for absolute error: h(X) - log2(2 e D) <= R; and 2^R policies are one
    # way to use R bits.
    bound = rate_distortion_limit(SPEEDS[::4, ::4], bits)
    assert -150 / 2**bits < bound < -200 * 3 / (2 * np.e) / 2**bits + 1.0


def test_the_information_in_answers():
    assert answer_capacity(None, 1.0) == answer_capacity(ExactNoise(), 1.0) == 1.0
    assert answer_capacity(MistakeNoise(0.2), 1.0) == pytest.approx(1 - entropy(0.2))
    assert answer_capacity(MistakeNoise(0.5), 1.0) == 0.0
    assert answer_capacity(BoltzmannNoise(), 1.0) == pytest.approx(1 - entropy(1 / (1 + np.e)))
    assert answer_capacity(BoltzmannNoise(0.5), 3.0) == pytest.approx(
        1 - entropy(1 / (1 + np.exp(1.5)))
    )
    # No inputs in between carry more: the capacity of all probabilities in the range, found by
    # brute force over two inputs.
    left = np.linspace(0.2, 0.8, 31)
    mixed = [
        entropy(w * p + (1 - w) * q) - w * entropy(p) - (1 - w) * entropy(q)
        for p, q, w in itertools.product(left, left, np.linspace(0, 1, 21))
    ]
    assert max(mixed) == pytest.approx(answer_capacity(MistakeNoise(0.2), 1.0), abs=1e-9)


def test_noise_lowers_the_limit():
    returns = SPEEDS[::8, ::8]
    for k in (1, 3, 5):
        exact, rare, often, none = (
            information_limit(returns, k, noise_model=noise)
            for noise in (None, MistakeNoise(0.01), MistakeNoise(0.2), MistakeNoise(0.5))
        )
        assert exact >= rare > often > none
        assert none == pytest.approx(returns.mean(axis=0).max())
        assert information_limit(returns, k, noise_model=ExactNoise()) == exact


def test_majority_votes_stay_below_the_noisy_limit():
    # Two tasks, one question asked three times: what the vote earns is what a method can reach.
    for rate in (0.05, 0.2, 0.4):
        right = (1 - rate) ** 3 + 3 * rate * (1 - rate) ** 2
        assert right < information_limit(np.eye(2), 3, noise_model=MistakeNoise(rate)) + 1e-9


def test_more_kinds_of_answers_raise_the_limit():
    returns = SPEEDS[::8, ::8]
    assert answer_capacity(None, 1.0, 5) == pytest.approx(np.log2(5))
    assert answer_capacity(MistakeNoise(0.0), 1.0, 5) == pytest.approx(np.log2(5))
    # Always random between opposites: the size alone is told, of three.
    assert answer_capacity(MistakeNoise(0.5), 1.0, 5) == pytest.approx(np.log2(3))
    best = returns[:, best_codebook(returns, 5, ordered=True)].max(axis=1).mean()
    assert information_limit(returns, 1, n_answers=5, ordered=True) == pytest.approx(best)
    for noise in (None, MistakeNoise(0.2), BoltzmannNoise()):
        limits = [information_limit(returns, 2, noise_model=noise, n_answers=n) for n in (2, 3, 5)]
        assert limits == sorted(limits)
        assert limits[0] < limits[2]
    with pytest.raises(ValueError, match="`n_answers` must be at least 2"):
        answer_capacity(None, 1.0, 1)


@pytest.mark.parametrize("beta", [0.02, 0.2])
def test_boltzmann_grades_tell_no_more_than_their_bound(beta):
    bound = answer_capacity(BoltzmannNoise(beta), 30.0, 5)
    assert bound >= answer_capacity(BoltzmannNoise(beta), 30.0)
    inputs = np.linspace(-30, 30, 7)
    for equal, much in ((5.0, 15.0), (10.0, 25.0)):
        cuts = np.array([-much, -equal, equal, much])
        above = 1 / (1 + np.exp(beta * (cuts - inputs[:, None])))
        ends = np.ones((7, 1)), np.zeros((7, 1))
        channel = -np.diff(np.hstack([ends[0], above, ends[1]]), axis=1)
        for shares in (np.full(7, 1 / 7), np.array([0.35, 0, 0, 0.3, 0, 0, 0.35])):
            marginal = shares @ channel
            told = shares @ np.sum(channel * np.log2(channel / marginal), axis=1)
            assert told < bound < np.log2(5)


def test_the_best_of_four_tells_up_to_two_bits():
    assert answer_capacity(None, 1.0, 4) == 2.0
    assert answer_capacity(MistakeNoise(0.0), 1.0, 4) == pytest.approx(2.0)
    rng = np.random.default_rng(0)
    for noise, exponent in ((BoltzmannNoise(0.1), 3.0), (BoltzmannNoise(), 2.0)):
        bound, most = answer_capacity(noise, 30.0, 4), 0.0
        for _ in range(300):  # inputs in any permutation, as a symmetric channel has them
            values = exponent * rng.integers(0, 2, size=4) if rng.random() < 0.5 else None
            values = exponent * rng.random(4) if values is None else values
            p = np.exp(values) / np.exp(values).sum()
            most = max(most, 2 + np.sum(p * np.log2(p)))
        assert most <= bound + 1e-12
        assert most == pytest.approx(bound, abs=1e-9)
    # A mistake is any other one: three equally probable ones at 0.75 tell nothing.
    p = np.array([0.8, *[0.2 / 3] * 3])
    told = 2 + np.sum(p * np.log2(p))
    assert answer_capacity(MistakeNoise(0.2), 1.0, 4) == pytest.approx(told)
    returns = SPEEDS[::8, ::8]
    best = returns[:, best_codebook(returns, 4, ordered=True)].max(axis=1).mean()
    assert information_limit(returns, 1, n_answers=4, ordered=True) == pytest.approx(best)
    noisy = information_limit(returns, 2, n_answers=4, noise_model=MistakeNoise(0.2))
    assert noisy < information_limit(returns, 2, n_answers=4)


def test_fair_limits_do_not_profit_from_luck():
    """Policies that are all alike: what they earned was luck, and a limit by it would lie above."""
    rng = np.random.default_rng(0)
    others, chosen, fresh = (rng.normal(size=(n, 60)) for n in (200, 100, 100))
    limits = AnswerLimits.measure(others, chosen, fresh)
    assert information_limit(chosen, 5) > 1.5
    assert len(limits.codebooks) == 7
    for k in (0, 1, 5, 10):
        for noise in (None, MistakeNoise(0.1)):
            assert abs(limits.after(k, noise)) < 0.35  # 100 tasks: the standard error is 0.1


def test_limits_of_exact_answers_alone():
    others, returns = np.random.default_rng(0).normal(size=(2, 12, 9))
    full = AnswerLimits.measure(others, returns, returns)
    exact = AnswerLimits.measure(others, returns, returns, erring=False)
    for n in (2, 4, 5):
        assert [exact.after(k, None, n) for k in range(4)] == [
            full.after(k, None, n) for k in range(4)
        ]
    with pytest.raises(ValueError, match="errors were not measured: limits=True does"):
        exact.after(1, MistakeNoise(0.2))


def test_fair_limits_on_a_line():
    """Without luck, and with other tasks as dense as these, they are the plain ones."""
    returns, others = SPEEDS[4::8, ::8], SPEEDS[::8, ::8]
    limits = AnswerLimits.measure(others, returns, returns, ordered=True)
    for k in range(4):
        assert limits.after(k) == pytest.approx(-150 / 2**k, rel=0.06)
    for k in (1, 3):
        noisy = limits.after(k, MistakeNoise(0.1))
        bound = rate_distortion_limit(returns, k * answer_capacity(MistakeNoise(0.1), 1.0))
        assert noisy == pytest.approx(bound, abs=4.0)
        assert limits.after(0) < noisy < limits.after(k)
    assert limits.after(1) < limits.after(1, n_answers=3) < limits.after(2)
    assert limits.after(1, n_answers=4) == limits.after(2)
    with pytest.raises(ValueError, match="`k` must be at least 0"):
        limits.after(-1)


class OtherNoise:
    pass


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: information_limit(np.zeros((2, 2)), -1), "`k` must be at least 0"),
        (lambda: information_limit(np.zeros(3), 1), "neither 0, but has shape"),
        (lambda: information_limit(np.full((2, 2), np.nan), 1), "`returns` must be finite"),
        (
            lambda: information_limit(np.zeros((2, 2)), 1, noise_model=OtherNoise()),
            "`noise_model` must be .* OtherNoise",
        ),
        (lambda: best_codebook(np.zeros((2, 2)), 0), "`size` must be at least 1"),
        (lambda: rate_distortion_limit(np.zeros((2, 2)), -0.1), "`bits` must be at least 0"),
        (lambda: rate_distortion_limit([[0.0, np.nan]], 0.5), "`returns` must be finite"),
        *(
            (lambda bad=bad: AnswerLimits.measure(*bad), "`returns` must be finite")
            for bad in np.where(np.eye(3)[:, :, None, None], np.nan, np.zeros((2, 2)))
        ),
    ],
)
def test_bad_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_finite_family_s_limit_is_chosen_on_all_of_its_tasks() -> None:
    env_id = "poem/HalfCheetahFwdBack-v0"
    known = known_task_return("HalfCheetahFwdBack", env_id, 2, n_latents=6, n_episodes=1)
    assert known.limit(0) < known.limit(1) - 500  # one policy for both ways, or one for each
