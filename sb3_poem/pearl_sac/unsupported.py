"""What SB3's SAC takes and our algorithms do not: why, and what to do instead."""

import difflib
import inspect
from collections.abc import Iterable

_NOISE = "training explores by the policy's own noise; with noise_color=1 it keeps a direction"
_BUFFER = (
    "experience is kept for each training task, so that it can be relabelled for others, as HER does "
    "for goals; see buffer_size, relabel_fraction, and poem_envs.GoalFamily for goal-conditioned "
    "environments"
)
_FEATURES = "networks read flat observations; see net_arch, and put features into the observation"
_WRAPPED = "it changes what is seen or paid, and rewards are computed for other tasks from what the family itself gives; "
_DEVIATION = "the policy's deviation is learned, from 1 on; see ent_coef and target_entropy"

#: Argument of SAC or of its policies, or key of rl_zoo3's files: why not, and what to do instead
UNSUPPORTED = {
    **dict.fromkeys(("action_noise", "noise_type", "noise_std"), _NOISE),
    **dict.fromkeys(("use_sde", "sde_sample_freq", "use_sde_at_warmup"), _NOISE),
    "train_freq": (
        "an epoch is a rollout of every training task, then gradient steps; see trajectories_per_task and gradient_steps"
    ),
    "optimize_memory_usage": "relabelling needs all of a transition; a smaller buffer_size saves memory",
    **dict.fromkeys(("replay_buffer_class", "replay_buffer_kwargs"), _BUFFER),
    **dict.fromkeys(("features_extractor_class", "features_extractor_kwargs"), _FEATURES),
    **dict.fromkeys(("share_features_extractor", "normalize_images"), _FEATURES),
    **dict.fromkeys(
        ("env_wrapper", "vec_env_wrapper", "frame_stack"), f"{_WRAPPED}write it into the family"
    ),
    "normalize": f"{_WRAPPED}observations and rewards are standardised by the algorithm",
    **dict.fromkeys(("log_std_init", "use_expln", "clip_mean"), _DEVIATION),
}
#: Arguments of the policy, which people give to the algorithm
POLICY_ARGUMENTS = (
    "net_arch",
    "activation_fn",
    "layer_norm",
    "n_critics",
    "optimizer_class",
    "optimizer_kwargs",
)


def refuse_unsupported(names: Iterable[str], algorithm: str) -> None:
    """:param names: Of arguments, of the algorithm or of its policy
    :param algorithm: Whose, for the message
    :raises TypeError: at the first that SAC takes and ours do not
    """
    for name in names:
        if name in UNSUPPORTED:
            raise TypeError(f"{algorithm} takes no {name!r}: {UNSUPPORTED[name]}")


def refuse_unknown(names: Iterable[str], algorithm: type) -> None:
    """:param names: Of arguments that the constructor does not have
    :param algorithm: Its class
    :raises TypeError: at the first; as :func:`refuse_unsupported`, or with a name like it
    """
    refuse_unsupported(names, algorithm.__name__)
    for name in names:
        if name in POLICY_ARGUMENTS:
            raise TypeError(
                f"{algorithm.__name__} takes {name!r} in policy_kwargs: policy_kwargs=dict({name}=...)"
            )
        close = difflib.get_close_matches(name, inspect.signature(algorithm).parameters, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise TypeError(f"{algorithm.__name__} got an unexpected keyword argument {name!r}{hint}")
