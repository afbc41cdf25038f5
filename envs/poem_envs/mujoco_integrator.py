"""Physics steps of many states at once, in MuJoCo's own threads."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.rollout import Rollout


class Integrator:
    """Advances a batch of states of one model through ``mujoco.rollout``, with threads that stay.

    :param model: the model that the states are of
    :param frame_skip: physics steps in one call of :meth:`advance`
    :param batch_size: number of states
    :param nthread: number of threads; 0 or 1 for the calling one
    """

    def __init__(
        self, model: mujoco.MjModel, frame_skip: int, batch_size: int, nthread: int
    ) -> None:
        nthread = min(nthread, batch_size)
        self._rollout = Rollout(nthread=nthread if nthread > 1 else 0)
        self._data = [mujoco.MjData(model) for _ in range(max(nthread, 1))]
        self._models = [model] * batch_size
        self._frame_skip = frame_skip
        self._controls = np.empty((batch_size, frame_skip, model.nu))
        self._states = np.empty((batch_size, frame_skip, 1 + model.nq + model.nv))

    def advance(self, states: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Advance every state under a constant control, with a cold solver start.

        :param states: ``(batch_size, 1 + nq + nv)``: time, positions, velocities; contiguous
            float64
        :param controls: ``(batch_size, nu)``
        :return: the states after, a view that the next call overwrites
        """
        self._controls[:] = controls[:, None]
        self._rollout.rollout(
            self._models,
            self._data,
            states,
            self._controls,
            control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            skip_checks=True,
            nstep=self._frame_skip,
            state=self._states,
        )
        return self._states[:, -1]

    def close(self) -> None:
        """End the threads."""
        self._rollout.close()
