"""Evaluation on held-out tasks during training."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation.bayes import Bayes
from sb3_poem.adaptation.environments import check_model_fits
from sb3_poem.adaptation.evaluation import evaluate_adaptation
from sb3_poem.adaptation.known_task import known_task_return, preference_order
from sb3_poem.adaptation.meta_model import HasSimilarity
from sb3_poem.adaptation.rule import as_rule
from sb3_poem.common.checks import check_whole, check_whole_numbers
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.callbacks import EpochCallback

#: What ``adaptation_kwargs`` may hold; the rest of :func:`evaluate_adaptation` is said otherwise.
ADAPTATION_KWARGS = ("rule", "oracle_factory", "deterministic", "library", "progress_bar")


class AdaptationEvalCallback(EpochCallback):
    """Adapts the model to held-out tasks from preferences while it trains, logs how well that goes,
    and keeps the best model. Training is the same with it and without it.

    Logs ``eval/return_after_<k>_queries`` for each k, ``eval/known_task_return`` (the best of many
    latents for each task), ``eval/preference_accuracy`` and ``eval/kendall_tau`` of Property 1, and
    for a family that says what a success is ``eval/success_rate_after_<k>_queries`` and
    ``eval/known_task_success_rate``.

    >>> from sb3_poem import POEMSAC
    >>> model = POEMSAC("MlpPolicy", "poem/PointGoal-v0", n_train_tasks=4, gradient_steps=1)
    >>> evaluation = AdaptationEvalCallback(every=5, best_model_save_path="best")
    >>> model = model.learn(400, callback=evaluation)  # four epochs: none is evaluated yet

    :param every: Epochs between two evaluations
    :param n_tasks: Held-out tasks; all of a finite family that has no more
    :param record_at: Numbers of answers after which the adapted policy is measured
    :param n_episodes: Episodes of each task and measurement
    :param best_model_save_path: Folder for ``best_model.zip``, the model of the highest return
        after the most answers. A run that is resumed with the same folder goes on comparing with it
    :param seed: Of the held-out tasks and of everything else here
    :param adaptation_kwargs: Arguments of :func:`sb3_poem.adaptation.evaluate_adaptation`, for
        instance ``rule``, without which a model without a similarity is asked random queries
    :param env_kwargs: Arguments of the environment that differ from training's, ``split`` say
    """

    def __init__(
        self,
        every: int = 5,
        n_tasks: int = 30,
        record_at: Sequence[int] = (0, 1, 2, 5, 10),
        n_episodes: int = 2,
        best_model_save_path: str | Path | None = None,
        seed: int = 1_000_003,
        adaptation_kwargs: dict[str, Any] | None = None,
        env_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(every, verbose)
        check_whole("n_tasks", n_tasks, 1)
        check_whole("n_episodes", n_episodes, 1)
        self.n_tasks, self.n_episodes, self.seed = n_tasks, n_episodes, seed
        self.record_at = check_whole_numbers("record_at", record_at, 0)
        folder = best_model_save_path
        self.best_model_save_path = None if folder is None else Path(folder)
        self._best_model = None if folder is None else Path(folder) / "best_model.zip"
        self.adaptation_kwargs = dict(adaptation_kwargs or {})
        self.env_kwargs = dict(env_kwargs or {})
        for name in self.adaptation_kwargs:
            if name not in ADAPTATION_KWARGS:
                raise TypeError(f"adaptation_kwargs takes {ADAPTATION_KWARGS}, but has {name!r}")
        if self.adaptation_kwargs.get("rule") is not None:
            as_rule(self.adaptation_kwargs["rule"])
        self.best_return = -np.inf
        self.last_evaluation: dict[str, float] = {}
        self._env: VecEnv | None = None

    def _init_callback(self) -> None:
        """Refuse before training what could not be evaluated or saved afterwards."""
        super()._init_callback()
        self._make_env()
        if self._best_model is not None:
            self._best_model.parent.mkdir(parents=True, exist_ok=True)
        # that of a run that goes on, if the model that earned it is still there
        is_lost = self._best_model is not None and not self._best_model.exists()
        self.best_return = -np.inf if is_lost else self.model.best_adapted_return

    def _make_env(self) -> tuple[VecEnv, np.ndarray]:
        if self._env is None:
            spec = self.model.family.spec
            if spec is None:
                raise ValueError(
                    "AdaptationEvalCallback makes copies of the environment, which must be "
                    "registered with Gymnasium; or call evaluate_adaptation yourself"
                )
            kwargs = {"max_episode_steps": spec.max_episode_steps, **spec.kwargs, **self.env_kwargs}
            self._env = make_task_vec_env(spec.id, 2 * self.n_tasks, **kwargs)
            check_model_fits(self.model, self._env)
        family = FamilyView(self._env)
        family.check_same_family(self.model.task_space, self.model.reward_feature_dim)
        distinct = self.n_tasks if family.all_tasks is None else len(family.all_tasks)
        return self._env, family.test_tasks(min(distinct, self.n_tasks), self.seed)

    def _on_epoch(self) -> None:
        env, tasks = self._make_env()
        options: dict[str, Any] = {"seed": self.seed, "n_episodes": self.n_episodes}
        how = {"record_at": self.record_at, **options, **self.adaptation_kwargs}
        if not isinstance(self.model, HasSimilarity) and how.get("rule") is None:
            how["rule"] = Bayes(query_rule="random")
        result = evaluate_adaptation(self.model, env, tasks, **how)
        known = known_task_return(self.model, env, tasks, limits=False, **options)
        metrics = {f"return_after_{k}_queries": result.after(k) for k in self.record_at}
        metrics["known_task_return"] = known.mean_return
        if result.success_rates is not None and known.success_rate is not None:
            rates = zip(result.record_at, result.success_rates.tolist(), strict=True)
            metrics |= {f"success_rate_after_{k}_queries": rate for k, rate in rates}
            metrics["known_task_success_rate"] = known.success_rate
        if isinstance(self.model, HasSimilarity):
            accuracy, tau = preference_order(self.model, known)
            metrics |= {"preference_accuracy": accuracy, "kendall_tau": tau}
        for name, value in metrics.items():
            self.logger.record(f"eval/{name}", value)
        self.last_evaluation = metrics
        if self.verbose > 0:
            listing = ", ".join(f"{name} {value:.3f}" for name, value in metrics.items())
            print(f"Evaluation after {self.model.num_timesteps} steps: {listing}")
        score = result.after(max(self.record_at))
        if score > self.best_return:
            self.best_return = self.model.best_adapted_return = score
            if self._best_model is not None:
                self.model.save(self._best_model)

    def _on_training_end(self) -> None:
        super()._on_training_end()
        if self._env is not None:
            self._env.close()
            self._env = None
