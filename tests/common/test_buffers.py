"""The replay buffer against a model of Python lists."""

import pickle

import numpy as np
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from meta_toys import experience_of

from sb3_poem.common.buffers import INITIAL_ROWS_PER_TASK, Segment, TaskBatch, TaskReplayBuffer

OBS = spaces.Box(-np.inf, np.inf, (2,), np.float64)
ACTION = spaces.Box(-1.0, 1.0, (3,), np.float32)
WIDTHS = {
    "observations": 2,
    "actions": 3,
    "next_observations": 2,
    "rewards": 0,
    "terminated": 0,
    "features": 4,
}


def make_buffer(size: int, n_tasks: int) -> TaskReplayBuffer:
    return TaskReplayBuffer(size, OBS, ACTION, "cpu", tasks=np.zeros((n_tasks, 1)), feature_dim=4)


def fields_of(numbers: np.ndarray) -> dict[str, np.ndarray]:
    """Every entry of a transition follows from its number and its column, so that a mix-up shows.

    The observation after transition n is that of n + 1, unless n ends an episode: every seventh
    does, and every fourteenth of all terminates.
    """
    numbers = np.asarray(numbers)
    is_end = numbers % 7 == 3
    return {
        "observations": numbers[..., None] + np.arange(2) / 16.0,
        "actions": (numbers[..., None] * 7 + np.arange(3)) % 32767 / 32767.0,
        "next_observations": np.where(is_end, -numbers, numbers + 1)[..., None]
        + np.arange(2) / 16.0,
        "rewards": numbers + 0.5,
        "terminated": (numbers % 14 == 3).astype(np.float64),
        "features": numbers[..., None] + np.arange(4) / 8.0,
    }


def segment_of(task_ids: list[int], numbers: np.ndarray) -> Segment:
    copies, steps = numbers.shape
    return Segment(
        task_ids=np.array(task_ids),
        first_episode=np.ones((copies, steps), bool),
        latents=np.zeros((copies, 1)),
        **fields_of(numbers),
    )


def numbers_in(batch: TaskBatch) -> np.ndarray:
    """Numbers of a batch's transitions, (tasks, batch); checks all columns."""
    numbers = batch.observations[..., 0].double().numpy()
    for name, expected in fields_of(numbers).items():
        stored = getattr(batch, name).numpy()
        assert stored.dtype == np.float32
        if name == "actions":
            np.testing.assert_allclose(stored, expected, rtol=0, atol=1.6e-5)
        else:
            assert np.array_equal(stored, expected.astype(np.float32)), name
    return numbers


def stored_numbers(buffer: TaskReplayBuffer, task: int) -> list[float]:
    return sorted(numbers_in(experience_of(buffer, task))[0].tolist())


class ListBuffer:
    """What a ring a task should hold."""

    def __init__(self, size: int, n_tasks: int) -> None:
        self.size, self.kept = size, [[] for _ in range(n_tasks)]

    def extend(self, task_ids: list[int], numbers: np.ndarray) -> None:
        for task, row in zip(task_ids, numbers.tolist(), strict=True):
            self.kept[task] = (self.kept[task] + row)[-self.size :]


@settings(max_examples=60)
@given(
    size=st.integers(1, 20),
    n_tasks=st.integers(1, 4),
    segments=st.lists(
        st.tuples(st.lists(st.integers(0, 3), min_size=1, max_size=6), st.integers(1, 30)),
        max_size=8,
    ),
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
        numbers = counter + np.arange(len(task_ids) * steps, dtype=np.float64).reshape(
            len(task_ids), steps
        )
        counter += numbers.size
        buffer.extend(segment_of(task_ids, numbers))
        truth.extend(task_ids, numbers)
    assert buffer.counts.tolist() == [len(kept) for kept in truth.kept]
    assert buffer.size() == sum(map(len, truth.kept))
    assert buffer.full == all(len(kept) == size for kept in truth.kept)
    for task, kept in enumerate(truth.kept):
        assert stored_numbers(buffer, task) == sorted(kept)
        if kept:
            drawn = numbers_in(
                buffer.sample_rows(th.full((1, 40), task), th.Generator().manual_seed(counter))
            )
            assert set(drawn.ravel()) <= set(kept)


def test_memory_grows_as_it_fills_and_stops_at_the_buffer_size() -> None:
    buffer = make_buffer(3000, 2)
    assert buffer.capacity == 0
    capacities, numbers = [], np.zeros((1, 700))
    for _ in range(6):
        buffer.extend(segment_of([0], numbers))
        capacities.append(buffer.capacity)
    assert capacities == [INITIAL_ROWS_PER_TASK, 2 * INITIAL_ROWS_PER_TASK, 3000, 3000, 3000, 3000]
    assert buffer.counts.tolist() == [3000, 0]
    assert not buffer.full


def test_growth_keeps_what_was_there() -> None:
    buffer = make_buffer(10_000, 2)
    numbers = np.arange(2 * 900, dtype=np.float64).reshape(2, 900)
    buffer.extend(segment_of([0, 1], numbers))
    assert buffer.capacity == INITIAL_ROWS_PER_TASK
    buffer.extend(segment_of([1], numbers[:1] + 5000.0))
    assert buffer.capacity > INITIAL_ROWS_PER_TASK
    assert stored_numbers(buffer, 0) == numbers[0].tolist()
    assert stored_numbers(buffer, 1) == [*numbers[1], *(numbers[0] + 5000.0)]


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
    for value in state.values():
        value[:] = 0  # the buffer has its own copies
    for one in (buffer, restored):
        one.extend(segment_of([1, 0], numbers[:, :900]))  # wraps
    sources = th.randint(2, (2, 64), generator=th.Generator().manual_seed(0))
    first, second = (
        one.sample_rows(sources, th.Generator().manual_seed(1)) for one in (buffer, restored)
    )
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
    assert stored_numbers(copy, 0) == stored_numbers(buffer, 0) == list(range(5, 15))
    copy.extend(segment_of([0], np.arange(3.0)[None]))
    assert stored_numbers(copy, 0) == [0, 1, 2, *range(8, 15)]
    assert stored_numbers(buffer, 0) == list(range(5, 15))


def test_ends_do_not_pile_up() -> None:
    """What follows an end is kept as long as its transition is, and its place is used again."""
    buffer = make_buffer(200, 3)
    for _ in range(30):
        buffer.extend(segment_of([0, 1, 2], np.arange(3 * 20, dtype=np.float64).reshape(3, 20)))
    places = len(buffer.ends)
    for _ in range(100):
        buffer.extend(segment_of([0, 1, 2], np.arange(3 * 20, dtype=np.float64).reshape(3, 20)))
    assert len(buffer.ends) == places


def test_takes_three_fifths_of_the_memory_of_plain_transitions() -> None:
    obs_dim, action_dim, steps, tasks = 27, 8, 200, 2
    space, actions = spaces.Box(-np.inf, np.inf, (obs_dim,)), spaces.Box(-1.0, 1.0, (action_dim,))
    buffer = TaskReplayBuffer(
        4000, space, actions, "cpu", tasks=np.zeros((tasks, 1)), feature_dim=3
    )
    rng = np.random.default_rng(0)
    for _ in range(20):
        states = rng.standard_normal((tasks, steps + 1, obs_dim)).astype(np.float32)
        buffer.extend(
            Segment(
                task_ids=np.arange(tasks),
                observations=states[:, :-1],
                actions=rng.uniform(-1.0, 1.0, (tasks, steps, action_dim)),
                next_observations=states[:, 1:],
                rewards=np.zeros((tasks, steps)),
                terminated=np.zeros((tasks, steps)),
                features=np.zeros((tasks, steps, 3)),
                first_episode=np.ones((tasks, steps), bool),
                latents=np.zeros((tasks, 1)),
            )
        )
    assert buffer.full
    unused_ends = 4 * obs_dim * INITIAL_ROWS_PER_TASK  # room for a while
    nbytes = buffer.rows.nbytes + buffer.ends.nbytes
    assert nbytes - unused_ends <= 0.6 * 4 * (2 * obs_dim + action_dim + 1) * buffer.size()


def test_reset_forgets() -> None:
    buffer = make_buffer(10, 1)
    buffer.extend(segment_of([0], np.arange(15.0)[None]))
    assert buffer.full
    buffer.reset()
    assert buffer.size() == 0
    assert not buffer.full
