"""Arguments: their ranges, what an environment may be, and why SAC's others are not taken."""

import contextlib
import inspect
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from poem_envs.registration import did_you_mean, plain_id
from sb3_poem.common.checks import check_number, check_number_or_auto, check_whole
from sb3_poem.common.precision import check_device, hidden_dtype
from sb3_poem.common.vec_env import make_task_vec_env, vectorised
from sb3_poem.pearl_sac.policies import DEFAULT_NET_ARCH
from sb3_poem.pearl_sac.train_tasks import DEFAULT_TRAIN_TASKS, default_train_tasks

#: What a model may be given as its environment
GivenEnv = GymEnv | gym.vector.VectorEnv | str

T = TypeVar("T")
BY_NAME = inspect.Parameter.KEYWORD_ONLY

#: The least of arguments that are whole numbers
LEAST = {
    **dict.fromkeys(("batch_size", "meta_batch_size", "context_size", "trajectories_per_task"), 1),
    **dict.fromkeys(("latent_dim", "buffer_size", "target_update_interval", "n_steps"), 1),
    **{"policy_delay": 1, "learning_starts": 0, "gradient_steps": -1},
    **{"n_train_tasks": 1, "horizon": 1, "seed": 0},
}
#: Those of them that may be None
OPTIONAL = ("n_train_tasks", "horizon", "seed", "relabel_fraction", "context_relabel_fraction")
#: The most of arguments that are numbers from 0 on
MOST = {
    **dict.fromkeys(("kl_coef", "reward_coef", "policy_coef"), np.inf),
    **dict.fromkeys(("gamma", "tau", "shaping_coef"), 1.0),
    **dict.fromkeys(("relabel_fraction", "context_relabel_fraction"), 1.0),
}

_NOISE = "training explores by the policy's own noise; see ent_coef and target_entropy"
_BUFFER = (
    "experience is kept for each training task, so that it can be relabelled for others, as HER "
    "does for goals; see buffer_size, relabel_fraction, and poem_envs.GoalFamily for "
    "goal-conditioned environments"
)
_FEATURES = "networks read flat observations; see net_arch, and put features into the observation"
_WRAPPED = (
    "it changes what is seen or paid, and rewards are computed for other tasks from what the "
    "family itself gives; "
)
_DEVIATION = "the policy's deviation is learned, from 1 on; see ent_coef and target_entropy"

#: Argument of SAC or of its policies, or key of rl_zoo3's files: why not, and what to do instead
UNSUPPORTED = {
    **dict.fromkeys(("action_noise", "noise_type", "noise_std"), _NOISE),
    **dict.fromkeys(("use_sde", "sde_sample_freq", "use_sde_at_warmup"), _NOISE),
    "train_freq": "an epoch is a rollout of every training task, then gradient steps; see "
    "trajectories_per_task and gradient_steps",
    "optimize_memory_usage": "relabelling needs all of a transition; a smaller buffer_size saves "
    "memory",
    **dict.fromkeys(("replay_buffer_class", "replay_buffer_kwargs"), _BUFFER),
    **dict.fromkeys(("features_extractor_class", "features_extractor_kwargs"), _FEATURES),
    **dict.fromkeys(("share_features_extractor", "normalize_images"), _FEATURES),
    **dict.fromkeys(("env_wrapper", "vec_env_wrapper"), f"{_WRAPPED}write it into the family"),
    "frame_stack": f"{_WRAPPED}write it into the family",
    "normalize": f"{_WRAPPED}observations and rewards are standardised by the algorithm",
    **dict.fromkeys(("log_std_init", "use_expln", "clip_mean"), _DEVIATION),
}
#: Arguments of the policy, which people give to the algorithm
POLICY_ARGUMENTS = (
    *("net_arch", "activation_fn", "layer_norm", "n_critics"),
    *("optimizer_class", "optimizer_kwargs"),
)


def refuse_unsupported(names: Iterable[str], algorithm: str) -> None:
    """:raises TypeError: At the first name of an argument that SAC takes and ours do not"""
    for name in names:
        if name in UNSUPPORTED:
            raise TypeError(f"{algorithm} takes no {name!r}: {UNSUPPORTED[name]}")


def refuse_unknown(names: Iterable[str], algorithm: type) -> None:
    """Refuse a name that the constructor does not have, and say which it may have meant."""
    refuse_unsupported(names, algorithm.__name__)
    for name in names:
        if name in POLICY_ARGUMENTS:
            instead = f"policy_kwargs: policy_kwargs=dict({name}=...)"
            raise TypeError(f"{algorithm.__name__} takes {name!r} in {instead}")
        hint = did_you_mean(name, inspect.signature(algorithm).parameters)
        raise TypeError(f"{algorithm.__name__} got an unexpected keyword argument {name!r}{hint}")


def check_arguments(given: Mapping[str, Any], algorithm: type) -> None:
    """Refuse the first of PEARLSAC's arguments, by name, that is outside its range."""
    policy_kwargs, scale, device = given["policy_kwargs"], given["reward_scale"], given["device"]
    if not isinstance(policy_kwargs, dict | None):
        raise TypeError(f"policy_kwargs must be a dictionary, but is {policy_kwargs!r}")
    refuse_unsupported(policy_kwargs or (), f"{algorithm.__name__}'s policy")
    for name in policy_kwargs or ():
        if given["policy"] == "MlpPolicy" and name not in POLICY_ARGUMENTS:
            known = f"known are {', '.join(POLICY_ARGUMENTS)}"
            if name in DEFAULT_NET_ARCH:
                known = f"widths go into net_arch: dict(net_arch=dict({name}=[...]))"
            raise TypeError(f"policy_kwargs has an unknown key {name!r}; {known}")
    for name, least in LEAST.items():
        if not (given[name] is None and name in OPTIONAL):
            check_whole(name, given[name], least)
    if not callable(given["learning_rate"]):
        check_number("learning_rate", given["learning_rate"], 0.0)
    for name, most in MOST.items():
        if not (given[name] is None and name in OPTIONAL):
            check_number(name, given[name], 0.0, most)
    check_number_or_auto("ent_coef", given["ent_coef"], 0.0)
    check_number_or_auto("target_entropy", given["target_entropy"])
    number = isinstance(scale, int | float | np.number) and 0 < scale < np.inf
    if not (number or scale in ("auto", "per-task")):
        needed = 'a positive number, "auto" or "per-task"'
        raise ValueError(f"reward_scale must be {needed}, but is {scale!r}")
    if given["shaping_coef"] > 0 and given["gamma"] == 1:
        raise ValueError("shaping_coef must be 0 with gamma=1: staying has no finite value then")
    hidden_dtype(given["precision"], "cpu")  # refuses an unknown name
    check_device(device)
    if str(device).startswith("cuda") and not th.cuda.is_available():  # which SB3 says nothing of
        what = f"device is {device!r}, but torch sees no CUDA device: the CPU is used"
        warnings.warn(what, stacklevel=3)


def warn_of_idle_callbacks(callback: BaseCallback, total_timesteps: int, n_envs: int) -> None:
    """Say which of SB3's callbacks, which count a step of all copies as one call, never act."""
    calls = -(-total_timesteps // n_envs)
    found = [callback]
    for each in found:
        found += getattr(each, "callbacks", ())  # a progress bar puts a list into another
        for name in ("save_freq", "eval_freq"):
            every = getattr(each, name, 0)
            if isinstance(every, int) and every - each.n_calls % max(every, 1) > calls:
                warnings.warn(
                    f"{type(each).__name__} never acts in this training: {name}={every} counts "
                    f"calls, of which a training of {total_timesteps:,} steps has {calls:,}, one "
                    f"for a step of all {n_envs} copies of the environment. For each {every:,} "
                    f"steps pass {max(every // n_envs, 1)}",
                    stacklevel=3,
                )


def with_arguments_of(base: type, without: str) -> Callable[[type[T]], type[T]]:
    """Of a class whose constructor passes ``*args`` and ``**kwargs`` on to its base class's: its
    signature and docstring have the arguments of both, ``without`` one of the base class's.
    """

    def described(cls: type) -> dict[str, str]:
        found = re.findall(r"(    :param (\w+):.*\n(?:        .*\n)*)", cls.__doc__ or "")
        return {name: words for words, name in found}

    def decorate(cls: type[T]) -> type[T]:
        constructor: Any = vars(cls)["__init__"]
        signatures = [inspect.signature(vars(each)["__init__"]) for each in (base, cls)]
        merged = {**signatures[0].parameters, **signatures[1].parameters}
        for name in (without, "args", "kwargs"):
            del merged[name]
        by_place = ("self", "policy", "env", "unsupported")
        kinds = [
            one if name in by_place else one.replace(kind=BY_NAME) for name, one in merged.items()
        ]
        constructor.__signature__ = inspect.Signature(sorted(kinds, key=lambda one: one.kind))
        text, documented = cls.__doc__ or "", {*described(cls), without}
        inherited = [words for name, words in described(base).items() if name not in documented]
        start = text.index("    :param ")
        cls.__doc__ = text[:start] + "".join(inherited) + text[start:]
        return cls

    return decorate


def vectorise(
    env: GivenEnv | None,
    n_copies: int | None = None,
    n_train_tasks: int | None = None,
    trajectories_per_task: int = 1,
    **env_kwargs: Any,
) -> GymEnv:
    """An environment as SB3 takes it. A registered id becomes ``n_copies`` with these arguments;
    None: as many as are worth while.
    """
    if isinstance(env, gym.vector.VectorEnv):
        return vectorised(env)
    if isinstance(env, gym.Env | VecEnv):
        return env
    if not isinstance(env, str):
        raise TypeError(
            f"env is {env!r}, but must be an environment, a vectorised one (DummyVecEnv, "
            "SubprocVecEnv, TaskVecEnv), or a registered id"
        )
    env = plain_id(env)
    if n_copies is not None:
        return make_task_vec_env(env, n_copies, max_sequential=n_copies, **env_kwargs)
    return make_task_vec_env(env, default_copies(env, n_train_tasks, trajectories_per_task))


def default_copies(
    env_id: str, n_train_tasks: int | None, trajectories_per_task: int, **env_kwargs: Any
) -> int:
    """How many copies of an environment to step unless told: one for each trajectory of an epoch,
    up to one per task or :data:`DEFAULT_TRAIN_TASKS`, whichever is more.
    """
    if n_train_tasks is None:
        with contextlib.closing(gym.make(env_id, **env_kwargs)) as probe:
            n_train_tasks = default_train_tasks(getattr(probe.unwrapped, "all_tasks", None))
    return min(n_train_tasks * trajectories_per_task, max(n_train_tasks, DEFAULT_TRAIN_TASKS))
