"""MAML against finite differences, and on tasks where only adaptation can help."""

import numpy as np
import pytest
import torch as th
from meta_toys import WindyWalk, small, walks
from torch.func import grad

from sb3_poem import PEARLSAC
from sb3_poem.adaptation import Preference
from sb3_poem.adaptation.rule import Answer
from sb3_poem.baselines import replay_fragments
from sb3_poem.baselines.maml_reward import (
    MetaReward,
    PreferencePairs,
    RewardNetwork,
    meta_train_reward,
)
from sb3_poem.common.trajectory import Trajectory


def tiny(steps=1):
    th.manual_seed(0)
    network = RewardNetwork(3, (4,), 0.3, steps).double()
    parameters = {name: value.detach().clone() for name, value in network.named_parameters()}
    return network, parameters


def pairs(tasks, n, seed, steps=5, in_dim=4):
    generator = th.Generator().manual_seed(seed)
    left, right = th.randn(2, tasks, n, steps, in_dim, generator=generator, dtype=th.float64)
    label = th.randint(0, 3, (tasks, n), generator=generator).double() / 2
    return PreferencePairs(left, right, label)


def test_the_loss_is_bradley_terrys_cross_entropy():
    network, parameters = tiny()
    some = PreferencePairs(*(part[0] for part in pairs(1, 20, 1)))
    with th.no_grad():
        left, right = (network(part).sum(dim=1).numpy() for part in some[:2])
    probability = np.exp(left) / (np.exp(left) + np.exp(right))
    label = some.label.numpy()
    expected = -(label * np.log(probability) + (1 - label) * np.log(1 - probability)).mean()
    assert float(network.preference_loss(parameters, some)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("steps", [1, 3])
def test_the_outer_gradient_against_finite_differences(steps):
    network, parameters = tiny(steps)
    support, query = pairs(3, 6, 2), pairs(3, 6, 3)
    width = 1e-5
    slope = grad(network.maml_loss)(parameters, support, query)
    first_order = 0.0
    for name, value in parameters.items():
        for index in np.ndindex(*value.shape):
            ends = []
            for sign in (1, -1):
                moved = {key: part.clone() for key, part in parameters.items()}
                moved[name][index] += sign * width
                ends.append(float(network.maml_loss(moved, support, query)))
            assert float(slope[name][index]) == pytest.approx(
                (ends[0] - ends[1]) / (2 * width), abs=1e-8
            )
        adapted = [
            network.adapted(parameters, PreferencePairs(*(part[i] for part in support)))
            for i in range(3)
        ]
        plain = sum(
            grad(network.preference_loss)(
                adapted[i], PreferencePairs(*(part[i] for part in query))
            )[name]
            for i in range(3)
        )
        first_order = max(first_order, float((plain / 3 - slope[name]).abs().max()))
    assert (
        first_order > 1e-3
    )  # the second derivatives matter here, so a first-order gradient would have failed


@pytest.fixture(scope="module")
def trained():
    return small(PEARLSAC, walks(10), horizon=10, n_train_tasks=10, learning_starts=10**6).learn(
        3 * 100
    )


def judged(fragments, goal, n, seed):
    rng = np.random.default_rng(seed)
    answers = []
    for _ in range(n):
        left, right = (fragments[i] for i in rng.choice(len(fragments), size=2, replace=False))
        better = sum(
            (-np.abs(t.reward_features[:, 0] - goal)).sum() * sign
            for t, sign in ((left, 1), (right, -1))
        )
        answers.append(Answer(Preference.LEFT if better > 0 else Preference.RIGHT, (left, right)))
    return answers


def accuracy(meta, parameters, answers):
    right = 0
    for answer in answers:
        difference = (
            meta.rewards(parameters, answer.shown[0]).sum()
            - meta.rewards(parameters, answer.shown[1]).sum()
        )
        right += (difference > 0) == (answer.preference == Preference.LEFT)
    return right / len(answers)


def test_ten_answers_tell_the_meta_trained_reward_its_task(trained):
    meta = meta_train_reward(
        trained, n_iterations=100, fragment_length=10, n_fragments=100, learning_rate=3e-3
    )
    fragments = replay_fragments(trained, 100, 10, np.random.default_rng(1))
    before, after = [], []
    for goal in (-0.8, 0.8):
        test = judged(fragments, goal, 100, 2)
        before.append(accuracy(meta, meta.parameters, test))
        after.append(accuracy(meta, meta.adapted(judged(fragments, goal, 10, 3)), test))
    # Which way is not known beforehand: what holds for one goal is wrong for the other.
    assert min(before) < 0.5
    assert min(after) > 0.75


def test_answers_about_episodes_that_ended_early(trained):
    meta = MetaReward(trained.policy, (8,))
    long, short = (replay_fragments(trained, 1, n, np.random.default_rng(0))[0] for n in (9, 4))
    answers = [Answer(Preference.LEFT, (long, short)), Answer(Preference.EQUAL, (short, short))]
    adapted = meta.adapted(answers)
    # One step of gradient descent after the other, each pair by itself and nothing filled up.
    parameters = meta.parameters
    for _ in range(meta.inner_steps):
        parts = {name: value.clone().requires_grad_() for name, value in parameters.items()}
        sums = [
            th.func.functional_call(meta.network, parts, (meta.transitions(shown),)).sum()
            for answer in answers
            for shown in answer.shown
        ]
        loss = -th.nn.functional.logsigmoid(sums[0] - sums[1]) / 2 + np.log(2) / 2
        slopes = th.autograd.grad(loss, list(parts.values()))
        parameters = {
            name: value.detach() - meta.inner_learning_rate * slope
            for (name, value), slope in zip(parts.items(), slopes, strict=True)
        }
    for name, value in parameters.items():
        th.testing.assert_close(adapted[name], value, rtol=1e-4, atol=1e-5)
    assert meta.adapted([]) is meta.parameters


def test_a_whole_rollout_weighs_as_much_as_a_fragment_of_the_meta_training(trained):
    """Of three times its length, and alike in every step, it adapts the reward as the fragment."""
    meta = MetaReward(trained.policy, (8,), fragment_length=5)

    def standing(place, steps):
        observations = np.full((steps + 1, 2), place, dtype=np.float32)
        return Trajectory(observations, np.zeros((steps, 1), np.float32), np.zeros(5))

    short, long = (
        meta.adapted([Answer(Preference.LEFT, (standing(0.5, n), standing(-0.2, n)))])
        for n in (5, 15)
    )
    assert any(not th.equal(value, meta.parameters[name]) for name, value in short.items())
    for name, value in short.items():
        th.testing.assert_close(long[name], value)


def test_what_will_not_do(trained):
    windy = small(PEARLSAC, walks(2, WindyWalk), horizon=10, n_train_tasks=2)
    with pytest.raises(ValueError, match="a family whose tasks share their dynamics"):
        meta_train_reward(windy)
    with pytest.raises(ValueError, match="an empty replay buffer"):
        meta_train_reward(small(PEARLSAC, walks(2), horizon=10, n_train_tasks=2))
    with pytest.raises(ValueError, match="`n_iterations` must be at least 1, but is 0"):
        meta_train_reward(trained, 0)
    with pytest.raises(ValueError, match="`n_fragments` must be at least 1, but is 0"):
        meta_train_reward(trained, 1, n_fragments=0)
    with pytest.raises(ValueError, match="`inner_learning_rate` must be above 0"):
        MetaReward(trained.policy, inner_learning_rate=0.0)
    with pytest.raises(ValueError, match="`inner_steps` must be at least 1"):
        MetaReward(trained.policy, inner_steps=0)


def test_a_meta_reward_is_saved_and_read(tmp_path):
    model = small(PEARLSAC).learn(300)
    arguments = {"net_arch": (8, 4), "inner_learning_rate": 0.2, "inner_steps": 2}
    meta = meta_train_reward(model, n_iterations=2, n_fragments=20, fragment_length=10, **arguments)
    meta.save(tmp_path / "reward")
    loaded = MetaReward.load(tmp_path / "reward", model.policy)
    assert (loaded.net_arch, loaded.inner_learning_rate, loaded.inner_steps) == ((8, 4), 0.2, 2)
    left, right = replay_fragments(model, 2, 10, np.random.default_rng(0))
    answers = [Answer(Preference.LEFT, (left, right))]
    for judged in ([], answers):
        np.testing.assert_array_equal(
            loaded.rewards(loaded.adapted(judged), right), meta.rewards(meta.adapted(judged), right)
        )
    assert {file.suffix for file in (tmp_path / "reward").iterdir()} == {".safetensors", ".json"}

    other = small(PEARLSAC, seed=5).learn(300)
    with pytest.raises(
        ValueError,
        match=r"is not the one with which the reward in .* was meta-trained: its obs_mean differs",
    ):
        MetaReward.load(tmp_path / "reward", other.policy)
    with pytest.raises(FileNotFoundError, match="holds no meta-trained reward"):
        MetaReward.load(tmp_path, model.policy)
    weights = tmp_path / "reward" / "reward.safetensors"
    weights.write_bytes(weights.read_bytes()[:-20])
    with pytest.raises(ValueError, match="is truncated, or no safetensors file"):
        MetaReward.load(tmp_path / "reward", model.policy)
    config = tmp_path / "reward" / "reward.json"
    config.write_text(config.read_text().replace("meta reward 2", "meta reward 1"))
    with pytest.raises(ValueError, match="is not of this version of sb3_poem"):
        MetaReward.load(tmp_path / "reward", model.policy)
