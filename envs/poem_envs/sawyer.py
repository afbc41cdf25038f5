"""Meta-World's Sawyer manipulations, made reproducible: a start depends on the placement alone."""

import collections
import copy
import functools
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import mujoco
import numpy as np

from poem_envs.mujoco_rendering import close_viewers, fit_buffer, leave_out_details, prepared_viewer
from poem_envs.registration import did_you_mean

INSTALL = "pip install -c constraints.txt '.[metaworld]' in a checkout"


def load_metaworld() -> Any:
    """The module ``metaworld.env_dict``, of a version whose environments are known."""
    needed = "the Meta-World families need metaworld >= 3.1, < 4"
    try:
        found = version("metaworld")
    except PackageNotFoundError:
        raise ImportError(f"{needed}: {INSTALL}") from None
    major, minor = (int(part) for part in found.split(".")[:2])
    if major != 3 or minor < 1:
        raise ImportError(f"{needed}, but metaworld {found} is installed: {INSTALL}")
    import metaworld.env_dict

    return metaworld.env_dict


def manipulation_names() -> list[str]:
    """Meta-World's manipulations, without the ``-v3`` that all of them end with."""
    return sorted(name.removesuffix("-v3") for name in load_metaworld().ALL_V3_ENVIRONMENTS)


def checked_manipulation(env_name: str) -> str:
    """The name of a manipulation, with ``-v3`` or without, as one without."""
    known, name = manipulation_names(), str(env_name).removesuffix("-v3")
    if name in known:
        return name
    hint = did_you_mean(name, known, cutoff=0.4) or f"; choose one of {', '.join(known)}"
    raise ValueError(f"{env_name=} is none of Meta-World's {len(known)} manipulations{hint}")


class Sawyer:
    """One manipulation, in any placement.

    Meta-World's own reset leaves some starts depending on the episode before: it computes them from
    data that the simulator has not brought up to date since objects were moved. Here a reset is
    what Meta-World does in an environment that has just been made, bit for bit, however often it
    was used before. Arguments of rendering are Meta-World's ``render_mode``, ``camera_name``,
    ``width`` and ``height``.
    """

    def __init__(
        self, manipulation: str, *, renders_fast: bool = False, **render_arguments: Any
    ) -> None:
        self.manipulation = manipulation
        self.arguments = {"renders_fast": renders_fast, **render_arguments}
        self.env = env = _environment_class(manipulation)(**render_arguments)
        if renders_fast:
            leave_out_details(env.model)
        env._set_task_called = True  # placements are set here, without Meta-World's pickled tasks
        env.max_path_length = np.inf  # time limits are a wrapper's
        env._get_state_rand_vec = self._take_placement
        self._placement: np.ndarray | None = None

    def reset(self, placement: np.ndarray, show_goal: bool = False) -> np.ndarray:
        """Begin an episode of a placement, Meta-World's ``rand_vec``; returns the observation. A
        ValueError says that Meta-World would redraw the placement.
        """
        env = self.env
        # The first pass moves bodies in the model, from which the second one computes.
        for _ in range(2):
            mujoco.mj_resetData(env.model, env.data)
            self._placement = placement.copy()
            observation = env.reset_model()
        for name, _ in env._target_site_config:
            env.model.site(name).rgba[3] = float(show_goal)
        env._prev_obs = observation[:18].copy()
        observation = observation.copy()
        observation[18:36] = env._prev_obs
        return observation

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        """Observation, Meta-World's reward, and whether the step was a success; a
        FloatingPointError says that the simulation diverged.
        """
        env = self.env
        before = env.data.time
        observation, reward, _, _, info = env.step(action)
        # MuJoCo resets a simulation that blows up, with no more than a warning; its clock tells.
        if env.data.time <= before or not (np.isfinite(observation).all() and np.isfinite(reward)):
            raise FloatingPointError("MuJoCo met a state that is not finite or too large")
        return observation, float(reward), bool(info["success"])

    def render(self) -> Any:
        env = self.env
        if env.render_mode is not None:
            prepared_viewer(env.mujoco_renderer, env.render_mode, self.arguments["renders_fast"])
        return env.render()

    def close(self) -> None:
        """Close windows and graphics contexts, which a later rendering would open again."""
        close_viewers(self.env.mujoco_renderer)

    def _take_placement(self) -> np.ndarray:
        if self._placement is None:  # it asks for another one
            raise ValueError(
                f"Meta-World refuses the placement of {self.manipulation!r}: it places object and "
                "goal too near to each other; draw one by sample_tasks"
            )
        placement, self._placement = self._placement, None
        return placement


# Simulators at rest, by what they were made with. An environment whose tasks are different
# manipulations changes simulators at its resets; without this, each of many environments would come
# to hold one for every manipulation.
_at_rest: dict[tuple[Any, ...], list[Sawyer]] = collections.defaultdict(list)


def take_sawyer(manipulation: str, **arguments: Any) -> Sawyer:
    """A simulator made with :class:`Sawyer`'s arguments, anew if none is at rest."""
    at_rest = _at_rest[manipulation, *sorted(arguments.items())]
    return at_rest.pop() if at_rest else Sawyer(manipulation, **arguments)


def give_back_sawyer(sawyer: Sawyer) -> None:
    """Let others have a simulator that is no longer used."""
    _at_rest[sawyer.manipulation, *sorted(sawyer.arguments.items())].append(sawyer)


class Placements:
    """A manipulation's placements, as Meta-World draws them, in an arm that stays still."""

    def __init__(self, manipulation: str) -> None:
        self._sawyer = Sawyer(manipulation)
        env = self._sawyer.env
        self._own_draw = type(env)._get_state_rand_vec
        env._reset_hand = lambda steps=50: setattr(env, "init_tcp", env.tcp_center)
        env._freeze_rand_vec, env.seeded_rand_vec = False, True
        #: Where the hand begins, ``(3,)``.
        self.hand_init_pos = np.array(env.hand_init_pos, dtype=np.float64)
        #: Bounds, each ``(placement_dim,)``.
        self.low = env._random_reset_space.low.astype(np.float64)
        self.high = env._random_reset_space.high.astype(np.float64)

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a placement as Meta-World does, ``(placement_dim,)``."""
        env = self._sawyer.env
        env.np_random = rng
        env._get_state_rand_vec = lambda: self._own_draw(env)
        env.reset_model()
        return np.array(env._last_rand_vec, dtype=np.float64)

    def check(self, placement: np.ndarray) -> None:
        """Raise a ValueError if Meta-World would redraw the placement."""
        self._sawyer.env._get_state_rand_vec = self._sawyer._take_placement
        self._sawyer._placement = placement.copy()
        self._sawyer.env.reset_model()


#: The placements of a manipulation; they are kept, since an environment takes long to make.
placements_of = functools.cache(Placements)


@functools.cache
def _environment_class(manipulation: str) -> type:
    """Meta-World's class, with models that are copied rather than compiled anew, which is slow."""
    base: Any = load_metaworld().ALL_V3_ENVIRONMENTS[f"{manipulation}-v3"]
    compiled: dict[str, mujoco.MjModel] = {}

    class Environment(base):
        def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
            if self.fullpath not in compiled:
                compiled[self.fullpath], _ = super()._initialize_simulation()
            model = copy.deepcopy(compiled[self.fullpath])
            fit_buffer(model, self.width, self.height)
            return model, mujoco.MjData(model)

    return Environment
