"""One gradient step of POEM with all its losses: ours, a plain implementation's, SB3's SAC, and the
matrix products alone.

python benchmarks/bench_gradient_step.py [--sizes entries paper] [--threads 2] [--sbx]

Contenders take turns within one run; a figure is the median of their turns. *plain* is the same
mathematics in eager float32 (`plain_poem.py`; its losses are compared with ours first). *SAC* is
Stable-Baselines3's own on as many transitions: it has no encoder, decoder, embeddings or
preferences, and its actor learns in every step. *SBX* (`--sbx`; `pip install '.[sbx]'`) is
SAC in JAX and float32; *SBX, delayed* trains its actor as seldom as we do. *products* is the time
of `torch.mm` for every matrix product of our step, on operands of the same shapes, strides and
type. What happens once an epoch (posteriors, the decoder's error) is timed on its own and
subtracted. On a GPU, *on the processor* is our step on that machine's processor, with the given
number of threads, and the matrix products are replayed as one CUDA graph, as our step is.
"""

import statistics
from collections import Counter
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from common import DEVICE, arguments, seconds_in_turns, table, write
from plain_poem import PlainPOEM, fields
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from torch.utils._python_dispatch import TorchDispatchMode

from poem_envs.vector import available_cores
from sb3_poem import POEMSAC
from sb3_poem.common.precision import MixedPrecision
from sb3_poem.pearl_sac.objective import kl_to_prior

#: Of *entries*, the defaults of POEMSAC, with which those of ``zoo_configs/`` train
SIZES: dict[str, dict[str, Any]] = {
    "entries": {"tasks": 20, "batch": 32, "context": 32, "widths": [256, 256], "steps": 40},
    "small": {"tasks": 16, "batch": 128, "context": 128, "widths": [256, 256], "steps": 20},
    "paper": {"tasks": 32, "batch": 256, "context": 128, "widths": [300, 300, 300], "steps": 4},
}
N_TRAIN_TASKS, HORIZON = 120, 200
#: A GPU's first steps of a call are not captured yet; there should be many more of them, as there
#: are in training
STEPS_ON_GPU = {"ours": 1000, "ours, float32": 1000, "SAC": 100}


def poem(size: dict[str, Any], precision: str, device: str) -> POEMSAC:
    """A model with an epoch of data, ready for gradient steps."""
    settings: dict[str, Any] = {"gradient_steps": 0, "n_train_tasks": N_TRAIN_TASKS, "seed": 0}
    settings |= {"meta_batch_size": size["tasks"], "batch_size": size["batch"]}
    settings |= {"context_size": size["context"], "precision": precision, "device": device}
    arch = {"net_arch": {"pi": size["widths"], "qf": size["widths"]}}
    model = POEMSAC("MlpPolicy", "poem/HalfCheetahVel-v0", policy_kwargs=arch, **settings)
    return model.learn(N_TRAIN_TASKS * HORIZON)


def sac(size: dict[str, Any], device: str) -> SAC:
    """SB3's own SAC with as many transitions in its buffer."""
    settings: dict[str, Any] = {"policy_kwargs": {"net_arch": size["widths"]}, "device": device}
    settings |= {"buffer_size": N_TRAIN_TASKS * HORIZON, "seed": 0}
    return filled(SAC("MlpPolicy", gym.make("HalfCheetah-v5"), **settings))


def filled(model: Any) -> Any:
    """A SAC with random transitions in its buffer."""
    model.set_logger(configure(None, []))
    buffer, rng = model.replay_buffer, np.random.default_rng(0)
    assert buffer is not None
    for _ in range(N_TRAIN_TASKS * HORIZON):
        obs, next_obs = rng.normal(size=(2, 1, 17))
        action = rng.uniform(-1, 1, (1, 6))
        buffer.add(obs, next_obs, action, rng.normal(size=1), np.zeros(1), [{}])
    return model


def sbx_sac(size: dict[str, Any], steps: int, policy_delay: int) -> Callable[[], None]:
    """SBX's SAC on as many transitions."""
    import sbx

    settings: dict[str, Any] = {"policy_kwargs": {"net_arch": size["widths"]}, "seed": 0}
    settings |= {"buffer_size": N_TRAIN_TASKS * HORIZON, "policy_delay": policy_delay}
    model = filled(sbx.SAC("MlpPolicy", gym.make("HalfCheetah-v5"), **settings))
    return partial(model.train, steps, size["tasks"] * size["batch"])


def compare_losses(model: POEMSAC, plain: PlainPOEM, size: dict[str, Any]) -> dict[str, float]:
    """The plain implementation's losses against ours on the same batch and noise; returns the
    relative differences.

    :raises AssertionError: If one differs by more than float32 explains
    """
    batch = model.make_sampler().sample(1, size["batch"])[0]
    noises = [batch.latent_noise, batch.next_action_noise, batch.action_noise]
    theirs = plain.losses(
        fields(model, batch), batch.context, batch.context_rewards, batch.returns, noises
    )
    with th.no_grad():
        mean, variance = model.policy.encoder(batch.context)
        objective = model.make_objective()
        embeddings = objective.embed(mean + variance.sqrt() * noises[0])
        data, alpha = objective.standardised(batch.transitions), model.entropy_coefficient.value
        actor, log_prob = objective.actor_loss(batch, data, embeddings, alpha)
        ours = {
            "critic": objective.critic_loss(batch, data, embeddings, alpha),
            "kl": kl_to_prior(mean, variance).mean(),
            "actor": actor,
            "decoder": objective.decoder_loss(batch, data, embeddings),
            "preference": objective.embedding_loss(batch, embeddings)[1]["preference_loss"],
            "log_prob": log_prob,
        }
    differences = {
        name: abs(a.item() - b.item()) / max(abs(b.item()), 1e-3)
        for (name, a), b in zip(ours.items(), theirs, strict=True)
    }
    assert max(differences.values()) < 1e-3, differences
    return differences


class Products(TorchDispatchMode):
    """Notes the operands of all matrix products that run within it."""

    def __init__(self) -> None:
        super().__init__()
        self.operands: Counter[tuple[Any, ...]] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name in ("mm", "addmm"):
            self._note(*args[-2:])
        elif name == "_linear_pointwise":
            self._note(args[0], args[1].t())
        return func(*args, **(kwargs or {}))

    def _note(self, left: th.Tensor, right: th.Tensor) -> None:
        layouts = ((tuple(x.shape), x.stride(), x.dtype, x.device.type) for x in (left, right))
        self.operands[tuple(layouts)] += 1

    def contender(self) -> Callable[[], None]:
        """All of the products by ``torch.mm``, one after another."""
        pairs = []
        for (left, right), count in self.operands.items():
            one, two = strided(*left), strided(*right)
            pairs.append((one, two, one.new_empty(one.shape[0], two.shape[1]), count))

        def run() -> None:
            for one, two, out, count in pairs:
                for _ in range(count):
                    th.mm(one, two, out=out)

        return run

    @property
    def operations(self) -> float:
        """Floating-point operations."""
        sizes = ((*left[0], right[0][1], count) for (left, right), count in self.operands.items())
        return sum(2.0 * float(np.prod(size)) for size in sizes)


def strided(
    shape: tuple[int, ...], stride: tuple[int, ...], dtype: th.dtype, device: str
) -> th.Tensor:
    """Random numbers in a tensor of the same layout."""
    x = th.empty_strided(shape, stride, dtype=dtype, device=device)
    return x.copy_(th.randn(shape, device=device))


def products_of_a_step(model: POEMSAC, size: dict[str, Any]) -> Products:
    """The matrix products of as many gradient steps as there are to one of the actor."""
    policy, products, delay = model.policy, Products(), model.policy_delay
    networks = [policy.encoder, policy.decoder, policy.actor, policy.critic, policy.critic_target]
    with MixedPrecision(th.nn.ModuleList(networks), model.hidden_dtype) as precision:
        precision.refresh()
        batch = model.make_sampler().sample(1, size["batch"])[0]
        objective, alpha = model.make_objective(), model.entropy_coefficient.value
        with products:
            for step in range(delay):
                objective.loss(batch, alpha, whole=step == 0)[0].backward()
    policy.optimizer.zero_grad(set_to_none=True)
    return products


def captured(run: Callable[[], None]) -> Callable[[], None]:
    """The same as one CUDA graph."""
    stream, graph = th.cuda.Stream(), th.cuda.CUDAGraph()
    with th.cuda.stream(stream):
        run()
    th.cuda.synchronize()
    with th.cuda.graph(graph):
        run()

    def replay(operands_of: Callable[[], None] = run) -> None:  # the graph does not keep them
        graph.replay()

    return replay


def repeat(plain: PlainPOEM, size: dict[str, Any]) -> None:
    """The plain implementation's steps, one of them whole."""
    for _ in range(plain.settings.policy_delay):
        plain.step(size["tasks"], size["batch"])


def measure(name: str, device: str, turns: int, sbx: bool) -> dict[str, Any]:
    """One size: milliseconds a step of every contender."""
    size = SIZES[name]
    n, steps = size["tasks"] * size["batch"], size["steps"]
    fast, exact = poem(size, "auto", device), poem(size, "fp32", device)
    plain, plain_sac = PlainPOEM(exact), sac(size, device)
    differences = compare_losses(exact, plain, size) if device == "cpu" else {}
    products = products_of_a_step(fast, size)
    n_steps = {key: steps if device == "cpu" else count for key, count in STEPS_ON_GPU.items()}
    contenders: dict[str, tuple[Callable[[], Any], int]] = {
        "SAC": (lambda: plain_sac.train(n_steps["SAC"], n), n_steps["SAC"]),
    }
    run = products.contender()
    contenders["products"] = (run if device == "cpu" else captured(run), fast.policy_delay)
    if sbx:
        contenders |= {
            "SBX": (sbx_sac(size, steps, 1), steps),
            "SBX, delayed": (sbx_sac(size, steps, fast.policy_delay), steps),
        }
    ends = {}

    def add(key: str, model: POEMSAC, steps: int) -> None:
        """A model's steps, and what it does at the end of an epoch."""
        ends[key] = f"end of an epoch, {key}"
        contenders[key] = (partial(model.train, steps, size["batch"]), steps)
        contenders[ends[key]] = (partial(model.train, 0, size["batch"]), 1)

    add("ours", fast, n_steps["ours"])
    add("ours, float32", exact, n_steps["ours, float32"])
    if device == "cpu":
        contenders["plain"] = (partial(repeat, plain, size), fast.policy_delay)
    else:
        add("on the processor", poem(size, "auto", "cpu"), steps)

    def synchronised(run: Callable[[], Any]) -> None:
        run()
        if device != "cpu":
            th.cuda.synchronize()

    timed = {key: partial(synchronised, run) for key, (run, _) in contenders.items()}
    taken = seconds_in_turns(timed, turns)
    seconds = {key: statistics.median(values) for key, values in taken.items()}
    for key, end in ends.items():  # posteriors and decoder: once an epoch, not in a step
        seconds[key] -= seconds[end]
    milliseconds = {key: 1e3 * seconds[key] / contenders[key][1] for key in contenders}
    ours, nan = milliseconds["ours"], float("nan")
    return {
        "size": {key: value for key, value in size.items() if key != "steps"},
        "arithmetic of hidden layers": str(fast.hidden_dtype),
        "milliseconds": milliseconds,
        "faster than plain": milliseconds.get("plain", nan) / ours,
        "faster than the processor": milliseconds.get("on the processor", nan) / ours,
        "faster than SAC": milliseconds["SAC"] / ours,
        "share of the products rate": milliseconds["products"] / ours,
        "gigaflop a step": products.operations / 1e9 / fast.policy_delay,
        "relative differences of the losses from plain": differences,
    }


def main() -> None:
    sizes = {"nargs": "+", "choices": SIZES, "default": list(SIZES)}
    flag = {"action": "store_true", "help": "measure SBX's SAC as well, on a processor"}
    options = {"sizes": sizes, "threads": [1, 2], "turns": 5, "device": DEVICE, "sbx": flag}
    given = arguments(__doc__, **options)
    on_cpu = given.device == "cpu"
    if given.sbx and not on_cpu:
        raise SystemExit(f"--sbx is measured on the processor, but --device is {given.device}")
    if given.sbx and find_spec("sbx") is None:
        raise SystemExit("--sbx: SBX is not installed; pip install '.[sbx]'")
    if given.sbx and {available_cores()} != set(given.threads):
        raise SystemExit(
            f"--sbx: JAX takes all {available_cores()} core(s) that this process may use, but "
            f"--threads is {given.threads}: ask for that many threads, or pin it by taskset"
        )
    reference, rival = ("plain", "plain") if on_cpu else ("on the processor", "the processor")
    columns = ["ours", "ours, float32", reference, "SAC"]
    columns += ["SBX", "SBX, delayed"] * given.sbx + ["products"]
    rows, results = [], []
    for threads in given.threads:
        th.set_num_threads(threads)
        for name in given.sizes:
            result = {
                "name": name,
                "threads": threads,
                **measure(name, given.device, given.turns, given.sbx),
            }
            results.append(result)
            cells = [f"{result['milliseconds'][key]:.3g}" for key in columns]
            cells += [f"{result[key]:.1f}x" for key in (f"faster than {rival}", "faster than SAC")]
            share = f"{100 * result['share of the products rate']:.0f} %"
            rows.append([name, threads, *cells, share])
    ratios = [f"ours to {rival}", "ours to SAC", "share of the products' rate"]
    text = table(["size", "threads", *(f"{key}, ms" for key in columns), *ratios], rows)
    name = "gradient-step" if on_cpu else f"gradient-step-{given.device}"
    settings = {"turns": given.turns, "device": given.device, "tasks": N_TRAIN_TASKS}
    sections, threads = [DESCRIPTION, text], max(given.threads)
    write(name, "Gradient step", sections, results, given.out, settings, threads)


DESCRIPTION = (__doc__ or "").split("\n\n")[-1].strip()

if __name__ == "__main__":
    main()
