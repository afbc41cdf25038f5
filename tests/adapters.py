"""Adapters of a small world, and who answers there."""

import numpy as np
from worlds import SpeedEnv, SpeedModel

from sb3_poem import Bayes, Paper
from sb3_poem.adaptation import (
    Preference,
    PreferenceAdapter,
)

GOAL = np.array([2.2])
SMALL = Bayes(n_particles=20)
RULES = [
    Bayes(),
    Bayes(likelihood="similarity"),
    Bayes(question="graded", noise_model="infer"),
    Bayes(question="best-of-four"),
    Paper(),
]


def kind_of(rule):
    """What an oracle is given to answer this rule's questions."""
    four = {"question": "best-of-four"}
    return {"graded": {"thresholds": (20, 200)}, "best-of-four": four}.get(rule.question, {})


def make_env(goal=GOAL, **kwargs):
    env = SpeedEnv(**kwargs)
    env.set_task(goal)
    return env


def outside_oracle(*shown):
    """Knows the goal, and sees observations only."""
    misses = [np.abs(trajectory.observations[1:, 1] - GOAL).sum() for trajectory in shown]
    if len(shown) == 2:
        return Preference.LEFT if misses[0] < misses[1] else Preference.RIGHT
    return ("first", "second", "third", "fourth")[int(np.argmin(misses))]


def adapter(env=None, seed=0, model=None, **kwargs):
    return PreferenceAdapter(
        model or SpeedModel(), make_env() if env is None else env, seed=seed, **kwargs
    )


def answer(a, times, oracle=outside_oracle):
    for _ in range(times):
        query = a.ask()
        a.tell(oracle(*query.shown))
