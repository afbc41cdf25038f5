"""Fast rendering shows what full rendering shows."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import poem_envs  # noqa: F401
from poem_envs.headless import can_draw


@pytest.mark.skipif(not can_draw(), reason="no off-screen OpenGL")
@pytest.mark.parametrize(
    "env_id",
    [
        "poem/HalfCheetahVel-v0",
        "poem/AntGoal-v0",
        pytest.param("poem/MetaWorldML1-v0", marks=pytest.mark.metaworld),
    ],
)
def test_the_same_scene_from_the_same_camera(env_id: str) -> None:
    images = {}
    for quality in ("full", "fast"):
        options = {
            "width": 160,
            "height": 120,
            "render_mode": "rgb_array",
            "render_quality": quality,
            "render_task": True,
        }
        env = gym.make(env_id, **options)
        env.reset(seed=1)
        for _ in range(10):
            env.step(np.zeros(env.action_space.shape, dtype=np.float32))
        images[quality] = env.render().astype(np.float64)
        env.close()
    full, fast = images["full"], images["fast"]
    assert fast.shape == full.shape == (120, 160, 3)
    assert np.corrcoef(full.ravel(), fast.ravel())[0, 1] > 0.85  # shadows and edges differ
    assert (
        np.corrcoef(full.ravel(), fast[:, ::-1].ravel())[0, 1]
        < np.corrcoef(full.ravel(), fast.ravel())[0, 1]
    )


@pytest.mark.skipif(not can_draw(), reason="no off-screen OpenGL")
def test_a_scene_that_is_too_small_for_the_task(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a file there
    options = {"render_mode": "rgb_array", "render_quality": "fast", "render_task": True}
    env = gym.make("poem/AntGoal-v0", max_geom=3, width=64, height=64, **options)
    env.reset(seed=1)
    with pytest.raises(RuntimeError, match="maxgeom: 3"):
        env.render()
    env.close()


@pytest.mark.parametrize(
    "env_id", ["poem/AntVel-v0", pytest.param("poem/MetaWorldML1-v0", marks=pytest.mark.metaworld)]
)
def test_it_renders_images_alone(env_id: str) -> None:
    with pytest.raises(ValueError, match="render_quality"):
        gym.make(env_id, render_quality="best")
    with pytest.raises(ValueError, match="rgb_array"):
        gym.make(env_id, render_quality="fast", render_mode="depth_array")
