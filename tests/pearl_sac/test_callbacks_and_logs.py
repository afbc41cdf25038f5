"""SB3's callbacks and logs."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from meta_toys import EPOCH, N_TASKS, POINT_GOAL, experience_of, small
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_poem import PEARLSAC, POEMSAC


class StopAt(BaseCallback):
    """Stops after some steps of the vectorised environment."""

    def __init__(self, calls: int) -> None:
        super().__init__()
        self.last = calls

    def _on_step(self) -> bool:
        assert self.training_env is self.model.get_env()
        return self.n_calls < self.last


@pytest.mark.parametrize("calls", [25, 40])  # at an epoch's last step, and within the next
def test_a_callback_stops_training(calls: int) -> None:
    model = small(POEMSAC)
    model.learn(10 * EPOCH, StopAt(calls))
    assert model.num_timesteps == calls * N_TASKS
    assert model._n_updates == 5 * ((calls - 1) // 25)
    model.learn(EPOCH, reset_num_timesteps=False)  # and it goes on
    assert model.num_timesteps == calls * N_TASKS + EPOCH


def test_sb3s_callbacks(tmp_path: Path) -> None:
    events: list[int] = []

    class Count(BaseCallback):
        def _on_step(self) -> bool:
            events.append(self.model.num_timesteps)
            return True

    evaluation = EvalCallback(
        make_vec_env(POINT_GOAL, 1),
        n_eval_episodes=2,
        eval_freq=20,
        best_model_save_path=str(tmp_path),
        verbose=0,
    )
    callbacks = CallbackList(
        [
            EveryNTimesteps(EPOCH, Count()),
            CheckpointCallback(30, str(tmp_path), save_replay_buffer=True),
            evaluation,
            StopTrainingOnMaxEpisodes(3, verbose=0),  # of each copy
        ]
    )
    model = small(POEMSAC)
    model.learn(10 * EPOCH, callbacks)
    assert model.num_timesteps == 3 * EPOCH
    assert events == [EPOCH, 2 * EPOCH, 3 * EPOCH]
    assert (tmp_path / "best_model.zip").is_file()
    assert np.isfinite(evaluation.last_mean_reward)
    saved = POEMSAC.load(tmp_path / f"rl_model_{30 * N_TASKS}_steps")
    assert saved.num_timesteps == 30 * N_TASKS


LOGGED = {
    "rollout/train_task_return",
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "time/collection_fps",
    "time/updates_per_second",
    "time/fps",
    "train/learning_rate",
    "train/critic_loss",
    "train/actor_loss",
    "train/decoder_loss",
    "train/kl",
    "train/kl_ideal",
    "train/aggregate_to_prior_kl",
    "train/decoder_error",
    "train/clipped_observations",
    "train/ent_coef",
}
LOGGED_BY_POEM = {"train/preference_loss", "train/preference_accuracy"}


def test_csv_and_json_logs(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    model = small(algorithm)
    model.set_logger(configure(str(tmp_path), ["csv", "json"]))
    model.learn(3 * EPOCH)
    rows = list(csv.DictReader((tmp_path / "progress.csv").open()))
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    promised = LOGGED | (LOGGED_BY_POEM if algorithm is POEMSAC else set())
    for entries in (rows, lines):
        assert [int(float(entry["time/total_timesteps"])) for entry in entries] == [
            EPOCH,
            2 * EPOCH,
            3 * EPOCH,
        ]
        for entry in entries:
            assert promised <= set(entry)
            assert np.isfinite([float(entry[name]) for name in promised]).all()
    assert float(rows[0]["train/kl_ideal"]) == pytest.approx(np.log(N_TASKS))
    assert float(rows[0]["rollout/ep_len_mean"]) == 25
    assert [int(row["train/n_updates"]) for row in rows] == [5, 10, 15]
    # the first row is of the first epoch alone: twelve episodes, whose returns Monitor saw too
    assert float(rows[0]["rollout/train_task_return"]) == pytest.approx(
        float(rows[0]["rollout/ep_rew_mean"]), rel=1e-5
    )


def test_observations_beyond_the_bound_are_counted(tmp_path: Path) -> None:
    model = small(POEMSAC)
    model.policy.obs_norm.std[:] = 0.02
    model.policy.obs_norm.update = lambda rows: None
    model.set_logger(configure(str(tmp_path), ["json"]))
    model.learn(EPOCH)
    seen = np.concatenate(
        [experience_of(model.replay_buffer, task).observations for task in range(N_TASKS)]
    ).reshape(-1, 2)
    share = (np.abs(seen) / 0.02 >= 10).any(axis=1).mean()
    assert 0.05 < share < 0.95
    assert json.loads((tmp_path / "progress.json").read_text())[
        "train/clipped_observations"
    ] == pytest.approx(share)


@pytest.mark.parametrize(("log_interval", "expected"), [(2, [2, 4]), (None, [])])
def test_log_interval_counts_epochs(
    tmp_path: Path, log_interval: int | None, expected: list[int]
) -> None:
    model = small(POEMSAC)
    model.set_logger(configure(str(tmp_path), ["json"]))
    model.learn(4 * EPOCH, log_interval=log_interval)
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert [line["time/total_timesteps"] // EPOCH for line in lines] == expected


def test_tensorboard(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    model = small(POEMSAC, tensorboard_log=str(tmp_path))
    model.learn(2 * EPOCH)
    model.learn(EPOCH, reset_num_timesteps=False)
    model.learn(EPOCH, tb_log_name="named")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["POEMSAC_1", "named_1"]
    events = EventAccumulator(str(tmp_path / "POEMSAC_1"))
    events.Reload()
    assert set(events.Tags()["scalars"]) >= LOGGED | LOGGED_BY_POEM
    assert [event.step for event in events.Scalars("train/kl")] == [EPOCH, 2 * EPOCH, 3 * EPOCH]


def test_verbose_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    model = small(POEMSAC, verbose=1)
    assert "Using cpu device" in capsys.readouterr().out

    class Printed(BaseCallback):
        """Notes how many tables there are when an epoch begins."""

        tables: ClassVar[list[int]] = []
        printed = ""

        def _on_rollout_start(self) -> None:
            Printed.printed += capsys.readouterr().out
            self.tables.append(Printed.printed.count("decoder_error"))

        def _on_step(self) -> bool:
            return True

    model.learn(2 * EPOCH + 1, Printed())
    printed = Printed.printed + capsys.readouterr().out
    sentence = (
        "Training for 601 steps in 3 epochs: each has 300 environment steps, then 5 gradient steps, "
        "15 in all"
    )
    assert printed.index(sentence) < printed.index("decoder_error")
    assert printed.count("decoder_error") == 3
    assert Printed.tables == [
        0,
        0,
        1,
    ]  # that of an epoch is printed when the next begins, right after this
    small(POEMSAC, verbose=0).learn(EPOCH)
    assert capsys.readouterr().out == ""


def test_monitors_episode_info(tmp_path: Path) -> None:
    """Returns as SB3 logs them are those of the tasks; a Monitor file is written."""
    env = make_vec_env(POINT_GOAL, 3, monitor_dir=str(tmp_path / "monitor"))
    model = small(POEMSAC, env).learn(EPOCH)
    episodes = list(model.ep_info_buffer)
    assert [episode["l"] for episode in episodes] == [25] * N_TASKS
    # copies end together, in waves of three tasks
    own = [experience_of(model.replay_buffer, task).rewards.sum() for task in range(N_TASKS)]
    np.testing.assert_allclose([episode["r"] for episode in episodes], own, rtol=1e-4)
    assert len(list((tmp_path / "monitor").glob("*.monitor.csv"))) == 3


def test_a_model_from_a_gpu_goes_on_training_here(tmp_path: Path) -> None:
    """There optimisers are captured in a graph, which Adam refuses on a processor."""
    model = small(POEMSAC).learn(EPOCH)
    for optimizer in (model.policy.optimizer, model.ent_coef_optimizer):
        optimizer.param_groups[0]["capturable"] = True
    model.save(tmp_path / "model.zip")
    loaded = POEMSAC.load(tmp_path / "model.zip", env=POINT_GOAL, device="cpu")
    loaded.learn(EPOCH, reset_num_timesteps=False)
    assert loaded._n_updates == 10
