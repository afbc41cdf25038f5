"""Adaptation to a new task from preferences: ask and tell, inference rules, oracles, evaluation."""

from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.adaptation.evaluation import (
    AdaptationEvaluation,
    EpisodeOutcomes,
    KnownTaskReturn,
    evaluate_adaptation,
    evaluate_episodes,
    evaluate_latents,
    known_task_return,
    property_one,
)
from sb3_poem.adaptation.human import HumanOracle
from sb3_poem.adaptation.limits import best_codebook, information_limit
from sb3_poem.adaptation.lockstep import TaskAdaptations, adapt_tasks
from sb3_poem.adaptation.noise import BoltzmannNoise, ExactNoise, MistakeNoise, NoiseModel
from sb3_poem.adaptation.oracles import BoltzmannOracle, MistakeOracle, ReturnOracle, TaskOracle
from sb3_poem.adaptation.policy import AdaptedPolicy
from sb3_poem.adaptation.preference import Preference, Query
from sb3_poem.adaptation.rate_distortion import answer_capacity, rate_distortion_limit
from sb3_poem.common.trajectory import Trajectory

__all__ = [
    "AdaptationEvaluation",
    "AdaptedPolicy",
    "BoltzmannNoise",
    "BoltzmannOracle",
    "EpisodeOutcomes",
    "ExactNoise",
    "HumanOracle",
    "KnownTaskReturn",
    "MistakeNoise",
    "MistakeOracle",
    "NoiseModel",
    "Preference",
    "PreferenceAdapter",
    "Query",
    "ReturnOracle",
    "TaskAdaptations",
    "TaskOracle",
    "Trajectory",
    "adapt_tasks",
    "answer_capacity",
    "best_codebook",
    "evaluate_adaptation",
    "evaluate_episodes",
    "evaluate_latents",
    "information_limit",
    "known_task_return",
    "property_one",
    "rate_distortion_limit",
]
