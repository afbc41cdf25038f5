"""Callbacks between epochs, and evaluation by adaptation while training."""

from __future__ import annotations

import errno
import json
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from meta_toys import EPOCH, N_TASKS, POINT_GOAL, differing, parameters, small, walks
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem import (
    PEARLSAC,
    POEMSAC,
    AdaptationEvalCallback,
    Paper,
    ReturnOracle,
    RewardOracle,
    TrainingCheckpointCallback,
)
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.callbacks import EpochCallback


class Note(EpochCallback):
    """Notes when it is called: (epoch, updates, environment steps)."""

    def _init_callback(self) -> None:
        self.calls: list[tuple[int, int, int]] = []

    def _on_epoch(self) -> None:
        self.calls.append((self.model.epoch, self.model._n_updates, self.model.num_timesteps))


def after(epoch: int) -> tuple[int, int, int]:
    """A model between two epochs: it has learned from all that it collected."""
    return epoch, 5 * epoch, EPOCH * epoch


def test_is_called_between_epochs_and_at_the_end() -> None:
    notes = {every: Note(every) for every in (1, 2, 5, 9)}
    model = small(PEARLSAC).learn(5 * EPOCH, list(notes.values()))
    expected = {1: [1, 2, 3, 4, 5], 2: [2, 4, 5], 5: [5], 9: [5]}
    for every, note in notes.items():
        assert note.calls == [after(epoch) for epoch in expected[every]]
    model.learn(EPOCH, list(notes.values()), reset_num_timesteps=False)
    for note in notes.values():
        assert note.calls == [after(6)]  # counted from where training began


@pytest.fixture(scope="module")
def five_epochs() -> dict[str, th.Tensor]:
    """What a training without callbacks ends with."""
    return parameters(small(PEARLSAC).learn(5 * EPOCH))


def test_every_must_be_positive(tmp_path: Path) -> None:
    for every in (0, -1):
        with pytest.raises(ValueError, match="`every` must be at least 1"):
            EpochCallback(every)
        with pytest.raises(ValueError, match="`every` must be at least 1"):
            TrainingCheckpointCallback(tmp_path / "c.pt", every)
        with pytest.raises(ValueError, match="`every` must be at least 1"):
            AdaptationEvalCallback(every)
    with pytest.raises(ValueError, match="`record_at` must be at least 0, but is -1"):
        AdaptationEvalCallback(record_at=(0, -1))


@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize("bar", [False, True])  # which SB3 puts beside a list, in another
def test_a_callback_that_never_acts_is_told(tmp_path: Path, bar: bool) -> None:
    model = small(PEARLSAC)
    calls = EPOCH // model.n_envs  # SB3 counts a step of all copies as one
    with pytest.warns(UserWarning, match=f"save_freq={EPOCH} counts calls.* pass {calls}$"):
        model.learn(EPOCH, [CheckpointCallback(EPOCH, str(tmp_path / "never"))], progress_bar=bar)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(EPOCH, CheckpointCallback(calls, str(tmp_path / "once")))
    assert not (tmp_path / "never").exists() or not list((tmp_path / "never").iterdir())
    assert len(list((tmp_path / "once").iterdir())) == 1


def test_checkpoints_replace_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "runs" / "checkpoint.pt"
    small(PEARLSAC).learn(3 * EPOCH, TrainingCheckpointCallback(path, every=2, verbose=1))
    assert [file.name for file in path.parent.iterdir()] == ["checkpoint.pt"]
    assert PEARLSAC.load_checkpoint(path).num_timesteps == 3 * EPOCH
    assert capsys.readouterr().out.count("Checkpoint of ") == 2


def test_a_stop_within_an_epoch_writes_no_checkpoint_of_half_an_epoch(
    tmp_path: Path, five_epochs: dict[str, th.Tensor]
) -> None:
    """What was collected since the last whole epoch was not learned from, and could not be
    continued bit for bit.
    """

    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.n_calls < 85  # in the fourth epoch: the third was not written yet

    path = tmp_path / "checkpoint.pt"
    small(PEARLSAC).learn(5 * EPOCH, [TrainingCheckpointCallback(path, every=2), Stop()])
    loaded = PEARLSAC.load_checkpoint(path, POINT_GOAL)
    assert (loaded.epoch, loaded.num_timesteps) == (2, 2 * EPOCH)
    assert not differing(parameters(loaded.resume()), five_epochs)


def test_a_training_that_is_told_to_stop_goes_on_bit_for_bit(
    tmp_path: Path, five_epochs: dict[str, th.Tensor]
) -> None:
    path = tmp_path / "checkpoint.pt"
    checkpoint = TrainingCheckpointCallback(path, every=3)
    with pytest.raises(KeyboardInterrupt):
        small(PEARLSAC).learn(5 * EPOCH, [StopAt(EPOCH + N_TASKS, checkpoint), checkpoint])
    loaded = PEARLSAC.load_checkpoint(path, POINT_GOAL)
    assert loaded.num_timesteps == checkpoint.saved_steps == 2 * EPOCH
    assert not differing(parameters(loaded.resume(checkpoint)), five_epochs)


def test_a_stop_in_the_last_epoch_does_not_interrupt_the_next_training(tmp_path: Path) -> None:
    checkpoint = TrainingCheckpointCallback(tmp_path / "checkpoint.zip")
    model = small(PEARLSAC).learn(EPOCH, [StopAt(N_TASKS, checkpoint), checkpoint])
    assert checkpoint.saved_steps == EPOCH
    assert model.learn(EPOCH, checkpoint).epoch == 2


class StopAt(BaseCallback):
    def __init__(self, steps: int, checkpoint: TrainingCheckpointCallback) -> None:
        super().__init__()
        self.steps, self.checkpoint = steps, checkpoint

    def _on_step(self) -> bool:
        if self.num_timesteps == self.steps:
            self.checkpoint.stop()
        return True


def test_checkpoints_that_take_long_are_rare(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved = []

    def save(model: PEARLSAC, path: Path) -> None:
        saved.append(model.num_timesteps)
        time.sleep(0.2)  # and so none for the next ten seconds

    monkeypatch.setattr(PEARLSAC, "save_checkpoint", save)
    small(PEARLSAC).learn(4 * EPOCH, TrainingCheckpointCallback(tmp_path / "c.pt", every=None))
    assert saved == [EPOCH, 4 * EPOCH]  # the first, and the end


def test_a_full_disk_ends_training_only_where_checkpoints_were_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"could not write .*c\.pt \(No space left on device\)"):
        small(PEARLSAC).learn(2 * EPOCH, TrainingCheckpointCallback(tmp_path / "c.pt"))
    model = small(PEARLSAC)
    with pytest.warns(
        UserWarning, match=r"no checkpoint of 300 steps: .* could not write .*c\.pt \(No space"
    ):
        model.learn(2 * EPOCH, TrainingCheckpointCallback(tmp_path / "c.pt", every=None))
    assert model.num_timesteps == 2 * EPOCH


# ---------------------------------------------------------------- evaluation

QUICK = {"n_tasks": 5, "record_at": (0, 2), "n_episodes": 1}
METRICS = {"return_after_0_queries", "return_after_2_queries", "known_task_return"}
POEM_METRICS = {"preference_accuracy", "kendall_tau"}
SHORT_EPOCH = N_TASKS * 5


def short() -> VecEnv:
    """Copies of episodes of five steps, of which an evaluation runs hundreds."""
    return make_task_vec_env(POINT_GOAL, N_TASKS, max_episode_steps=5)


def test_evaluation_is_logged_and_changes_nothing(
    algorithm: type[PEARLSAC], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    how = {**QUICK, "best_model_save_path": tmp_path / "best", "verbose": 1}
    callback = AdaptationEvalCallback(every=2, **how)
    model = small(algorithm, short())
    model.set_logger(configure(str(tmp_path), ["json"]))
    th.manual_seed(5)
    model.learn(3 * SHORT_EPOCH, callback)
    assert "Evaluation after 120 steps: return_after_0_queries -" in capsys.readouterr().out
    plain = small(algorithm, short()).learn(3 * SHORT_EPOCH)
    assert not differing(parameters(model), parameters(plain))
    assert model.num_timesteps == plain.num_timesteps
    assert [episode["r"] for episode in model.ep_info_buffer] == [
        episode["r"] for episode in plain.ep_info_buffer
    ]

    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    metrics = METRICS | (POEM_METRICS if algorithm is POEMSAC else set())
    evaluated = [line["time/total_timesteps"] for line in lines if "eval/known_task_return" in line]
    assert evaluated == [2 * SHORT_EPOCH, 3 * SHORT_EPOCH]
    for line in lines[1:]:
        assert metrics == {name.removeprefix("eval/") for name in line if name.startswith("eval/")}
        for name in metrics - {"preference_accuracy", "kendall_tau"}:
            assert -12.0 < line[f"eval/{name}"] < 0.0
    if algorithm is POEMSAC:
        assert 0.0 <= callback.last_evaluation["preference_accuracy"] <= 1.0
        assert -1.0 <= callback.last_evaluation["kendall_tau"] <= 1.0
    returns = [line["eval/return_after_2_queries"] for line in lines[1:]]
    assert callback.best_return == pytest.approx(max(returns))
    best = algorithm.load(tmp_path / "best" / "best_model.zip")
    assert best.num_timesteps == (2 if returns[0] >= returns[1] else 3) * SHORT_EPOCH


def test_a_resumed_run_goes_on_comparing_with_its_best_model(tmp_path: Path) -> None:
    model = small(POEMSAC, short())
    model.learn(1, AdaptationEvalCallback(best_model_save_path=tmp_path / "best", **QUICK))
    model.best_adapted_return = 0.0  # which nothing exceeds
    model.save_checkpoint(tmp_path / "checkpoint.zip")
    best = (tmp_path / "best" / "best_model.zip").read_bytes()
    resumed = POEMSAC.load_checkpoint(tmp_path / "checkpoint.zip", short())
    resumed.learn(
        1,
        AdaptationEvalCallback(best_model_save_path=tmp_path / "best", **QUICK),
        reset_num_timesteps=False,
    )
    assert (tmp_path / "best" / "best_model.zip").read_bytes() == best
    # another folder holds no model that it could be compared with
    resumed.learn(
        1,
        AdaptationEvalCallback(best_model_save_path=tmp_path / "other", **QUICK),
        reset_num_timesteps=False,
    )
    assert (tmp_path / "other" / "best_model.zip").exists()


class Evaluations:
    """Makes the oracles of evaluations, and notes their environments and tasks."""

    def __init__(self) -> None:
        self.envs: list[VecEnv] = []
        self.tasks: list[float] = []

    def __call__(self, env: VecEnv, task: np.ndarray, seed: int) -> ReturnOracle:
        self.envs.append(env)
        self.tasks += task.tolist()
        return ReturnOracle(env, task, seed)


def test_evaluation_of_a_finite_family_is_on_all_its_tasks() -> None:
    found = Evaluations()

    def unanswered(**about: Any) -> Callable[..., None]:
        found(**about)
        return lambda left, right: None

    how = {"n_tasks": 5, "record_at": (1,), "adaptation_kwargs": {"oracle_factory": unanswered}}
    env = make_task_vec_env("poem/HalfCheetahFwdBack-v0", 2, max_episode_steps=5)
    model = small(POEMSAC, env, n_train_tasks=2)
    with pytest.raises(TypeError, match="did the oracle return nothing"):  # which ends it
        model.learn(1, AdaptationEvalCallback(every=1, **how))
    assert sorted(found.tasks) == [-1.0, 1.0]
    assert found.envs[0].get_attr("spec")[0].id == "poem/HalfCheetahFwdBack-v0"


def test_evaluation_takes_the_training_environments_arguments() -> None:
    found = Evaluations()
    model = small(POEMSAC, make_task_vec_env(POINT_GOAL, 3, step_length=0.2, max_episode_steps=7))
    how = {**QUICK, "adaptation_kwargs": {"oracle_factory": found}}
    model.learn(2 * N_TASKS * 7, AdaptationEvalCallback(every=1, **how))
    assert len(found.tasks) == 10
    assert found.tasks[:5] == found.tasks[5:]
    env = found.envs[0]
    assert all(each is env for each in found.envs)
    assert env.num_envs == 10
    spec = env.get_attr("spec")[0]
    assert spec.kwargs["step_length"] == 0.2
    assert spec.max_episode_steps == 7


def test_what_cannot_be_evaluated_or_saved_is_refused_before_training(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    for model, arguments, error, message in (
        (small(POEMSAC, walks(2), horizon=10), {}, ValueError, "must be registered with Gymnasium"),
        (small(POEMSAC), {"adaptation_kwargs": {"rule": "paper"}}, TypeError, r"rule=Paper\(\)"),
        (small(POEMSAC), {"adaptation_kwargs": {"rules": Paper()}}, TypeError, "rules"),
        (small(POEMSAC), {"env_kwargs": {"step_lenght": 1.0}}, TypeError, "step_lenght"),
        (small(POEMSAC), {"best_model_save_path": file / "best"}, OSError, str(file)),
    ):
        with pytest.raises(error, match=message):
            model.learn(1, AdaptationEvalCallback(**QUICK, **arguments))
        assert model.num_timesteps == 0


@pytest.mark.parametrize("arguments", [{"n_tasks": 0}, {"n_episodes": 0}])
def test_evaluation_refuses_nothing_to_do(arguments: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="must be at least 1, but is 0"):
        AdaptationEvalCallback(**arguments)


def test_a_baseline_evaluates_a_model_without_a_similarity() -> None:
    evaluation = {
        "n_tasks": 2,
        "n_episodes": 1,
        "record_at": (0, 1),
        "adaptation_kwargs": {"rule": RewardOracle()},
    }
    callback = AdaptationEvalCallback(every=1, **evaluation)
    small(PEARLSAC, short()).learn(1, callback)
    assert np.isfinite(callback.last_evaluation["return_after_1_queries"])


def test_one_callback_serves_one_model_after_another() -> None:
    """What it takes for a model without a similarity, and the best of that, are not the next's."""
    given: dict[str, Any] = {}
    callback = AdaptationEvalCallback(
        every=1, n_tasks=2, n_episodes=1, record_at=(0, 1), adaptation_kwargs=given
    )
    returns = []
    for algorithm in (PEARLSAC, POEMSAC):
        model = small(algorithm, short()).learn(1, callback)
        assert model.best_adapted_return == callback.best_return
        returns.append(callback.last_evaluation)
        callback.best_return = 0.0  # which nothing exceeds
    alone = AdaptationEvalCallback(every=1, n_tasks=2, n_episodes=1, record_at=(0, 1))
    small(POEMSAC, short()).learn(1, alone)
    np.testing.assert_equal(returns[1], alone.last_evaluation)
