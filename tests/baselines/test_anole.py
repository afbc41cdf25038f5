"""ANOLE and its variants against brute force, and on a world whose decoder is perfect."""

import itertools

import numpy as np
import pytest
from meta_toys import EPOCH, POINT_GOAL, Walk, WindyWalk, small, walks
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import SpeedEnv, SpeedModel, SpeedVecEnv

import sb3_poem
from sb3_poem import ANOLE, PEARLSAC, PreferenceAdapter
from sb3_poem.adaptation import (
    MistakeOracle,
    Preference,
    ReturnOracle,
    adapt_tasks,
    evaluate_adaptation,
)
from sb3_poem.adaptation.rule import Setting, inference_rng
from sb3_poem.baselines import replay_fragments, rollout_fragments, training_rollouts
from sb3_poem.baselines.anole import berlekamp_volumes, n_distinguishable, worst_case_volumes
from sb3_poem.common.rollouts import rollout_latents

MODEL = SpeedModel()
GOALS = np.linspace(0.05, 2.95, 30)[:, None]
LEFT, RIGHT, EQUAL = Preference.LEFT, Preference.RIGHT, Preference.EQUAL


def library(n=60):
    latents = np.random.default_rng(5).standard_normal((n, 5))
    return rollout_latents(MODEL, SpeedVecEnv(n), latents, np.full((n, 1), 1.5))


LIBRARY = library()


def begin(n_queries, seed=0, library=LIBRARY, **options):
    """ANOLE's inference."""
    rng = np.random.default_rng(seed)
    return ANOLE(**options).start(MODEL, rng, Setting(n_queries, library))


def anole(model, env, rule=None, **arguments):
    return PreferenceAdapter(model, env, rule=rule or ANOLE(), **arguments)


@pytest.mark.parametrize(("n_queries", "budget"), [(1, 0), (4, 0), (5, 1), (6, 2), (6, 6)])
def test_volumes_by_counting_all_answer_strings(n_queries, budget):
    # A candidate's true answers are all 0: a string's ones are the lies.
    for asked in range(n_queries + 1):
        for told in itertools.product((0, 1), repeat=asked):
            strings = [
                rest
                for rest in itertools.product((0, 1), repeat=n_queries - asked)
                if sum(told) + sum(rest) <= budget
            ]
            assert berlekamp_volumes(np.array([sum(told)]), n_queries - asked, budget)[0] == len(
                strings
            )


@pytest.mark.parametrize("seed", range(5))
def test_worst_case_volumes_by_counting(seed):
    rng = np.random.default_rng(seed)
    n_queries, budget, asked = 6, 2, 2
    differences = rng.integers(-1, 2, size=(7, 9)).astype(
        float
    )  # with ties, which contradict nothing
    contradictions = rng.integers(0, 3, size=7)
    expected = []
    for pair in range(9):
        after = []
        for sign in (1, -1):
            total = 0
            for m, difference in zip(contradictions, differences[:, pair], strict=True):
                lies = m + (sign * difference < 0)
                rest = itertools.product((0, 1), repeat=n_queries - asked - 1)
                total += sum(1 for string in rest if lies + sum(string) <= budget)
            after.append(total)
        expected.append(max(after))
    np.testing.assert_array_equal(
        worst_case_volumes(differences, contradictions, n_queries - asked - 1, budget), expected
    )


def test_numbers_of_candidates():
    assert n_distinguishable(10, 2) == 1024 // 56
    assert n_distinguishable(3, 1) == 2  # the repetition code is perfect
    assert n_distinguishable(7, 1) == 16  # and so is Hamming's
    assert ANOLE().total_candidates(10) == 100
    assert ANOLE().budget(10) == 2
    assert ANOLE().total_candidates(20) == 2**20 // 6196
    assert ANOLE(strategy="greedy").total_candidates(10) == 1024
    assert ANOLE(mistake_rate=0.2).budget(15) == 3


@pytest.mark.parametrize("seed", range(3))
def test_greedy_takes_the_pair_of_an_exhaustive_search(seed):
    # Every pair is among the draws, so that the choice must be as good as the best of all.
    inference = begin(4, seed, LIBRARY[:8], strategy="greedy", n_pairs=2000)
    for answer in (LEFT, RIGHT, LEFT):
        returns = MODEL.predicted_returns(inference.candidates[inference.alive], LIBRARY[:8])
        survivors = {
            (i, j): max(
                (returns[:, i] >= returns[:, j]).sum(), (returns[:, i] <= returns[:, j]).sum()
            )
            for i, j in itertools.permutations(range(8), 2)
        }
        left, right = inference.ask()
        asked = LIBRARY.index(left), LIBRARY.index(right)
        assert survivors[asked] == min(survivors.values())
        before = inference.alive.sum()
        inference.tell(answer, left, right)
        assert 1 <= inference.alive.sum() <= before


def test_contradictions_are_counted_and_the_budget_grows():
    inference = begin(5, n_candidates=30)
    assert inference.budget == 1
    left, right = inference.ask()
    for answer in (LEFT, RIGHT, LEFT, RIGHT, EQUAL):
        inference.tell(answer, left, right)
    assert set(inference.contradictions) <= {0, 2}
    assert inference.contradictions.max() == 2
    inference.contradictions[:] = 3
    assert inference.budget == 3
    assert np.isfinite(inference.estimate()).all()
    with pytest.raises(ValueError, match="needs the trajectories"):
        inference.tell(LEFT, left.latent, right.latent)


def test_greedy_keeps_candidates_when_none_agrees():
    inference = begin(3, strategy="greedy")
    order = np.argsort([t.observations[1, 1] for t in LIBRARY])
    slow, fast = LIBRARY[order[0]], LIBRARY[order[-1]]
    inference.tell(LEFT, slow, fast)
    kept = inference.alive.copy()
    inference.tell(RIGHT, slow, fast)
    np.testing.assert_array_equal(inference.alive, kept)


@pytest.mark.parametrize("strategy", ["berlekamp", "greedy", "random"])
def test_it_finds_the_speed(strategy):
    result = evaluate_adaptation(
        MODEL,
        SpeedVecEnv(30),
        GOALS,
        ReturnOracle,
        record_at=(0, 10),
        n_episodes=1,
        rule=ANOLE(strategy=strategy),
        library=LIBRARY,
    )
    # Blind -150 at best; the candidates alone lie 2 apart for 100 of them.
    assert result.after(0) < -140
    assert result.after(10) > (-40 if strategy == "random" else -15)


def test_every_task_may_have_a_library_of_its_own():
    shown = {}

    class Seen(ReturnOracle):
        def __call__(self, left, right):
            shown.setdefault(float(self.task[0]), []).extend([left, right])
            return super().__call__(left, right)

    own = {float(goal): library(4) for goal in GOALS[:2, 0]}
    options = {"rule": ANOLE(), "n_queries": 3, "library": lambda task: own[float(task[0])]}
    adapt_tasks(MODEL, SpeedVecEnv(4), GOALS[:2], Seen, **options)
    for goal, trajectories in shown.items():
        assert len(trajectories) == 6
        assert all(any(one is other for other in own[goal]) for one in trajectories)
    own[float(GOALS[1, 0])].clear()
    with pytest.raises(ValueError, match="`library` must hold at least 2 trajectories"):
        adapt_tasks(MODEL, SpeedVecEnv(4), GOALS[:2], Seen, **options)


def test_two_lies_in_ten_answers_are_borne():
    returns = {
        strategy: evaluate_adaptation(
            MODEL,
            SpeedVecEnv(30),
            GOALS,
            lambda env, task, seed: MistakeOracle(0.1, env, task, seed),
            record_at=(10,),
            n_episodes=1,
            rule=ANOLE(strategy=strategy),
            library=LIBRARY,
        ).after(10)
        for strategy in ("berlekamp", "greedy")
    }
    assert returns["berlekamp"] > returns["greedy"] + 5
    assert returns["berlekamp"] > -60


def test_one_task_and_many_tasks_agree_and_the_state_resumes():
    many = adapt_tasks(
        MODEL,
        SpeedVecEnv(2),
        GOALS[[3, 20]],
        ReturnOracle,
        n_queries=4,
        seed=7,
        rule=ANOLE(),
        library=LIBRARY,
    )
    env = DummyVecEnv([SpeedEnv])
    env.env_method("set_task", GOALS[20])
    adapter = anole(
        MODEL, env, n_queries=4, seed=8, library=LIBRARY, oracle=ReturnOracle(task=GOALS[20])
    )
    for _ in range(2):
        query = adapter.ask()
        adapter.tell(adapter.oracle(query.left, query.right))
        adapter.policy()
    adapter.ask()
    resumed = PreferenceAdapter.from_json(
        adapter.to_json(), MODEL, env, library=LIBRARY, oracle=ReturnOracle(env, GOALS[20])
    )
    for one in (adapter, resumed):
        np.testing.assert_array_equal(one.adapt().latent, many.latents[1, -1])
    assert resumed.n_answers == 4


def test_undo():
    adapter = anole(MODEL, SpeedEnv(), n_queries=3, seed=0, library=LIBRARY)
    before = adapter.policy().latent
    query = adapter.ask()
    adapter.tell("left")
    assert adapter.undo() is query
    np.testing.assert_array_equal(adapter.policy().latent, before)
    adapter.tell("right")
    assert adapter.n_answers == 1


@pytest.fixture(scope="module")
def trained():
    return small(PEARLSAC, walks(5, edge=0.6), horizon=10, n_train_tasks=5, buffer_size=45).learn(
        4 * 50
    )


def test_fragments_are_pieces_of_episodes(trained):
    fragments = replay_fragments(trained, 200, 4, np.random.default_rng(0))
    assert len(fragments) == 200
    for fragment in fragments:
        assert fragment.observations.shape == (5, 2)
        # Walk's own dynamics: 0.1 of the action a step, and a clock that goes up by 0.1.
        np.testing.assert_allclose(
            np.diff(fragment.observations[:, 0]), 0.1 * fragment.actions[:, 0], atol=1e-3
        )
        np.testing.assert_allclose(np.diff(fragment.observations[:, 1]), 0.1, atol=1e-6)
        np.testing.assert_allclose(
            fragment.reward_features[:, 0], fragment.observations[1:, 0], atol=1e-6
        )
    tasks = {tuple(fragment.latent) for fragment in fragments}
    assert len(tasks) == 5
    with pytest.raises(
        ValueError, match="`fragment_length` is 11, but the replay buffer holds too few"
    ):
        replay_fragments(trained, 5, 11, np.random.default_rng(0))


def test_it_runs_on_a_trained_model_from_its_replay_buffer(trained):
    env = walks(1)
    rule = ANOLE(n_pairs=20, fragment_length=4)
    adapter = PreferenceAdapter(trained, env, rule=rule, n_queries=3, seed=0, oracle=ReturnOracle())
    env.env_method("set_task", np.array([0.5]))
    env.reset()
    policy = adapter.adapt()
    assert policy.latent.shape == (5,)
    again = rule.start(trained, inference_rng(0), Setting(3))
    np.testing.assert_array_equal(again.candidates, adapter.inference.candidates)
    assert len(training_rollouts(trained, walks(4), 6)) == 6


def test_it_takes_ids_and_names():
    trained = small(PEARLSAC).learn(EPOCH)
    policy = PreferenceAdapter(
        trained, POINT_GOAL, rule=ANOLE(n_pairs=5), n_queries=2, seed=0, oracle=ReturnOracle()
    ).adapt()
    assert policy.latent.shape == (5,)
    fragments = training_rollouts("PointGoal", POINT_GOAL, 4)
    anole(
        "PointGoal", POINT_GOAL, n_queries=2, seed=0, library=fragments, oracle=ReturnOracle()
    ).adapt()
    with pytest.raises(
        ValueError, match=r"library=.*training_rollouts\(model, env, 200\), of another copy of env"
    ):
        anole("PointGoal", POINT_GOAL)


class Blind(SpeedModel):
    predicted_returns = None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"strategy": "best"}, "`strategy` must be one of"),
        ({"n_queries": 0}, "`n_queries` must be at least 1"),
        ({"strategy": "greedy", "n_queries": 15}, "`n_queries` must be at most 14"),
        ({"mistake_rate": 0.0, "n_queries": 30}, "at most 14 .* than 16,384 candidates, but is 30"),
        ({"mistake_rate": 0.5}, "`mistake_rate` must be below 0.5"),
        ({"candidates": "all"}, "`candidates` must be one of"),
        ({"fragment_length": 0}, "`fragment_length` must be at least 1"),
        ({"library": LIBRARY[:1]}, "`library` must hold at least 2 trajectories, but holds 1"),
        ({"library": None}, "its replay buffer is empty"),
    ],
)
def test_bad_arguments(arguments, message):
    of_adapter = {name: arguments[name] for name in ("n_queries", "library") if name in arguments}
    of_rule = {name: value for name, value in arguments.items() if name not in of_adapter}
    with pytest.raises(ValueError, match=message):
        anole(MODEL, SpeedEnv(), ANOLE(**of_rule), **{"library": LIBRARY, **of_adapter})


def test_models_and_families_that_will_not_do(trained):
    with pytest.raises(
        ValueError, match="`model` needs a trained reward decoder, which this Blind"
    ):
        anole(Blind(), SpeedEnv(), library=LIBRARY)
    untrained = small(PEARLSAC, walks(2), horizon=10, n_train_tasks=2, reward_coef=0.0)
    with pytest.raises(ValueError, match="`model` needs a trained reward decoder"):
        anole(untrained, walks(1), library=LIBRARY)
    with pytest.raises(ValueError, match="a family whose tasks share their dynamics"):
        anole(trained, walks(1, WindyWalk))
    with pytest.raises(ValueError, match="does not belong to this environment"):
        anole(MODEL, walks(1, Walk), library=LIBRARY)
    assert "ANOLE" in dir(sb3_poem)


def test_fragments_of_rollouts_are_pieces_of_the_training_tasks_episodes():
    model, env = small(PEARLSAC, walks(5), horizon=10, n_train_tasks=5).learn(100), walks(4)
    fragments = rollout_fragments(model, env, 12, 6, seed=3)
    episodes = training_rollouts(model, env, 12, seed=3)
    starts = set()
    for fragment, episode in zip(fragments, episodes, strict=True):
        assert len(fragment) == 6
        [start] = [
            t
            for t in range(5)
            if np.array_equal(episode.observations[t : t + 7], fragment.observations)
        ]
        np.testing.assert_array_equal(episode.actions[start : start + 6], fragment.actions)
        np.testing.assert_array_equal(
            episode.reward_features[start : start + 6], fragment.reward_features
        )
        np.testing.assert_array_equal(episode.latent, fragment.latent)
        starts.add(start)
    assert len(starts) > 2
    assert [len(fragment) for fragment in rollout_fragments(model, env, 2, 50)] == [10, 10]
