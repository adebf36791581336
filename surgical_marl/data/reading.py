"""Reads what `surgical-marl export episodes` wrote in LeRobot's formats."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from surgical_marl.untrusted.files import MAX_JSON, is_file, read_json

ABOUT, INFO = "export.json", "meta/info.json"
MOST_ROWS = 100_000_000


class Table(NamedTuple):
    """The rows of a data set."""

    about: dict[str, Any]
    """Settings of the export: `rate`, `actions`, `environment` and so on."""
    names: tuple[str, ...]
    """Names of the numbers of an action."""
    columns: dict[str, np.ndarray]
    """By name, [rows] or [rows, numbers]."""


def check_set(folder: Path) -> None:
    """Raise ValueError if a folder is no data set that was exported in a format of LeRobot."""
    for name in (ABOUT, INFO):
        if not is_file(folder / name):
            raise ValueError(f"{folder} is no data set that was exported in the format lerobot: it lacks {name}")
    if importlib.util.find_spec("pyarrow") is None:
        raise ValueError("the package pyarrow is not installed: pip install 'surgical-marl[data]'")


def read_set(folder: Path, wanted: Sequence[str]) -> Table:
    """Read some columns of all rows of a data set.

    Raises:
        ValueError: it is no such data set, it lacks a column or rows, or it holds what is not a finite number.
    """
    check_set(folder)
    import pyarrow as pa
    import pyarrow.parquet as pq

    about, info = (read_json(folder / name, MAX_JSON) for name in (ABOUT, INFO))
    try:
        names = tuple(map(str, info["features"]["action"]["names"]))
        rows, environment = int(info["total_frames"]), dict(about["environment"])
        files = sorted((folder / "data").rglob("*.parquet"))
        table = pa.concat_tables(pq.read_table(path, columns=list(wanted)) for path in files)
        columns = {name: _array(table[name]) for name in wanted}
    except (KeyError, TypeError, ValueError, OSError, pa.ArrowException) as error:
        raise ValueError(f"{folder} is damaged, or was not exported by this program: {error}") from None
    if len(table) != rows or not 0 < rows <= MOST_ROWS:
        raise ValueError(f"{folder} is not whole: it has {len(table):,} of {rows:,} rows")
    for name, column in columns.items():
        if not np.isfinite(column).all():
            raise ValueError(f"{folder} holds a {name} that is not a finite number")
    return Table({**about, "environment": environment}, names, columns)


def _array(column: Any) -> np.ndarray:
    """Return a column of parquet, [rows] or [rows, numbers]."""
    flat = column.combine_chunks()
    if not hasattr(flat.type, "value_type"):
        return np.asarray(flat.to_numpy(zero_copy_only=False))
    values = flat.flatten().to_numpy(zero_copy_only=False)
    return np.asarray(values.reshape(len(flat), -1))
