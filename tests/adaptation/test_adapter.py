"""Ask and tell: the protocol, and what it may see."""

import re
import warnings
from dataclasses import dataclass
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from adapters import GOAL, RULES, SMALL, adapter, answer, kind_of, make_env, outside_oracle
from gymnasium import spaces
from meta_toys import small
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import HORIZON, Blinded, SpeedEnv, SpeedModel, SpeedVecEnv

from poem_envs import TaskFamily
from sb3_poem import ANOLE, POEMSAC, Bayes, MAMLReward, Paper, set_task
from sb3_poem.adaptation import (
    BoltzmannNoise,
    BoltzmannOracle,
    ExactNoise,
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
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.resources import pretrained_folder


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
        answer(a, 10)
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


@pytest.mark.parametrize(
    "rule", [*RULES, Bayes(query_rule="random"), Bayes(candidates="aggregate")]
)
def test_equal_seeds_give_equal_policies(rule):
    first, second, third = adapter(rule=rule), adapter(rule=rule), adapter(rule=rule, seed=1)
    for a in (first, second, third):
        answer(a, 5)
    np.testing.assert_array_equal(first.policy().latent, second.policy().latent)
    assert not np.array_equal(first.policy().latent, third.policy().latent)


def test_without_a_seed_one_is_drawn_and_kept():
    first = adapter(seed=None)
    second = adapter(seed=first.seed)
    answer(first, 2)
    answer(second, 2)
    np.testing.assert_array_equal(first.policy().latent, second.policy().latent)
    assert adapter(seed=None).seed != first.seed


class WatchedEnv(SpeedEnv):
    """What people can see of it is what a family's features show."""

    visible_difference = TaskFamily.visible_difference


def test_people_are_not_asked_about_what_looks_alike(tmp_path):
    def episode(speed, feature):
        rows = np.column_stack([np.zeros(HORIZON + 1), np.full(HORIZON + 1, speed)])
        seen = feature + np.random.default_rng(0).normal(size=(HORIZON, 1))
        return Trajectory(rows, np.zeros((HORIZON, 1)), np.full(5, speed), seen)

    # The decoder tells all three apart, a person only the last from the others.
    library = [episode(1.0, 0.0), episode(2.0, 0.02), episode(2.2, 3.0)]

    def asked(oracle, env=WatchedEnv):
        a = adapter(env(render_mode="rgb_array"), rule=SMALL, library=library, oracle=oracle)
        return {a.ask().left, a.ask().right}

    person = HumanOracle(tmp_path, mistake_rate=0.05)
    assert asked(ReturnOracle()) == asked(None) == asked(person, SpeedEnv) == set(library[:2])
    assert asked(person) == {library[0], library[2]}


@pytest.mark.parametrize("question", ["pair", "graded"])
def test_a_question_that_looked_alike_is_replaced_by_the_next_best(tmp_path, question):
    rule = Bayes(question=question, noise_model=MistakeNoise(0.05))
    plain = adapter(make_env(render_mode="rgb_array"), rule=rule, render=True)
    best = {plain.ask().left.latent[0], plain.ask().right.latent[0]}
    looked = []

    class Watched(SpeedEnv):
        def visible_difference(self, left, right, spread):
            speeds = np.sort([SpeedModel.speed([z]) for z in best])
            looked.append(np.sort([left.mean(), right.mean()]))
            assert spread == pytest.approx(np.std([left, right]))  # all that the person has seen
            return 0.0 if np.allclose(looked[-1], speeds, atol=1e-4) else 5.0

    env = Watched(render_mode="rgb_array")
    a = adapter(env, rule=rule, oracle=HumanOracle(tmp_path, question=question))
    query = a.ask()
    assert len(looked) == 2
    assert {query.left.latent[0], query.right.latent[0]} != best
    assert len(query.left.frames) == HORIZON
    again = PreferenceAdapter.from_json(a.to_json(), SpeedModel(), env, oracle=a.oracle).ask()
    np.testing.assert_array_equal(again.left.observations, query.left.observations)
    np.testing.assert_array_equal(again.right.frames, query.right.frames)
    # A simulated oracle sees everything, whether or not there is a film.
    simulated = ReturnOracle(**kind_of(rule))
    one = adapter(Watched(render_mode="rgb_array"), rule=rule, oracle=simulated, render=True)
    assert {one.ask().left.latent[0], one.ask().right.latent[0]} == best
    assert len(looked) == 2


def test_a_model_that_was_not_trained(point_goal):
    untrained = POEMSAC("MlpPolicy", point_goal.env_id, n_train_tasks=2, device="cpu")
    env, tasks = make_task_vec_env(point_goal.env_id, 1), np.array([[0.5]])
    calls = (
        lambda model: PreferenceAdapter(model, env, rule=SMALL),
        lambda model: evaluate_adaptation(model, env, tasks, record_at=[0], n_episodes=1),
    )
    for call in calls:
        with pytest.warns(
            UserWarning, match="POEMSAC on poem/PointGoal-v0 has not been trained"
        ) as warned:
            call(untrained)
        assert [item.filename for item in warned if "not been trained" in str(item.message)] == [
            __file__
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            call(point_goal)


@pytest.mark.parametrize("value", [2.5, True, "10", -3, np.float64(4)])
@pytest.mark.parametrize("name", ["n_queries", "seed"])
def test_only_whole_numbers_will_do(name, value):
    calls = [
        lambda: PreferenceAdapter(SpeedModel(), make_env(), **{name: value}),
        lambda: adapt_tasks(
            SpeedModel(), DummyVecEnv([SpeedEnv]), np.array([[0.4]]), ReturnOracle, **{name: value}
        ),
    ]
    named = name
    if name == "n_queries":
        named = "(n_queries|n_candidates|n_particles|gradient_steps)"
        calls += [
            lambda: Bayes(value),
            lambda: Paper(value),
            lambda: ANOLE(n_candidates=value),
            lambda: MAMLReward(value),
        ]
    for call in calls:
        with pytest.raises(
            ValueError, match=f"`{named}` must be (a whole number|at least [012]), but is"
        ):
            call()


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
    answer(plain, 4)
    answer(corrected, 2)
    query = corrected.ask()
    before = corrected.policy().latent
    corrected.tell("equal")
    assert corrected.undo() is query
    np.testing.assert_array_equal(corrected.policy().latent, before)
    assert corrected.n_answers == 2
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


@pytest.mark.parametrize("nothing", [1, None, 0.3])
def test_an_oracle_that_returns_something_else(nothing):
    with pytest.raises(
        TypeError,
        match=f"an answer to a pair question must be a Preference.*but is {nothing} of type",
    ):
        adapter(oracle=lambda left, right: nothing).adapt()
    with pytest.raises(ValueError, match="adapt\\(\\) needs an oracle"):
        adapter().adapt()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"query_rule": "best"}, "`query_rule` must be one of"),
        ({"candidates": "uniform"}, "`candidates` must be one of"),
        ({"epsilon": 0.5}, "`epsilon` must be below 0.5"),
        ({"n_candidates": 1}, "`n_(candidates|particles)` must be at least 2"),
        ({"inference": "map"}, "`inference` must be one of .*bayes.*paper.*, but is 'map'"),
    ],
)
@pytest.mark.parametrize("inference", ["bayes", "paper"])
def test_bad_options(inference, arguments, message):
    with pytest.raises(ValueError, match=message):
        named_rule(**{"inference": inference, **arguments})


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"n_queries": 0}, ValueError, "`n_queries` must be at least 1, but is 0"),
        ({"seed": -1}, ValueError, "`seed` must be at least 0, but is -1"),
        ({"rule": Paper(), "library": []}, ValueError, "`library` must be None: Algorithm 2"),
        ({"rule": "paper"}, TypeError, r"`rule` must be an object.*'paper'; write rule=Paper\(\)"),
        (
            {"rule": Paper},
            TypeError,
            r"`rule` is the class Paper, but must be an object: Paper\(\)",
        ),
        ({"rule": 3}, TypeError, "`rule` must be an object .*but is 3$"),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        adapter(**arguments)
    if "seed" not in arguments:
        tasks = np.array([[0.4]])
        with pytest.raises(error, match=message):
            adapt_tasks(SpeedModel(), DummyVecEnv([SpeedEnv]), tasks, ReturnOracle, **arguments)


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


def test_a_model_for_another_environment_is_refused():
    class Other(SpeedEnv):
        observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)

    with pytest.raises(
        ValueError, match="does not belong to this environment: its observation_space"
    ):
        adapter(Other())
    with pytest.raises(
        ValueError, match="does not belong to this environment: its observation_space"
    ):
        adapter("MountainCarContinuous-v0", model=POINT_GOAL)


POINT_GOAL = "PointGoal"  # a model that ships
POINT = "poem/PointGoal-v0"


@pytest.mark.filterwarnings("error::UserWarning")
def test_the_policy_is_for_the_task_of_the_adapters_environment():
    """Elsewhere, evaluation meets another task; there, no Monitor is missing either."""
    a = PreferenceAdapter(POINT_GOAL, POINT, oracle=ReturnOracle(), seed=0)
    policy = a.adapt()
    [task] = a.env.get_attr("task")
    mean, _ = evaluate_policy(policy, a.env, n_eval_episodes=3)
    assert mean > -11  # 25 steps; the best policies need ten of them for the way
    np.testing.assert_array_equal(a.env.get_attr("task"), [task])
    elsewhere = Monitor(gym.make(POINT))
    elsewhere.reset(seed=0)
    assert evaluate_policy(policy, elsewhere, n_eval_episodes=3)[0] < -15
    set_task(elsewhere, task)
    assert evaluate_policy(policy, elsewhere, n_eval_episodes=3)[0] > -11
    a.close()


@pytest.mark.parametrize(
    "env",
    [
        lambda: POINT,
        lambda: gym.make(POINT),
        lambda: gym.make_vec(POINT, 2),
        lambda: gym.make_vec(POINT, 2, vectorization_mode="sync"),
        lambda: DummyVecEnv([lambda: gym.make(POINT)] * 2),
        lambda: make_task_vec_env(POINT, 2),
    ],
)
def test_models_and_environments_by_name_and_of_every_kind(env, point_goal):
    expected = PreferenceAdapter(
        point_goal, POINT, oracle=ReturnOracle(), seed=0, n_queries=2
    ).adapt()
    for name in (POINT_GOAL, pretrained_folder(POINT_GOAL)):
        policy = PreferenceAdapter(name, env(), oracle=ReturnOracle(), seed=0, n_queries=2).adapt()
        np.testing.assert_allclose(policy.latent, expected.latent, atol=1e-6)


def test_the_id_of_the_models_own_environment_makes_that():
    env = make_task_vec_env(POINT, 2, step_length=0.1)
    a = PreferenceAdapter(small(POEMSAC, env), POINT)
    assert a.env.get_attr("step_length") == [0.1]


def test_an_oracle_without_an_environment_judges_by_that_of_each_adapter():
    elsewhere = make_env(np.array([0.3]))
    elsewhere.reset()
    lent, own = ReturnOracle(), ReturnOracle(elsewhere)
    for goal in (0.3, 2.5):
        env = make_env(np.array([goal]))
        for oracle, wanted in ((lent, goal), (own, 0.3)):
            policy = adapter(env, oracle=oracle).adapt()
            assert SpeedModel.speed(policy.latent) == pytest.approx(wanted, abs=0.3)
    assert own.env is elsewhere


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"model": SAC}, TypeError, "`model` is the class SAC, but must be a trained POEMSAC"),
        ({"model": "a SAC"}, TypeError, "`model` is of type SAC, but must be a trained POEMSAC"),
        (
            {"model": POEMSAC},
            TypeError,
            "`model` is the class POEMSAC, but must be a trained POEMSAC",
        ),
        (
            {"model": None},
            TypeError,
            "`model` is of type NoneType.*name of a model that ships: .*PointGoal",
        ),
        (
            {"model": "PointGaol"},
            FileNotFoundError,
            "No model 'PointGaol' is shipped; there are: .*PointGoal",
        ),
        (
            {"model": "logs/model.zip"},
            FileNotFoundError,
            "logs/model.zip: there is no such file or folder of a model",
        ),
        (
            {"env": 3},
            TypeError,
            "`env` must be a gymnasium.Env, an id, a Gymnasium VectorEnv or an SB3 VecEnv, but is 3",
        ),
        (
            {"env": SpeedEnv},
            TypeError,
            "`env` must be a gymnasium.Env, .* but is <class 'worlds.SpeedEnv'>",
        ),
        (
            {"env": "poem/PointGaol-v0"},
            gym.error.NameNotFound,
            "(?i)PointGaol.*did you mean.*PointGoal",
        ),
        (
            {"oracle": ReturnOracle},
            TypeError,
            r"`oracle` is the class ReturnOracle, but must be an object: ReturnOracle\(\)",
        ),
        (
            {"oracle": "return"},
            TypeError,
            r"`oracle` must be called as oracle\(left, right\).* but is 'return'",
        ),
    ],
)
def test_arguments_of_another_kind(arguments, error, message):
    if arguments.get("model") == "a SAC":
        arguments = {"model": SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu")}
    with pytest.raises(error, match=message):
        PreferenceAdapter(**{"model": POINT_GOAL, "env": POINT, **arguments})
    if "oracle" in arguments:
        with pytest.raises(error, match=message):
            adapter().adapt(arguments["oracle"])


def test_frames_for_ask_and_tell(tmp_path):
    a = PreferenceAdapter(POINT_GOAL, POINT, seed=0, render=True)
    query = a.ask()
    assert len(query.left.frames) == len(query.left)
    assert query.to_video(tmp_path / "query.gif").stat().st_size > 1000
    resumed = PreferenceAdapter.from_json(a.to_json(), POINT_GOAL, POINT, render=True)
    np.testing.assert_array_equal(resumed.ask().right.frames, query.right.frames)
    with pytest.raises(
        ValueError,
        match=r"the question has no frames to show: .*PreferenceAdapter\(..., render=True\)",
    ):
        adapter().ask().to_video(tmp_path / "query.mp4")
    with pytest.raises(ValueError, match='render_mode="rgb_array", but this one has None'):
        adapter(render=True).ask()


def test_a_question_stays_where_an_environment_draws_nothing(monkeypatch):
    monkeypatch.setattr(SpeedEnv, "render", lambda self: None)
    a = adapter(SpeedEnv(render_mode="rgb_array"), render=True)
    assert a.ask() is a.ask()


def test_an_id_and_a_vector_environment_will_do():
    gym.register("test/Speed-v0", SpeedEnv)
    try:
        from_id = PreferenceAdapter(SpeedModel(), "test/Speed-v0", seed=0)
        answer(from_id, 2)
        from_id.close()
        # Other copies of a vector environment may hold other tasks: the first is watched.
        many = adapter(
            DummyVecEnv([make_env, partial(make_env, np.array([0.1]))]),
            oracle=ReturnOracle(),
            n_queries=2,
        )
        one = adapter(make_env(), oracle=ReturnOracle(), n_queries=2)
        np.testing.assert_array_equal(many.adapt().latent, one.adapt().latent)
        first = from_id.answers[0].shown[0].observations
        np.testing.assert_array_equal(first, one.answers[0].shown[0].observations)
    finally:
        del gym.registry["test/Speed-v0"]


def test_the_oracles_noise_model_is_taken():
    assert adapter(oracle=MistakeOracle(0.3)).rule.noise_model == MistakeNoise(0.3)
    chosen = Bayes(noise_model=BoltzmannNoise())
    assert adapter(oracle=MistakeOracle(0.3), rule=chosen).rule == chosen
    assert adapter(oracle=outside_oracle).inference.noise_model == ExactNoise()
    told = adapter(oracle=MistakeOracle(0.3, seed=0)).adapt()
    late = adapter()
    np.testing.assert_array_equal(late.adapt(MistakeOracle(0.3, seed=0)).latent, told.latent)
    assert late.inference.noise_model == late.rule.noise_model == MistakeNoise(0.3)
    begun = adapter()
    begun.ask()
    with pytest.raises(ValueError, match="pass the oracle to PreferenceAdapter, or a rule"):
        begun.adapt(MistakeOracle(0.3))
    assert begun.adapt(ReturnOracle()).n_answers == 10


def test_graded_questions_are_asked_kept_and_answered_by_five_words():
    words = ["much left", "left", "equal", "right", "much right"]
    rule = Bayes(n_particles=20, question="graded", noise_model="infer")
    a = adapter(rule=rule)
    for word in words:
        assert a.ask().kind == "graded"
        a.tell(word)
    a.ask()
    again = PreferenceAdapter.from_json(a.to_json(), SpeedModel(), make_env())
    assert again.rule == rule
    assert again.pending.kind == "graded"
    assert [answer.preference.value for answer in again.answers] == words
    np.testing.assert_array_equal(again.policy().latent, a.policy().latent)
    assert adapter().ask().kind == "pair"


def test_the_best_of_four_is_asked_kept_and_answered_by_five_words():
    words = ["first", "second", "third", "fourth", "equal"]
    rule = Bayes(n_particles=20, question="best-of-four", noise_model="infer")
    a = adapter(rule=rule)
    for word in words:
        assert len(a.ask().shown) == 4
        with pytest.raises(
            ValueError, match=r'"first", .* "equal", but is .left., which only pair'
        ):
            a.tell("left")
        a.tell(word)
    shown = a.ask().shown
    assert len({item.latent.tobytes() for item in shown}) == 4
    again = PreferenceAdapter.from_json(a.to_json(), SpeedModel(), make_env())
    assert again.rule == rule
    for kept, item in zip(again.pending.shown, shown, strict=True):
        np.testing.assert_array_equal(kept.observations, item.observations)
    assert [answer.preference.value for answer in again.answers] == words
    np.testing.assert_array_equal(again.policy().latent, a.policy().latent)
    with pytest.raises(ValueError, match="`library` must hold at least 4 trajectories"):
        adapter(rule=rule, library=shown[:3])
    first = a.ask_again(0)
    assert [x.latent.tobytes() for x in first.shown] == [
        x.latent.tobytes() for x in a.answers[0].shown
    ]
    for pair in (adapter(), adapter(rule=Paper())):
        pair.ask()
        with pytest.raises(ValueError, match="'third', which only best-of-four questions have"):
            pair.tell("third")


@pytest.mark.parametrize("rule", [Bayes(), Bayes(noise_model="infer"), Paper()])
@pytest.mark.parametrize("graded", ["much left", Preference.MUCH_LEFT])
def test_a_pair_takes_no_graded_answer(rule, graded):
    a = adapter(rule=rule)
    query = a.ask()
    with pytest.raises(ValueError, match=r"a pair question .* 'much left', which only graded"):
        a.tell(graded)
    assert a.pending is query
    with pytest.raises(ValueError, match=r"a pair question .* 'much left', which only graded"):
        a.adapt(lambda left, right: graded)


def test_who_answers_must_know_the_kind_of_the_questions():
    graded, exact = Bayes(question="graded"), ReturnOracle(thresholds=(20, 200))
    four = ReturnOracle(question="best-of-four")
    wrong = [(graded, ReturnOracle()), (Bayes(), exact), (Paper(), exact), (Paper(), four)]
    wrong += [(graded, four), (Bayes(question="best-of-four"), exact)]
    for rule, oracle in wrong:
        words = f'answers "{oracle.question}" questions, but the rule asks "{rule.question}" ones'
        with pytest.raises(ValueError, match=words):
            adapter(rule=rule, oracle=oracle)
        with pytest.raises(ValueError, match=words):
            adapter(rule=rule).adapt(oracle)
        how = {"rule": rule, "n_queries": 1}
        with pytest.raises(ValueError, match=words):
            adapt_tasks(SpeedModel(), SpeedVecEnv(2), [[1.0]], lambda **_: oracle, **how)  # noqa: B023
    assert adapter(rule=graded, oracle=exact).rule.question == "graded"


def test_answers_that_say_more_find_a_task_in_fewer_questions():
    def misses(oracle, n_queries=3, **options):
        tasks = np.linspace(0.3, 2.7, 12)[:, None]
        how = {"rule": Bayes(100, **options), "n_queries": n_queries}
        found = adapt_tasks(SpeedModel(), SpeedVecEnv(24), tasks, oracle, **how)
        return np.abs(SpeedModel.speed(found.latents[:, -1]) - tasks[:, 0]).mean()

    graded = partial(ReturnOracle, thresholds=(30, 180))
    pairs = misses(ReturnOracle)
    assert misses(graded, question="graded") < 0.7 * pairs
    assert misses(graded, question="graded", noise_model="infer") < pairs
    best = partial(ReturnOracle, question="best-of-four")
    assert misses(best, 2, question="best-of-four") < pairs


def test_a_library_in_an_environment_that_was_not_reset(point_goal):
    model = point_goal
    source = PreferenceAdapter(
        model, "poem/PointGoal-v0", oracle=ReturnOracle(), seed=0, n_queries=2
    )
    source.adapt()
    library = [trajectory for item in source.answers for trajectory in item.shown]
    adapter = PreferenceAdapter(
        model, "poem/PointGoal-v0", oracle=ReturnOracle(), library=library, seed=0, n_queries=2
    )
    adapter.adapt()
    assert adapter.done
    env, how = gym.make("poem/PointGoal-v0"), {"library": library, "seed": 0, "n_queries": 2}
    drawn = PreferenceAdapter(model, env, oracle=ReturnOracle(), **how).adapt()
    np.testing.assert_array_equal(drawn.latent, adapter.policy().latent)
    np.testing.assert_array_equal(env.unwrapped.task, adapter.env.get_attr("task")[0])
    set_task(env, [0.5])  # which takes effect at the next reset
    PreferenceAdapter(model, env, oracle=ReturnOracle(), **how).adapt()
    np.testing.assert_array_equal(env.unwrapped.task, [0.5])


class Looks:
    needs_frames = True

    def __call__(self, left, right):
        return "left"


def test_a_library_needs_no_rollouts():
    model = SpeedModel()
    source = PreferenceAdapter(
        model, make_env(np.array([0.3])), seed=3, rule=Bayes(query_rule="random")
    )
    answer(source, 10)
    library = [trajectory for item in source.answers for trajectory in item.shown]

    class NoSteps(SpeedEnv):
        def step(self, action):
            raise AssertionError("a rollout")

    a = PreferenceAdapter(model, NoSteps(), library=library, seed=0, n_queries=4)
    answer(a, 4)
    assert all(item.shown[0] in library for item in a.answers)
    looking = PreferenceAdapter(model, NoSteps(), library=library, seed=0, oracle=Looks())
    assert looking.ask() is looking.ask()  # which has no frames, and is not rolled out for them
    with pytest.raises(ValueError, match="pass the same `library`"):
        PreferenceAdapter.from_json(a.to_json(), model, make_env())
    resumed = PreferenceAdapter.from_json(a.to_json(), model, make_env(), library=library)
    np.testing.assert_array_equal(resumed.policy().latent, a.policy().latent)


@pytest.mark.parametrize(
    "wrapper",
    [
        gym.wrappers.NormalizeObservation,
        gym.wrappers.NormalizeReward,
        lambda env: gym.wrappers.TransformReward(env, np.negative),
    ],
)
def test_wrappers_that_change_what_is_seen_or_paid_are_refused(wrapper):
    # HalfCheetah's observations have no bounds, so that their space alone does not tell.
    env = wrapper(gym.make("poem/HalfCheetahVel-v0"))
    with pytest.raises(ValueError, match=r"env must not be wrapped in (Normalize|Transform)"):
        PreferenceAdapter("HalfCheetahVel", env)
