"""The generators that are saved with a model."""

import pickle

import numpy as np
import pytest
import torch as th

from sb3_poem.common.random import Generators


def draws(generators: Generators) -> tuple[list[float], list[float]]:
    return generators.numpy.random(5).tolist(), th.rand(5, generator=generators.torch).tolist()


def test_a_seed_determines_both_streams_and_they_are_not_global() -> None:
    np.random.seed(1)  # noqa: NPY002 (to show that it does not matter)
    first = draws(Generators(3))
    np.random.seed(2)  # noqa: NPY002
    th.manual_seed(5)
    before = th.get_rng_state()
    assert draws(Generators(3)) == first
    assert th.equal(th.get_rng_state(), before)
    other = draws(Generators(4))
    assert other[0] != first[0]
    assert other[1] != first[1]


def test_no_seed_means_a_new_stream_each_time() -> None:
    assert draws(Generators(None)) != draws(Generators(None))


def test_pickling_keeps_the_exact_state() -> None:
    generators = Generators(0)
    draws(generators)
    copy = pickle.loads(pickle.dumps(generators))
    assert draws(copy) == draws(generators)
    assert draws(copy) == draws(generators)


def test_children_are_independent_and_reproducible() -> None:
    generators, same = Generators(0), Generators(0)
    children = [generators.child() for _ in range(3)]
    values = [child.random(4).tolist() for child in children]
    assert len({tuple(row) for row in values}) == 3
    assert [same.child().random(4).tolist() for _ in range(3)] == values
    assert (
        generators.integer_seed() == same.integer_seed()
    )  # a child's own draws do not advance its parent
    assert 0 <= generators.integer_seed() < 2**31


def test_moving_to_the_same_kind_of_device_changes_nothing() -> None:
    generators, same = Generators(0), Generators(0)
    assert generators.to("cpu") is generators
    assert draws(generators) == draws(same)


@pytest.mark.skipif(th.cuda.is_available(), reason="shows what happens without the device")
def test_a_state_of_another_device_continues_reproducibly() -> None:
    state = {**Generators(0).__getstate__(), "device": "cuda"}
    first, second = Generators(1), Generators(2)
    first.__setstate__(state)
    second.__setstate__(state)
    assert first.torch.device.type == "cpu"
    assert draws(first) == draws(second)
