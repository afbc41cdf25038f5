"""The replay buffer against a model of Python lists."""

import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_poem.common.buffers import INITIAL_ROWS_PER_TASK, Segment, TaskReplayBuffer

OBS = spaces.Box(-np.inf, np.inf, (2,), np.float64)
ACTION = spaces.Box(-1.0, 1.0, (3,), np.float32)
FIELDS = ("observations", "actions", "next_observations", "rewards", "terminated", "features")
WIDTHS = (2, 3, 2, None, None, 4)


def make_buffer(size: int, n_tasks: int) -> TaskReplayBuffer:
    return TaskReplayBuffer(size, OBS, ACTION, "cpu", n_tasks=n_tasks, feature_dim=4)


def segment_of(task_ids: list[int], numbers: np.ndarray) -> Segment:
    """Every entry of a transition is its number plus a constant of its column, so that a mix-up shows."""
    column, values = 0, {}
    for name, width in zip(FIELDS, WIDTHS, strict=True):
        columns = column + np.arange(width or 1)
        value = numbers[..., None] + columns / 16.0
        values[name] = value if width else value[..., 0]
        column += width or 1
    copies, steps = numbers.shape
    return Segment(
        task_ids=np.array(task_ids), first_episode=np.ones((copies, steps), bool), latents=np.zeros((copies, 1)), **values
    )


def row_of(number: float) -> list[float]:
    return [number + column / 16.0 for column in range(sum(width or 1 for width in WIDTHS))]


def numbers_in(batch: tuple[th.Tensor, ...]) -> np.ndarray:
    """Numbers of a batch's transitions, (tasks, batch); checks all columns."""
    parts = [part if part.ndim == 3 else part[..., None] for part in batch]
    assert [part.shape[-1] for part in parts] == [width or 1 for width in WIDTHS]
    rows = th.cat(parts, dim=-1).numpy()
    numbers = rows[..., 0]
    assert np.array_equal(rows, numbers[..., None] + np.arange(rows.shape[-1]) / 16.0)
    return numbers


class ListBuffer:
    """What a ring a task should hold."""

    def __init__(self, size: int, n_tasks: int) -> None:
        self.size, self.kept = size, [[] for _ in range(n_tasks)]

    def extend(self, task_ids: list[int], numbers: np.ndarray) -> None:
        for task, row in zip(task_ids, numbers.tolist(), strict=True):
            self.kept[task] = (self.kept[task] + row)[-self.size :]


@settings(max_examples=60, deadline=None, database=None, derandomize=True)
@given(
    size=st.integers(1, 20),
    n_tasks=st.integers(1, 4),
    segments=st.lists(st.tuples(st.lists(st.integers(0, 3), min_size=1, max_size=6), st.integers(1, 30)), max_size=8),
    restore_at=st.integers(0, 8),
)
def test_is_a_ring_of_the_latest_transitions_of_each_task(
    size: int, n_tasks: int, segments: list[tuple[list[int], int]], restore_at: int
) -> None:
    buffer, truth, counter = make_buffer(size, n_tasks), ListBuffer(size, n_tasks), 0
    for index, (tasks, steps) in enumerate(segments):
        if index == restore_at:
            state, buffer = buffer.state(), make_buffer(size, n_tasks)
            buffer.load_state(state)
        task_ids = [task % n_tasks for task in tasks]
        numbers = counter + np.arange(len(task_ids) * steps, dtype=np.float64).reshape(len(task_ids), steps)
        counter += numbers.size
        buffer.extend(segment_of(task_ids, numbers))
        truth.extend(task_ids, numbers)
    assert buffer.counts.tolist() == [len(kept) for kept in truth.kept]
    assert buffer.size() == sum(map(len, truth.kept))
    assert buffer.full == all(len(kept) == size for kept in truth.kept)
    for task, kept in enumerate(truth.kept):
        stored = buffer.rows[task, : len(kept)].tolist()
        assert sorted(stored) == [row_of(number) for number in sorted(kept)]
        if kept:
            drawn = numbers_in(buffer.sample_rows(th.full((1, 40), task), th.Generator().manual_seed(counter)))
            assert set(drawn.ravel()) <= set(kept)


def test_memory_grows_as_it_fills_and_stops_at_the_buffer_size() -> None:
    buffer = make_buffer(3000, 2)
    assert buffer.rows.numel() == 0
    capacities, numbers = [], np.zeros((1, 700))
    for _ in range(6):
        buffer.extend(segment_of([0], numbers))
        capacities.append(buffer.rows.shape[1])
    assert capacities == [INITIAL_ROWS_PER_TASK, 2 * INITIAL_ROWS_PER_TASK, 3000, 3000, 3000, 3000]
    assert buffer.counts.tolist() == [3000, 0]
    assert not buffer.full


def test_growth_keeps_what_was_there() -> None:
    buffer = make_buffer(10_000, 2)
    numbers = np.arange(2 * 900, dtype=np.float64).reshape(2, 900)
    buffer.extend(segment_of([0, 1], numbers))
    before = buffer.rows[:, :900].clone()
    buffer.extend(segment_of([1], numbers[:1]))
    assert buffer.rows.shape[1] > INITIAL_ROWS_PER_TASK
    assert th.equal(buffer.rows[:, :900], before)


def test_draws_are_uniform_over_a_tasks_own_transitions() -> None:
    buffer = make_buffer(100, 3)
    buffer.extend(segment_of([1], np.arange(30.0)[None]))
    buffer.extend(segment_of([2], np.arange(1000.0, 1170.0)[None]))  # wraps: 1070 to 1169 stay
    tasks = th.tensor([1, 2]).repeat_interleave(30_000).view(2, -1)
    numbers = numbers_in(buffer.sample_rows(tasks, th.Generator().manual_seed(0)))
    for drawn, first, count in ((numbers[0], 0, 30), (numbers[1], 1070, 100)):
        frequencies = np.bincount((drawn - first).astype(int), minlength=count)
        assert len(frequencies) == count
        expected = len(drawn) / count
        chi_squared = ((frequencies - expected) ** 2 / expected).sum()
        assert abs(chi_squared - (count - 1)) < 4 * np.sqrt(2 * (count - 1))


def test_each_entry_names_its_task() -> None:
    buffer = make_buffer(50, 4)
    buffer.extend(segment_of([0, 1, 2, 3], 100.0 * np.arange(4)[:, None] + np.arange(50.0)))
    sources = th.randint(4, (7, 11), generator=th.Generator().manual_seed(0))
    numbers = numbers_in(buffer.sample_rows(sources, th.Generator().manual_seed(0)))
    assert np.array_equal(numbers // 100, sources.numpy())


def test_state_leaves_unused_room_out_and_continues_alike() -> None:
    buffer = make_buffer(2000, 2)
    numbers = np.arange(2.0 * 1500).reshape(2, 1500)
    buffer.extend(segment_of([0, 1], numbers))
    state = buffer.state()
    assert state["rows"].shape[1] == 1500
    restored = make_buffer(2000, 2)
    restored.load_state(state)
    state["rows"].zero_()
    state["counts"][:] = 0  # the buffer has its own copies
    for one in (buffer, restored):
        one.extend(segment_of([1, 0], numbers[:, :900]))  # wraps
    sources = th.randint(2, (2, 64), generator=th.Generator().manual_seed(0))
    first, second = (one.sample_rows(sources, th.Generator().manual_seed(1)) for one in (buffer, restored))
    assert np.array_equal(numbers_in(first), numbers_in(second))
    assert restored.size() == buffer.size()
    assert restored.full
    assert buffer.full


def test_an_empty_state_restores() -> None:
    buffer = make_buffer(10, 2)
    buffer.load_state(make_buffer(10, 2).state())
    assert buffer.size() == 0


def test_pickles_as_sb3s_save_replay_buffer_does() -> None:
    buffer = make_buffer(10, 1)
    buffer.extend(segment_of([0], np.arange(15.0)[None]))
    copy = pickle.loads(pickle.dumps(buffer))
    assert th.equal(copy.rows, buffer.rows)
    copy.extend(segment_of([0], np.arange(3.0)[None]))
    assert not th.equal(copy.rows, buffer.rows)


def test_reset_forgets() -> None:
    buffer = make_buffer(10, 1)
    buffer.extend(segment_of([0], np.arange(15.0)[None]))
    assert buffer.full
    buffer.reset()
    assert buffer.size() == 0
    assert not buffer.full


def test_needs_a_flat_box() -> None:
    with pytest.raises((AssertionError, ValueError)):
        TaskReplayBuffer(10, spaces.Discrete(3), ACTION, "cpu", n_tasks=1, feature_dim=1)
