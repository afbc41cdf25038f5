"""Saving, loading, and what a loaded model keeps or is told anew."""

from __future__ import annotations

import io
import pickle
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from first_hour import foreign
from meta_toys import (
    EPOCH,
    N_TASKS,
    POINT_GOAL,
    OtherWalk,
    Walk,
    WindyWalk,
    assert_same_model,
    differing,
    experience_of,
    parameters,
    small,
    walks,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.common.vec_env import make_task_vec_env

OBS = np.random.default_rng(0).normal(size=(6, 2))


def test_save_and_load(trained: PEARLSAC, tmp_path: Path) -> None:
    for name in ("model", "other.zip", "deep/er/model"):
        trained.save(tmp_path / name)
        assert (tmp_path / name).with_suffix(".zip").is_file()
        loaded = type(trained).load(tmp_path / name)
        assert_same_model(trained, loaded)
        assert loaded.env is None
    with pytest.raises(ValueError, match="has no environment"):
        _ = loaded.family
    loaded.save(str(tmp_path / "again"))
    assert_same_model(trained, type(trained).load(str(tmp_path / "again.zip"), device="cpu"))


def test_save_to_a_buffer(poem: POEMSAC) -> None:
    buffer = io.BytesIO()
    poem.save(buffer)
    buffer.seek(0)
    assert_same_model(poem, POEMSAC.load(buffer))


def test_loaded_models_continue_with_another_number_of_copies(
    trained: PEARLSAC, tmp_path: Path
) -> None:
    trained.save(tmp_path / "model")
    loaded = type(trained).load(tmp_path / "model", env=make_vec_env(POINT_GOAL, 3))
    assert_same_model(trained, loaded)
    before = parameters(loaded)
    loaded.learn(1, reset_num_timesteps=False)
    assert loaded.num_timesteps == 2 * EPOCH + EPOCH
    assert (loaded.epoch, loaded._n_updates) == (3, 15)
    changed = differing(before, parameters(loaded))
    assert {
        "policy.actor.mlp.output.weight",
        "policy.encoder.mlp.output.weight",
        "log_ent_coef",
    } <= set(changed)
    assert "policy.reward_norm.std" not in changed  # rewards keep the first epoch's
    assert (trained.policy.obs_norm.count, loaded.policy.obs_norm.count) == (2 * EPOCH, 3 * EPOCH)
    third = th.cat(
        [experience_of(loaded.replay_buffer, task).observations for task in range(N_TASKS)]
    )
    mean = third.reshape(-1, 2).mean(dim=0)  # what the buffer, which is new, holds
    th.testing.assert_close(
        loaded.policy.obs_norm.mean,
        (2 * trained.policy.obs_norm.mean + mean) / 3,
        atol=1e-5,
        rtol=0,
    )
    assert np.array_equal(loaded.train_tasks.tasks, trained.train_tasks.tasks)


def test_set_env_takes_another_number_of_copies() -> None:
    model = small(POEMSAC).learn(EPOCH)
    for env in (
        make_vec_env(POINT_GOAL, 2),
        make_task_vec_env(POINT_GOAL, 30),
        gym.make(POINT_GOAL),
    ):
        model.set_env(env)
        model.learn(1, reset_num_timesteps=False)
    assert model.num_timesteps == EPOCH + 300 + 750 + 300


def test_set_env_of_a_family_that_is_not_registered(tmp_path: Path) -> None:
    """Its episodes' length is the model's to know."""
    model = small(POEMSAC, walks(2), horizon=10).learn(1)
    model.set_env(walks(3))
    model.learn(1, reset_num_timesteps=False)
    assert model.num_timesteps == 240
    model.save(tmp_path / "model")
    loaded = POEMSAC.load(tmp_path / "model")
    loaded.set_env(walks(4))
    loaded.learn(1, reset_num_timesteps=False)
    assert loaded.num_timesteps == 360
    POEMSAC.load(tmp_path / "model", env=walks(5)).learn(1)
    for env in (walks(2, OtherWalk), DummyVecEnv([OtherWalk])):
        with pytest.raises(ValueError, match="own family"):
            model.set_env(env)


def test_another_family(tmp_path: Path) -> None:
    cheetah, both_ways = "poem/HalfCheetahVel-v0", "poem/HalfCheetahFwdBack-v0"
    model = small(POEMSAC, cheetah, n_train_tasks=2)
    env, family = model.env, model.family
    for other, message in (
        (make_vec_env(both_ways, 1), "own family"),
        (make_vec_env(POINT_GOAL, 1), "[Oo]bservation spaces do not match"),
        (VecNormalize(make_vec_env(cheetah, 1)), "must not be wrapped in VecNormalize"),
        (
            make_vec_env(cheetah, 1, env_kwargs={"max_episode_steps": 50}),
            "horizon is 200, but the environment ends episodes after 50 steps",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            model.set_env(other)
        assert model.env is env  # a refused environment leaves the model as it was
        assert model.family is family
        assert model.n_envs == 2
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="own family"):
        POEMSAC.load(tmp_path / "model", env=both_ways)


def test_broken_and_foreign_files(poem: POEMSAC, tmp_path: Path) -> None:
    poem.save(tmp_path / "model.zip")
    content = (tmp_path / "model.zip").read_bytes()
    broken = tmp_path / "broken.zip"
    for bad in (
        content[: len(content) // 2],
        content[:-30],
        b"",
        b"hello",
        np.random.default_rng(0).bytes(5000),
    ):
        broken.write_bytes(bad)
        with pytest.raises(ValueError, match=r"broken\.zip is truncated, or no model saved by"):
            POEMSAC.load(broken)
    middle = bytearray(content)
    middle[len(content) // 2] ^= 0xFF
    broken.write_bytes(middle)
    with pytest.raises(ValueError, match=r"broken\.zip is truncated, or no model saved by"):
        POEMSAC.load(broken)
    with pytest.raises(FileNotFoundError):
        POEMSAC.load(tmp_path / "nothing.zip")
    foreign().save(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match=r"sac\.zip holds a model of another algorithm"):
        POEMSAC.load(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match=r"model\.zip holds a POEMSAC, not a PEARLSAC"):
        PEARLSAC.load(tmp_path / "model.zip")


def test_get_and_set_parameters(poem: POEMSAC, tmp_path: Path) -> None:
    other = small(POEMSAC, seed=7)
    assert differing(parameters(other), parameters(poem))
    other.set_parameters(poem.get_parameters())
    mine, theirs = parameters(other), parameters(poem)
    assert not [
        name for name in differing(mine, theirs) if name != "log_ent_coef"
    ]  # SB3 keeps it beside the parameters
    latents = np.random.default_rng(1).normal(size=(6, 5))
    actions = [model.predict(OBS, latents, deterministic=True)[0] for model in (other, poem)]
    assert np.array_equal(*actions)
    poem.save(tmp_path / "model")
    third = small(POEMSAC, seed=8)
    third.set_parameters(tmp_path / "model")
    assert np.array_equal(third.predict(OBS, latents, deterministic=True)[0], actions[0])
    with pytest.raises(ValueError, match="parameters do not match"):
        third.set_parameters({"policy": poem.policy.state_dict()})
    third.set_parameters({"policy": poem.policy.state_dict()}, exact_match=False)


def test_policy_saves_alone(trained: PEARLSAC, tmp_path: Path) -> None:
    """rl_zoo3 and users export ``model.policy``."""
    trained.policy.save(tmp_path / "policy")
    policy = type(trained.policy).load(tmp_path / "policy")
    latents = np.random.default_rng(1).normal(size=(6, 5))
    expected = trained.predict(OBS, latents, deterministic=True)[0]
    assert np.array_equal(policy.predict(OBS, latents, deterministic=True)[0], expected)


@pytest.mark.parametrize("other", [{"seed": 5}, {"n_train_tasks": 5}])
def test_a_replay_buffer_of_other_tasks_is_refused(tmp_path: Path, other: dict[str, int]) -> None:
    small(POEMSAC).learn(EPOCH).save_replay_buffer(tmp_path / "buffer")
    model = small(POEMSAC, **other)
    with pytest.raises(ValueError, match="buffer is the experience of other tasks than"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.learn(1).replay_buffer.size() == model.num_timesteps  # and it goes on
    foreign().save_replay_buffer(tmp_path / "of_sac")
    with pytest.raises(ValueError, match="of_sac is the experience of other tasks than"):
        model.load_replay_buffer(tmp_path / "of_sac")


def test_a_file_that_is_no_replay_buffer_is_refused(poem: POEMSAC, tmp_path: Path) -> None:
    poem.save_replay_buffer(tmp_path / "buffer")
    half = (tmp_path / "buffer.pkl").read_bytes()[:2000]
    poem.save(tmp_path / "model")
    zipped, other = (tmp_path / "model.zip").read_bytes(), pickle.dumps({"a": "dictionary"})
    model = POEMSAC.load(tmp_path / "model", POINT_GOAL)
    for content in (half, zipped, other, b"hello", b""):
        (tmp_path / "buffer.pkl").write_bytes(content)
        with pytest.raises(ValueError, match="buffer is truncated, or no replay buffer that"):
            model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.size() == 0  # its own


def test_a_file_beside_a_folder_of_the_same_name(poem: POEMSAC, tmp_path: Path) -> None:
    poem.save_pretrained(tmp_path / "model")
    with pytest.raises(ValueError, match=r"model is a folder: use POEMSAC\.from_pretrained"):
        POEMSAC.load(tmp_path / "model")
    poem.save(tmp_path / "model")
    assert_same_model(poem, POEMSAC.load(tmp_path / "model"))
    assert POEMSAC.from_pretrained(tmp_path / "model").digest == poem.digest


def test_a_model_and_its_buffer_go_on_as_if_they_had_never_stopped(tmp_path: Path) -> None:
    """SB3's way, of ``save`` and ``save_replay_buffer``."""
    whole = small(POEMSAC).learn(2 * EPOCH)
    half = small(POEMSAC).learn(EPOCH)
    half.save(tmp_path / "model")
    half.save_replay_buffer(tmp_path / "buffer")
    loaded = POEMSAC.load(tmp_path / "model", POINT_GOAL, device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(EPOCH, reset_num_timesteps=False)
    assert not differing(parameters(whole), parameters(loaded))
    loaded.device = th.device("meta")  # in place of a GPU
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.rows.device == loaded.replay_buffer.ends.device == loaded.device


def test_parameters_come_with_their_standardisation(poem: POEMSAC) -> None:
    copy = small(POEMSAC, gradient_steps=0)
    copy.set_parameters(poem.get_parameters())
    assert np.array_equal(
        copy.predict(OBS, deterministic=True)[0], poem.predict(OBS, deterministic=True)[0]
    )
    copy.learn(EPOCH)  # which collects, and goes on where the other stopped
    assert copy.policy.obs_norm.count == 3 * EPOCH
    assert th.equal(copy.policy.reward_norm.mean, poem.policy.reward_norm.mean)
    fresh = small(POEMSAC, seed=5)
    fresh.set_parameters(small(POEMSAC).get_parameters())  # of a model that has seen nothing
    assert th.equal(fresh.policy.obs_norm.std, th.ones(2))
    fresh.learn(EPOCH)
    assert not th.equal(fresh.policy.obs_norm.std, th.ones(2))


def test_arguments_of_a_model_that_is_loaded(tmp_path: Path) -> None:
    model = small(POEMSAC, similarity="inner", context="pearl", latent_dim=3)
    model.save(tmp_path / "m.zip")
    same = {"similarity": "inner", "context": "pearl", "latent_dim": 3}
    loaded = POEMSAC.load(tmp_path / "m.zip", n_steps=5, kl_coef=0.7, device="cpu", **same)
    assert (loaded.n_steps, loaded.kl_coef) == (5, 0.7)
    assert loaded.similarities(np.zeros((2, 3)), np.zeros((1, 3))).shape == (2, 1)
    for name, value in {"similarity": "two", "context": "poem", "latent_dim": 5}.items():
        with pytest.raises(
            ValueError, match=f"{name} is .* in .*m.zip, and cannot become {value!r}"
        ):
            POEMSAC.load(tmp_path / "m.zip", **{name: value})


def test_an_argument_outside_its_range(tmp_path: Path) -> None:
    """Of a model that is loaded, as of one that is made."""
    small(POEMSAC).save(tmp_path / "m.zip")
    for name, value in {"gamma": 1.5, "batch_size": 0, "preference_coef": -1.0}.items():
        with pytest.raises(ValueError, match=f"`{name}` must be"):
            POEMSAC.load(tmp_path / "m.zip", **{name: value})


def test_a_seed_changes_what_follows(tmp_path: Path) -> None:
    small(POEMSAC).learn(EPOCH).save(tmp_path / "m.zip")

    def further(seed: int | None, later: int | None = None) -> dict[str, th.Tensor]:
        arguments = {} if seed is None else {"seed": seed}
        model = POEMSAC.load(tmp_path / "m.zip", env=POINT_GOAL, device="cpu", **arguments)
        if later is not None:
            model.set_random_seed(later)
        return parameters(model.learn(EPOCH, reset_num_timesteps=False))

    own, one, two = further(None), further(1), further(2)
    assert differing(one, two)
    assert differing(own, one)
    assert not differing(own, further(None))
    assert not differing(one, further(1))
    assert not differing(two, further(None, 2))


def test_an_id_becomes_as_many_copies_as_in_training(tmp_path: Path) -> None:
    arguments = {"n_train_tasks": 4, "trajectories_per_task": 3, "meta_batch_size": 4}
    whole = small(POEMSAC, **arguments).learn(3 * 12 * 25)
    half = small(POEMSAC, **arguments).learn(12 * 25)
    half.save_checkpoint(tmp_path / "c.pt")
    half.save(tmp_path / "m.zip")
    half.save_pretrained(tmp_path / "p")
    resumed = POEMSAC.load_checkpoint(tmp_path / "c.pt", POINT_GOAL, device="cpu")
    for loaded in (
        resumed,
        POEMSAC.load(tmp_path / "m.zip", POINT_GOAL),
        POEMSAC.from_pretrained(tmp_path / "p", POINT_GOAL),
    ):
        assert loaded.n_envs == whole.n_envs == 12
    resumed.learn(2 * 12 * 25, reset_num_timesteps=False)
    assert not differing(parameters(resumed), parameters(whole))
    other = small(POEMSAC, make_task_vec_env(POINT_GOAL, 5), **arguments)
    other.save(tmp_path / "o.zip")
    assert POEMSAC.load(tmp_path / "o.zip", POINT_GOAL).n_envs == 5


def test_the_models_own_id_has_the_arguments_of_its_training(tmp_path: Path) -> None:
    def step_length(model: POEMSAC) -> float:
        return model.get_env().get_attr("step_length")[0]

    model = small(POEMSAC, make_task_vec_env(POINT_GOAL, N_TASKS, step_length=0.2))
    model.save(tmp_path / "m.zip")
    model.save_checkpoint(tmp_path / "c.zip")
    model.save_pretrained(tmp_path / "p")
    loaded = (
        POEMSAC.load(tmp_path / "m.zip", POINT_GOAL),
        POEMSAC.load_checkpoint(tmp_path / "c.zip", f"poem_envs:{POINT_GOAL}"),
        POEMSAC.from_pretrained(tmp_path / "p", POINT_GOAL),
    )
    assert [step_length(each) for each in loaded] == [0.2] * 3
    model.set_env(POINT_GOAL)
    assert step_length(model) == 0.2
    model.set_env(make_vec_env(POINT_GOAL, 2))  # one says so oneself
    model.learn(1)
    assert (step_length(model), dict(model.env_kwargs)) == (0.05, {})


def test_a_target_entropy_is_found_without_an_environment(tmp_path: Path) -> None:
    small(POEMSAC, target_entropy=0.5).save(tmp_path / "m.zip")
    assert POEMSAC.load(tmp_path / "m.zip", target_entropy="auto").target_entropy == -2.0


def test_an_id_without_a_vectorised_version(tmp_path: Path) -> None:
    gym.register("Strolling-v0", Walk, max_episode_steps=10)
    try:
        whole = small(POEMSAC, "Strolling-v0", n_train_tasks=4, meta_batch_size=4).learn(2 * 40)
        half = small(POEMSAC, "Strolling-v0", n_train_tasks=4, meta_batch_size=4).learn(40)
        half.save_checkpoint(tmp_path / "c.pt")
        half.save(tmp_path / "m.zip")
        half.save_pretrained(tmp_path / "p")
        resumed = POEMSAC.load_checkpoint(tmp_path / "c.pt", "Strolling-v0", device="cpu").learn(
            40, reset_num_timesteps=False
        )
        assert not differing(parameters(resumed), parameters(whole))
        for loaded in (
            POEMSAC.load(tmp_path / "m.zip", "Strolling-v0"),
            POEMSAC.from_pretrained(tmp_path / "p", "Strolling-v0"),
        ):
            assert loaded.n_envs == 4
    finally:
        del gym.registry["Strolling-v0"]


def test_arguments_that_the_family_cannot_have(tmp_path: Path) -> None:
    small(POEMSAC, walks(3, WindyWalk), horizon=10, n_train_tasks=4).save(tmp_path / "windy.zip")
    calm = small(POEMSAC, walks(3), horizon=10, n_train_tasks=4, relabel_fraction=0.5)
    calm.save(tmp_path / "calm.zip")
    with pytest.raises(
        ValueError, match=r"relabel_fraction must be 0: the tasks of .* do not share dynamics"
    ):
        POEMSAC.load(tmp_path / "windy.zip", walks(3, WindyWalk), relabel_fraction=0.5)
    with pytest.raises(ValueError, match="relabel_fraction must be 0"):
        calm.set_env(walks(3, WindyWalk))
    with pytest.raises(ValueError, match=r"n_train_tasks is 4 in .*calm\.zip, and cannot become 2"):
        POEMSAC.load(tmp_path / "calm.zip", n_train_tasks=2)
    with pytest.raises(
        ValueError, match=r"ent_coef is 'auto_0.1' in .*calm\.zip, and cannot become 0\.1"
    ):
        POEMSAC.load(tmp_path / "calm.zip", ent_coef=0.1)
