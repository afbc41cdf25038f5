"""rl_zoo3's experiments on task families."""

import contextlib
import inspect
import json
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

import gymnasium as gym
import optuna
import yaml
from gymnasium.envs.registration import load_env_creator
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from rl_zoo3.utils import get_callback_list
from stable_baselines3.common.callbacks import ProgressBarCallback
from stable_baselines3.common.vec_env import VecEnv

from poem_envs import TaskFamily
from sb3_poem.adaptation.callback import AdaptationEvalCallback
from sb3_poem.cli.hyperparams import check_entry, entry_params, find_config
from sb3_poem.cli.needs import check_writable
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import TaskVecEnv
from sb3_poem.loading import ALGORITHMS
from sb3_poem.pearl_sac import PEARLSAC
from sb3_poem.pearl_sac.arguments import default_copies
from sb3_poem.pearl_sac.callbacks import TrainingCheckpointCallback
from sb3_poem.pearl_sac.saving import CHECKPOINT, facts_of
from sb3_poem.resources import config_file


class TrainingInterrupted(KeyboardInterrupt):
    """Training was interrupted and saved, with a checkpoint if its second argument says so."""


@contextlib.contextmanager
def handled(handler: Any, *numbers: signal.Signals) -> Iterator[None]:
    """Let signals be handled so within; in threads but the main one (--n-jobs) as before."""
    if threading.current_thread() is not threading.main_thread():
        numbers = ()
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, own in before.items():
            signal.signal(number, own)


@contextlib.contextmanager
def stopping_between_epochs(checkpoint: TrainingCheckpointCallback) -> Iterator[None]:
    """Let the first Ctrl-C (or SIGTERM) end training after this epoch, the second at once."""
    both = (signal.SIGINT, signal.SIGTERM)
    heard = [number for number in both if signal.getsignal(number) is not signal.SIG_IGN]

    def stop(number: int, frame: FrameType | None) -> None:
        first.close()
        checkpoint.stop()
        with contextlib.suppress(OSError):  # and not print, which this signal may have interrupted
            os.write(2, b"\nStopping after this epoch, to save it. Ctrl-C again stops at once.\n")

    with contextlib.ExitStack() as first:
        first.enter_context(handled(stop, *heard))
        yield


def make_experiment(
    args: Any, algo: str, env_id: str, log_folder: str, *rest: Any, **kwargs: Any
) -> ExperimentManager:
    """The experiment that rl_zoo3's ``train`` takes for its own, once arguments are checked."""
    # -1 is rl_zoo3's default, and takes the entry's
    if args.n_timesteps < 1 and args.n_timesteps != -1:
        raise ValueError(f"-n/--n-timesteps must be at least 1, got {args.n_timesteps}")
    if args.conf_file is not None:
        kwargs["config"] = find_config(args.conf_file)
    for folder in (log_folder, args.tensorboard_log, args.optimization_log_path):
        if folder:
            check_writable(folder)
    kind = PoemExperiment if algo in ALGORITHMS else FamilyExperiment
    return kind(args, algo, env_id, log_folder, *rest, **kwargs)


def is_task_family(env_id: str) -> bool | None:
    """Whether an environment is a task family; None if a function makes it."""
    creator: Any = gym.spec(env_id).entry_point
    if isinstance(creator, str):
        creator = load_env_creator(creator)
    return issubclass(creator, TaskFamily) if inspect.isclass(creator) else None


class FamilyExperiment(ExperimentManager):
    """Steps all copies of a task family at once, unless ``--vec-env subproc`` asks otherwise."""

    def __init__(self, args: Any, algo: str, env_id: str, *rest: Any, **kwargs: Any) -> None:
        super().__init__(args, algo, env_id, *rest, **kwargs)
        vectorises = is_task_family(env_id) and gym.spec(env_id).vector_entry_point is not None
        if args.vec_env == "dummy" and vectorises:
            self.vec_env_class = TaskVecEnv

    def create_log_folder(self) -> None:
        """As rl_zoo3's, but in no folder of another run, as of one that begins at the same time."""
        name, _, number = self.save_path.rpartition("_")
        while True:
            try:
                os.makedirs(self.save_path)
                break
            except FileExistsError:
                number = str(int(number) + 1)
                self.save_path = f"{name}_{number}"
        self.params_path = f"{self.save_path}/{self.env_name}"
        super().create_log_folder()


class PoemExperiment(FamilyExperiment):
    """A meta-training run: evaluated by adaptation to held-out tasks, and resumable from
    ``checkpoint.zip``, which is written as often as it costs little, or by ``--save-freq``.
    """

    def __init__(self, args: Any, algo: str, env_id: str, *rest: Any, **kwargs: Any) -> None:
        if is_task_family(env_id) is False:
            raise ValueError(f"--env {env_id} is no task family, and {algo} needs one")
        kwargs["config"] = kwargs.get("config") or str(config_file(algo))
        super().__init__(args, algo, env_id, *rest, **kwargs)
        self.steps_per_evaluation, self.steps_per_checkpoint = self.eval_freq, self.save_freq
        # rl_zoo3's own evaluation would run the policy without telling it the task.
        self.eval_freq = -1
        self.resumes = self.is_interrupted = False

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        try:
            hyperparams, saved = super().read_hyperparameters()
        except yaml.YAMLError as error:
            why = " ".join(str(error).split())
            raise ValueError(f"{self.config} is not valid YAML: {why}") from error
        except (AttributeError, TypeError) as error:
            raise ValueError(
                f"{self.config} must hold a mapping of hyperparameters for each environment id"
            ) from error
        source = f"{self.config}, entry {self.env_name.gym_id!r}"
        custom = self.custom_hyperparams or {}
        check_entry(custom, self.algo, "-params")
        own = {key: value for key, value in hyperparams.items() if key not in custom}
        check_entry(own, self.algo, source)
        for key in ("n_timesteps", "policy"):
            if key not in hyperparams:
                raise ValueError(f"{source} has no {key!r}")
        resumed = facts_of(self.trained_agent) if self.continue_training else {}
        if resumed.get("keeps_experience"):  # copies are a hyperparameter: an epoch fills waves
            hyperparams["n_envs"] = resumed["n_envs"]
            if "n_envs" in saved:
                saved["n_envs"] = resumed["n_envs"]
        elif "n_envs" not in hyperparams:
            sizes = hyperparams.get("n_train_tasks"), hyperparams.get("trajectories_per_task", 1)
            env_kwargs = hyperparams.get("env_kwargs") or self.env_kwargs
            hyperparams["n_envs"] = default_copies(self.env_name.gym_id, *sizes, **env_kwargs)
        return hyperparams, saved

    def create_envs(self, *args: Any, **kwargs: Any) -> VecEnv:
        # Ctrl-C reaches the processes of --vec-env subproc too, which must last an epoch
        with handled(signal.SIG_IGN, signal.SIGINT):
            return super().create_envs(*args, **kwargs)

    def setup_experiment(self) -> tuple[Any, dict[str, Any]] | None:
        """As rl_zoo3's, with the callbacks that count in epochs, whose length the model knows."""
        results = super().setup_experiment()
        if results is not None:
            model: Any = results[0]
            if self.steps_per_evaluation > 0:
                how = self._evaluation(model, self.steps_per_evaluation, self.save_path)
                self.callbacks.append(AdaptationEvalCallback(verbose=self.verbose, **how))
            steps = self.steps_per_checkpoint
            every = _epochs(model, steps) if steps > 0 else None
            self.checkpoint = TrainingCheckpointCallback(Path(self.save_path) / CHECKPOINT, every)
            self.callbacks.append(self.checkpoint)
        return results

    def _evaluation(self, model: PEARLSAC, steps: int, folder: str | None) -> dict[str, Any]:
        return {
            "every": _epochs(model, steps),
            "n_episodes": self.n_eval_episodes,
            "best_model_save_path": folder,
            "env_kwargs": self._eval_env_kwargs_args,
        }

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> Any:
        file, algorithm = self.trained_agent, ALGORITHMS[self.algo]
        try:
            if not facts_of(file).get("keeps_experience"):
                return super()._load_pretrained_agent(hyperparams, env)
            model = algorithm.load_checkpoint(file, env, device=self.device)
            both = model.env_kwargs, model.family.env_kwargs
            own, given = (json.dumps(each, sort_keys=True, default=str) for each in both)
            if own != given:
                raise ValueError(f"it was trained with --env-kwargs {own}, not {given}")
        except ValueError as error:
            raise ValueError(f"-i {file}, --env {self.env_name.gym_id}: {error}") from error
        model.tensorboard_log, model.verbose = self.tensorboard_log, self.verbose
        self.args.seed = model.seed  # by which --resume finds this run, if it is interrupted too
        self.resumes, steps = True, model.num_timesteps
        print(f"Resuming {self.trained_agent} after {steps} steps, with its own hyperparameters")
        return model

    def learn(self, model: Any) -> None:
        log_interval = {-1: 1, -2: None}.get(self.log_interval, self.log_interval)
        try:
            with stopping_between_epochs(self.checkpoint):
                if self.resumes:
                    model.resume(self.callbacks, log_interval)
                else:
                    model.learn(self.n_timesteps, self.callbacks, log_interval)
        except KeyboardInterrupt:
            self.is_interrupted = True
            for callback in self.callbacks:
                if isinstance(callback, ProgressBarCallback):
                    callback.on_training_end()
        finally:
            model.env.close()

    def save_trained_model(self, model: Any) -> None:
        done, total = model.num_timesteps, model._total_timesteps
        saved = self.checkpoint.saved_steps
        # not a model whose last updates lack, with no checkpoint to tell it from a finished one
        if not self.is_interrupted or done < total or saved is not None:
            super().save_trained_model(model)
        if self.is_interrupted:
            kept = ", before the first checkpoint" if saved is None else f", saved at {saved:,}"
            message = f"Interrupted at {done:,} of {total:,} steps{kept * (saved != done)}"
            raise TrainingInterrupted(message, saved is not None)
        if done >= total and self.steps_per_checkpoint <= 0:
            self.checkpoint.path.unlink(missing_ok=True)

    def hyperparameters_optimization(self) -> None:
        """As rl_zoo3's, but that the first trial of a study is the entry itself."""
        create_study = optuna.create_study

        def create_with_entry(**options: Any) -> optuna.Study:
            study = create_study(**options)
            if not study.trials:
                study.enqueue_trial(entry_params(self.algo, self._hyperparams))
            return study

        # rl_zoo3 has no other place
        with mock.patch.object(optuna, "create_study", create_with_entry):
            super().hyperparameters_optimization()

    def objective(self, trial: optuna.Trial) -> float:
        """What ``-optimize`` maximises: the return on held-out tasks after the most answers."""
        sample, entry = HYPERPARAMS_SAMPLER[self.algo], {"entry": self._hyperparams}
        sampled = self._preprocess_schedules(sample(trial, self.n_actions, self.n_envs, entry))
        env = self.create_envs(self.n_envs, no_log=True)
        with contextlib.closing(env):
            if not FamilyView(env).shared_dynamics:
                # a reward of another task needs a transition that could be of it
                sampled["relabel_fraction"] = 0.0
            hyperparams = {**self._hyperparams, **sampled}
            model = ALGORITHMS[self.algo](env=env, device=self.device, **hyperparams)
            log = self.optimization_log_path
            folder = log and os.path.join(log, f"trial_{trial.number}")
            how = self._evaluation(model, self.n_timesteps // self.n_evaluations, folder)
            evaluation = TrialAdaptationCallback(trial, **how)
            own = get_callback_list({"callback": self.specified_callbacks})
            try:
                model.learn(self.n_timesteps, [*own, evaluation])
            except ValueError as error:
                # Some random hyperparameters diverge, which the model reports.
                print(f"Trial {trial.number} failed: {error}")
                raise optuna.TrialPruned from error
        if evaluation.is_pruned:
            raise optuna.TrialPruned
        return evaluation.last_return


def _epochs(model: PEARLSAC, steps: int) -> int:
    """How many epochs take about so many environment steps, at least 1."""
    return max(1, round(steps / model.epoch_steps))


class TrialAdaptationCallback(AdaptationEvalCallback):
    """Reports each evaluation to Optuna, and ends trials that are not worth finishing."""

    def __init__(self, trial: optuna.Trial, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.trial = trial
        self.is_pruned = False
        self.last_return = float("nan")
        self._reports = 0

    def _on_epoch(self) -> None:
        super()._on_epoch()
        self.last_return = self.last_evaluation[f"return_after_{max(self.record_at)}_queries"]
        self._reports += 1
        self.trial.report(self.last_return, self._reports)
        self.is_pruned = self.trial.should_prune()

    def _on_step(self) -> bool:
        return not self.is_pruned
