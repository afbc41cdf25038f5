"""``sb3-poem train`` and ``enjoy``: rl_zoo3 with our algorithms, files and checks."""

import os
import runpy
import shlex
import signal
import sys
import uuid
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import gymnasium as gym
import optuna
import pandas as pd
import pytest
import torch as th
import yaml
from first_hour import ENTRY as SMALL
from first_hour import write_entry
from meta_toys import Walk, WindyWalk, differing, parameters
from rl_zoo3 import ALGOS, exp_manager
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import SimpleLinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem import PEARLSAC, POEMSAC, cli, resources
from sb3_poem.cli import experiment
from sb3_poem.cli.hyperparams import SAMPLERS, check_entry, find_config
from sb3_poem.cli.zoo import last_run, register_algorithms
from sb3_poem.common.vec_env import TaskVecEnv, make_task_vec_env
from sb3_poem.pearl_sac.arguments import UNSUPPORTED


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return write_entry(tmp_path / "small.yml")


def train(*arguments: object) -> int:
    small = ["train", "--env", "poem/PointGoal-v0", "--seed", "0", "--verbose", "0"]
    return cli.main([*small, *map(str, arguments)])


def test_algorithms_are_registered() -> None:
    register_algorithms()
    assert ALGOS["poem_sac"] is POEMSAC
    assert ALGOS["pearl_sac"] is PEARLSAC
    assert {"poem_sac", "pearl_sac"} <= set(HYPERPARAMS_SAMPLER) & set(HYPERPARAMS_CONVERTER)


ENTRY = {
    "gamma": 0.85,
    "learning_rate": SimpleLinearSchedule(5e-3),
    "batch_size": 32,
    "kl_coef": 0.4,
    "reward_coef": 0.0,
}


@pytest.mark.parametrize("algorithm", ["poem_sac", "pearl_sac"])
def test_sampled_hyperparameters_are_arguments_of_the_algorithm_around_the_entry(
    algorithm: str,
) -> None:
    register_algorithms()
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    draws = []
    for _ in range(40):
        trial = study.ask()
        draws.append(HYPERPARAMS_SAMPLER[algorithm](trial, 2, 1, {"entry": ENTRY}))
        check_entry(draws[-1], algorithm, "the sampler")
        assert HYPERPARAMS_CONVERTER[algorithm](trial.params) == draws[-1]
    for name, low, high in (
        ("kl_coef", 0.1, 1.6),
        ("batch_size", 16, 64),
        ("gamma", 0.4, 0.9625),
        ("latent_dim", 3, 10),
    ):
        values = [draw[name] for draw in draws]
        middle = sorted(values)[20]
        assert low <= min(values) < middle < max(values) <= high + 1e-9, name
    rates = [
        float(draw["learning_rate"].removeprefix("lin_")) for draw in draws
    ]  # the schedule stays
    assert 1.25e-3 <= min(rates) < 5e-3 < max(rates) <= 2e-2
    assert "reward_coef" not in draws[0]  # nothing lies around 0
    assert ("preference_coef" in draws[0]) == (algorithm == "poem_sac")


@pytest.mark.parametrize(
    "file",
    sorted(resources.shipped_folder("zoo_configs").glob("*.yml")),
    ids=lambda file: file.name,
)
def test_shipped_hyperparameters_are_known_and_cover_the_environments(file: Path) -> None:
    register_algorithms()
    algorithm = "pearl_sac" if file.stem.startswith("pearl") else "poem_sac"
    entries = yaml.safe_load(file.read_text())
    assert "default" in entries or {
        name for name in gym.registry if name.startswith("poem/")
    } <= set(entries)
    for env_id, entry in entries.items():
        check_entry(entry, algorithm, f"{file}, {env_id}")
        assert entry["policy"] == "MlpPolicy"
        assert float(entry["n_timesteps"]) > 0


def test_what_only_sac_takes_and_what_changes_a_family_is_refused_by_the_same_words() -> None:
    of_rl_zoo3 = {"env_wrapper", "vec_env_wrapper", "frame_stack", "normalize", "noise_type"}
    assert of_rl_zoo3 <= UNSUPPORTED.keys()
    for key, why in UNSUPPORTED.items():
        with pytest.raises(ValueError, match=f"'{key}' in my.yml is not for poem_sac: {why}"):
            check_entry({key: "normal"}, "poem_sac", "my.yml")


@pytest.mark.parametrize(
    ("algorithm", "key"), [("poem_sac", "train_freq"), ("pearl_sac", "vec_env_wrapper")]
)
def test_an_entry_is_refused_before_training(
    algorithm: str, key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_entry(tmp_path / "wrong.yml", **{key: "gymnasium.wrappers.NormalizeReward"})
    assert train("--algo", algorithm, "-c", config, "-f", tmp_path / "logs") == 1
    what = f"'{key}' in {config}, entry 'poem/PointGoal-v0' is not for {algorithm}"
    assert f"{what}: {UNSUPPORTED[key]}" in capsys.readouterr().err
    assert not list((tmp_path / "logs").rglob("*.csv")), "nothing may have started"


def test_train_then_enjoy(
    config: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    logs, made = tmp_path / "logs", []
    create_envs = ExperimentManager.create_envs

    def spy(self: ExperimentManager, *args: object, **kwargs: object) -> object:
        made.append(create_envs(self, *args, **kwargs))  # type: ignore[arg-type]
        return made[-1]

    monkeypatch.setattr(ExperimentManager, "create_envs", spy)
    assert train("-c", config, "-f", logs, "--eval-freq", -1) == 0
    assert type(made[0]) is TaskVecEnv
    assert made[0].num_envs == 6
    run = logs / "poem_sac" / "poem-PointGoal-v0_1"
    model = POEMSAC.load(run / "poem-PointGoal-v0.zip")
    assert model.num_timesteps == 300
    saved = yaml.load((run / "poem-PointGoal-v0" / "config.yml").read_text(), yaml.UnsafeLoader)
    assert saved["n_train_tasks"] == len(model.task_latents) == 6

    capsys.readouterr()
    enjoy = [
        "enjoy",
        "--env",
        "poem/PointGoal-v0",
        "-f",
        str(logs),
        "--no-render",
        "--episodes",
        "2",
        "--queries",
        "1",
    ]
    assert cli.main(enjoy) == 0
    shown = capsys.readouterr().out
    assert f"Policy of {run / 'poem-PointGoal-v0.zip'}, adapted by the oracle" in shown
    assert "Episode 2: return" in shown
    assert cli.main([*enjoy, "--exp-id", "1", "-n", "60"]) == 0
    assert "Episode 3: return" in capsys.readouterr().out
    assert cli.main([*enjoy, "--exp-id", "7"]) == 1
    assert "there is no run 7 of poem_sac on poem/PointGoal-v0" in capsys.readouterr().err


#: Episodes of which an evaluation runs hundreds
SHORT = ("--env-kwargs", "max_episode_steps:5")


def test_evaluation_is_by_adaptation_and_keeps_the_best(
    config: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = []

    def make(env_id: str, n_envs: int, **arguments: object) -> VecEnv:
        made.append(arguments)
        return make_task_vec_env(env_id, n_envs, **arguments)

    monkeypatch.setattr("sb3_poem.adaptation.callback.make_task_vec_env", make)
    monkeypatch.setattr(
        experiment, "AdaptationEvalCallback", partial(experiment.AdaptationEvalCallback, n_tasks=2)
    )
    flags = ["-c", config, "-f", tmp_path / "logs", "--eval-freq", 30, "--eval-episodes", 1]
    # epochs of six episodes of five steps
    flags += ["-n", 60, *SHORT, "--eval-env-kwargs", "step_length:0.2"]
    assert train(*flags, "--log-interval", 1, "--verbose", 1) == 0
    assert [arguments.get("step_length") for arguments in made] == [0.2]
    shown = capsys.readouterr().out
    assert shown.count("Evaluation after") == 2
    for name in (
        "return_after_0_queries",
        "return_after_10_queries",
        "known_task_return",
        "preference_accuracy",
    ):
        assert name in shown
    assert POEMSAC.load(
        tmp_path / "logs/poem_sac/poem-PointGoal-v0_1/best_model.zip"
    ).num_timesteps in (30, 60)


@pytest.fixture
def windy_config(tmp_path: Path) -> Iterator[Path]:
    """Of a family without shared dynamics, which is registered as long."""
    gym.register("Windy-v0", lambda **kwargs: WindyWalk(), max_episode_steps=10)
    entry = {"policy": "MlpPolicy", "n_timesteps": 60, "n_envs": 2, "n_train_tasks": 6}
    entry |= {"gradient_steps": 2, "meta_batch_size": 2}
    entry |= {name: SMALL[name] for name in ("batch_size", "context_size")}
    config = tmp_path / "windy.yml"
    config.write_text(yaml.safe_dump({"Windy-v0": entry}))
    yield config
    del gym.registry["Windy-v0"]


def test_an_environment_that_needs_arguments_is_trained(tmp_path: Path) -> None:
    gym.register("Sized-v0", lambda size, **kwargs: Walk(), max_episode_steps=10)
    entry = {"policy": "MlpPolicy", "n_timesteps": 1, "gradient_steps": 1, "batch_size": 2}
    (tmp_path / "sized.yml").write_text(yaml.safe_dump({"default": entry}))
    flags = ("-c", tmp_path / "sized.yml", "-f", tmp_path / "logs", "--eval-freq", -1)
    try:
        assert train("--env", "Sized-v0", *flags, "--env-kwargs", "size:1") == 0
    finally:
        del gym.registry["Sized-v0"]


def test_epochs_are_counted_with_the_rollouts_that_compare_policies(
    windy_config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved = []
    monkeypatch.setattr(POEMSAC, "save_checkpoint", lambda self, _: saved.append(self.epoch))
    flags = ["-c", windy_config, "-f", tmp_path / "logs", "--eval-freq", -1]
    # 6 tasks in one group: 6 * 6 rollouts of 10 steps
    flags += ["--save-freq", 360, "-params", "n_timesteps:1080"]
    assert train("--env", "Windy-v0", *flags) == 0
    assert saved == [1, 2, 3]


def test_a_search_in_threads_on_a_family_without_shared_dynamics(
    windy_config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(
        SAMPLERS,
        "poem_sac",
        lambda trial, *_: {"relabel_fraction": trial.suggest_float("r", 0.2, 0.8)},
    )
    monkeypatch.setattr(
        experiment,
        "TrialAdaptationCallback",
        partial(experiment.TrialAdaptationCallback, n_tasks=2),
    )
    flags = [
        "-optimize",
        "--n-trials",
        "1",
        "--n-jobs",
        "2",
        "--n-evaluations",
        "1",
        "--eval-episodes",
        "1",
        "--no-optim-plots",
    ]
    where = ["-c", windy_config, "-f", tmp_path / "logs"]
    assert train("--env", "Windy-v0", *where, *flags) == 0
    (report,) = (tmp_path / "logs" / "poem_sac").glob("report_*.csv")
    assert "COMPLETE" in report.read_text()


def test_hyperparameters_are_searched_around_the_entry_which_comes_first(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        experiment,
        "TrialAdaptationCallback",
        partial(experiment.TrialAdaptationCallback, n_tasks=2),
    )
    entry = {"gamma": 0.9, "learning_rate": "lin_2e-3", "kl_coef": 0.2, "relabel_fraction": 0.5}
    entry |= {"reward_coef": 0.3, "policy_coef": 0.5, "preference_coef": 3.0}
    write_entry(config, n_timesteps=30, **entry)
    flags = [
        "-optimize",
        "--n-trials",
        2,
        "--n-evaluations",
        1,
        "--eval-episodes",
        1,
        "--no-optim-plots",
    ]
    assert train("-c", config, "-f", tmp_path / "logs", *SHORT, *flags) == 0
    (report,) = (tmp_path / "logs" / "poem_sac").glob("report_*.csv")
    first, second = (
        pd.read_csv(report)
        .filter(like="params_")
        .rename(columns=lambda name: name[7:])
        .to_dict("records")
    )
    own = {
        name: SMALL[name]
        for name in ("gradient_steps", "batch_size", "context_size", "meta_batch_size")
    }
    own |= {"one_minus_gamma": 0.1, "lin_learning_rate": 2e-3, "latent_dim": 5, "tau": 0.01}
    own |= {name: value for name, value in entry.items() if name.endswith(("_coef", "_fraction"))}
    assert first == pytest.approx(own)
    assert second.keys() == own.keys()
    assert all(value / 4 <= second[name] <= 4 * value for name, value in own.items())
    assert sum(second[name] != pytest.approx(value) for name, value in own.items()) > 8


def test_rl_zoo3_is_left_as_it_was(config: Path, tmp_path: Path) -> None:
    from rl_zoo3 import train as zoo_train

    arguments = sys.argv
    assert train("-c", tmp_path / "missing.yml", "-f", tmp_path / "logs") == 1
    assert zoo_train.ExperimentManager is ExperimentManager
    assert sys.argv is arguments


def test_unknown_key_is_named_with_file_algorithm_and_near_matches(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_entry(tmp_path / "typo.yml", latent_dims=3)
    assert train("-c", config, "-f", tmp_path / "logs") == 1
    error = capsys.readouterr().err
    for word in ("'latent_dims'", str(config), "poem_sac", "'latent_dim'", "poem/PointGoal-v0"):
        assert word in error
    assert not list((tmp_path / "logs").rglob("*.csv")), "nothing may have started"


def test_a_key_of_poem_is_unknown_to_pearl(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_entry(config, preference_coef=1.0)
    assert train("--algo", "pearl_sac", "-c", config, "-f", tmp_path / "logs") == 1
    assert "pearl_sac has no such hyperparameter" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_refused_before_training(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    for flags in (
        ["-f", tmp_path / "file" / "logs"],
        ["-f", tmp_path / "logs", "-tb", tmp_path / "file" / "tb"],
    ):
        assert train("-c", config, *flags) == 1
        assert f"cannot write to the folder '{flags[-1]}'" in capsys.readouterr().err


def test_files_that_ship_are_found_by_their_names_and_ones_own_come_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Path(find_config("poem_sac_gpu.yml")) == resources.config_file("poem_sac_gpu")
    Path("poem_sac_gpu.yml").write_text("poem/PointGoal-v0: {}")
    assert find_config("poem_sac_gpu.yml") == "poem_sac_gpu.yml"


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("-params", "gama:0.9"), ("'gama' in -params", "'gamma'")),
        (("-params", "kl_coef:abc"), ("-params kl_coef:abc", "'abc'", "KEY:VALUE")),
        (("-params", "kl_coef"), ("-params kl_coef", "KEY:VALUE")),
        (("-params", "kl_coef=0.1"), ("-params kl_coef=0.1", "did you mean kl_coef:0.1?")),
        (("-params", "kl_coef:'abc'"), ("kl_coef in -params must be a number, got 'abc'",)),
        (("-params", "kl_coef:'0.1'"), ("kl_coef in -params is the text '0.1'; write 0.1",)),
        (("-params", "batch_size:2.5"), ("batch_size in -params must be a whole number, got 2.5",)),
        (
            ("-params", "learning_rate:'fast'"),
            ("learning_rate in -params must be a number, or 'lin_' and a number",),
        ),
        (
            ("-params", "n_timesteps:0"),
            ("n_timesteps in -params must be a positive number, got 0",),
        ),
        (
            ("-params", "n_envs:1e1"),
            ("n_envs in -params must be a positive whole number, got 10.0",),
        ),
        (("-n", "0"), ("-n/--n-timesteps must be at least 1, got 0",)),
        (("-c", "missing.yml"), ("-c missing.yml: there is no such file", "poem_sac_gpu.yml")),
        (("-c", "missing"), ("-c missing: there is no such module", ".yml")),
        (
            ("--env", "HalfCheetahVel"),
            ("--env HalfCheetahVel", "did you mean 'poem/HalfCheetahVel-v0'?"),
        ),
        (("--env", "nothing-like-it"), ("--env nothing-like-it", "--gym-packages")),
    ],
)
def test_a_wrong_argument_is_named_before_training(
    flags: tuple[str, ...],
    words: tuple[str, ...],
    config: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert train("-c", config, "-f", tmp_path / "logs", *flags) == 1
    error = capsys.readouterr().err
    assert all(word in error for word in words), error
    assert not list((tmp_path / "logs").rglob("*.csv")), "nothing may have started"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "must hold a mapping of hyperparameters for each environment id"),
        ("poem/PointGoal-v0: 5", "must hold a mapping"),
        ("poem/PointGoal-v0: {policy: [", "is not valid YAML"),
        (
            "poem/PointGoal-v0: {policy: MlpPolicy}",
            "entry 'poem/PointGoal-v0' has no 'n_timesteps'",
        ),
    ],
)
def test_a_file_of_another_form_is_refused(
    content: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other.yml").write_text(content)
    assert train("-c", tmp_path / "other.yml", "-f", tmp_path / "logs") == 1
    error = capsys.readouterr().err
    assert f"{tmp_path / 'other.yml'}" in error
    assert words in error


def test_algorithms_of_rl_zoo3_still_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "--algo",
        "ppo",
        "--env",
        "Pendulum-v1",
        "-n",
        "256",
        "--eval-freq",
        "-1",
        "--verbose",
        "0",
    ]
    settings = ["-params", "n_envs:1", "n_steps:128", "-f", str(tmp_path)]
    assert cli.main(["train", *arguments, *settings]) == 0
    assert (tmp_path / "ppo" / "Pendulum-v1_1" / "Pendulum-v1.zip").is_file()
    enjoy = [
        "enjoy",
        "--algo",
        "ppo",
        "--env",
        "Pendulum-v1",
        "-f",
        str(tmp_path),
        "-n",
        "200",
        "--no-render",
    ]
    assert cli.main(enjoy) == 0
    assert "1 Episodes" in capsys.readouterr().out


# ---------------------------------------------------------------- interruptions and --resume

# an epoch of this configuration takes 150 steps
LONG = ("--eval-freq", "-1", "-params", "n_timesteps:900")


class CrashError(Exception):
    """Training was cut off."""


@pytest.fixture(autouse=True)
def _keyboard() -> Iterator[None]:
    """Ctrl-C is heard, which a shell's background jobs ignore, this process among them perhaps."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, th.Tensor]:
    """What training ends with when nothing interrupts it."""
    folder = tmp_path_factory.mktemp("whole")
    config = write_entry(folder / "small.yml")
    assert train("-c", config, "-f", folder, *LONG) == 0
    (run,) = (folder / "poem_sac").iterdir()
    assert not (
        run / "checkpoint.zip"
    ).exists()  # nobody asked for it, and nothing is left to go on with
    return parameters(POEMSAC.load(run / "poem-PointGoal-v0.zip"))


def trained(folder: Path, run: int) -> POEMSAC:
    return POEMSAC.load(folder / "poem_sac" / f"poem-PointGoal-v0_{run}" / "poem-PointGoal-v0.zip")


def interrupts(path: Path, *callbacks: dict[str, int]) -> Path:
    return write_entry(path, callback=[{"meta_toys.Interrupt": callback} for callback in callbacks])


def test_resume_finishes_the_interrupted_run_of_the_same_seed_as_if_nothing_had_happened(
    config: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    whole: dict[str, th.Tensor],
) -> None:
    flags, logs = ("-c", config, *LONG), tmp_path / "logs"
    learn, calls = POEMSAC.train, []

    def crash(model: POEMSAC, **options: int) -> None:
        calls.append(None)
        if len(calls) == 4:
            raise CrashError
        learn(model, **options)

    with monkeypatch.context() as patch:
        patch.setattr(POEMSAC, "train", crash)
        with pytest.raises(CrashError):
            train("-f", logs, *flags, "--resume")
    shown = capsys.readouterr().out
    assert "has no checkpoint of poem/PointGoal-v0 with seed 0; training begins from zero" in shown
    assert train("-f", logs, "--seed", "1", *flags) == 0  # a newer run, of another seed
    assert train("-f", logs, *flags, "--resume") == 0
    assert "Resuming" in capsys.readouterr().out
    assert not differing(parameters(trained(logs, 3)), whole)
    assert train("-f", logs, *flags, "--resume") == 0
    assert "has finished already" in capsys.readouterr().out
    assert not (logs / "poem_sac" / "poem-PointGoal-v0_4").exists()


def test_a_checkpoint_continues_bit_for_bit(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, th.Tensor]
) -> None:
    flags = ("-c", config, "-f", tmp_path, *LONG, "--save-freq", 150)
    save_checkpoint, saved = POEMSAC.save_checkpoint, []

    def save_then_die(self: POEMSAC, path: Path) -> None:
        save_checkpoint(self, path)
        saved.append(path)
        if len(saved) == 2:
            raise CrashError

    with monkeypatch.context() as patch:
        patch.setattr(POEMSAC, "save_checkpoint", save_then_die)
        with pytest.raises(CrashError):
            train(*flags)
    assert not (saved[-1].parent / "poem-PointGoal-v0.zip").exists()
    assert train(*flags, "-i", saved[-1], "--seed", 5) == 0
    assert not differing(parameters(trained(tmp_path, 2)), whole)
    runs = tmp_path / "poem_sac"  # and it has the seed with which it began
    assert last_run(runs, "poem-PointGoal-v0", 0) == runs / "poem-PointGoal-v0_2"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_training_after_the_epoch_and_says_how_to_go_on(
    number: int,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    whole: dict[str, th.Tensor],
) -> None:
    config = interrupts(tmp_path / "c.yml", {"at": 480, "number": int(number)})
    given = ["train", "--env", "poem/PointGoal-v0", "--seed", "0", "-P", *LONG]
    monkeypatch.setattr(sys, "argv", ["sb3-poem", *given, "-c", str(config), "-f", str(tmp_path)])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module("sb3_poem", run_name="__main__")
    assert stop.value.code == 130
    error = capfd.readouterr().err
    assert "Stopping after this epoch" in error
    stopped, _, command = error.splitlines()[-1].partition("; go on with: sb3-poem ")
    assert stopped.endswith("Interrupted at 600 of 900 steps")
    assert command.startswith("train --env poem/PointGoal-v0 --seed 0 -P ")
    assert trained(tmp_path, 1).num_timesteps == 600
    assert cli.main(shlex.split(command)) == 0
    assert not differing(parameters(trained(tmp_path, 2)), whole)


def test_a_second_interrupt_stops_at_once_and_loses_no_older_checkpoint(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], whole: dict[str, th.Tensor]
) -> None:
    config = interrupts(tmp_path / "c.yml", {"at": 480}, {"at": 630, "times": 2})
    flags = ("-c", config, "-f", tmp_path, *LONG)
    assert train(*flags) == 130
    assert train(*flags, "--resume") == 130  # within the first epoch of this run
    error = capfd.readouterr().err.splitlines()[-1]
    assert error == (
        "Interrupted at 630 of 900 steps, before the first checkpoint; the same command begins "
        "again"
    )
    assert train(*flags, "-n", 1200, "--resume") == 1
    assert "goes on to its own 900 steps; leave -n out" in capfd.readouterr().err
    assert train(*flags, "--resume", "-params", "n_timesteps:900", "callback:None") == 0
    assert "after 600 steps" in capfd.readouterr().out
    assert not differing(parameters(trained(tmp_path, 3)), whole)


def test_an_interrupt_before_the_last_updates_leaves_them_to_do(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], whole: dict[str, th.Tensor]
) -> None:
    config = interrupts(tmp_path / "c.yml", {"at": 900, "times": 2})
    flags = ("-c", config, "-f", tmp_path, *LONG, "--save-freq", 150)
    assert train(*flags) == 130
    assert "Interrupted at 900 of 900 steps, saved at 750; go on with" in capfd.readouterr().err
    assert train(*flags, "--resume") == 130  # this run has no checkpoint of its own
    assert train(*flags, "--resume", "-params", "n_timesteps:900", "callback:None") == 0
    assert not differing(parameters(trained(tmp_path, 3)), whole)


def test_a_run_goes_on_in_its_own_number_of_copies_and_in_no_other_environment(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = interrupts(tmp_path / "c.yml", {"at": 60})
    flags, kwargs = ("-c", config, "-f", tmp_path, "--eval-freq", -1), ("step_length:0.2",)
    assert train(*flags, "--env-kwargs", *kwargs, "-params", "n_envs:3") == 130
    assert train(*flags, "--resume") == 1
    error = capfd.readouterr().err
    assert 'it was trained with --env-kwargs {"step_length": 0.2}, not {}' in error
    assert train(*flags, "--resume", "--env-kwargs", *kwargs) == 0
    assert (trained(tmp_path, 3).n_envs, trained(tmp_path, 3).num_timesteps) == (3, 300)


def test_an_interrupt_before_the_first_checkpoint(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = interrupts(tmp_path / "c.yml", {"at": 60, "times": 2})
    assert train("-c", config, "-f", tmp_path, *LONG) == 130
    assert "before the first checkpoint; the same command begins again" in capfd.readouterr().err
    assert train("-c", config, "-f", tmp_path, *LONG, "--resume") == 130
    assert (
        "has no checkpoint of poem/PointGoal-v0 with seed 0; training begins from zero"
        in capfd.readouterr().out
    )
    (tmp_path / "poem_sac" / "poem-PointGoal-v0_2" / "poem-PointGoal-v0.zip").write_bytes(b"half")
    assert train("-c", config, "-f", tmp_path, *LONG, "--resume") == 1
    assert "is truncated" in capfd.readouterr().err


def test_folders_that_are_no_runs_are_passed_over(tmp_path: Path) -> None:
    for name in ("2", "10", "11_copy", "old"):
        (tmp_path / f"poem-PointGoal-v0_{name}").mkdir()
        (tmp_path / f"poem-PointGoal-v0_{name}" / "checkpoint.zip").touch()
    assert last_run(tmp_path, "poem-PointGoal-v0", -1) == tmp_path / "poem-PointGoal-v0_10"


def test_no_run_writes_into_the_folder_of_another(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that begin together count the same runs before them."""
    monkeypatch.setattr(exp_manager, "get_latest_run_id", lambda *_: 0)
    for number in (1, 2, 3):
        assert train("-c", config, "-f", tmp_path, "--seed", number) == 0
        folder = tmp_path / "poem_sac" / f"poem-PointGoal-v0_{number}"
        assert POEMSAC.load(folder / "poem-PointGoal-v0").seed == number


def test_of_runs_with_a_unique_id_the_newest_is_found(tmp_path: Path) -> None:
    runs = [tmp_path / f"poem-PointGoal-v0_1_{uuid.UUID(int=number)}" for number in (1, 2, 0)]
    for second, run in enumerate(runs):
        run.mkdir()
        (run / "checkpoint.zip").touch()
        os.utime(run, (second, second))
    assert last_run(tmp_path, "poem-PointGoal-v0", -1) == runs[-1]


def test_a_run_that_a_full_disk_ended_before_it_began_is_passed_over(tmp_path: Path) -> None:
    for number, content in ((1, "seed: 3"), (2, "")):
        folder = tmp_path / f"poem-PointGoal-v0_{number}" / "poem-PointGoal-v0"
        folder.mkdir(parents=True)
        (folder / "args.yml").write_text(content)
    (tmp_path / "poem-PointGoal-v0_1" / "checkpoint.zip").touch()
    assert last_run(tmp_path, "poem-PointGoal-v0", 3) == tmp_path / "poem-PointGoal-v0_1"


def test_a_model_that_is_trained_further_is_read_once(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    how = {"n_train_tasks": SMALL["n_train_tasks"], "meta_batch_size": 2}
    POEMSAC("MlpPolicy", "poem/PointGoal-v0", **how).save(tmp_path / "m.zip")
    load, files = th.load, []
    monkeypatch.setattr(
        th, "load", lambda file, **how: files.append(file.name) or load(file, **how)
    )
    flags = ("-c", config, "-f", tmp_path / "logs", "--eval-freq", -1, "-n", 1)
    assert train(*flags, "-i", tmp_path / "m.zip") == 0
    assert files.count("policy.pth") == 1


def test_a_model_of_another_family_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    POEMSAC("MlpPolicy", "poem/PointGoal-v0", n_train_tasks=2).save(tmp_path / "m.zip")
    other = ("train", "--env", "poem/HalfCheetahVel-v0", "-f", tmp_path, "-i", tmp_path / "m.zip")
    assert cli.main([*map(str, other)]) == 1
    assert (
        "m.zip, --env poem/HalfCheetahVel-v0: Observation spaces do not match"
        in capsys.readouterr().err
    )
