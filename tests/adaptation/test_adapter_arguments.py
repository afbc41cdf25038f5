"""What an adapter takes as model, environment and options, and what it refuses."""

import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from adapters import SMALL, adapter, answer, make_env
from gymnasium import spaces
from meta_toys import small
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import SpeedEnv, SpeedModel

from sb3_poem import ANOLE, POEMSAC, Bayes, MAMLReward, Paper, set_task
from sb3_poem.adaptation import (
    PreferenceAdapter,
    ReturnOracle,
    adapt_tasks,
    evaluate_adaptation,
    named_rule,
)
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.resources import pretrained_folder

POINT_GOAL = "PointGoal"  # a model that ships
POINT = "poem/PointGoal-v0"


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"query_rule": "best"}, "`query_rule` must be one of .*worst-case.*, but is 'best'"),
        ({"candidates": "uniform"}, "`candidates` must be one of .*prior.*aggregate"),
        ({"epsilon": 0.5}, "`epsilon` must be below 0.5, but is 0.5"),
        ({"epsilon": -0.1}, "`epsilon` must be at least 0"),
        ({"epsilon": float("nan")}, "`epsilon` must be a finite number"),
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


def test_models_and_environments_by_name_and_of_every_kind(point_goal):
    how = {"oracle": ReturnOracle(), "seed": 0, "n_queries": 2, "rule": SMALL}
    expected = PreferenceAdapter(point_goal, POINT, **how).adapt()
    for model, env in [
        (POINT_GOAL, POINT),
        (pretrained_folder(POINT_GOAL), POINT),
        (point_goal, gym.make(POINT)),
        (point_goal, gym.make_vec(POINT, 2)),
        (point_goal, gym.make_vec(POINT, 2, vectorization_mode="sync")),
        (point_goal, DummyVecEnv([lambda: gym.make(POINT)] * 2)),
        (point_goal, make_task_vec_env(POINT, 2)),
    ]:
        policy = PreferenceAdapter(model, env, **how).adapt()
        np.testing.assert_allclose(policy.latent, expected.latent, atol=1e-6)


@pytest.mark.parametrize("mode", ["vector_entry_point", "sync"])
def test_an_oracle_judges_by_gymnasiums_vector_environment(mode, point_goal):
    env = gym.make_vec(POINT, 2, vectorization_mode=mode)
    set_task(env, [0.5])
    query = PreferenceAdapter(point_goal, env, rule=SMALL, seed=0).ask()
    shown = query.left, query.right
    for goal in (0.5, 2.5):
        single = gym.make(POINT)
        single.reset(options={"task": [goal]})
        assert ReturnOracle(env, task=[goal])(*shown) == ReturnOracle(single)(*shown)
    assert ReturnOracle(env)(*shown) == ReturnOracle(env, task=[0.5])(*shown)


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
            "There is no model 'PointGaol' here, and none is shipped; those shipped are: .*PointGoal",
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
