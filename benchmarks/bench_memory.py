"""Bytes of a stored transition, and what sampling costs, against a plain float32 store of (s, a,
s', r).

Fills the replay buffer of 120 tasks with episodes of Ant's shape (200 steps, a third of them end
early) and reads the process's own memory. A plain store holds (27 + 8 + 27 + 1) x 4 = 252 bytes a
transition, and neither the flags nor the reward features that training needs; it samples with one
gather, as the buffer does.
"""

import os
import statistics
from pathlib import Path
from typing import Any

import common
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_poem.common.buffers import Segment, TaskReplayBuffer

N_TASKS, STEPS = 120, 200
SHAPES = {"Ant": (27, 8, 3), "HalfCheetah": (17, 6, 2)}
BATCHES = ((20, 32), (16, 128), (32, 256))


def resident_bytes() -> int:
    """Memory that the system gave to this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def make_segment(shape: tuple[int, int, int], rng: np.random.Generator) -> Segment:
    """One horizon of every task."""
    obs_dim, action_dim, feature_dim = shape
    states = rng.standard_normal((N_TASKS, STEPS + 1, obs_dim), dtype=np.float32)
    next_observations = states[:, 1:].copy()
    terminated = np.zeros((N_TASKS, STEPS), dtype=np.float32)
    early = np.flatnonzero(rng.random(N_TASKS) < 1 / 3)
    steps = rng.integers(STEPS - 1, size=len(early))
    terminated[early, steps] = 1.0
    next_observations[early, steps] += 1.0  # not the following row's
    return Segment(
        task_ids=np.arange(N_TASKS),
        observations=states[:, :-1],
        actions=rng.uniform(-1.0, 1.0, (N_TASKS, STEPS, action_dim)).astype(np.float32),
        next_observations=next_observations,
        rewards=rng.standard_normal((N_TASKS, STEPS)),
        terminated=terminated,
        features=rng.standard_normal((N_TASKS, STEPS, feature_dim)),
        first_episode=np.ones((N_TASKS, STEPS), dtype=bool),
        latents=np.zeros((N_TASKS, 5)),
    )


def make_buffer(size: int, shape: tuple[int, int, int]) -> TaskReplayBuffer:
    obs_dim, action_dim, feature_dim = shape
    obs, action = spaces.Box(-np.inf, np.inf, (obs_dim,)), spaces.Box(-1.0, 1.0, (action_dim,))
    tasks = np.zeros((N_TASKS, 1))
    return TaskReplayBuffer(size, obs, action, "cpu", tasks=tasks, feature_dim=feature_dim)


def filling(size: int, marks: tuple[float, ...] = (0.1, 0.25, 0.5, 1.0)) -> list[dict[str, Any]]:
    """What the buffer takes while it fills with Ant's transitions."""
    rng = np.random.default_rng(0)
    segments = [make_segment(SHAPES["Ant"], rng) for _ in range(4)]
    before, rows = resident_bytes(), []
    buffer = make_buffer(size, SHAPES["Ant"])
    for epoch in range(size // STEPS):
        buffer.extend(segments[epoch % len(segments)])
        if buffer.counts[0] in [int(mark * size) // STEPS * STEPS for mark in marks]:
            taken, stored = resident_bytes() - before, buffer.size()
            rows.append({"stored": stored, "resident": taken, "bytes each": taken / stored})
    return rows


def sampling(name: str, size: int, repeats: int) -> list[dict[str, Any]]:
    """Seconds of a batch from the buffer and from a plain store, in turns."""
    shape = SHAPES[name]
    obs_dim, action_dim, _ = shape
    buffer, rng = make_buffer(size, shape), np.random.default_rng(0)
    for _ in range(size // STEPS):
        buffer.extend(make_segment(shape, rng))
    widths = [obs_dim, action_dim, obs_dim, 1]
    plain = th.rand(N_TASKS, size, sum(widths))
    generator, rows = th.Generator().manual_seed(0), []
    for tasks, batch in BATCHES:
        sources = th.randint(N_TASKS, (tasks, 1), generator=generator).expand(-1, batch)

        def sample_plain(sources: th.Tensor = sources) -> None:
            slots = (th.rand(sources.shape, generator=generator) * size).long()
            flat = plain.view(-1, plain.shape[2])
            taken = flat.index_select(0, (sources * size + slots).view(-1))
            taken.view(*sources.shape, -1).split(widths, dim=-1)

        def sample_buffer(sources: th.Tensor = sources) -> None:
            buffer.sample_rows(sources, generator)

        contenders = {"buffer": sample_buffer, "plain": sample_plain}
        seconds = common.seconds_in_turns(contenders, repeats, warm_up=20)
        microseconds = {key: 1e6 * statistics.median(values) for key, values in seconds.items()}
        share = {"ratio": common.ratio(seconds["buffer"], seconds["plain"])}
        rows.append({"family": name, "batch": f"{tasks} x {batch}", **microseconds, **share})
    return rows


def main() -> None:
    size = {"type": int, "default": 100_000, "help": "transitions of a task"}
    given = common.arguments(__doc__, size=size, repeats=300)
    th.set_num_threads(1)
    filled = filling(given.size)
    some = min(given.size, 20_000)
    sampled = [row for name in SHAPES for row in sampling(name, some, given.repeats)]
    plain = 4 * (2 * 27 + 8 + 1)
    header = ["transitions stored", "resident, MB", "bytes a transition", "share of a plain store"]
    rows = [
        [row["stored"], row["resident"] / 1e6, row["bytes each"], row["bytes each"] / plain]
        for row in filled
    ]
    others = ["replay buffer", "plain store, flags and features missing", "ratio"]
    sections = [
        f"Ant, {N_TASKS} tasks, room for {given.size:,} transitions each; a plain store takes "
        f"{plain} bytes a transition.",
        common.table(header, rows),
        f"Microseconds of a batch, {some:,} transitions a task.",
        common.table(["family", "tasks x batch", *others], [[*row.values()] for row in sampled]),
    ]
    settings = {"threads of torch": 1, "steps of a segment": STEPS, "turns": given.repeats}
    data = {"filling": filled, "sampling": sampled}
    common.write("memory", "Memory of the replay buffer", sections, data, given.out, settings)


if __name__ == "__main__":
    main()
