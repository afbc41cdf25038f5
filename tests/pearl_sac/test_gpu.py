"""Training on a CUDA device: `pytest -m gpu`."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch as th
from meta_toys import ARCH, EPOCH, POINT_GOAL, small

from sb3_poem import PEARLSAC, POEMSAC, PreferenceAdapter, ReturnOracle
from sb3_poem.adaptation import named_rule
from sb3_poem.pearl_sac import updater
from sb3_poem.pearl_sac.sampler import MetaBatch

pytestmark = [pytest.mark.gpu, pytest.mark.parametrize("algorithm", [PEARLSAC, POEMSAC])]


def on_gpu(algorithm: type[PEARLSAC], **arguments: Any) -> PEARLSAC:
    return small(algorithm, device="cuda", **arguments)


def weights(model: PEARLSAC) -> dict[str, th.Tensor]:
    return {name: value.detach().clone() for name, value in model.policy.state_dict().items()}


@pytest.mark.parametrize("policy_delay", [1, 2])
def test_replayed_steps_are_the_eager_ones(
    algorithm: type[PEARLSAC], policy_delay: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = {"precision": "fp32", "gradient_steps": 20, "policy_delay": policy_delay}
    graphed = on_gpu(algorithm, **arguments).learn(EPOCH)
    monkeypatch.setattr(updater, "GraphedStep", lambda step: step)
    eager = on_gpu(algorithm, **arguments).learn(EPOCH)
    assert graphed._n_updates == eager._n_updates == 20
    for name, value in weights(eager).items():
        th.testing.assert_close(weights(graphed)[name], value, rtol=1e-3, atol=1e-4, msg=name)
    assert graphed.log_ent_coef.item() == pytest.approx(eager.log_ent_coef.item(), rel=1e-3)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_everything_is_trained(algorithm: type[PEARLSAC], precision: str) -> None:
    model = on_gpu(algorithm, precision=precision).learn(EPOCH)
    before = weights(model)
    model.learn(EPOCH, reset_num_timesteps=False)
    trained = [name for name in before if name.endswith("weight")]
    assert all((weights(model)[name] != before[name]).any() for name in trained)
    assert all(value.isfinite().all() for value in weights(model).values())


def test_a_step_waits_for_nothing(
    algorithm: type[PEARLSAC], monkeypatch: pytest.MonkeyPatch
) -> None:
    step = updater.Updater.step

    def watched(self: updater.Updater, batch: MetaBatch) -> dict[str, th.Tensor]:
        th.cuda.set_sync_debug_mode("error")
        try:
            return step(self, batch)
        finally:
            th.cuda.set_sync_debug_mode("default")

    monkeypatch.setattr(updater.Updater, "step", watched)
    on_gpu(algorithm).learn(EPOCH)


@pytest.mark.parametrize(
    "optimizer",
    [
        {},
        {"optimizer_kwargs": {"betas": (0.9, 0.999), "eps": 1e-8}},
        {"optimizer_kwargs": {"foreach": True}},
        {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.9}},
        {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"fused": True}},
    ],
)
def test_a_loss_that_is_not_finite_changes_no_weight(
    algorithm: type[PEARLSAC], optimizer: dict[str, Any]
) -> None:
    model = on_gpu(algorithm, policy_kwargs={"net_arch": ARCH, **optimizer}).learn(EPOCH)
    model.epoch_context.transitions[:] = float("nan")
    before = weights(model)
    with pytest.raises(ValueError, match="loss or its gradient is not finite at update 5"):
        model.train(6, 16)
    for name, value in weights(model).items():
        if not name.startswith("critic_target"):
            assert th.equal(value, before[name]), name
    assert model.log_ent_coef.isfinite().all()


def test_a_checkpoint_continues(algorithm: type[PEARLSAC], tmp_path: Any) -> None:
    model = on_gpu(algorithm).learn(EPOCH)
    model.save(tmp_path / "model.zip")
    loaded = algorithm.load(tmp_path / "model.zip", env=model.get_env(), device="cuda")
    loaded.learn(EPOCH, reset_num_timesteps=False)
    assert loaded._n_updates == 10


def test_a_model_goes_on_training_on_a_processor(algorithm: type[PEARLSAC], tmp_path: Any) -> None:
    on_gpu(algorithm).learn(EPOCH).save(tmp_path / "model.zip")
    loaded = algorithm.load(tmp_path / "model.zip", env=POINT_GOAL, device="cpu")
    loaded.learn(EPOCH, reset_num_timesteps=False)
    assert loaded._n_updates == 10


@pytest.mark.parametrize("inference", ["bayes", "paper"])
def test_adaptation_is_that_of_a_processor(algorithm: type[PEARLSAC], inference: str) -> None:
    """The same model adapts on both devices to the same latent, but for rounding."""
    if algorithm is PEARLSAC:
        pytest.skip("PEARL has no similarity to adapt by")
    model = on_gpu(algorithm, precision="fp32").learn(3 * EPOCH)
    latents = []
    for device in ("cuda", "cpu"):
        copy = algorithm.load(saved(model), device=device)
        adapter = PreferenceAdapter(
            copy, POINT_GOAL, oracle=ReturnOracle(), n_queries=3, rule=named_rule(inference), seed=0
        )
        latents.append(adapter.adapt().latent)
    np.testing.assert_allclose(*latents, atol=0.05)


def saved(model: PEARLSAC) -> io.BytesIO:
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    return file
