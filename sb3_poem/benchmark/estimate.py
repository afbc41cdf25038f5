"""How long trainings and cells take, told from how fast this machine is at a short training."""

import contextlib
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch as th

from sb3_poem.adaptation.known_task import (
    LATENTS_WITH_OWN_DYNAMICS,
    LATENTS_WITH_SHARED_DYNAMICS,
    REFINING_DRAWS,
    REFINING_WIDTHS,
    SELECTION_EPISODES,
)
from sb3_poem.baselines import MAMLReward
from sb3_poem.baselines.fragments import default_fragment_length
from sb3_poem.benchmark.methods import META_ITERATIONS, META_ITERATIONS_OF
from sb3_poem.benchmark.suites import Cell, ModelKey
from sb3_poem.benchmark.training import family_facts, training_plan
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.poem_sac import POEMSAC

#: Seconds until a training's process has begun, and to save what it ends with
PROCESS_SECONDS = 6.0
# What follows is counted in gradient steps of the family's model, which grow with the machine's
# speed as it does.
#: Of an iteration of MAML-reward's meta-training
UPDATES_PER_META_ITERATION = 18
#: Of what is computed for an answer and the next question, by rule or strategy; others are quick
UPDATES_PER_ANSWER = {"Bayes": 0.7, "berlekamp": 2.0}
#: Of the same with ANOLE's greedy strategy, for each step of a fragment
UPDATES_PER_GREEDY_STEP = 0.65
# MAML-reward adapts by SAC's gradient steps, which cost as much as the model's own.
#: What the machine is tried with: copies that are stepped at once, steps of an episode, and
#: gradient steps
COPIES, STEPS, UPDATES = 20, 128, 20


@dataclass(frozen=True)
class Pace:
    """Seconds of an environment step of one copy with its action, and of a gradient step."""

    step: float
    update: float


@cache
def measure_pace(env_id: str, device: str = "cpu", num_threads: int = 1) -> Pace:
    """Train for two short epochs with the hyperparameters that ship, and look at the second."""
    th.set_num_threads(num_threads)
    facts = family_facts(env_id)
    tasks, steps = min(COPIES, facts.n_train_tasks), min(facts.horizon, STEPS)
    with contextlib.closing(make_task_vec_env(env_id, COPIES, max_episode_steps=steps)) as env:
        changes: dict[str, Any] = {"env": env, "gradient_steps": UPDATES, "device": device}
        changes |= {"n_train_tasks": tasks, "trajectories_per_task": COPIES // tasks}
        model = POEMSAC.from_zoo(env_id, **changes)
        model.learn(2 * COPIES * steps, log_interval=None)
    log = model.logger.name_to_value
    return Pace(1.0 / log["time/collection_fps"], 1.0 / log["time/updates_per_second"])


def training_seconds(key: ModelKey, pace: Pace) -> float:
    """Of a model's training from scratch; of one that is made from another's, what comes on top."""
    if key.base is not None:
        iterations = META_ITERATIONS_OF.get(key.family, META_ITERATIONS)
        return iterations * UPDATES_PER_META_ITERATION * pace.update
    plan = training_plan(key)
    return PROCESS_SECONDS + plan.timesteps * pace.step + plan.updates * pace.update


def cell_seconds(cell: Cell, pace: Pace) -> float:
    """Of a cell whose model is there."""
    budget, facts, method = cell.budget, family_facts(cell.env_id), cell.definition
    queries = budget.record_at[-1]
    if method.rule is None:
        latents = LATENTS_WITH_OWN_DYNAMICS * budget.tasks
        if facts.shared_dynamics:
            latents = LATENTS_WITH_SHARED_DYNAMICS
        refining = len(REFINING_WIDTHS) * (1 + REFINING_DRAWS) * budget.tasks
        episodes = latents + (latents + refining) * min(budget.episodes, SELECTION_EPISODES)
        return (episodes + budget.tasks * budget.episodes) * facts.horizon * pace.step
    episodes = budget.tasks * budget.episodes * len(budget.record_at)
    if method.rule != "ANOLE" or method.library:  # else it asks about what there is
        episodes += budget.tasks * method.films * queries
    asks = method.options.get("strategy", method.rule)
    updates = UPDATES_PER_ANSWER.get(asks, 0.0)
    if asks == "greedy":
        updates = UPDATES_PER_GREEDY_STEP * default_fragment_length(facts.horizon)
    elif asks == "MAMLReward":
        updates = MAMLReward(**dict(cell.overrides)).gradient_steps
    return episodes * facts.horizon * pace.step + budget.tasks * queries * updates * pace.update
