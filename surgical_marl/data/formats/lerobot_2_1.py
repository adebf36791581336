"""LeRobot's format v2.1, with the files that Open-H and GR00T add to it: a table and a film for each episode.

data/chunk-000/episode_000000.parquet
videos/chunk-000/observation.images.<picture>/episode_000000.mp4
meta/info.json, episodes.jsonl, episodes_stats.jsonl, tasks.jsonl
meta/stats.json, modality.json                                           of GR00T
meta/README.md                                                           of Open-H
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from surgical_marl.data.card import card_of
from surgical_marl.data.dataset import Dataset
from surgical_marl.data.formats.lerobot import (
    CHUNK,
    IMAGES,
    columns,
    copy_film,
    episode_stats,
    features,
    listed,
    table_of,
    together,
    write_json,
)


def write(dataset: Dataset, out: Path) -> None:
    """Write a data set into a new folder."""
    rows, episodes, every = 0, [], []
    for episode in dataset:
        values, number = columns(dataset, episode, rows), episode.number
        table = table_of(values)
        path = out / "data" / _chunk(number) / f"episode_{number:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path)
        for picture in dataset.pictures:
            folder = out / "videos" / _chunk(number) / (IMAGES + picture.name)
            copy_film(dataset, number, picture.name, folder / f"episode_{number:06d}.mp4")
        episodes.append({"episode_index": number, "tasks": [dataset.language], "length": len(table)})
        every.append(episode_stats(values, episode.levels))
        rows += len(table)
    meta = out / "meta"
    meta.mkdir()
    stats = [{key: listed(value) for key, value in own.items()} for own in every]
    _write_lines(meta / "episodes.jsonl", episodes)
    _write_lines(meta / "episodes_stats.jsonl", ({"episode_index": i, "stats": own} for i, own in enumerate(stats)))
    _write_lines(meta / "tasks.jsonl", [{"task_index": 0, "task": dataset.language}])
    write_json(meta / "stats.json", {key: listed(value) for key, value in together(every).items()})
    write_json(meta / "modality.json", _modality(dataset))
    meta.joinpath("README.md").write_text(card_of(dataset), encoding="utf-8")
    write_json(meta / "info.json", {
        "codebase_version": "v2.1", "robot_type": dataset.robot, "total_episodes": dataset.count,
        "total_frames": rows, "total_tasks": 1, "total_videos": dataset.count * len(dataset.pictures),
        "total_chunks": -(-dataset.count // CHUNK), "chunks_size": CHUNK, "fps": dataset.rate,
        "splits": {"train": f"0:{dataset.count}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        if dataset.pictures else None,
        "features": features(dataset),
    })  # fmt: skip


def _modality(dataset: Dataset) -> dict[str, Any]:
    """Return which numbers of a state and of an action are of which arm, and the names of films, as GR00T reads it."""
    names = {"state": dataset.signals.state_names, "action": dataset.signals.action_names}
    found: dict[str, Any] = {
        kind: {agent: {"start": part.start, "end": part.stop} for agent, part in dataset.signals.parts(own).items()}
        for kind, own in names.items()
    }
    found["video"] = {picture.name: {"original_key": IMAGES + picture.name} for picture in dataset.pictures}
    found["annotation"] = {"human.task_description": {"original_key": "task_index"}}
    return found


def _chunk(number: int) -> str:
    return f"chunk-{number // CHUNK:03d}"


def _write_lines(path: Path, rows: Iterable[Any]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
