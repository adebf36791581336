"""LeRobot's format v3.0: tables of rows in parquet, films in mp4, and what there is to know about them in `meta/`.

data/chunk-000/file-000.parquet                              rows of several episodes
videos/observation.images.<picture>/chunk-000/file-000.mp4   a film for each episode
meta/info.json, stats.json, tasks.parquet, episodes/chunk-000/file-000.parquet
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from surgical_marl.data.dataset import LEVELS, Dataset, Episode

CHUNK = 1000
"""Files of a folder at most."""
DATA_MB, FILM_MB = 100, 200
"""Size of a file that readers are told to expect at most."""
IMAGES = "observation.images."
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_COUNTED = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64",
            "task_index": "int64"}  # fmt: skip
Stats = dict[str, dict[str, np.ndarray]]


def write(dataset: Dataset, out: Path) -> None:
    """Write a data set into a new folder."""
    rows, file, size = 0, 0, 0
    held: list[pa.Table] = []
    episodes, every = [], []
    named = features(dataset)

    def flush() -> None:
        if held:
            path = out / "data" / f"{_place(file)}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.concat_tables(held), path)
            held.clear()

    for episode in dataset:
        values = columns(dataset, episode, rows)
        table = table_of(values)
        if size + table.nbytes > DATA_MB * 2**20:
            flush()
            file, size = file + 1, 0
        held.append(table)
        size += table.nbytes
        stats = episode_stats(values, episode.levels)
        episodes.append(_about(dataset, episode, rows, file, stats))
        every.append(stats)
        rows += len(table)
    flush()
    for picture in dataset.pictures:
        for number in range(dataset.count):
            copy_film(dataset, number, picture.name, out / "videos" / (IMAGES + picture.name) / f"{_place(number)}.mp4")
    meta = out / "meta"
    meta.joinpath("episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(episodes), meta / "episodes/chunk-000/file-000.parquet")
    pq.write_table(_tasks([dataset.language]), meta / "tasks.parquet")
    write_json(meta / "stats.json", {key: listed(value) for key, value in together(every).items()})
    write_json(meta / "info.json", {
        "codebase_version": "v3.0", "robot_type": dataset.robot, "total_episodes": dataset.count,
        "total_frames": rows, "total_tasks": 1, "chunks_size": CHUNK, "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": FILM_MB, "fps": dataset.rate, "splits": {"train": f"0:{dataset.count}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        if dataset.pictures else None,
        "features": named,
    })  # fmt: skip


def features(dataset: Dataset) -> dict[str, Any]:
    """Return the names, types and shapes of a row's values, as `meta/info.json` has them."""
    signals = dataset.signals
    states = dataset.env.state_space.shape[0]
    vectors: dict[str, Sequence[str]] = {
        "observation.state": signals.state_names,
        "observation.environment_state": [f"state_{number}" for number in range(states)],
        "action": signals.action_names,
    }
    found: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [len(names)], "names": list(names)} for key, names in vectors.items()
    }
    for key, kind in {"next.reward": "float32", "next.done": "bool", "next.success": "bool", **_COUNTED}.items():
        found[key] = {"dtype": kind, "shape": [1], "names": None}
    width, height = dataset.size
    for picture in dataset.pictures:
        found[IMAGES + picture.name] = {
            "dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"],
            "info": {
                "video.fps": dataset.rate, "video.height": height, "video.width": width, "video.channels": 3,
                "video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False, "has_audio": False,
            },
        }  # fmt: skip
    return found


def columns(dataset: Dataset, episode: Episode, first: int) -> dict[str, np.ndarray]:
    """Return the rows of an episode by their names, [T, ...] each; `first` is the number of the first one."""
    recording = episode.recording
    count = len(recording)
    return {
        "observation.state": dataset.signals.state(recording)[:-1],
        "observation.environment_state": recording.seen["state"][:-1].astype(np.float32),
        "action": dataset.signals.action(recording),
        "next.reward": recording.reward,
        "next.done": recording.ended,
        "next.success": recording.done["success"],
        "timestamp": (np.arange(count) / dataset.rate).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, episode.number),
        "index": np.arange(first, first + count),
        "task_index": np.zeros(count, np.int64),
    }


def table_of(values: Mapping[str, np.ndarray]) -> pa.Table:
    """Return columns [T] or [T, n] as a table of parquet."""
    found = {}
    for key, column in values.items():
        flat = pa.array(column.ravel())
        found[key] = pa.FixedSizeListArray.from_arrays(flat, column.shape[1]) if column.ndim == 2 else flat
    return pa.table(found)


def episode_stats(values: Mapping[str, np.ndarray], levels: Mapping[str, np.ndarray]) -> Stats:
    """Return statistics of an episode's columns [T, ...] and of its pictures, by their names.

    Those of pictures are [3, 1, 1] each, of colours from 0 to 1; `levels` are those of `Episode`.
    """
    found = {}
    for key, column in values.items():
        rows = column.reshape(len(column), -1).astype(float)
        found[key] = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
        found[key] |= {name: np.quantile(rows, share, axis=0) for name, share in QUANTILES.items()}
        found[key]["count"] = np.array([len(rows)])
    for name, counts in levels.items():
        found[IMAGES + name] = _picture_stats(counts)
    return found


def together(every: Iterable[Stats]) -> Stats:
    """Return the statistics of all episodes from those of each; a quantile is the mean of theirs, as LeRobot has it."""
    every, found = list(every), {}
    for key in every[0]:
        counts = np.array([own[key]["count"][0] for own in every], float)
        shares = counts / counts.sum()
        parts = {name: np.stack([own[key][name] for own in every]) for name in every[0][key]}
        mean = np.tensordot(shares, parts["mean"], 1)
        variance = np.tensordot(shares, parts["std"] ** 2 + (parts["mean"] - mean) ** 2, 1)
        found[key] = {"min": parts["min"].min(0), "max": parts["max"].max(0), "mean": mean, "std": np.sqrt(variance)}
        found[key] |= {name: np.tensordot(shares, parts[name], 1) for name in QUANTILES}
        found[key]["count"] = parts["count"].sum(0)
    return found


def listed(stats: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return statistics as lists, for JSON."""
    return {name: value.tolist() for name, value in stats.items()}


def write_json(path: Path, content: Any) -> None:
    """Write a file in JSON."""
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def copy_film(dataset: Dataset, number: int, picture: str, target: Path) -> None:
    """Copy an episode's film to where a format has it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(dataset.film(number, picture), target)


def _picture_stats(levels: np.ndarray) -> dict[str, np.ndarray]:
    """Return the statistics of colours from how often each level is there, [3, 256]."""
    shares = levels / levels.sum(1, keepdims=True)
    at = np.arange(LEVELS) / (LEVELS - 1)
    mean = shares @ at
    below = shares.cumsum(1)
    found = {"min": at[(levels > 0).argmax(1)], "max": at[LEVELS - 1 - (levels[:, ::-1] > 0).argmax(1)], "mean": mean}
    found["std"] = np.sqrt(np.maximum(shares @ at**2 - mean**2, 0.0))
    found |= {name: at[(below < share).sum(1)] for name, share in QUANTILES.items()}
    return {name: value[:, None, None] for name, value in found.items()} | {"count": levels[0].sum(keepdims=True)}


def _about(dataset: Dataset, episode: Episode, rows: int, file: int, stats: Stats) -> dict[str, Any]:
    """Return the row of an episode in `meta/episodes`."""
    count, number = len(episode.recording), episode.number
    found: dict[str, Any] = {
        "episode_index": number, "tasks": [dataset.language], "length": count,
        "data/chunk_index": file // CHUNK, "data/file_index": file % CHUNK,
        "dataset_from_index": rows, "dataset_to_index": rows + count,
    }  # fmt: skip
    for picture in dataset.pictures:
        own = f"videos/{IMAGES}{picture.name}"
        found |= {f"{own}/chunk_index": number // CHUNK, f"{own}/file_index": number % CHUNK}
        found |= {f"{own}/from_timestamp": 0.0, f"{own}/to_timestamp": count / dataset.rate}
    for key, values in stats.items():
        found |= {f"stats/{key}/{name}": value for name, value in listed(values).items()}
    return {**found, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}


def _tasks(tasks: Sequence[str]) -> pa.Table:
    """Return the table of tasks. Readers take it for a table of pandas, with the task as its index."""
    index = "__index_level_0__"
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), index: pa.array(tasks)})
    kinds = {"task_index": ("int64", "int64", "task_index"), index: ("unicode", "object", None)}
    about = {
        "index_columns": [index],
        "column_indexes": [{"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object",
                            "metadata": {"encoding": "UTF-8"}}],
        "columns": [{"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
                    for field, (kind, numpy, name) in kinds.items()],
        "pandas_version": "2.0.0",
    }  # fmt: skip
    return table.replace_schema_metadata({b"pandas": json.dumps(about).encode()})


def _place(number: int) -> str:
    """Return the folder and the name of a file by its number."""
    return f"chunk-{number // CHUNK:03d}/file-{number % CHUNK:03d}"
