"""The Bayesian rule in a small world, without an adapter."""

import numpy as np
from scipy.special import ndtri
from worlds import HORIZON, TOP_SPEED, SpeedModel

from sb3_poem.adaptation.bayes import (
    Bayes,
)
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.rule import Setting
from sb3_poem.common.trajectory import Trajectory

LEFT, RIGHT, EQUAL = Preference.LEFT, Preference.RIGHT, Preference.EQUAL


def at_speed(model, speed, latent=None):
    """An episode at a constant speed."""
    observations = np.column_stack([np.zeros(HORIZON + 1), np.full(HORIZON + 1, speed)])
    z = np.zeros(model.latent_dim) if latent is None else latent
    return Trajectory(observations, np.zeros((HORIZON, 1)), z)


def make(model=None, seed=0, library=None, **options):
    rule, model = Bayes(**options), model or SpeedModel()
    setting = Setting(library=library)
    rule.check(model, setting)
    return rule.start(model, np.random.default_rng(seed), setting)


def crowd(inference, speed):
    """Have most particles stand where the answers to come are likely: then none is moved, and the
    weights alone change.
    """
    inference.particles[len(inference.particles) // 3 :] = ndtri(speed / TOP_SPEED)
    return inference.particles.copy()


def logistic(x):
    return 1 / (1 + np.exp(-x))
