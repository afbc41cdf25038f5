"""Ask and tell: the protocol, and what it may see."""

import re
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
from adapters import GOAL, RULES, SMALL, adapter, answer, make_env, outside_oracle
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import Blinded, SpeedModel

from sb3_poem import Bayes, Paper
from sb3_poem.adaptation import (
    AdaptedPolicy,
    BoltzmannOracle,
    HumanOracle,
    Inference,
    MistakeNoise,
    MistakeOracle,
    Preference,
    PreferenceAdapter,
    ReturnOracle,
    Rule,
    adapt_tasks,
    evaluate_adaptation,
    evaluate_episodes,
    known_task_return,
    named_rule,
)
from sb3_poem.adaptation.rule import Answer
from sb3_poem.common.vec_env import make_task_vec_env


@pytest.mark.parametrize("rule", RULES)
def test_ten_answers_find_the_goal(rule):
    a = adapter(rule=rule)
    while not a.done:
        query = a.ask()
        assert all(item.frames is None for item in query.shown)
        # common random numbers: all start alike
        assert len({item.observations[0].tobytes() for item in query.shown}) == 1
        a.tell(outside_oracle(*query.shown))
    policy = a.policy()
    assert SpeedModel.speed(policy.latent) == pytest.approx(GOAL[0], abs=0.3)
    assert a.n_answers == 10


def test_the_policy_follows_sb3s_protocol():
    env = make_env()
    policy = PreferenceAdapter(SpeedModel(), env, oracle=ReturnOracle(), seed=1).adapt()
    speed = SpeedModel.speed(policy.latent)
    mean, _ = evaluate_policy(policy, env, n_eval_episodes=3, warn=False)
    assert mean == pytest.approx(-200 * abs(speed - GOAL[0]), abs=1e-3)
    mean, _ = evaluate_policy(policy, DummyVecEnv([make_env] * 2), n_eval_episodes=3, warn=False)
    assert mean == pytest.approx(-200 * abs(speed - GOAL[0]), abs=1e-3)
    single, _ = policy.predict(np.zeros(2))
    batch, state = policy.predict(
        np.zeros((4, 2)), state=None, episode_start=np.ones(4, bool), deterministic=True
    )
    assert single.shape == (1,)
    assert batch.shape == (4, 1)
    assert state.shape == (4, 5)


@pytest.mark.parametrize("rule", RULES)
def test_it_never_reads_rewards(rule):
    """NaN rewards and no reward features, with an oracle outside: the same policy, bit for bit."""
    seeing, blind = adapter(rule=rule), adapter(Blinded(make_env()), rule=rule)
    for a in (seeing, blind):
        answer(a, 3)
    assert blind.answers[0].shown[0].reward_features is None
    np.testing.assert_array_equal(seeing.policy().latent, blind.policy().latent)


def test_it_neither_reads_nor_sets_the_task():
    class Guarded(gym.Wrapper):
        """The task must not be touched, and a reset with a seed would draw another one."""

        def set_task(self, task):
            raise AssertionError("the task was set")

        @property
        def task(self):
            raise AssertionError("the task was read")

        def compute_rewards(self, tasks, features):
            raise AssertionError("rewards were computed")

        def reset(self, *, seed=None, options=None):
            assert seed is None, "a seeded reset of a family draws its task anew"
            return self.env.reset(options=options)

    env = make_env()
    env.reset()
    a = adapter(Guarded(env))
    answer(a, 3)
    np.testing.assert_array_equal(env.task, GOAL)


@pytest.mark.parametrize("rule", [Bayes(query_rule="random"), Bayes(candidates="aggregate")])
def test_equal_seeds_give_equal_policies(rule):
    """Of the rules by their defaults, saved adaptations that go on exactly say so."""
    first, second, third = adapter(rule=rule), adapter(rule=rule), adapter(rule=rule, seed=1)
    for a in (first, second, third):
        answer(a, 3)
    np.testing.assert_array_equal(first.policy().latent, second.policy().latent)
    assert not np.array_equal(first.policy().latent, third.policy().latent)


def test_without_a_seed_one_is_drawn_and_kept():
    first = adapter(seed=None)
    second = adapter(seed=first.seed)
    answer(first, 2)
    answer(second, 2)
    np.testing.assert_array_equal(first.policy().latent, second.policy().latent)
    assert adapter(seed=None).seed != first.seed


def test_a_file_without_a_suffix_gets_one(point_goal, tmp_path):
    policy = PreferenceAdapter(point_goal, point_goal.env_id, seed=0).policy()
    policy.save(tmp_path / "mine")
    assert [file.name for file in tmp_path.iterdir()] == ["mine.safetensors"]
    assert np.array_equal(AdaptedPolicy.load(tmp_path / "mine").latent, policy.latent)


def test_a_policy_knows_by_whose_answers_it_was_adapted(point_goal):
    env = make_task_vec_env(point_goal.env_id, 2)
    one = PreferenceAdapter(point_goal, env, oracle=ReturnOracle(), seed=0, n_queries=1, rule=SMALL)
    assert (one.policy().n_answers, one.policy().env) == (0, env)
    policy = one.adapt()
    assert policy.n_answers == 1
    assert policy.env is env
    mean, _ = evaluate_policy(policy, policy.env, n_eval_episodes=2, warn=False)
    assert np.isfinite(mean)
    assert not any("task" in name for name in vars(policy))


def test_what_a_notebook_shows(point_goal):
    env, tasks = make_task_vec_env(point_goal.env_id, 2), np.array([[0.5], [1.5]])
    one = PreferenceAdapter(point_goal, env, oracle=ReturnOracle(), seed=0, n_queries=2, rule=SMALL)
    query, policy = one.ask(), one.policy()
    latent = r"\[(-?\d\.\d\d, ){4}-?\d\.\d\d\]"
    trajectory = r"Trajectory\(25 steps of 2 observations and 2 actions\)"
    outcomes = evaluate_episodes(point_goal, env, np.zeros((2, 5)), tasks, 3)
    adapted = evaluate_adaptation(
        point_goal, env, tasks, record_at=(0, 1), n_episodes=1, rule=SMALL
    )
    shown = {
        r"POEMSAC\(poem/PointGoal-v0, 105,000 steps trained\)": point_goal,
        rf"AdaptedPolicy\(POEMSAC on poem/PointGoal-v0, 0 answers, latent={latent}\)": policy,
        r"PreferenceAdapter\(POEMSAC on poem/PointGoal-v0, Bayes\(n_particles=20, noise_model=ExactNoise\(\)\), 0 of 2 answers\)": one,
        r"PreferenceAdapter\(SpeedModel, Paper\(\), 0 of 10 answers\)": adapter(rule=Paper()),
        rf"Query\(shown=\({trajectory}, {trajectory}\), kind='pair'\)": query,
        r"ReturnOracle\(task=the environment's\)": ReturnOracle(),
        r"MistakeOracle\(rate=0.7, task=\[1.0\]\)": MistakeOracle(0.7, task=[1.0]),
        r"BoltzmannOracle\(beta=2, task=the environment's\)": BoltzmannOracle(2),
        r"HumanOracle\(0 asked, videos in preference_queries\)": HumanOracle(),
        r"EpisodeOutcomes\(2 times 3 episodes, mean return -\d+\.\d\)": outcomes,
        r"AdaptationEvaluation\(2 tasks, mean return -\d+\.\d, -\d+\.\d after 0, 1 answers\)": adapted,
        r"KnownTaskReturn\(2 tasks, mean return -\d+\.\d of the best of 6 latents, refined\)": known_task_return(
            point_goal, env, tasks, 6, 1
        ),
        r"TaskAdaptations\(2 tasks, after 0, 1, 2 answers\)": adapt_tasks(
            point_goal, env, tasks, ReturnOracle, n_queries=2, rule=SMALL
        ),
        r"TaskVecEnv\(poem/PointGoal-v0, 2 copies\)": env,
    }
    for pattern, thing in shown.items():
        assert re.fullmatch(pattern, repr(thing)), repr(thing)


@pytest.mark.parametrize("rule", RULES)
def test_undo_takes_the_last_answer_back(rule):
    plain, corrected = adapter(rule=rule), adapter(rule=rule)
    answer(plain, 3)
    answer(corrected, 1)
    query = corrected.ask()
    before = corrected.policy().latent
    corrected.tell("equal")
    assert corrected.undo() is query
    np.testing.assert_array_equal(corrected.policy().latent, before)
    assert corrected.n_answers == 1
    assert corrected.ask() is query
    answer(corrected, 2)
    np.testing.assert_array_equal(corrected.policy().latent, plain.policy().latent)


def test_undo_has_its_limits():
    a = adapter()
    with pytest.raises(RuntimeError, match="nothing to undo"):
        a.undo()
    answer(a, 1)
    a.ask()
    with pytest.raises(RuntimeError, match="before the next question"):
        a.undo()


def test_the_protocol_is_kept():
    a = adapter(n_queries=2)
    with pytest.raises(RuntimeError, match=r"no question has been asked; call ask\(\) first"):
        a.tell("left")
    query = a.ask()
    assert a.ask() is query  # the pending question, not another
    with pytest.raises(ValueError, match='"left", "equal", "right", but is \'better\''):
        a.tell("better")
    for nonsense in (None, 0, True, 1.0, ["left"], np.array([1, 0])):
        with pytest.raises(TypeError, match="an answer to a pair question must be a Preference"):
            a.tell(nonsense)
    assert a.pending is query  # a refused answer leaves the question waiting
    a.tell(Preference.LEFT)
    with pytest.raises(RuntimeError, match="has its answer already"):
        a.tell("left")
    a.ask()
    a.tell("right")
    assert a.done
    with pytest.raises(RuntimeError, match="all 2 questions have been answered"):
        a.ask()
    a.policy()


def test_the_short_form():
    assert named_rule() == Bayes()
    assert named_rule("paper") == Paper()
    assert named_rule("bayes", 7, query_rule="random") == Bayes(7, query_rule="random")
    assert named_rule("paper", 7, 0.1) == Paper(7)
    assert named_rule(mistake_rate=0.1) == Bayes(noise_model=MistakeNoise(0.1))
    assert named_rule("paper", question="pair", noise_model="infer") == Paper()
    graded = Bayes(question="graded", noise_model="infer")
    assert named_rule(question="graded", noise_model="infer") == graded
    with pytest.raises(ValueError, match='leave out question="graded"'):
        named_rule("paper", question="graded")


def test_a_rule_shows_what_was_chosen():
    assert repr(Paper()) == "Paper()"
    assert repr(Bayes(40, noise_model=MistakeNoise(0.1))) == (
        "Bayes(n_particles=40, noise_model=MistakeNoise(rate=0.1))"
    )


def test_a_rule_of_ones_own():
    @dataclass(frozen=True, repr=False)
    class AlwaysFive(Rule):
        latent: int = 5

        def start(self, model, rng, setting=None):
            return Fixed(rng, np.full(model.latent_dim, self.latent))

    class Fixed(Inference):
        def __init__(self, rng, latent):
            super().__init__(rng)
            self.latent = latent

        def ask(self):
            return self.rng.normal(size=(2, len(self.latent)))

        def tell(self, preference, left, right):
            self.answers.append(Answer(preference, (left, right)))

        def estimate(self):
            return self.latent

    a = adapter(rule=AlwaysFive(4))
    answer(a, 2)
    text = a.to_json()
    resumed = PreferenceAdapter.from_json(text, SpeedModel(), make_env())
    assert resumed.rule == AlwaysFive(4)
    np.testing.assert_array_equal(resumed.ask().left.latent, a.ask().left.latent)
    foreign = text.replace('"AlwaysFive"', '"AlwaysSix"').replace('"test_adapter"', '"sixes"')
    message = "the rule is 'AlwaysSix', .*: import it first, by `from sixes import AlwaysSix`"
    with pytest.raises(ValueError, match=message):
        PreferenceAdapter.from_json(foreign, SpeedModel(), make_env())
