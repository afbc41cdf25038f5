"""Oracles: true returns from reward features, and errors at the rates that they claim."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import HORIZON, SpeedEnv, SpeedModel

from sb3_poem.adaptation import (
    Bayes,
    BoltzmannNoise,
    BoltzmannOracle,
    ExactNoise,
    HumanOracle,
    MistakeNoise,
    MistakeOracle,
    Preference,
    PreferenceAdapter,
    ReturnOracle,
)
from sb3_poem.adaptation.oracles import PROMPTS
from sb3_poem.adaptation.rule import inference_rng
from sb3_poem.common.trajectory import Trajectory

LEFT, RIGHT, EQUAL = Preference.LEFT, Preference.RIGHT, Preference.EQUAL


def at_speed(speed, steps=HORIZON, frames=None):
    features = np.full((steps, 1), float(speed))
    return Trajectory(np.zeros((steps + 1, 2)), np.zeros((steps, 1)), np.zeros(5), features, frames)


def env_with_goal(goal):
    env = SpeedEnv()
    env.set_task(np.array([goal]))
    env.reset()
    return env


def test_the_larger_return_wins_and_equal_returns_are_equal():
    oracle = ReturnOracle(env_with_goal(2.0))
    assert oracle(at_speed(1.9), at_speed(1.0)) is LEFT
    assert oracle(at_speed(2.9), at_speed(1.5)) is RIGHT
    assert oracle(at_speed(1.5), at_speed(2.5)) is EQUAL
    assert oracle.true_return(at_speed(1.5)) == pytest.approx(-100.0)  # 20 steps of -10 * 0.5
    # An early end is the sum up to it: here fewer steps cost less.
    assert oracle(at_speed(1.5, steps=5), at_speed(1.6)) is LEFT
    assert oracle.noise_model == ExactNoise()


def test_the_task_is_given_or_the_one_in_effect():
    env = env_with_goal(0.5)
    assert ReturnOracle(env)(at_speed(0.4), at_speed(2.0)) is LEFT
    assert ReturnOracle(env, task=[2.1])(at_speed(0.4), at_speed(2.0)) is RIGHT
    vec_env = DummyVecEnv([lambda: env])
    assert ReturnOracle().bind(vec_env)(at_speed(0.4), at_speed(2.0)) is LEFT
    assert ReturnOracle(task=[2.1]).bind(vec_env)(at_speed(0.4), at_speed(2.0)) is RIGHT


def test_mistakes_come_at_their_rate():
    oracle = MistakeOracle(0.2, env_with_goal(2.0), seed=0)
    wrong = sum(oracle(at_speed(1.9), at_speed(1.0)) is RIGHT for _ in range(4000))
    assert wrong / 4000 == pytest.approx(0.2, abs=0.025)
    assert oracle(at_speed(1.5), at_speed(2.5)) is EQUAL
    assert oracle.noise_model == MistakeNoise(0.2)
    assert MistakeOracle(1.0, env_with_goal(2.0))(at_speed(1.9), at_speed(1.0)) is RIGHT
    assert MistakeOracle(1.0).noise_model == MistakeNoise(0.5)
    with pytest.raises(ValueError, match="`rate` must be at most"):
        MistakeOracle(1.5)


@pytest.mark.parametrize(
    ("beta", "expected"),
    [(None, 1 / (1 + np.exp(-60 / 100))), (0.02, 1 / (1 + np.exp(-0.02 * 60)))],
)
def test_boltzmann_answers_come_at_their_rate(beta, expected):
    # Returns -20 and -80: C.6's beta is 1 / 100.
    oracle = BoltzmannOracle(beta, env_with_goal(2.0), seed=0)
    lefts = sum(oracle(at_speed(1.9), at_speed(1.6)) is LEFT for _ in range(4000))
    assert lefts / 4000 == pytest.approx(expected, abs=0.025)
    assert oracle.noise_model == BoltzmannNoise(beta)


def test_boltzmann_with_two_returns_of_zero():
    answers = {
        BoltzmannOracle(None, env_with_goal(2.0), seed=seed)(at_speed(2.0), at_speed(2.0))
        for seed in range(20)
    }
    assert answers == {LEFT, RIGHT}


@pytest.mark.parametrize("kind", [ReturnOracle, partial(MistakeOracle, 0.0)])
def test_graded_answers_follow_the_thresholds(kind):
    # At goal 2 a step's return is -10 |speed - 2|, of 20 steps.
    oracle = kind(env=env_with_goal(2.0), thresholds=(10.0, 100.0), seed=0)
    assert oracle.question == "graded"
    speeds = [1.0, 1.6, 1.96, 2.0]  # 200, 80 and 8 less than the last
    much, better, equal, _ = (oracle(at_speed(2.0), at_speed(speed)) for speed in speeds)
    assert (much, better, equal) == (Preference.MUCH_LEFT, LEFT, EQUAL)
    assert oracle(at_speed(1.0), at_speed(2.0)) is Preference.MUCH_RIGHT
    assert oracle(at_speed(1.6), at_speed(2.0)) is RIGHT
    assert ReturnOracle().question == "pair"


def test_graded_answers_with_mistakes_and_doubts():
    env, near, far = env_with_goal(2.0), at_speed(1.9), at_speed(1.0)  # -20 and -200
    always = MistakeOracle(1.0, env, thresholds=(10.0, 100.0))
    assert always(near, far) is Preference.MUCH_RIGHT
    unsure = BoltzmannOracle(0.02, env, seed=0, thresholds=(10.0, 100.0))
    answers = [unsure(near, far) for _ in range(4000)]
    much = 1 / (1 + np.exp(-0.02 * (180 - 100)))
    assert answers.count(Preference.MUCH_LEFT) / 4000 == pytest.approx(much, abs=0.025)
    equal = 1 / (1 + np.exp(-0.02 * (180 + 10))) - 1 / (1 + np.exp(-0.02 * (180 - 10)))
    assert answers.count(EQUAL) / 4000 == pytest.approx(equal, abs=0.01)


@pytest.mark.parametrize(
    "thresholds", [(20.0, 10.0), (-1.0, 10.0), (1.0, np.inf), (0.0, np.nan), (1.0,), 5.0]
)
def test_bad_thresholds(thresholds):
    with pytest.raises(ValueError, match="`thresholds` must be two finite differences"):
        ReturnOracle(thresholds=thresholds)


@pytest.mark.parametrize("kind", [partial(MistakeOracle, 0.4), BoltzmannOracle])
def test_noise_follows_the_seed(kind):
    def answers(seed):
        oracle = kind(env=env_with_goal(2.0), seed=seed)
        return [oracle(at_speed(1.9), at_speed(1.6)) for _ in range(40)]

    assert answers(1) == answers(1)
    assert answers(1) != answers(2)


def test_what_an_oracle_needs():
    blind = Trajectory(np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(5))
    with pytest.raises(
        ValueError, match="computed from reward features, but the trajectory has none"
    ):
        ReturnOracle(env_with_goal(1.0))(blind, blind)
    with pytest.raises(RuntimeError, match="has no environment"):
        ReturnOracle()(at_speed(1.0), at_speed(2.0))
    with pytest.raises(ValueError, match="no task family"):
        ReturnOracle(gym.make("CartPole-v1"), task=[1.0])(at_speed(1.0), at_speed(2.0))
    with pytest.raises(ValueError, match="return of a trajectory is nan"):
        ReturnOracle(env_with_goal(1.0))(at_speed(np.nan), at_speed(2.0))


class Terminal:
    def __init__(self, *lines):
        self.lines, self.shown, self.prompts = list(lines), [], []

    def read(self, prompt):
        self.prompts.append(prompt)
        if not self.lines:
            raise EOFError
        return self.lines.pop(0)


def frames(n, brightness, shape=(24, 32, 3)):
    return [np.full(shape, brightness, np.uint8) for _ in range(n)]


@pytest.mark.parametrize("video_format", ["gif", "mp4"])
def test_a_person_sees_both_side_by_side(tmp_path, video_format):
    import imageio.v3 as imageio

    terminal = Terminal("both?", "", " R ", "can't tell")
    oracle = HumanOracle(
        tmp_path / "videos", video_format, read=terminal.read, write=terminal.shown.append
    )
    left, right = at_speed(1.0, 4, frames(4, 30)), at_speed(2.0, 6, frames(6, 220))
    assert oracle(left, right) is RIGHT
    assert terminal.prompts == [PROMPTS["pair"]] * 3
    assert "'both?' is no answer" in terminal.shown[1]
    assert oracle(left, right) is EQUAL
    files = sorted(path.name for path in (tmp_path / "videos").iterdir())
    assert files == [f"query-001.{video_format}", f"query-002.{video_format}"]
    assert str(tmp_path / "videos" / files[0]) in terminal.shown[0]
    video = imageio.imread(tmp_path / "videos" / files[0])
    bottom = np.asarray(video[-1])[
        -6
    ]  # a row well below the captions, where left is dark and right is bright
    width = bottom.shape[0]
    assert bottom[: width // 2 - 8].mean() < 60
    assert bottom[width // 2 + 8 :].mean() > 190


def test_a_person_through_the_adapter(tmp_path):
    terminal = Terminal("l", "left", "1")
    oracle = HumanOracle(tmp_path, read=terminal.read, write=terminal.shown.append)
    adapter = PreferenceAdapter(
        SpeedModel(), SpeedEnv(render_mode="rgb_array"), n_queries=3, oracle=oracle, seed=0
    )
    query = adapter.ask()
    assert len(query.left.frames) == HORIZON
    # A question that comes from a file is rendered again, from its seed.
    resumed = PreferenceAdapter.from_json(
        adapter.to_json(), SpeedModel(), SpeedEnv(render_mode="rgb_array"), oracle=oracle
    )
    assert resumed.pending.left.frames is None
    again = resumed.ask()
    np.testing.assert_array_equal(again.left.frames, query.left.frames)
    np.testing.assert_array_equal(again.left.observations, query.left.observations)
    adapter.adapt()
    assert [a.preference for a in adapter.answers] == [LEFT] * 3
    assert adapter.rule.noise_model == "infer"
    told = HumanOracle(tmp_path, mistake_rate=0.1)
    assert Bayes().answered_by(told).noise_model == MistakeNoise(0.1)


def test_a_person_says_how_much_better(tmp_path):
    terminal = Terminal("1", "2", "3", "4", "5", "ll", "much right", "e", "6", "L")
    shown = []
    oracle = HumanOracle(tmp_path, read=terminal.read, write=shown.append, question="graded")
    left, right = at_speed(1.0, 2, frames(2, 30)), at_speed(2.0, 2, frames(2, 220))
    words = [oracle(left, right).value for _ in range(9)]
    five = ["much left", "left", "equal", "right", "much right"]
    assert words == [*five, "much left", "much right", "equal", "left"]
    assert "'6' is no answer." in shown
    assert set(terminal.prompts) == {PROMPTS["graded"]}
    with pytest.raises(ValueError, match="`question` must be one of"):
        HumanOracle(tmp_path, question="numbers")


FOUR = [Preference.FIRST, Preference.SECOND, Preference.THIRD, Preference.FOURTH]


def test_the_best_of_four_wins_at_the_rates_that_are_claimed():
    env, speeds = env_with_goal(2.0), (1.0, 1.9, 2.3, 2.8)
    shown, how = [at_speed(speed) for speed in speeds], {"question": "best-of-four"}
    exact = ReturnOracle(env, **how)
    assert exact(*shown) is Preference.SECOND
    assert exact(*shown[::-1]) is Preference.THIRD
    assert exact(at_speed(1.9), at_speed(1.0), at_speed(2.1), at_speed(0.0)) is EQUAL
    assert ReturnOracle(env, thresholds=(41, 50), **how)(*shown) is EQUAL  # 20 against 60
    assert ReturnOracle(env, thresholds=(39, 50), **how)(*shown) is Preference.SECOND
    mistaken = MistakeOracle(0.3, env, seed=0, **how)
    said = [mistaken(*shown) for _ in range(1500)]
    counts = np.array([said.count(each) for each in FOUR]) / 1500
    np.testing.assert_allclose(counts, [0.1, 0.7, 0.1, 0.1], atol=0.03)
    returns = -200.0 * np.abs(np.array(speeds) - 2.0)
    for beta in (None, 0.01):
        noisy = BoltzmannOracle(beta, env, seed=0, **how)
        said = [noisy(*shown) for _ in range(1500)]
        counts = np.array([said.count(each) for each in FOUR]) / 1500
        odds = np.exp((beta or 1 / (2 * np.abs(returns).mean())) * returns)
        np.testing.assert_allclose(counts, odds / odds.sum(), atol=0.04)
    with pytest.raises(ValueError, match=r"about 4 trajectories, but 2 .* oracle\(\*query.shown\)"):
        exact(*shown[:2])
    with pytest.raises(ValueError, match="a pair question is about 2 trajectories, but 4"):
        ReturnOracle(env)(*shown)
    with pytest.raises(ValueError, match=r"`question` must be None, .pair. .* but is 'graded'"):
        ReturnOracle(env, question="graded")


def test_a_person_sees_four_in_two_rows(tmp_path):
    import imageio.v3 as imageio

    terminal = Terminal("1", "2", "3", "4", "0", "e", "fourth", "l", "third")
    lines = []
    oracle = HumanOracle(
        tmp_path, "gif", read=terminal.read, write=lines.append, question="best-of-four"
    )
    shown = [at_speed(1.0, n, [frames(1, 60 * i)[0] for i in range(n)]) for n in (2, 3, 2, 1)]
    words = [oracle(*shown).value for _ in range(8)]
    assert words == ["first", "second", "third", "fourth", "equal", "equal", "fourth", "third"]
    assert "'l' is no answer." in lines
    assert set(terminal.prompts) == {PROMPTS["best-of-four"]}
    film = imageio.imread(tmp_path / "query-001.gif")
    one = shown[0].frames[0].shape
    assert len(film) == 3
    assert film[0].shape[0] > 2 * one[0]
    assert film[0].shape[1] >= 2 * one[1]
    with pytest.raises(ValueError, match="a best-of-four question is about 4"):
        oracle(*shown[:2])


def test_a_persons_terminal_and_frames_are_needed(tmp_path):
    with pytest.raises(ValueError, match="no frames to show"):
        HumanOracle(tmp_path)(at_speed(1.0), at_speed(2.0))
    closed = HumanOracle(tmp_path, read=Terminal().read, write=lambda line: None)
    with pytest.raises(EOFError, match="standard input is closed"):
        closed(at_speed(1.0, 2, frames(2, 0)), at_speed(1.0, 2, frames(2, 9)))
    with pytest.raises(ValueError, match=r"`video_format` must be one of .*, but is 'avi'"):
        HumanOracle(tmp_path, "avi")
    with pytest.raises(ValueError, match=r"`mistake_rate` must be at most 0.5, but is 0.7"):
        HumanOracle(tmp_path, mistake_rate=0.7)
    with pytest.raises(ValueError, match="render_mode"):
        PreferenceAdapter(SpeedModel(), SpeedEnv(), oracle=HumanOracle(tmp_path)).ask()


def test_an_oracle_and_an_adaptation_of_one_seed_draw_from_different_streams():
    for seed in (0, 7):
        of_oracle, of_inference = (
            MistakeOracle(seed=seed).rng.random(4),
            inference_rng(seed).random(4),
        )
        assert not np.isclose(of_oracle, of_inference).any()
        assert np.array_equal(of_oracle, BoltzmannOracle(seed=seed).rng.random(4))
