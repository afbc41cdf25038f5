"""Train for so many seconds, where there is no more time than that, and keep the model.

    python benchmarks/train_for.py poem/AntFwdBack-v0 ant.zip 470 --device cuda --conf zoo_configs/poem_sac_gpu.yml

Takes an entry of hyperparameters, changed by ``--set``, but for ``n_timesteps``: the learning rate
falls from what the entry names to 0 over the time, however many steps that turns out to be.
``--start`` goes on from the weights of a pretrained folder; optimisers and replay buffers begin
anew, so let the rate rise from 0 at first (``--warm-up``): at a full rate a good policy is soon
lost. Where ``--set`` changes ``gamma``, the critics' outputs are scaled to what rewards then add up
to. The model is written every few epochs.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import torch as th
import yaml
from common import available_device
from stable_baselines3.common.utils import ConstantSchedule

from sb3_poem import POEMSAC
from sb3_poem.common.vec_env import TaskVecEnv, make_task_vec_env
from sb3_poem.pearl_sac.callbacks import EpochCallback
from sb3_poem.resources import zoo_entry

SHOWN = (
    "train_task_return",
    "critic_loss",
    "kl",
    "preference_accuracy",
    "ent_coef",
    "entropy",
    "collection_fps",
    "updates_per_second",
)


class Clock(EpochCallback):
    """Ends training after some time, lets the learning rate fall until then, and writes the model
    every few epochs.

    :param seconds: The time
    :param rate: Learning rate at the start
    :param warm_up: Seconds in which it rises from 0
    :param out: The model's file
    :param every: Epochs between two writes of it
    """

    def __init__(self, seconds: float, rate: float, warm_up: float, out: Path, every: int) -> None:
        super().__init__()
        self.seconds, self.rate, self.warm_up, self.out, self.write_every = (
            seconds,
            rate,
            warm_up,
            out,
            every,
        )
        self.started = time.monotonic()

    @property
    def share(self) -> float:
        """Of the time that is over."""
        return min(1.0, (time.monotonic() - self.started) / self.seconds)

    @property
    def schedule(self) -> ConstantSchedule:
        """Of the learning rate, until the next epoch."""
        risen = min(1.0, self.share * self.seconds / self.warm_up) if self.warm_up > 0 else 1.0
        return ConstantSchedule(self.rate * risen * (1.0 - self.share))

    def _on_epoch(self) -> None:
        self.model.lr_schedule = self.schedule
        values = {name.split("/")[-1]: value for name, value in self.logger.name_to_value.items()}
        shown = {name: round(float(values[name]), 3) for name in SHOWN if name in values}
        print(
            self.model.epoch,
            self.model.num_timesteps,
            self.model._n_updates,
            round(self.share * self.seconds),
            shown,
            flush=True,
        )
        if self.model.epoch % self.write_every == 0:
            self.model.save(self.out)

    def _on_step(self) -> bool:
        return self.share < 1.0


def pairs(words: list[str]) -> dict[str, Any]:
    """``["a=1"]`` as ``{"a": 1}``; values are YAML."""
    return {name: yaml.safe_load(value) for name, value in (word.split("=", 1) for word in words)}


def make_model(
    entry: dict[str, Any], env: TaskVecEnv, start: Path | None, seed: int, device: str
) -> POEMSAC:
    """A new model of an entry, or a pretrained one with the entry's settings of training."""
    if start is None:
        return POEMSAC(entry.pop("policy"), env, seed=seed, device=device, **entry)
    model = POEMSAC.from_pretrained(start, env=env, device=device)
    with th.no_grad():
        for critic in (*model.policy.critic.members, *model.policy.critic_target.members):
            for parameter in critic.output.parameters():
                parameter *= (1.0 - model.gamma) / (1.0 - entry.get("gamma", model.gamma))
    for name in entry.keys() - {
        "policy",
        "policy_kwargs",
        "ent_coef",
    }:  # which belong to the weights
        setattr(model, name, entry[name])
    return model


def main() -> None:
    """Train and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env_id")
    parser.add_argument("out", type=Path)
    parser.add_argument("seconds", type=float)
    parser.add_argument(
        "--conf", type=Path, default=Path(__file__).parents[1] / "zoo_configs" / "poem_sac.yml"
    )
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="KEY=VALUE", help="other hyperparameters"
    )
    parser.add_argument(
        "--env-set", nargs="+", default=[], metavar="KEY=VALUE", help="arguments of the environment"
    )
    parser.add_argument("--start", type=Path, help="a pretrained folder to go on from")
    parser.add_argument(
        "--warm-up",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="let the rate rise from 0 for so long",
    )
    parser.add_argument(
        "--every", type=int, default=8, help="epochs between two writes of the model"
    )
    parser.add_argument("--threads", type=int, help="of the simulation")
    parser.add_argument("--device", type=available_device, default="auto")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    th.set_num_threads(1)
    entry = zoo_entry(given.conf, given.env_id, **pairs(given.set))
    del entry["n_timesteps"]
    rate = float(str(entry.pop("learning_rate")).removeprefix("lin_"))
    env = make_task_vec_env(
        given.env_id, entry.pop("n_envs"), nthread=given.threads, **pairs(given.env_set)
    )
    model = make_model(entry, env, given.start, given.seed, given.device)
    clock = Clock(given.seconds, rate, given.warm_up, given.out, given.every)
    model.lr_schedule = clock.schedule
    model.learn(10**12, callback=clock, log_interval=None, reset_num_timesteps=False)
    model.save(given.out)
    print(f"{given.out}: {model.num_timesteps:,} steps, {model._n_updates:,} updates", flush=True)


if __name__ == "__main__":
    main()
