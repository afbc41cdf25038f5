"""Recorded answers as Minari data sets: the episodes that were compared for each."""

import re
import shutil
import sqlite3
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_poem.common.foreign import check_env_id
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.label.export import answer_record, trajectories_of
from sb3_poem.label.store import Store

NAME = re.compile(r"[\w-]+-v\d+", re.ASCII)
DESCRIPTION = (
    "Episodes that people compared, two or four an answer. ALL REWARDS ARE ZERO, since people gave "
    "no rewards but preferences: `answers` in the data set's metadata has each with its episodes "
    "(`left_episode` and `right_episode`, or `first_episode` to `fourth_episode`) and latents."
)


def export_minari(store: Store, name: str, undone: bool = False) -> dict[str, Path]:
    """Write all answers where Minari keeps its data sets (``MINARI_DATASETS_PATH``), one data set
    for each environment: ``"poem/PointGoal/<name>"``, say, or of several versions of one
    ``"poem/PointGoal-v0/<name>"`` and so on.

    Rewards are zero. An episode that is shorter than its environment's time limit has terminated,
    another one is truncated. Reward features are in the infos, without a first one (NaN), since a
    reset gives none.

    :param name: Of the data sets, with a version: ``"answers-v0"``
    :param undone: Whether answers that were taken back are among them
    :return: Where each is, by its id
    :raises ImportError: If the extra ``[minari]`` is not installed
    :raises ValueError: If a data set of that id exists, the name is of another form, there are no
        answers, or an environment is not the one in which they were recorded
    """
    try:
        import h5py  # noqa: F401
        from minari.storage import get_dataset_path
    except ImportError as error:
        raise ImportError(
            f"Minari is missing: pip install -c constraints.txt '.[minari]' in a checkout ({error})"
        ) from error
    if NAME.fullmatch(name) is None:
        raise ValueError(f"a Minari data set's name must be like answers-v0, but is {name!r}")
    rows = [row for row in store.records() if undone or row["undone"] is None]
    if not rows:
        raise ValueError(f"{store.folder} holds no answers")
    datasets, families = {}, {row["env_id"]: re.sub(r"-v\d+$", "", row["env_id"]) for row in rows}
    for env_id, family in families.items():
        check_env_id(env_id, str(store.path))
        has_versions = [*families.values()].count(family) > 1
        family = re.sub(r"[^\w/-]", "_", env_id if has_versions else family)
        dataset = datasets[env_id] = f"{family}/{name}"
        if (where := get_dataset_path(dataset)).exists():
            raise ValueError(f"there is a Minari data set {dataset} already, in {where}")
    written: dict[str, Path] = {}
    try:
        for env_id, dataset in datasets.items():
            written[dataset] = get_dataset_path(dataset)
            _write(dataset, env_id, [row for row in rows if row["env_id"] == env_id], store.videos)
    except BaseException:  # all or none
        for where in written.values():
            shutil.rmtree(where, ignore_errors=True)
        raise
    return written


def _write(dataset: str, env_id: str, rows: list[sqlite3.Row], videos: Path) -> None:
    import minari
    from minari.data_collector import EpisodeBuffer

    env = gym.make(env_id)
    shapes = env.observation_space.shape, env.action_space.shape
    limit = getattr(env.spec, "max_episode_steps", None) or 0
    episodes: list[EpisodeBuffer] = []
    metadata: list[dict[str, Any]] = []
    answers: list[dict[str, Any]] = []
    for row in rows:
        answer = {**answer_record(row, videos), "video": row["video"]}
        for side, shown in trajectories_of(row).items():
            found = shown.observations.shape[1:], shown.actions.shape[1:]
            if found != shapes:
                recorded = f"observations and actions recorded in {env_id} have the shapes {found}"
                raise ValueError(f"{recorded}, but the environment's are {shapes}")
            answer[f"{side}_episode"] = len(episodes)
            about = {"preference": row["preference"], "latent": shown.latent}
            metadata.append({"answer": len(answers), "side": side, **about})
            episodes.append(EpisodeBuffer(**_steps(shown, limit)))
        answers.append(answer)
    with warnings.catch_warnings():
        # of authors and reference scores that are not given
        warnings.simplefilter("ignore", UserWarning)
        create = minari.create_dataset_from_buffers
        made = create(dataset, episodes, env=env, description=DESCRIPTION)
    made.storage.update_metadata({"answers": answers})
    made.storage.update_episode_metadata(metadata, range(len(episodes)))
    env.close()


def _steps(shown: Trajectory, limit: int) -> dict[str, Any]:
    """An episode's arrays, as Minari names them."""
    last = np.arange(1, len(shown) + 1) == len(shown)
    is_cut, features = len(shown) >= limit, shown.reward_features
    infos = {}
    if features is not None:
        infos["reward_features"] = np.pad(features, ((1, 0), (0, 0)), constant_values=np.nan)
    return {
        "observations": shown.observations,
        "actions": shown.actions,
        "rewards": np.zeros(len(shown)),
        "terminations": last & (not is_cut),
        "truncations": last & is_cut,
        "infos": infos,
    }
