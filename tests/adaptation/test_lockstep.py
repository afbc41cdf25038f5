"""Many tasks adapted in lockstep."""

from functools import partial

import numpy as np
import pytest
from adapters import RULES, answer, kind_of, make_env
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import SpeedEnv, SpeedModel

from sb3_poem import Bayes
from sb3_poem.adaptation import (
    MistakeOracle,
    PreferenceAdapter,
    ReturnOracle,
    adapt_tasks,
)


@pytest.mark.parametrize("rule", RULES)
def test_many_tasks_in_lockstep_as_each_alone(rule):
    tasks = np.array([[0.4], [1.3], [2.7]])
    model = SpeedModel()
    together = adapt_tasks(
        model,
        DummyVecEnv([SpeedEnv] * 4),
        tasks,
        partial(MistakeOracle, 0.2, **kind_of(rule)),
        n_queries=3,
        seed=7,
        rule=rule,
    )
    assert together.latents.shape == (3, 4, 5)
    assert together.record_at == (0, 1, 2, 3)
    for i, task in enumerate(tasks):
        oracle = MistakeOracle(0.2, task=task, seed=7 + i, **kind_of(rule))
        alone = PreferenceAdapter(
            model, make_env(task), oracle=oracle, seed=7 + i, n_queries=3, rule=rule
        )
        np.testing.assert_array_equal(together.latents[i, 0], alone.policy().latent)
        for query in range(1, 4):
            answer(alone, 1, oracle)
            np.testing.assert_array_equal(together.latents[i, query], alone.policy().latent)
        assert together.preferences[i] == [item.preference for item in alone.answers]


def test_lockstep_options(capsys):
    env, model, tasks = DummyVecEnv([SpeedEnv] * 2), SpeedModel(), np.array([[0.4]])
    how = {"n_queries": 4, "record_at": [2, 0], "progress_bar": True}
    result = adapt_tasks(model, env, tasks, ReturnOracle, **how)
    assert "2/2" in capsys.readouterr().err
    assert result.record_at == (0, 2)
    assert result.latents.shape == (1, 2, 5)
    assert len(result.preferences[0]) == 2  # nothing is asked that nobody will look at
    for arguments, message in [
        ({"record_at": [5]}, "`record_at` must be at most 4, but is 5"),
        ({"record_at": []}, "`record_at` must hold"),
        ({"n_queries": 0}, "`n_queries` must be at least 1"),
    ]:
        with pytest.raises(ValueError, match=message):
            adapt_tasks(model, env, tasks, ReturnOracle, **{"n_queries": 4, **arguments})
    with pytest.raises(ValueError, match="`tasks` must have shape"):
        adapt_tasks(model, env, np.zeros(3), ReturnOracle)


def test_lockstep_with_a_library():
    model, tasks = SpeedModel(), np.array([[0.4], [2.1]])
    source = PreferenceAdapter(model, make_env(), seed=3, rule=Bayes(query_rule="random"))
    answer(source, 10)
    library = [trajectory for item in source.answers for trajectory in item.shown]
    together = adapt_tasks(
        model, DummyVecEnv([SpeedEnv]), tasks, ReturnOracle, n_queries=4, library=library
    )
    for i, task in enumerate(tasks):
        alone = PreferenceAdapter(
            model,
            make_env(task),
            oracle=ReturnOracle(task=task),
            seed=i,
            n_queries=4,
            library=library,
        )
        np.testing.assert_array_equal(together.latents[i, -1], alone.adapt().latent)
