"""The episodes of an export on disk: whole ones only, so that an export that was killed goes on.

FOLDER/about.json              what is exported: an export goes on only if it is the same
FOLDER/episode-000000.npz      an episode: written last, and with its name only when it is complete
FOLDER/episode-000000-<picture>.mp4
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.data.recording import Recording
from surgical_marl.files import remove_temporaries, write_atomic, write_npz, write_text
from surgical_marl.untrusted.arrays import read_npz
from surgical_marl.untrusted.files import MAX_JSON, is_file, read_json
from surgical_marl.untrusted.values import shown
from surgical_marl.view.video import Mp4
from surgical_marl.vision.cameras import NODES, Cameras, Picture

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.policies.signals import Signals

ABOUT = "about.json"
ENCODING = "-preset fast -crf 18 -g 2 -bf 0"
"""Of films: a picture is decoded from at most two, because learners read them in any order."""
LEVELS = 256
_POSES = ("origin", "quaternion", NODES)


class Episode(NamedTuple):
    """An episode of a data set."""

    number: int
    recording: Recording
    """Without the poses that pictures are drawn from."""
    pictures: dict[str, np.ndarray]
    """[T + 1, H, W, C] each, by name; none where they are films."""
    levels: dict[str, np.ndarray]
    """Counts of each level of each colour in some of the frames of a film, [3, 256] each, by name."""


@dataclass(frozen=True)
class Dataset:
    """A data set to be written: its episodes, and all that formats say of it."""

    folder: Path
    env: BatchedEnv
    signals: Signals
    rate: int
    """Rows a second."""
    language: str
    """The task in words."""
    pictures: tuple[Picture, ...] = ()
    size: tuple[int, int] = (0, 0)
    """Width and height of pictures, pixels."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """The export, as the user asked for it."""

    @property
    def robot(self) -> str:
        """The types of the arms, such as "psm_psm"."""
        return "_".join(mount.arm.name for mount in self.env.scene.mounts.values())

    @cached_property
    def count(self) -> int:
        """The number of episodes."""
        return len(numbers(self.folder))

    def __iter__(self) -> Iterator[Episode]:
        for number in range(self.count):
            yield read_episode(self.folder, number)

    def film(self, number: int, picture: str) -> Path:
        """Return the path of an episode's film."""
        return self.folder / _film(number, picture)


def numbers(folder: Path) -> list[int]:
    """Return the numbers of the whole episodes in a folder."""
    return sorted(int(path.stem.partition("-")[2]) for path in folder.glob("episode-*.npz"))


def begin(folder: Path, about: Mapping[str, Any]) -> None:
    """Begin an export in a folder, or go on with the one that is there.

    Raises:
        ValueError: the folder holds an export of something else.
    """
    remove_temporaries(folder)
    path = folder / ABOUT
    if not is_file(path):
        write_text(path, json.dumps(about, indent=1))
        return
    before = read_json(path, MAX_JSON)
    if not isinstance(before, dict):
        before = {}
    wanted = json.loads(json.dumps(about))
    if changed := sorted(key for key in {*before, *wanted} if before.get(key) != wanted.get(key)):
        key = changed[0]
        raise ValueError(
            f"{folder} holds the part of an export with {key} {shown(before.get(key))}, not {shown(wanted.get(key))}: "
            "repeat that command to go on, or remove the folder"
        )


def add_episode(
    folder: Path, number: int, recording: Recording, cameras: Cameras | None, films: Sequence[Picture], rate: int
) -> None:
    """Draw an episode's pictures, and write it, completely or not at all.

    Args:
        folder: of the export.
        number: of the episode.
        recording: with a row for each row of the data set.
        cameras: draw the pictures; None without any.
        films: pictures that become films. All others are kept as arrays.
        rate: rows a second.
    """
    pictures: dict[str, np.ndarray] = {}
    levels: dict[str, np.ndarray] = {}
    if cameras is not None and films:
        levels = _write_films(folder, number, recording, cameras, films, rate)
    elif cameras is not None:
        drawn = list(cameras.draw(recording.seen))
        pictures = {name: np.concatenate([part[name] for part in drawn]) for name in drawn[0]}
    arrays = {"place": np.array(recording.place)}
    for kind, values in (("pictures", pictures), ("levels", levels), ("done", recording.done)):
        arrays |= {f"{kind}/{name}": value for name, value in values.items()}
    kept = {name: value for name, value in recording.seen.items() if not name.startswith(_POSES)}
    arrays |= {f"seen/{name}": value for name, value in kept.items()}
    write_npz(folder / f"episode-{number:06d}.npz", arrays)


def read_episode(folder: Path, number: int) -> Episode:
    """Read an episode that `add_episode` wrote."""
    arrays = read_npz(folder / f"episode-{number:06d}.npz", most=2**40)
    parts: dict[str, dict[str, np.ndarray]] = {"seen": {}, "done": {}, "pictures": {}, "levels": {}}
    place = tuple(int(value) for value in arrays.pop("place"))
    for name, value in arrays.items():
        kind, _, own = name.partition("/")
        parts[kind][own] = value
    return Episode(number, Recording(parts["seen"], parts["done"], place), parts["pictures"], parts["levels"])  # type: ignore[arg-type]


def last_place(folder: Path) -> tuple[int, int] | None:
    """Return the place of the last whole episode in a folder; None if there is none."""
    found = numbers(folder)
    return read_episode(folder, found[-1]).recording.place if found else None


def _write_films(
    folder: Path, number: int, recording: Recording, cameras: Cameras, films: Sequence[Picture], rate: int
) -> dict[str, np.ndarray]:
    """Write the films of an episode, a frame for each row but the last; return the levels of their colours."""
    levels = {picture.name: np.zeros((3, LEVELS), np.int64) for picture in films}
    paths = {picture.name: folder / _film(number, picture.name) for picture in films}
    parts = {name: path.with_name(f".{path.name}.{number}.tmp") for name, path in paths.items()}
    left = len(recording)
    with contextlib.ExitStack() as opened:
        writers: dict[str, Mp4] = {}
        for drawn in cameras.draw(recording.seen):
            for name, frames in drawn.items():
                if not writers.get(name):
                    film = Mp4(parts[name], frames.shape[1:], rate, f"{ENCODING} -f mp4")
                    writers[name] = opened.enter_context(film)
                for channel in range(3):
                    levels[name][channel] += np.bincount(frames[0, ..., channel].ravel(), minlength=LEVELS)
                for frame in frames[:left]:
                    writers[name].add(frame)
            left -= len(next(iter(drawn.values())))
    for name, path in paths.items():
        write_atomic(path, parts[name].replace)
    return levels


def _film(number: int, picture: str) -> str:
    return f"episode-{number:06d}-{picture}.mp4"
