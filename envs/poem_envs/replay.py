"""Families around simulators that cannot be copied: a copy is made by living through the episode again."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import Any

import numpy as np
import numpy.typing as npt

from poem_envs.core import TaskFamily


class ReplayFamily(TaskFamily):
    """A family whose copies (``pickle``, ``copy.deepcopy``) get a simulator of their own, and repeat the episode so far in it.

    For that its episodes must depend on the task, the generator and the actions alone. A subclass defines
    :meth:`_begin_simulation` and :meth:`_step_simulation` in place of :meth:`_begin_episode` and :meth:`_simulate`, and
    :meth:`_build`, which makes what ``_simulator_attributes`` names.
    """

    #: Attributes that are made by :meth:`_build` and stay out of copies.
    _simulator_attributes: tuple[str, ...] = ()

    _start_rng: np.random.Generator | None = None
    _start_state: np.ndarray | None = None
    _actions: list[np.ndarray]

    @abstractmethod
    def _build(self) -> None:
        """Make the simulator. Called by the subclass's constructor, and for a copy."""

    @abstractmethod
    def _begin_simulation(self, rng: np.random.Generator) -> np.ndarray:
        """As :meth:`_begin_episode`."""

    @abstractmethod
    def _step_simulation(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """As :meth:`_simulate`."""

    def _begin_episode(self, rng: np.random.Generator) -> np.ndarray:
        self._start_rng, self._start_state, self._actions = copy.deepcopy(rng), None, []
        return self._begin_simulation(rng)

    def _simulate(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        self._actions.append(action)
        return self._step_simulation(action)

    def _restart_from(self, state: npt.ArrayLike) -> None:
        """To be called when the simulator was put into a state that :meth:`set_physics_state` takes."""
        self._start_state, self._actions = np.array(state), []

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in self._simulator_attributes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._build()
        if self._start_rng is None:
            return
        actions, start_state = self._actions, self._start_state
        self._begin_episode(copy.deepcopy(self._start_rng))
        if start_state is not None:
            self.set_physics_state(start_state)  # type: ignore[attr-defined]
        for action in actions:
            self._simulate(action)
