"""Saved adaptations: they go on exactly, and what is no such file is refused."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from adapters import RULES, SMALL, adapter, answer, kind_of, make_env
from worlds import SpeedModel

from sb3_poem import POEMSAC, Bayes
from sb3_poem.adaptation import (
    MistakeNoise,
    MistakeOracle,
    NoiseModel,
    PreferenceAdapter,
    ReturnOracle,
)
from sb3_poem.common.networks import digest_of
from sb3_poem.common.vec_env import make_task_vec_env

POINT = "poem/PointGoal-v0"


@pytest.mark.parametrize("rule", RULES)
def test_a_saved_adaptation_continues_exactly(tmp_path, rule):
    rule = rule.answered_by(MistakeOracle(0.1, **kind_of(rule)))
    whole = adapter(rule=rule)
    answer(whole, 6)

    first = adapter(rule=rule, n_queries=6)
    answer(first, 3)
    path = tmp_path / "adaptation.json"
    for pending in (False, True):
        query = first.ask() if pending else None
        first.save(path)
        assert [p.name for p in tmp_path.iterdir()] == ["adaptation.json"]
        assert [item["preference"] for item in json.loads(path.read_text())["answers"]] == [
            a.preference.value for a in first.answers
        ]

        second = PreferenceAdapter.load(path, SpeedModel(), make_env())
        assert second.n_answers == 3
        assert second.rule == first.rule
        np.testing.assert_array_equal(second.policy().latent, first.policy().latent)
        if pending:
            np.testing.assert_array_equal(second.pending.left.observations, query.left.observations)
            np.testing.assert_array_equal(second.ask().right.latent, query.right.latent)
        else:
            assert second.pending is None
        answer(second, 3)
        assert second.done
        np.testing.assert_array_equal(second.policy().latent, whole.policy().latent)
    third = PreferenceAdapter.from_json(second.to_json(), SpeedModel(), make_env())
    np.testing.assert_array_equal(third.policy().latent, whole.policy().latent)


def test_saving_replaces_the_file_only_once_the_new_one_is_whole(tmp_path, monkeypatch):
    import os

    a = adapter()
    path = tmp_path / "adaptation.json"
    a.save(path)
    before = path.read_bytes()
    answer(a, 1)

    def full_disk(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        a.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["adaptation.json"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is not a saved adaptation"),
        ('{"format": "sb3_poem.Pref', "is not a saved adaptation"),
        ("PK\x03\x04\xff", "is not a saved adaptation"),
        ("[1]", "holds a list"),
        ('{"format": "optuna"}', "`format` is 'optuna'"),
        ('{"format": "sb3_poem.PreferenceAdapter", "version": 99}', "version 99"),
        ('{"format": "sb3_poem.PreferenceAdapter", "version": 3}', "incomplete"),
    ],
)
def test_foreign_and_truncated_files_are_refused(tmp_path, content, message):
    path = tmp_path / "adaptation.json"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(ValueError, match=message):
        PreferenceAdapter.load(path, SpeedModel(), make_env())


def test_another_models_file_is_refused():
    text = adapter().to_json()
    with pytest.raises(ValueError, match="latent_dim=5, but the model has 4"):
        PreferenceAdapter.from_json(text, SpeedModel(latent_dim=4), make_env())


def test_the_same_weights_go_on_and_others_are_refused(point_goal, tmp_path):
    env = make_task_vec_env(point_goal.env_id, 1)
    begun = PreferenceAdapter(
        point_goal, env, oracle=ReturnOracle(), seed=0, n_queries=2, rule=SMALL
    )
    answer(begun, 1, begun.oracle)
    text = begun.to_json()
    point_goal.save(tmp_path / "m.zip")
    point_goal.save_pretrained(tmp_path / "folder")
    for again in (
        POEMSAC.load(tmp_path / "m.zip", device="cpu"),
        POEMSAC.from_pretrained(tmp_path / "folder", device="cpu"),
    ):
        assert again.digest == point_goal.digest
        np.testing.assert_array_equal(
            PreferenceAdapter.from_json(text, again, env).policy().latent, begun.policy().latent
        )
        with torch.no_grad():
            again.policy.critic.members[0].output.bias += 1.0  # which adaptation does not use
        assert again.digest == point_goal.digest
        for tensor in (
            again.policy.actor.mlp.output.bias,
            again.policy.obs_norm.mean,
            again.policy.reward_mapping.output.weight,
        ):
            with torch.no_grad():
                tensor += 0.01
            with pytest.raises(
                ValueError,
                match="saved with a model of other weights than this POEMSAC on poem/PointGoal-v0",
            ):
                PreferenceAdapter.from_json(text, again, env)
            with torch.no_grad():
                tensor -= 0.01
    other = POEMSAC.load(tmp_path / "m.zip", device="cpu")
    other.train_tasks.latent_means += 0.1
    begun.save(tmp_path / "state.json")
    with pytest.raises(ValueError, match="other weights"):
        PreferenceAdapter.load(tmp_path / "state.json", other, env)


def test_a_digest_is_of_the_numbers_not_of_how_they_are_kept():
    numbers = torch.arange(6, dtype=torch.float32).reshape(2, 3) / 8
    digest = digest_of({"a": numbers, "b": torch.ones(1)})
    for kind in (torch.float64, torch.bfloat16, torch.float16):
        assert digest_of({"b": torch.ones(1, dtype=torch.int64), "a": numbers.to(kind)}) == digest
    assert digest_of({"a": numbers.T.contiguous().T, "b": torch.ones(1)}) == digest
    assert digest_of({"a": numbers.reshape(3, 2), "b": torch.ones(1)}) != digest
    assert digest_of({"a": numbers, "c": torch.ones(1)}) != digest
    assert digest_of({"a": numbers + 1e-7, "b": torch.ones(1)}) != digest


def test_an_adaptation_resumes_by_names():
    a = PreferenceAdapter("PointGoal", POINT, seed=0, n_queries=2)
    a.ask()
    a.tell("left")
    resumed = PreferenceAdapter.from_json(a.to_json(), "PointGoal", POINT)
    np.testing.assert_array_equal(resumed.policy().latent, a.policy().latent)
    for one in (a, resumed):  # on the task that the first question drew
        one.ask()
    assert a.env.get_attr("task") == resumed.env.get_attr("task")
    np.testing.assert_array_equal(a.pending.left.observations, resumed.pending.left.observations)


def test_numbers_of_numpy_can_be_saved():
    adapter = PreferenceAdapter(
        SpeedModel(),
        make_env(),
        n_queries=np.int64(3),
        rule=Bayes(epsilon=np.float32(0.125), noise_model=MistakeNoise(np.float32(0.25))),
        seed=0,
    )
    resumed = PreferenceAdapter.from_json(adapter.to_json(), SpeedModel(), make_env())
    assert (resumed.n_queries, resumed.rule.epsilon) == (3, 0.125)
    assert resumed.rule.noise_model == MistakeNoise(0.25)


@dataclass(frozen=True)
class Spiteful(NoiseModel):
    """Turns round as many answers as one likes."""

    rate: float
    kind = "spiteful"


def test_a_noise_model_of_ones_own_can_be_saved():
    first = adapter(rule=Bayes(n_particles=20, noise_model=Spiteful(0.75)), n_queries=2)
    answer(first, 1)
    resumed = PreferenceAdapter.from_json(first.to_json(), SpeedModel(), make_env())
    assert resumed.rule.noise_model == Spiteful(0.75)
    for each in (first, resumed):
        answer(each, 1)
    np.testing.assert_array_equal(resumed.policy().latent, first.policy().latent)
