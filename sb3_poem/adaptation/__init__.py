"""Adaptation to a new task from preferences: ask and tell, rules, oracles, evaluation."""
# ruff: noqa: F401

from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.adaptation.bayes import Bayes
from sb3_poem.adaptation.evaluation import (
    AdaptationEvaluation,
    EpisodeOutcomes,
    TaskAdaptations,
    adapt_tasks,
    evaluate_adaptation,
    evaluate_episodes,
)
from sb3_poem.adaptation.known_task import (
    KnownTaskReturn,
    known_task_return,
    property_one,
    return_spread,
)
from sb3_poem.adaptation.limits import (
    AnswerLimits,
    answer_capacity,
    best_codebook,
    information_limit,
    rate_distortion_limit,
)
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.named_rule import named_rule
from sb3_poem.adaptation.noise import BoltzmannNoise, ExactNoise, MistakeNoise, NoiseModel
from sb3_poem.adaptation.oracles import (
    BoltzmannOracle,
    HumanOracle,
    MistakeOracle,
    ReturnOracle,
    TaskOracle,
)
from sb3_poem.adaptation.paper import Paper
from sb3_poem.adaptation.policy import AdaptedPolicy
from sb3_poem.adaptation.preference import Preference, Query
from sb3_poem.adaptation.rule import Answer, Inference, Rule, Setting
from sb3_poem.common.trajectory import Trajectory
