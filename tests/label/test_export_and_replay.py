"""Answers as a data set, to other models and rules, from the terminal, and in a notebook."""

from __future__ import annotations

import asyncio
import json
import shutil
import sqlite3
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from label_world import make_sessions, settled
from worlds import SpeedEnv, SpeedModel

from sb3_poem import PEARLSAC, POEMSAC, Bayes, cli
from sb3_poem.adaptation import HumanOracle, PreferenceAdapter, ReturnOracle
from sb3_poem.adaptation.policy import AdaptedPolicy
from sb3_poem.adaptation.rule import Setting, inference_rng
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.label import LabelWidget, StoreRecorder, families
from sb3_poem.label.export import FIELDS, answer_record, export, records
from sb3_poem.label.families import ModelInfo
from sb3_poem.label.rendering import StorageError, Turn, load_shown_model
from sb3_poem.label.replay import replay
from sb3_poem.label.store import Session, Store
from sb3_poem.resources import pretrained_folder

TASK = np.array([0.7])


@pytest.fixture(scope="module")
def conversation(tmp_path_factory: pytest.TempPathFactory, point_goal: ModelInfo) -> Store:
    """A session whose four answers are by true return; the first was given the wrong way, and taken
    back.
    """
    store = Store(tmp_path_factory.mktemp("conversation"))
    oracle = ReturnOracle(gym.make(point_goal.env_id), TASK)

    async def life() -> Session:
        sessions = make_sessions(store, point_goal)
        session = await sessions.find(await sessions.begin("PointGoal"))
        assert session is not None
        wrong_first = True
        while len(store.answers(session.id)) < 4:
            view = await settled(sessions, session)
            row = store.whole_turn(view["turn"]["id"])
            assert row is not None
            shown = map(Trajectory.from_dict, json.loads(row["trajectories"]).values())
            right = oracle(*shown).value
            wrong = {"left": "right", "right": "left", "equal": "left"}[right]
            store.add_answer(session.id, view["turn"]["id"], wrong if wrong_first else right)
            if wrong_first:
                store.undo(session.id, 1)
                wrong_first = False
        await sessions.queue.close()
        return session

    session = asyncio.run(life())
    store.set_wish(session.id, 'right, "and" up\n☺')
    store.close()
    return store


@pytest.fixture
def answered(conversation: Store, store: Store) -> Session:
    """That session, in a store of the test's own."""
    with sqlite3.connect(conversation.path) as kept, sqlite3.connect(store.path) as copy:
        kept.backup(copy)
    shutil.copytree(conversation.videos, store.videos, dirs_exist_ok=True)
    (session,) = store.sessions()
    return session


def test_both_formats_hold_the_same_answers(
    answered: Session, store: Store, tmp_path: Path
) -> None:
    from pyarrow import parquet

    assert export(store, tmp_path / "a.jsonl", trajectories=True) == 4
    assert export(store, tmp_path / "a.parquet", trajectories=True) == 4
    lines = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert lines == parquet.read_table(tmp_path / "a.parquet").to_pylist()
    asked = store.adapter_answers(answered.id, 4)
    for line, item in zip(lines, asked, strict=True):
        left = Trajectory.from_dict(item["left"])
        assert line["preference"] == item["preference"]
        assert line["left_latent"] == left.latent.tolist()
        np.testing.assert_array_equal(line["left_observations"], left.observations)
        np.testing.assert_array_equal(line["left_actions"], left.actions)
        assert Path(line["video"]).read_bytes()[4:8] == b"ftyp"
        assert line["wish"] == 'right, "and" up\n☺'
        assert line["asked"] <= line["answered"]
    with_undone = list(records(store, undone=True))
    assert [record["undone"] for record in with_undone] == [True, False, False, False, False]
    assert set(with_undone[0]) == {*FIELDS, "left_latent", "right_latent"}


def test_an_answer_takes_no_negative_time(answered: Session, store: Store) -> None:
    row = dict(next(iter(store.records())))
    row["shown"] = row["answered"] - 2.5
    assert answer_record(row, store.videos)["seconds"] == 2.5
    row["shown"] = row["answered"] + 60.0  # the clock was set back
    assert answer_record(row, store.videos)["seconds"] == 0.0


def test_minari_reads_the_episodes_with_preferences_and_latents(
    answered: Session,
    store: Store,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    minari = pytest.importorskip("minari", reason="the extra [minari] is not installed")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    command = ["label", "--store", str(store.folder), "export", "--format", "minari", "--out"]
    assert cli.main([*command, "answers-v0"]) == 0
    dataset = minari.load_dataset("poem/PointGoal/answers-v0")
    assert list(minari.list_local_datasets()) == ["poem/PointGoal/answers-v0"]
    env = dataset.recover_environment()
    assert env.spec is not None
    assert env.spec.id == "poem/PointGoal-v0"
    assert dataset.observation_space == env.observation_space
    answers, kept = dataset.storage.metadata["answers"], store.adapter_answers(answered.id, 4)
    assert "ALL REWARDS ARE ZERO" in dataset.storage.metadata["description"]
    assert dataset.total_episodes == 8
    assert len(answers) == 4
    for answer, item in zip(answers, kept, strict=True):
        assert answer["preference"] == item["preference"]
        assert answer["wish"] == store.session(answered.id).wish
        assert "/" not in answer["video"]
        for side in ("left", "right"):
            shown, episode = Trajectory.from_dict(item[side]), dataset[answer[f"{side}_episode"]]
            np.testing.assert_array_equal(episode.observations, shown.observations)
            np.testing.assert_array_equal(episode.actions, shown.actions)
            features = episode.infos["reward_features"]
            np.testing.assert_array_equal(features[1:], shown.reward_features)
            assert np.isnan(features[0]).all()
            assert not episode.rewards.any()
            assert not episode.terminations.any()
            assert episode.truncations.tolist() == [False] * (len(shown) - 1) + [True]
            (about,) = dataset.storage.get_episode_metadata([episode.id])
            np.testing.assert_array_equal(about["latent"], shown.latent)
            assert answer[f"{side}_latent"] == shown.latent.tolist()
            assert answers[about["answer"]] is answer
            assert (about["side"], about["preference"]) == (side, item["preference"])
    for name, words in (("answers-v0", "already"), ("answers", "must be like answers-v0")):
        assert cli.main([*command, name]) == 1
        assert words in capsys.readouterr().err
    assert cli.main([*command, "all-v1", "--undone"]) == 0
    assert minari.load_dataset("poem/PointGoal/all-v1").total_episodes == 10
    # an episode that ended before its time
    whole = Trajectory.from_dict(kept[0]["left"])
    assert whole.reward_features is not None
    fields = whole.observations[:-1], whole.actions[:-1], whole.latent, whole.reward_features[:-1]
    question = store.answers(answered.id)[0]["question"]
    with sqlite3.connect(store.path) as connection:
        shown = {"left": Trajectory(*fields).to_dict(), "right": kept[0]["right"]}
        changed = (json.dumps(shown), question)
        connection.execute("update turns set trajectories = ? where id = ?", changed)
    assert cli.main([*command, "shorter-v0"]) == 0
    short, other = list(minari.load_dataset("poem/PointGoal/shorter-v0"))[:2]
    assert short.terminations.tolist() == [False] * (len(whole) - 2) + [True]
    assert not short.truncations.any()
    assert other.truncations.tolist()[-1]
    other = store.create_session("AntVel", "poem/AntVel-v0", 0, {})[0]
    shown = {side: kept[0][side] for side in ("left", "right")}
    turn = Turn(None, shown, None, None, 20.0, 2)
    question = store.add_turn(other.id, "question", 0, None, turn, "a.gif")
    assert question is not None
    store.add_answer(other.id, question, "left")
    assert cli.main([*command, "both-v0"]) == 1
    assert "recorded in poem/AntVel-v0" in capsys.readouterr().err
    assert not (tmp_path / "minari/poem/PointGoal/both-v0").exists()  # all or none
    for session, version in ((answered, "v0"), (other, "v1")):
        env_id = f"my/Robot-{version}"
        monkeypatch.setitem(gym.registry, env_id, replace(gym.spec("poem/PointGoal-v0"), id=env_id))
        with sqlite3.connect(store.path) as connection:
            changed = (env_id, session.id)
            connection.execute("update sessions set env_id = ? where id = ?", changed)
    assert cli.main([*command, "versions-v0"]) == 0
    for version, episodes in (("v0", 8), ("v1", 2)):
        dataset = minari.load_dataset(f"my/Robot-{version}/versions-v0")
        assert dataset.total_episodes == episodes
    with sqlite3.connect(store.path) as connection:
        connection.execute("update sessions set env_id = 'this:poem/PointGoal-v0'")
    assert cli.main([*command, "answers-v2"]) == 1
    assert "without a module to import" in capsys.readouterr().err
    with sqlite3.connect(store.path) as connection:
        connection.execute("update sessions set env_id = 'poem/AntVel-v0'")
    assert cli.main([*command, "answers-v2"]) == 1
    assert "recorded in poem/AntVel-v0" in capsys.readouterr().err
    assert not (tmp_path / "minari/poem/AntVel/answers-v2").exists()
    monkeypatch.setitem(sys.modules, "minari.storage", None)
    assert cli.main([*command, "answers-v3"]) == 1
    assert "pip install -c constraints.txt '.[minari]' in a checkout" in capsys.readouterr().err


def test_replay_to_the_same_rule_is_where_the_session_was(
    answered: Session, store: Store, point_goal: ModelInfo
) -> None:
    model, asked = load_shown_model(point_goal), store.adapter_answers(answered.id)
    result = replay(store, answered, model, seed=answered.seed)
    assert len(result["latents"]) == 5
    assert result["action_error"] is None
    foretold, decided = 0, 0
    for number, item in enumerate(asked):
        latent = np.array(result["latents"][number])
        kept = json.loads(store.turn(answered.id, "question", number)["latent"])
        np.testing.assert_allclose(latent, kept, atol=0.15)  # by other draws
        if item["preference"] != "equal":
            shown = [Trajectory.from_dict(item[side]) for side in ("left", "right")]
            left, right = model.predicted_returns(latent[None], shown)[0]
            foretold += item["preference"] == ("left" if left >= right else "right")
            decided += 1
    assert (result["foretold"], result["decided"]) == (foretold, decided)
    assert decided > 0
    # Each rule and seed must come to latents that do what was asked for, better than the first.
    other = replay(store, answered, model, {"inference": "paper"}, seed=1, is_own=False)
    # the very latents are not among the candidates, like ones are
    assert 0.0 <= other["action_error"] < 0.2
    env = gym.make(point_goal.env_id)
    for outcome in (result, other):
        first, last = (
            _return(model, env, np.array(outcome["latents"][index])) for index in (0, -1)
        )
        assert last > first


def test_answers_are_replayed_to_a_model_without_similarity(
    answered: Session, store: Store, point_goal: ModelInfo
) -> None:
    small = {"n_train_tasks": 4, "learning_starts": 100, "gradient_steps": 4, "seed": 0}
    model = PEARLSAC("MlpPolicy", point_goal.env_id, **small).learn(400)
    result = replay(store, answered, model, {"decision": "posterior-mean"}, is_own=False)
    assert len({tuple(latent) for latent in result["latents"]}) == 5  # each answer tells something
    model.predicted_rewards_error = float("nan")
    with pytest.raises(ValueError, match="nor a decoder whose error is known"):
        replay(store, answered, model, is_own=False)


def _return(model: Any, env: gym.Env, latent: np.ndarray) -> float:
    observation, _ = env.reset(seed=1, options={"task": TASK})
    total, over = 0.0, False
    while not over:
        action, _ = model.predict(observation, state=latent, deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, over = total + float(reward), terminated or truncated
    return total


def test_the_commands(
    answered: Session,
    store: Store,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out, folder = tmp_path / "out.jsonl", str(store.folder)
    assert cli.main(["label", "export", "--store", folder, "--out", str(out), "--undone"]) == 0
    assert len(out.read_text().splitlines()) == 5
    result = tmp_path / "replay.json"
    assert (
        cli.main(
            ["label", "replay", "--store", folder, "--inference", "paper", "--json", str(result)]
        )
        == 0
    )
    assert "foretold" in capsys.readouterr().out
    assert len(json.loads(result.read_text())["sessions"]) == 1
    other = store.create_session("HalfCheetahVel", "poem/HalfCheetahVel-v0", 0, {})[0]
    spaces = gym.make(other.env_id)
    run = np.zeros((2, *spaces.observation_space.shape)), np.zeros((1, *spaces.action_space.shape))
    shown = dict.fromkeys(("left", "right"), Trajectory(*run, np.zeros(5)).to_dict())
    question = store.add_turn(
        other.id, "question", 0, None, Turn(None, shown, None, None, 20.0, 2), "2.gif"
    )
    assert question is not None
    store.add_answer(other.id, question, "left")
    mixed = tmp_path / "mixed.json"
    command = ["label", "replay", "--store", folder, "--json", str(mixed), "--model"]
    for model, own, left_out in (("PointGoal", 1, 2), ("HalfCheetahVel", 2, 1)):
        assert cli.main([*command, model]) == 0  # of two robots' sessions
        (replayed,) = json.loads(mixed.read_text())["sessions"]
        assert replayed["session"] == own
        assert f"Session {left_out} is left out: the recorded" in capsys.readouterr().out
    with sqlite3.connect(store.path) as connection:
        connection.execute("delete from answers where session = 2")
    # options before the subcommand are the same options
    monkeypatch.delitem(families.DESCRIPTIONS, "PointGoal")  # as of a family of one's own
    again = tmp_path / "again.json"
    options = ["--store", folder, "--inference", "paper"]
    assert cli.main(["label", *options, "replay", "--json", str(again)]) == 0
    assert "It takes the policy of the latent (" in capsys.readouterr().out
    latents = [json.loads(file.read_text())["sessions"][0]["latents"] for file in (result, again)]
    assert latents[0] == latents[1]


def test_replay_knows_a_model_by_its_weights_and_says_which_it_lacks(
    answered: Session,
    store: Store,
    point_goal: ModelInfo,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(pretrained_folder("PointGoal"), tmp_path / "models" / "any name")
    other = load_shown_model(point_goal)
    other.train_tasks.latent_means += 0.1
    other.save_pretrained(tmp_path / "models" / "PointGoal")
    result, command = tmp_path / "replay.json", ["label", "replay", "--store", str(store.folder)]
    for folder, is_own in (("any name", True), ("PointGoal", False)):
        model = str(tmp_path / "models" / folder)
        assert cli.main([*command, "--model", model, "--json", str(result)]) == 0
        assert (json.loads(result.read_text())["sessions"][0]["action_error"] is None) == is_own
    for gone in (
        "gone",
        str(tmp_path / "models" / "PointGoal"),
    ):  # a store that comes from elsewhere opens no other file
        with sqlite3.connect(store.folder / "answers.sqlite") as connection:
            connection.execute("update sessions set model = ?", (gone,))
        capsys.readouterr()
        assert cli.main(["label", "replay", "--store", str(store.folder)]) == 1
        shown = capsys.readouterr()
        assert f"recorded with a model '{gone}'" in " ".join(shown.out.split())
        assert "no session could be replayed" in shown.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["export", "--gym-packages", "nowhere", "--out", "a.jsonl"], "--gym-packages nowhere"),
        (
            ["--model", "PointGoal", "--env-kwargs", "far:1"],
            "PointGoal cannot be shown in poem/Poi",
        ),
        (["--model", "PointGoal", "--env", "poem/AntVel-v0"], "trained for tasks in"),
        (["--model", "PointGoal", "--env", "none/X-v0"], "by --env and --env-kwargs: "),
    ],
)
def test_wrong_commands_say_what_is_wrong(
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["label", *arguments]) == 1
    assert words in capsys.readouterr().err


def test_the_terminals_answers_are_in_the_same_store(
    store: Store, point_goal: ModelInfo, tmp_path: Path
) -> None:
    replies = iter(["l", "nonsense", "e"])
    recorder = StoreRecorder(store, "PointGoal", point_goal.env_id, seed=3)
    store.set_wish(recorder.session.id, "left")
    oracle = HumanOracle(
        tmp_path / "gifs", read=lambda _: next(replies), write=lambda _: None, record=recorder
    )
    env = gym.make(point_goal.env_id, render_mode="rgb_array", width=64, height=48)
    adapter = PreferenceAdapter(
        load_shown_model(point_goal), env, oracle=oracle, seed=3, n_queries=2
    )
    adapter.adapt()
    kept = list(records(store))
    assert [(record["source"], record["preference"], record["wish"]) for record in kept] == [
        ("terminal", "left", "left"),
        ("terminal", "equal", "left"),
    ]
    assert kept[1]["left_latent"] == adapter.answers[1].shown[0].latent.tolist()
    assert Path(kept[0]["video"]).read_bytes().startswith(b"GIF8")


def test_an_answer_at_the_terminal_that_could_not_be_kept_is_kept_when_there_is_room(
    store: Store, point_goal: ModelInfo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> int:
        raise StorageError("the disk is full")

    recorder = StoreRecorder(store, "PointGoal", point_goal.env_id, seed=3)
    oracle = HumanOracle(tmp_path, read=lambda _: "l", write=lambda _: None, record=recorder)
    env = gym.make(point_goal.env_id, render_mode="rgb_array", width=64, height=48)
    model = load_shown_model(point_goal)
    adapter = PreferenceAdapter(model, env, oracle=oracle, seed=3, n_queries=1)
    with monkeypatch.context() as context:
        context.setattr(store, "add_answer", full)
        with pytest.raises(StorageError):
            adapter.adapt()
    adapter.adapt()
    assert [record["preference"] for record in records(store)] == ["left"]


def test_the_best_of_four_is_exported_beside_pairs_and_replayed(
    answered: Session,
    store: Store,
    point_goal: ModelInfo,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from pyarrow import parquet

    replies, options = iter(["3", "0", "first"]), {"question": "best-of-four"}
    recorder = StoreRecorder(store, "PointGoal", point_goal.env_id, 3, options)
    oracle = HumanOracle(
        tmp_path / "gifs",
        read=lambda _: next(replies),
        write=lambda _: None,
        record=recorder,
        **options,
    )
    model, rule = load_shown_model(point_goal), Bayes(noise_model="infer", **options)
    env = gym.make(point_goal.env_id, render_mode="rgb_array", width=64, height=48)
    adapter = PreferenceAdapter(model, env, rule=rule, oracle=oracle, seed=3, n_queries=3)
    adapter.adapt()
    kinds = ["pair"] * 4 + ["best-of-four"] * 3
    assert export(store, tmp_path / "a.parquet", trajectories=True) == 7
    assert export(store, tmp_path / "a.jsonl", trajectories=True) == 7
    lines = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    rows = parquet.read_table(tmp_path / "a.parquet").to_pylist()
    assert [row["question"] for row in rows] == [line["question"] for line in lines] == kinds
    for row, line in zip(rows, lines, strict=True):
        assert {name: value for name, value in row.items() if value is not None} == {
            name: value for name, value in line.items() if value is not None
        }
    for line, given in zip(lines[4:], adapter.answers, strict=True):
        assert line["preference"] == given.preference.value
        assert "left_latent" not in line
        places = ("first", "second", "third", "fourth")
        for place, shown in zip(places, given.shown, strict=True):
            assert line[f"{place}_latent"] == shown.latent.tolist()
            np.testing.assert_array_equal(line[f"{place}_actions"], shown.actions)
    result = replay(store, recorder.session, model, seed=3)
    told = rule.start(model, inference_rng(3), Setting())  # without the draws that asking takes
    for given in adapter.answers:
        told.tell(given.preference, *given.shown)
    np.testing.assert_allclose(result["latents"][-1], told.estimate())
    assert (result["decided"], len(result["latents"])) == (2, 4)
    other = replay(store, recorder.session, model, seed=3, is_own=False)
    assert other["action_error"] < 0.2
    with pytest.raises(ValueError, match=r'which of four is best, which only inference="bayes"'):
        replay(store, recorder.session, model, {"inference": "paper"})
    result = tmp_path / "paper.json"
    command = ["label", "replay", "--store", str(store.folder), "--inference", "paper"]
    assert cli.main([*command, "--json", str(result)]) == 0
    words = f"Session {recorder.session.id} asks which of four is best, which --inference bayes"
    assert words in capsys.readouterr().out
    (replayed,) = json.loads(result.read_text())["sessions"]
    assert replayed["session"] == answered.id


def test_the_widget_moves_the_adapter(point_goal: ModelInfo, tmp_path: Path) -> None:
    model = load_shown_model(point_goal)
    env = gym.make(point_goal.env_id, render_mode="rgb_array", width=64, height=48)
    adapter = PreferenceAdapter(model, env, seed=8, n_queries=3)
    alone = PreferenceAdapter(model, point_goal.env_id, seed=8, n_queries=3)
    widget = LabelWidget(adapter, tmp_path / "notebook")
    try:
        assert f'src="{widget.url}"' in widget._repr_html_()
        for preference in ("right", "left", "left"):
            question = _wait(widget.url, "question")
            _post(
                f"{widget.url}/answer",
                {"question": question["turn"]["id"], "preference": preference},
            )
            alone.ask()
            alone.tell(preference)
        _wait(widget.url, "result")
        np.testing.assert_array_equal(widget.policy().latent, alone.policy().latent)
        assert adapter.done
        assert [answer.preference for answer in adapter.answers] == [
            answer.preference for answer in alone.answers
        ]
        with urllib.request.urlopen(f"{widget.url}/policy.safetensors") as response:
            np.testing.assert_array_equal(
                AdaptedPolicy.from_bytes(response.read()).latent, alone.policy().latent
            )
    finally:
        widget.close()
    with pytest.raises(ValueError, match="fresh one"):
        LabelWidget(alone)
    with pytest.raises(ValueError, match=r"SpeedModel, but the page needs .* and `train_tasks`"):
        LabelWidget(PreferenceAdapter(SpeedModel(), SpeedEnv(render_mode="rgb_array")))


def _wait(url: str, phase: str) -> dict[str, Any]:
    for _ in range(3000):
        with urllib.request.urlopen(f"{url}/state") as response:
            view = json.load(response)
        if view["phase"] == phase:
            return view
        time.sleep(0.02)
    raise AssertionError(f"no {phase} was shown")


def _post(url: str, body: dict[str, Any]) -> None:
    request = urllib.request.Request(
        url, json.dumps(body).encode(), {"Content-Type": "application/json"}
    )
    urllib.request.urlopen(request).close()


def test_an_adapted_policy_is_one_file(point_goal: ModelInfo, tmp_path: Path) -> None:
    model = load_shown_model(point_goal)
    latent = np.random.default_rng(0).standard_normal(model.latent_dim)
    policy = AdaptedPolicy(model, latent, 7)
    path = tmp_path / "policy.safetensors"
    policy.save(path)
    again = AdaptedPolicy.load(path)
    assert (again.n_answers, again.env) == (7, None)
    np.testing.assert_array_equal(again.latent, latent)
    observations = np.random.default_rng(1).standard_normal((5, 2))
    np.testing.assert_array_equal(again.predict(observations)[0], policy.predict(observations)[0])
    content = path.read_bytes()
    for broken in (b"", content[:100], content[:-10], b"x" * 200):
        with pytest.raises(ValueError, match="truncated"):
            AdaptedPolicy.from_bytes(broken)
    with pytest.raises(ValueError, match="not an adapted policy"):
        AdaptedPolicy.from_bytes((point_goal.folder / "model.safetensors").read_bytes())


@pytest.mark.parametrize("quality", ["full", "fast"])
def test_the_widget_takes_an_environment_that_was_rendered_and_gives_it_back(quality: str) -> None:
    env = gym.make(
        "poem/HalfCheetahVel-v0",
        render_mode="rgb_array",
        render_quality=quality,
        width=64,
        height=64,
        max_episode_steps=12,
    )
    try:
        env.reset(seed=0)
        before = env.render()
    except Exception as error:
        pytest.skip(f"this machine cannot render: {error}")
    model = POEMSAC.from_pretrained(pretrained_folder("HalfCheetahVel"), device="cpu")
    widget = LabelWidget(
        PreferenceAdapter(model, env, seed=0, n_queries=2, rule=Bayes(n_particles=10))
    )
    state: dict[str, Any] = {}
    for _ in range(600):
        state = json.loads(urllib.request.urlopen(widget.url + "/state").read())
        if state["phase"] == "question" or state.get("failed"):
            break
        time.sleep(0.1)
    assert state["phase"] == "question", state
    assert widget.sync().pending is not None
    widget.close()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), before)
    env.close()
