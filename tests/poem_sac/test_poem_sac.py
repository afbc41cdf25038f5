"""What POEMSAC adds: where preferences come from, its contexts, its embeddings and its ablations."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from meta_toys import (
    EPOCH,
    N_TASKS,
    POINT_GOAL,
    SMALL,
    TwoWalks,
    Walk,
    WindyWalk,
    apart,
    differing,
    experience_of,
    parameters,
    small,
    walks,
)
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.adaptation import Bayes
from sb3_poem.common.buffers import Segment, TaskBatch
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.arguments import default_copies
from sb3_poem.pearl_sac.collector import EpochCollector
from sb3_poem.pearl_sac.objective import TaskEmbeddings, kl_to_prior
from sb3_poem.poem_sac.poem_sac import POEMObjective


def transitions_of(model: PEARLSAC, start: int, stop: int) -> TaskBatch:
    """Stored transitions of all tasks from slot ``start`` to ``stop``, fields (tasks, stop - start,
    ...).
    """
    stored = [
        experience_of(model.replay_buffer, task) for task in range(model.replay_buffer.n_tasks)
    ]
    return TaskBatch(*(th.cat(parts)[:, start:stop] for parts in zip(*stored, strict=True)))


def nearly_deterministic(model: PEARLSAC) -> PEARLSAC:
    """Policies without noise (to float32), whose observations stay as they are: every rollout of a
    latent is the same.
    """
    with th.no_grad():
        actions = model.action_space.shape[0]
        model.policy.actor.mlp.output.weight[actions:] = 0.0
        model.policy.actor.mlp.output.bias[actions:] = -20.0
    model.policy.obs_norm.update = lambda rows: None  # type: ignore[method-assign]
    return model


# ---------------------------------------------------------------- J


def policy_returns(
    model: PEARLSAC, make_env: Callable[[], gym.Env], latents: np.ndarray
) -> np.ndarray:
    """(tasks, policies): returns of the mean actions, by stepping an environment of each policy in
    each task.
    """
    envs = [make_env() for _ in latents]
    returns = np.zeros((len(model.train_tasks), len(latents)))
    for i, task in enumerate(model.train_tasks.tasks):
        obs = [env.reset(seed=0, options={"task": task})[0] for env in envs]
        for _ in range(model.horizon):
            actions, _ = model.predict(np.stack(obs), state=latents, deterministic=True)
            steps = [env.step(action) for env, action in zip(envs, actions, strict=True)]
            obs = [step[0] for step in steps]
            returns[i] += [step[1] for step in steps]
        assert all(truncated for _, _, _, truncated, _ in steps)
    return returns


class Spy:
    """Notes every epoch's latents and returns."""

    def __init__(self, model: PEARLSAC) -> None:
        self.latents: list[np.ndarray] = []
        self.returns: list[np.ndarray] = []
        self._measure = model.measure_returns
        model.measure_returns = self._note  # type: ignore[method-assign]

    def _note(self, epoch: Segment, collector: EpochCollector) -> np.ndarray | None:
        returns = self._measure(epoch, collector)
        assert returns is not None
        self.latents.append(epoch.latents)
        self.returns.append(returns.copy())
        return returns


@pytest.fixture(scope="module")
def sources() -> dict[str, tuple[POEMSAC, Spy]]:
    """Two epochs of policies that differ only by their latents: equal starts, no noise, no
    learning.
    """
    result = {}
    for source in ("relabel", "rollout"):
        env = make_task_vec_env(POINT_GOAL, 4, reset_noise_scale=0.0)
        model = small(POEMSAC, env, gradient_steps=0, n_train_tasks=8)
        if source == "rollout":
            apart(model)
        spy = Spy(nearly_deterministic(model))
        result[source] = model.learn(1), spy
        model.learn(1, reset_num_timesteps=False)
    return result


@pytest.mark.parametrize(("source", "n_new"), [("relabel", 64), ("rollout", 8 + 2 * 4 * 3)])
def test_returns_are_those_of_environments_of_every_task(
    sources: dict, source: str, n_new: int
) -> None:
    model, spy = sources[source]
    make = functools.partial(gym.make, POINT_GOAL, reset_noise_scale=0.0)
    before, truth = (policy_returns(model, make, latents) for latents in spy.latents)
    assert np.ptp(truth) > 1.0
    found = spy.returns[1]
    new = np.isclose(found, truth, atol=1e-3)
    assert new.sum() == n_new
    # what was not measured anew is of the epoch before, where that measured it
    old = np.isfinite(found) & ~new
    assert old.any() == (source == "rollout")
    assert np.isfinite(spy.returns[0][old]).all()
    np.testing.assert_allclose(found[old], before[old], atol=1e-3)


def test_measured_returns_equal_relabelled_ones(sources: dict) -> None:
    """In the first epoch, where both see the same policies."""
    (_, relabelled), (_, measured) = sources["relabel"], sources["rollout"]
    assert np.array_equal(relabelled.latents[0], measured.latents[0])
    known = np.isfinite(measured.returns[0])
    np.testing.assert_allclose(measured.returns[0][known], relabelled.returns[0][known], atol=1e-3)


def test_returns_are_measured_within_groups_and_counted(sources: dict) -> None:
    model, spy = sources["rollout"]
    known = np.isfinite(spy.returns[0])
    assert known.sum(axis=1).tolist() == [4] * 8  # two groups of four
    assert np.array_equal(known @ known, known)  # who share one task share all
    # an epoch: 8 tasks in waves of 4, and 2 groups of 4 * 3 pairs in waves of 4; all steps count,
    # and fill the tasks' buffers
    assert model.num_timesteps == 2 * (2 + 6) * 4 * 25
    assert model.replay_buffer.counts.sum() == model.num_timesteps
    assert model.replay_buffer.counts.min() >= 2 * (1 + 3) * 25
    assert (
        sources["relabel"][0].num_timesteps == 2 * 2 * 4 * 25
    )  # not a step beyond the collection's own


def test_returns_by_rollouts_are_forgotten_bit_by_bit() -> None:
    model = apart(small(POEMSAC, n_train_tasks=40, gradient_steps=0))
    spy = Spy(model)
    model.learn(1)
    model.learn(1, reset_num_timesteps=False)
    first, second = spy.returns
    known = np.isfinite(first)
    assert known.sum() == 40 * 4
    assert np.all(np.diagonal(first) != np.diagonal(second))
    forgotten = np.isnan(second[known]).mean()
    assert 0.0 < forgotten < 0.12  # 0.05 of what was not measured again
    assert np.isfinite(second).sum() > 1.5 * known.sum()
    batch = model.make_sampler().sample(1, 8)[0]
    rows = second[batch.task_ids][:, batch.task_ids].astype(np.float32)
    assert np.array_equal(batch.returns.numpy(), rows, equal_nan=True)


def test_returns_are_relabelled_where_dynamics_agree() -> None:
    assert small(POEMSAC).learn(1).epoch_context.returns.isfinite().all()
    windy = small(POEMSAC, walks(4, WindyWalk), horizon=10)
    windy.learn(1)
    assert not windy.epoch_context.returns.isfinite().all()
    # The decoder knows no rewards for what others' policies do, so adaptation goes by S.
    assert np.isnan(windy.predicted_rewards_error)
    assert Bayes().likelihood_with(windy) == "similarity"


def test_returns_of_tasks_with_their_own_dynamics() -> None:
    """The wind blows a policy elsewhere on another task, which only running it there tells."""
    arguments = {"gradient_steps": 0, "n_train_tasks": 8}
    model = nearly_deterministic(small(POEMSAC, walks(4, StillWindyWalk), horizon=10, **arguments))
    spy = Spy(model)
    model.learn(1)
    truth = policy_returns(
        model, lambda: gym.wrappers.TimeLimit(StillWindyWalk(), 10), spy.latents[0]
    )
    returns = spy.returns[0]
    known = np.isfinite(returns)
    assert known.sum() == 2 * 16
    np.testing.assert_allclose(returns[known], truth[known], atol=1e-3)


class StillWindyWalk(WindyWalk):
    """Episodes begin at the origin."""

    def _begin_episode(self, rng: np.random.Generator) -> np.ndarray:
        super()._begin_episode(rng)
        self._place = 0.0
        return self._observation()


def test_trajectories_of_a_task_are_averaged() -> None:
    env = make_task_vec_env(POINT_GOAL, 3, reset_noise_scale=0.0)
    model = nearly_deterministic(
        small(POEMSAC, env, gradient_steps=0, n_train_tasks=4, trajectories_per_task=2)
    )
    spy = Spy(model)
    model.learn(2 * 3 * 3 * 25)
    make = functools.partial(gym.make, POINT_GOAL, reset_noise_scale=0.0)
    truth = policy_returns(model, make, spy.latents[1])  # (4, 8)
    np.testing.assert_allclose(spy.returns[1], truth.reshape(4, 4, 2).mean(axis=2), atol=1e-3)


# ---------------------------------------------------------------- contexts


def test_contexts_are_standardised_transitions_with_the_critics_values() -> None:
    model = small(POEMSAC, gradient_steps=3).learn(EPOCH)
    spy = Spy(model)
    before = {name: value.clone() for name, value in model.policy.critic.state_dict().items()}
    model.learn(EPOCH, reset_num_timesteps=False)
    policy, stored = model.policy, transitions_of(model, 25, 50)  # the second epoch's
    transitions = model.epoch_context.transitions
    assert transitions.shape == (N_TASKS, 25, 2 + 2 + 2 + 1 + 1)
    standardised = [
        ((obs - policy.obs_norm.mean) / policy.obs_norm.std).clamp(-10, 10)
        for obs in (stored.observations, stored.next_observations)
    ]
    th.testing.assert_close(transitions[..., :2], standardised[0])
    th.testing.assert_close(
        transitions[..., 2:4], stored.actions, atol=1.6e-5, rtol=0
    )  # the buffer's actions have 16 bits
    th.testing.assert_close(transitions[..., 4:6], standardised[1])
    rewards = stored.rewards
    th.testing.assert_close(model.epoch_context.rewards, rewards)
    th.testing.assert_close(
        transitions[..., 6], (rewards - rewards.mean()) / rewards.std(), atol=1e-5, rtol=0
    )
    # Q of the critics before this epoch's updates, the smaller of two, each task under the latent
    # that acted
    policy.critic.load_state_dict(before)
    with th.no_grad():
        values = th.stack(
            [
                policy.critic(
                    standardised[0][i],
                    transitions[i, :, 2:4],
                    th.tensor(spy.latents[0][i]).float().expand(25, -1),
                ).min(dim=0)[0]
                for i in range(N_TASKS)
            ]
        )
    th.testing.assert_close(
        transitions[..., 7], (values - values.mean()) / values.std(), atol=1e-4, rtol=0
    )


def test_values_are_zero_before_the_first_update() -> None:
    model = small(POEMSAC, gradient_steps=0).learn(1)
    assert (model.epoch_context.transitions[..., 7] == 0).all()


def test_observations_are_standardised_by_all_so_far_and_rewards_by_the_first_epoch() -> None:
    model = small(PEARLSAC, gradient_steps=1).learn(EPOCH)
    rewards = transitions_of(model, 0, 25).rewards.numpy()
    model.learn(3 * EPOCH, reset_num_timesteps=False)
    obs = transitions_of(model, 0, 100).observations.reshape(-1, 2).numpy()
    assert model.policy.obs_norm.count == len(obs) == 4 * EPOCH
    np.testing.assert_allclose(model.policy.obs_norm.mean.numpy(), obs.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(model.policy.obs_norm.std.numpy(), obs.std(axis=0), rtol=1e-4)
    assert model.policy.reward_norm.mean.item() == pytest.approx(rewards.mean(), abs=1e-5)
    assert model.policy.reward_norm.std.item() == pytest.approx(rewards.std(), rel=1e-4)


def test_the_context_is_the_last_epochs_only() -> None:
    model = small(POEMSAC).learn(3 * EPOCH)
    latest = transitions_of(model, 50, 75).rewards
    th.testing.assert_close(model.epoch_context.rewards, latest)
    own = latest.double().sum(dim=1)
    np.testing.assert_allclose(
        np.diagonal(model.epoch_context.returns.numpy()), own.numpy(), rtol=1e-5
    )


def test_posteriors_are_the_encoders_of_the_context() -> None:
    model = small(POEMSAC, context_size=25).learn(EPOCH)
    with th.no_grad():
        mean, variance = model.policy.encoder(model.epoch_context.transitions)
    np.testing.assert_allclose(model.train_tasks.latent_means, mean.numpy(), atol=1e-5)
    np.testing.assert_allclose(model.train_tasks.latent_variances, variance.numpy(), rtol=1e-4)
    assert np.array_equal(model.task_latents, model.train_tasks.latent_means)


# ---------------------------------------------------------------- relabelled batches


@pytest.mark.parametrize(("fraction", "n_foreign"), [(0.0, 0), (0.25, 4), (1.0, 16)])
def test_a_share_of_every_batch_is_relabelled(fraction: float, n_foreign: int) -> None:
    model = small(POEMSAC, walks(4), horizon=10, relabel_fraction=fraction).learn(1)
    batch = model.make_sampler().sample(1, 16)[0]
    tasks = model.train_tasks.tasks[batch.task_ids.numpy()]
    features = batch.transitions.features.numpy()
    truth = -np.abs(features[..., 0] - tasks) - 0.01 * features[..., 1] ** 2
    np.testing.assert_allclose(
        batch.transitions.rewards.numpy(), truth, atol=1e-5
    )  # own or relabelled, all fit the task
    own = [
        set(map(tuple, experience_of(model.replay_buffer, int(task)).observations[0, :10].tolist()))
        for task in batch.task_ids
    ]
    is_own = np.array(
        [
            [tuple(obs) in own[i] for obs in row]
            for i, row in enumerate(batch.transitions.observations.tolist())
        ]
    )
    assert is_own[:, : 16 - n_foreign].all()
    if n_foreign:
        assert not is_own[:, 16 - n_foreign :].all()


# ---------------------------------------------------------------- embeddings and ablations


def test_similarity_is_the_inner_product_of_the_two_embeddings() -> None:
    model = small(POEMSAC)
    tasks, policies = (
        np.random.default_rng(0).normal(size=(4, 5)),
        np.random.default_rng(1).normal(size=(7, 5)),
    )
    similarity = model.similarities(tasks, policies)
    assert similarity.shape == (4, 7)
    assert similarity.dtype == np.float64
    for i in range(4):
        for j in range(7):
            z_r = model.policy.reward_mapping(th.tensor(tasks[i]).float())
            z_pi = model.policy.policy_mapping(th.tensor(policies[j]).float())
            assert similarity[i, j] == pytest.approx((z_r @ z_pi).item(), abs=1e-5)
    assert model.similarities(tasks[0], policies[0]).shape == (1, 1)


def test_the_inner_product_has_one_embedding() -> None:
    model = small(POEMSAC, similarity="inner").learn(EPOCH)
    latents = np.random.default_rng(0).normal(size=(4, 5))
    z = th.tensor(latents).float()
    assert model.policy.policy_embedding(z) is z
    assert model.policy.reward_embedding(z) is z
    np.testing.assert_allclose(model.similarities(latents, latents), latents @ latents.T, rtol=1e-5)
    names = model.policy.state_dict().keys()
    assert not any("mapping" in name for name in names)
    assert any("mapping" in name for name in small(POEMSAC).policy.state_dict())


def test_the_cosine_has_a_scale_of_its_own(tmp_path: Path) -> None:
    """S is bounded by 1 / temperature, whatever the embeddings' norm, and a model trains with it,
    and keeps it.
    """
    model = small(POEMSAC, similarity="cosine", similarity_temperature=0.2).learn(3 * EPOCH)
    latents = np.random.default_rng(0).normal(size=(6, 5))
    similarities = model.similarities(latents, 100.0 * latents)
    assert np.abs(similarities).max() <= 5.0 + 1e-5
    z = th.tensor(latents).float()
    with th.no_grad():
        rewards, policies = model.policy.reward_embedding(z), model.policy.policy_embedding(z)
    cosine = th.nn.functional.cosine_similarity(rewards[:, None], policies[None], dim=2)
    found = model.similarities(latents, latents)
    np.testing.assert_allclose(found, cosine.numpy() / 0.2, atol=1e-5)
    scaled = model.policy.compare(7.0 * rewards, 0.1 * policies)
    np.testing.assert_allclose(scaled.numpy(), found, atol=1e-5)
    assert np.isfinite(model.logger.name_to_value["train/preference_loss"])
    model.save(tmp_path / "model.zip")
    model.save_pretrained(tmp_path / "folder")
    for again in (
        POEMSAC.load(tmp_path / "model.zip", device="cpu"),
        POEMSAC.from_pretrained(tmp_path / "folder"),
    ):
        np.testing.assert_array_equal(again.similarities(latents, latents), found)
    with pytest.raises(
        ValueError, match=r"similarity_temperature is 0\.2 in .* cannot become 0\.5"
    ):
        POEMSAC.load(tmp_path / "model.zip", device="cpu", similarity_temperature=0.5)
    with pytest.raises(ValueError, match="`similarity_temperature` must be at least 1e-06"):
        small(POEMSAC, similarity="cosine", similarity_temperature=0.0)


def test_contexts_without_values() -> None:
    model = small(POEMSAC, context="pearl").learn(EPOCH)
    assert model.epoch_context.transitions.shape[-1] == 2 + 2 + 2 + 1
    assert model.policy.encoder.mlp.hidden[0].in_features == 7
    assert model.context_relabel_fraction == 0.5  # by other tasks' policies
    optimal = small(POEMSAC)
    assert optimal.policy.encoder.mlp.hidden[0].in_features == 8
    assert optimal.context_relabel_fraction == 0.0


def test_without_its_parts_poem_is_pearl(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ablations leave PEARLSAC's networks, and the same losses but for the actor's gradient to
    the encoder.
    """
    arguments = {"kl_coef": 0.3, "reward_coef": 0.7, "policy_coef": 1.0}
    pearl = small(PEARLSAC, **arguments)
    poem = small(POEMSAC, similarity="inner", context="pearl", preference_coef=0.0, **arguments)
    assert parameters(pearl).keys() == parameters(poem).keys()
    monkeypatch.setattr(
        POEMObjective,
        "embed",
        lambda self, latents: TaskEmbeddings(latents, latents.detach(), latents),
    )
    pearl.learn(2 * EPOCH)
    poem.learn(2 * EPOCH)
    assert not differing(parameters(pearl), parameters(poem))


# ---------------------------------------------------------------- gradients


def gradients(model: PEARLSAC, **weights: float) -> set[str]:
    """Which modules a loss reaches, when all others are switched off."""
    for name in ("kl_coef", "reward_coef", "policy_coef", "preference_coef"):
        if hasattr(model, name):
            setattr(model, name, weights.get(name, 0.0))
    batch = model.make_sampler().sample(1, 16)[0]
    loss, _ = model.make_objective().loss(batch, model.entropy_coefficient.value)
    model.policy.zero_grad()
    loss.backward()
    return {
        name.split(".")[0]
        for name, parameter in model.policy.named_parameters()
        if parameter.grad is not None and (parameter.grad != 0).any()
    }


def test_each_loss_trains_what_the_paper_says() -> None:
    """Figure 3 and section 5.3; the critics' loss (here always on) trains critics and, as in PEARL,
    the encoder.
    """
    base = {"critic", "encoder"}
    poem = small(POEMSAC).learn(EPOCH)
    assert gradients(poem) == base
    assert gradients(poem, reward_coef=1.0) == base | {"decoder", "reward_mapping"}
    assert gradients(poem, policy_coef=1.0) == base | {"actor", "policy_mapping"}
    assert gradients(poem, preference_coef=1.0) == base | {"policy_mapping", "reward_mapping"}
    assert gradients(poem, kl_coef=1.0) == base
    pearl = small(PEARLSAC).learn(EPOCH)
    assert gradients(pearl, policy_coef=1.0) == base | {"actor"}


def encoder_gradient(model: PEARLSAC, batch: Any, name: str) -> float:
    objective, alpha = model.make_objective(), th.ones(())
    latents, kl = objective.encode(batch)
    embeddings, transitions = objective.embed(latents), objective.standardised(batch.transitions)
    losses = {
        "actor": lambda: objective.actor_loss(batch, transitions, embeddings, alpha)[0],
        "decoder": lambda: objective.decoder_loss(batch, transitions, embeddings),
        "preference": lambda: objective.embedding_loss(batch, embeddings)[0],
        "critic": lambda: objective.critic_loss(batch, transitions, embeddings, alpha),
        "kl": lambda: kl,
    }
    model.policy.zero_grad()
    losses[name]().backward()
    return sum(
        float(parameter.grad.abs().sum())
        for parameter in model.policy.encoder.parameters()
        if parameter.grad is not None
    )


def test_which_losses_reach_the_encoder() -> None:
    poem, pearl = small(POEMSAC).learn(EPOCH), small(PEARLSAC).learn(EPOCH)
    batch, other = poem.make_sampler().sample(1, 16)[0], pearl.make_sampler().sample(1, 16)[0]
    for name in ("actor", "decoder", "preference", "critic", "kl"):
        assert encoder_gradient(poem, batch, name) > 0, name
    for name in ("decoder", "critic", "kl"):
        assert encoder_gradient(pearl, other, name) > 0, name
    assert encoder_gradient(pearl, other, "actor") == 0.0


def test_the_actors_loss_does_not_train_the_critics() -> None:
    model = small(POEMSAC).learn(EPOCH)
    batch = model.make_sampler().sample(1, 16)[0]
    objective = model.make_objective()
    latents, _ = objective.encode(batch)
    model.policy.zero_grad()
    transitions, embeddings = objective.standardised(batch.transitions), objective.embed(latents)
    objective.actor_loss(batch, transitions, embeddings, th.ones(()))[0].backward()
    assert all(parameter.grad is None for parameter in model.policy.critic.parameters())
    assert all(parameter.grad is None for parameter in model.policy.critic_target.parameters())


def test_kl_is_that_of_two_normals() -> None:
    from torch.distributions import Normal, kl_divergence

    model = small(POEMSAC).learn(EPOCH)
    context = model.epoch_context.transitions
    with th.no_grad():
        mean, variance = model.policy.encoder(context)
        kl = kl_to_prior(mean, variance)
    expected = kl_divergence(Normal(mean, variance.sqrt()), Normal(th.zeros(5), th.ones(5))).sum(
        dim=1
    )
    th.testing.assert_close(kl, expected, rtol=1e-4, atol=1e-5)


def test_targets_are_bootstrapped_except_at_an_early_end() -> None:
    """The critics' loss against soft Bellman targets computed here, with gamma and alpha far from
    trivial.
    """
    model = small(
        POEMSAC, walks(4, edge=0.4), horizon=10, gamma=0.9, ent_coef=0.3, n_steps=1
    ).learn(120)
    meta_batch = model.make_sampler().sample(1, 16)[0]
    batch, noise = meta_batch.transitions, meta_batch.next_action_noise
    assert 0 < batch.terminated.sum() < batch.terminated.numel()
    policy, latents = model.policy, th.randn(6, 5)
    alpha = model.entropy_coefficient.value
    objective = model.make_objective()
    loss = objective.critic_loss(
        meta_batch, objective.standardised(batch), objective.embed(latents), alpha
    )
    total = 0.0
    with th.no_grad():
        for i in range(6):
            z = latents[i].expand(16, 5)
            obs, next_obs = (
                ((x - policy.obs_norm.mean) / policy.obs_norm.std).clamp(-10, 10)
                for x in (batch.observations[i], batch.next_observations[i])
            )
            next_actions, log_prob = policy.actor(next_obs, policy.policy_mapping(z), noise[i])
            next_values = (
                policy.critic_target(next_obs, next_actions, z).min(dim=0).values - 0.3 * log_prob
            )
            target = (
                batch.rewards[i] / policy.reward_norm.std
                + 0.9 * (1 - batch.terminated[i]) * next_values
            )
            for value in policy.critic(obs, batch.actions[i], z):
                total += 0.5 * (value - target).pow(2).mean().item() / 6
    assert alpha.item() == pytest.approx(0.3)
    assert loss.item() == pytest.approx(total, rel=1e-4)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_predicted_returns_are_sums_of_decoded_rewards(layer_norm: bool) -> None:
    from sb3_poem.common.trajectory import Trajectory

    policy_kwargs = {**SMALL["policy_kwargs"], "layer_norm": layer_norm}
    model = small(
        POEMSAC, walks(4), horizon=10, precision="fp32", policy_kwargs=policy_kwargs
    ).learn(120)
    rng = np.random.default_rng(0)
    lengths, latents = (4, 9), rng.normal(size=(3, 5))
    trajectories = [
        Trajectory(rng.normal(size=(n + 1, 2)), rng.uniform(-2.0, 4.0, size=(n, 1)), np.zeros(5))
        for n in lengths
    ]
    returns = model.predicted_returns(latents, trajectories)
    assert returns.shape == (3, 2)
    assert returns.dtype == np.float64
    policy = model.policy
    for i, latent in enumerate(latents):
        z_r = policy.reward_mapping(th.tensor(latent).float())
        for j, trajectory in enumerate(trajectories):
            total = 0.0
            for t in range(lengths[j]):
                obs, next_obs = (
                    policy.standardise(th.tensor(trajectory.observations[t + k]).float())
                    for k in (0, 1)
                )
                action = th.tensor(2.0 * (trajectory.actions[t] + 2.0) / 6.0 - 1.0).float()
                value = policy.decoder(obs, action, next_obs, z_r)
                total += (value * policy.reward_norm.std + policy.reward_norm.mean).item()
            assert returns[i, j] == pytest.approx(total, abs=1e-4)


# ---------------------------------------------------------------- two tasks


@pytest.mark.parametrize("own_dynamics", [False, True])
@pytest.mark.parametrize("arguments", [{}, {"meta_batch_size": 1}])
def test_a_family_of_two_tasks_trains_without_nan(
    arguments: dict[str, Any], own_dynamics: bool
) -> None:
    model = small(POEMSAC, walks(2, TwoWalks), horizon=10, n_train_tasks=None, **arguments)
    (apart(model) if own_dynamics else model).learn(100)
    assert model._n_updates == (15 if own_dynamics else 25)
    assert all(value.isfinite().all() for value in parameters(model).values())
    assert np.isfinite(model.train_tasks.latent_means).all()
    assert np.isfinite(model.similarities(model.task_latents, model.task_latents)).all()


def test_one_task_with_dynamics_of_its_own_is_a_family_too() -> None:
    """Of which there is no other to compare policies with."""
    model = apart(small(POEMSAC, walks(2), horizon=10, n_train_tasks=1)).learn(60)
    assert all(value.isfinite().all() for value in parameters(model).values())


def test_half_cheetah_forwards_and_backwards() -> None:
    """Two tasks on the real simulator."""
    env = make_task_vec_env("poem/HalfCheetahFwdBack-v0", 2, max_episode_steps=20)
    model = small(POEMSAC, env, n_train_tasks=None).learn(80)
    assert sorted(model.train_tasks.tasks.ravel()) == [-1.0, 1.0]
    assert all(value.isfinite().all() for value in parameters(model).values())
    assert model.epoch_context.returns.isfinite().all()


def test_environments_of_one_copy_and_many_tasks() -> None:
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(Walk(), 10)])
    model = apart(small(POEMSAC, env, horizon=10, n_train_tasks=4))
    assert model.learn(1).num_timesteps == 160


def test_an_id_becomes_as_many_copies_as_an_epoch_has_trajectories() -> None:
    finite = "poem/HalfCheetahFwdBack-v0"
    assert default_copies(finite, None, 1) == 2
    assert default_copies(finite, None, 100) == 120  # in two waves
    assert default_copies(POINT_GOAL, 130, 2) == 130
    assert small(POEMSAC, n_train_tasks=7, trajectories_per_task=2).n_envs == 14
