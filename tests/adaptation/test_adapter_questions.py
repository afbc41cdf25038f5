"""What an adapter asks about, and who answers: kinds of questions, frames, libraries."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from adapters import SMALL, adapter, answer, kind_of, make_env, outside_oracle
from worlds import HORIZON, SpeedEnv, SpeedModel, SpeedVecEnv

from poem_envs import TaskFamily
from sb3_poem import Bayes, Paper, set_task
from sb3_poem.adaptation import (
    BoltzmannNoise,
    ExactNoise,
    HumanOracle,
    MistakeNoise,
    MistakeOracle,
    Preference,
    PreferenceAdapter,
    ReturnOracle,
    adapt_tasks,
)
from sb3_poem.common.trajectory import Trajectory


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


def test_an_oracle_that_returns_nothing():
    message = "an answer to a pair question must be a Preference.*but is None of type"
    with pytest.raises(TypeError, match=message):
        adapter(oracle=lambda left, right: None).adapt()
    with pytest.raises(ValueError, match="adapt\\(\\) needs an oracle"):
        adapter().adapt()


def test_frames_for_ask_and_tell(tmp_path):
    a = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", seed=0, render=True)
    query = a.ask()
    assert len(query.left.frames) == len(query.left)
    assert query.to_video(tmp_path / "query.gif").stat().st_size > 1000
    resumed = PreferenceAdapter.from_json(
        a.to_json(), "PointGoal", "poem/PointGoal-v0", render=True
    )
    np.testing.assert_array_equal(resumed.ask().right.frames, query.right.frames)
    a.tell("left")
    assert [item.frames for item in a.answers[0].shown] == [None, None]  # they take megabytes
    assert a.undo() is query
    a.tell("left")
    np.testing.assert_array_equal(a.ask_again(0).right.frames, query.right.frames)
    with pytest.raises(
        ValueError,
        match=r"the question has no frames to show: .*PreferenceAdapter\(..., render=True\)",
    ):
        adapter().ask().to_video(tmp_path / "query.mp4")
    with pytest.raises(ValueError, match='render_mode="rgb_array", but this one has None'):
        adapter(render=True).ask()


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


@pytest.mark.parametrize("rule", [Bayes(), Paper()])
def test_a_pair_takes_no_graded_answer(rule):
    a = adapter(rule=rule)
    query = a.ask()
    for graded in ("much left", Preference.MUCH_LEFT):
        with pytest.raises(ValueError, match=r"a pair question .* 'much left', which only graded"):
            a.tell(graded)
    assert a.pending is query
    with pytest.raises(ValueError, match=r"a pair question .* 'much left', which only graded"):
        a.adapt(lambda left, right: "much left")


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
