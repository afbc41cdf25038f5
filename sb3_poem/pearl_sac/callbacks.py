"""Callbacks of training."""

import time
import warnings
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_poem.common.checks import check_whole
from sb3_poem.pearl_sac.pearl_sac import PEARLSAC


class EpochCallback(BaseCallback):
    """Calls :meth:`_on_epoch` between two epochs: after the gradient steps of one, before the
    collection of the next.

    :param every: Epochs between two calls; the end of training is always one
    """

    model: PEARLSAC

    def __init__(self, every: int = 1, verbose: int = 0) -> None:
        super().__init__(verbose)
        check_whole("every", every, 1)
        self.every = every
        self._last_epoch = 0

    def _init_callback(self) -> None:
        if not isinstance(self.model, PEARLSAC):
            who, other = type(self).__name__, type(self.model).__name__
            raise TypeError(
                f"{who} is for POEMSAC and PEARLSAC, which train in epochs, not {other}"
            )

    def _on_training_start(self) -> None:
        self._last_epoch = self.model.epoch

    def _on_rollout_start(self) -> None:
        self._run_after(self.every)

    def _on_training_end(self) -> None:
        self._run_after(1)

    def _run_after(self, epochs: int) -> None:
        if self.model.epoch >= self._last_epoch + epochs:
            self._last_epoch = self.model.epoch
            self._on_epoch()

    def _on_step(self) -> bool:
        return True

    def _on_epoch(self) -> None:
        """What to do; override."""


class TrainingCheckpointCallback(EpochCallback):
    """Writes a checkpoint from which ``load_checkpoint`` and ``resume`` continue bit for bit,
    always to the same file.

    A handler of Ctrl-C may call :meth:`stop`, as ``signal.signal(signal.SIGINT, lambda *_:
    callback.stop())``: then nothing of what was learned is lost.

    >>> from sb3_poem import POEMSAC
    >>> small = dict(n_train_tasks=4, gradient_steps=2, seed=0)
    >>> model = POEMSAC("MlpPolicy", "poem/PointGoal-v0", **small)
    >>> _ = model.learn(100, TrainingCheckpointCallback("checkpoint.zip"))
    >>> POEMSAC.load_checkpoint("checkpoint.zip", "poem/PointGoal-v0").num_timesteps
    100

    :param path: The file; it is replaced atomically
    :param every: Epochs between two checkpoints; None: at most every 50 times as long as writing
        one takes, and training goes on where it cannot be written. The end of training writes one
        too, unless it was stopped within an epoch
    :param verbose: 1 reports each write
    """

    def __init__(self, path: str | Path, every: int | None = 1, verbose: int = 0) -> None:
        super().__init__(1 if every is None else every, verbose)
        self.path = Path(path)
        #: Environment steps that the last checkpoint holds; None before the first
        self.saved_steps: int | None = None
        self._paced = every is None
        self._not_before = 0.0
        self._stops = self._collecting = False

    def stop(self) -> None:
        """End training after the epoch at hand with a checkpoint and a ``KeyboardInterrupt``; after
        the last epoch it has ended without one.
        """
        self._stops = True

    def _on_rollout_start(self) -> None:
        if self._stops:
            self._stops = False
            super()._on_training_end()  # writes, unless this epoch's is there
            raise KeyboardInterrupt
        if time.monotonic() >= self._not_before:
            super()._on_rollout_start()
        self._collecting = True

    def _on_rollout_end(self) -> None:
        self._collecting = False

    def _on_training_end(self) -> None:
        self._stops = False
        if not self._collecting:  # half an epoch could not be continued bit for bit
            super()._on_training_end()

    def _on_epoch(self) -> None:
        started, steps = time.monotonic(), self.model.num_timesteps
        try:
            self.model.save_checkpoint(self.path)
        except OSError as error:
            if not self._paced:
                raise
            warnings.warn(f"no checkpoint of {steps} steps: {error}", stacklevel=2)
        else:
            self.saved_steps = steps
            if self.verbose > 0:
                print(f"Checkpoint of {steps} steps: {self.path}")
        if self._paced:
            self._not_before = time.monotonic() + 50 * (time.monotonic() - started)
