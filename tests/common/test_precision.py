"""The choice of the hidden layers' arithmetic."""

import pytest
import torch as th

from sb3_poem.common import precision
from sb3_poem.common.precision import autocast_dtype


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_named_precisions(device: str) -> None:
    assert autocast_dtype("fp32", device) is None
    assert autocast_dtype("bf16", device) is th.bfloat16


@pytest.mark.parametrize(("supported", "expected"), [(True, th.bfloat16), (False, None)])
def test_auto_asks_the_processor(supported: bool, expected: th.dtype | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "cpu_has_bfloat16", lambda: supported)
    monkeypatch.setattr(th.cuda, "is_bf16_supported", lambda: not supported)
    assert autocast_dtype("auto", "cpu") is expected
    assert autocast_dtype("auto", "cuda") is (None if supported else th.bfloat16)


def test_the_processor_is_known() -> None:
    assert precision.cpu_has_bfloat16() in (True, False)


@pytest.mark.parametrize("name", ["fp16", "float32", "", None])
def test_another_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"precision must be one of 'auto', 'bf16', 'fp32', got"):
        autocast_dtype(name, "cpu")
