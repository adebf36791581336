"""Exports episodes of a policy, or takes, as a data set: `surgical-marl export episodes` (docs/data.md)."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from surgical_marl.data.card import card_of
from surgical_marl.data.dataset import Dataset, add_episode, begin, last_place, numbers
from surgical_marl.data.formats import FORMATS
from surgical_marl.data.recording import Recording, played, replayed
from surgical_marl.data.request import Request
from surgical_marl.envs.env import Env
from surgical_marl.evaluation.environment import find_policy
from surgical_marl.files import write_text
from surgical_marl.plugins.task_file import label
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.signals import Signals, check_form, language_of
from surgical_marl.runs.content import scene_label
from surgical_marl.runs.fault import PACKAGES
from surgical_marl.runs.folder import check_writable, owned
from surgical_marl.runs.progress import progress
from surgical_marl.runs.settings import Settings, make_env
from surgical_marl.view.take import open_take
from surgical_marl.vision.cameras import Cameras, Picture, find_pictures

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

BLOCK = 32
"""Episodes that are played at once."""
ABOUT, CARD = "export.json", "README.md"
TRIES, LEAST = 100, 0.01
"""Episodes that are played before one succeeds, and the share of successes below which an export is given up."""


def export(request: Request, out: Path) -> Path:
    """Write a data set into a new folder, completely or not at all, and return its path.

    An export that was ended goes on where it was if it is asked for again: whole episodes lie in `.<name>.partial`
    beside the folder until all of them are there.

    Raises:
        ValueError: something that is asked for does not exist or does not fit together.
        OSError: the folder is there and not empty, or something can't be written.
    """
    chosen = FORMATS[request.format]
    chosen.check()
    part = out.with_name(f".{out.name}.partial")
    check_writable(out.parent)
    source = _Source(request)
    dataset = _dataset(request, source, part)
    part.mkdir(exist_ok=True)
    with owned(part, "exports into it"):
        begin(part, dataset.about)
        try:
            _fill(request, source, dataset)
        except ValueError:
            if not numbers(part):  # nothing to go on with
                shutil.rmtree(part, ignore_errors=True)
            raise
        whole = part / "whole"
        shutil.rmtree(whole, ignore_errors=True)
        whole.mkdir()
        chosen.write(dataset, whole)
        write_text(whole / ABOUT, json.dumps(dataset.about, indent=1))
        write_text(whole / CARD, card_of(dataset))
        if out.exists():
            out.rmdir()
        os.replace(whole, out)
    shutil.rmtree(part, ignore_errors=True)
    return out


class _Source:
    """Episodes of a policy, or of takes."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._takes = [open_take(path, observations="si") for path in request.takes]
        for path, take in zip(request.takes, self._takes, strict=True):
            if take.settings.of_environment() != self._takes[0].settings.of_environment():
                raise ValueError(f"{path} and {request.takes[0]} are of different environments: export each on its own")
        if self._takes:
            self.settings: Settings = self._takes[0].settings
            self.env: BatchedEnv = self._takes[0].env
        else:
            assert request.settings is not None
            self.settings = replace(request.settings, observations="si")
            _terms(request, Env(**self.settings.of_environment()))  # before anything is compiled
            self.env = make_env(self.settings, min(request.episodes or BLOCK, BLOCK), "numpy")
            self._policy = load_policy(find_policy(request.policy), self.env)

    def episodes(self, after: tuple[int, int] | None) -> Iterator[Recording]:
        """Yield the episodes after a place, or all."""
        if not self._takes:
            yield from played(self.env, self._policy, self.settings.seed, after)
        for number, (path, take) in enumerate(zip(self._request.takes, self._takes, strict=True)):
            if after is None or number >= after[0]:
                for recording in replayed(take.env, take.arrays, take.about, path, number):
                    if after is None or recording.place > after:
                        yield recording


def _terms(request: Request, env: Env) -> tuple[int, str, tuple[Picture, ...]]:
    """Return the rows a second, the form of actions and the pictures; ValueError if they don't fit an environment."""
    chosen, control_rate = FORMATS[request.format], round(1 / env.control_dt)
    rate, form = check_rate(request.rate, control_rate), request.actions or chosen.form
    check_form(form, env.options.control, control_rate // rate)
    if request.actions and not chosen.chooses:
        raise ValueError(f"format {request.format} holds joints and poses, both: leave --actions out")
    pictures = find_pictures(request.pictures, env.scene)
    for picture in pictures:
        if picture.channel not in chosen.channels:
            good = [name for name in request.pictures if not name.endswith(f"_{picture.channel}")]
            raise ValueError(
                f"format {request.format} has no pictures of {picture.channel}: leave out {picture.name}"
                + (f", and keep {', '.join(good)}" if good else "")
            )
    return rate, form, pictures


def _dataset(request: Request, source: _Source, folder: Path) -> Dataset:
    """Return the data set of a request, which has no episodes yet."""
    env = source.env
    rate, form, pictures = _terms(request, env.env)
    signals = Signals(env, form)
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    own = source.settings
    environment = {**own.of_environment(), "task": label(own.task), "scene": scene_label(own.scene)}
    about = {
        "format": request.format, "takes": [[path.name, _digest(path)] for path in request.takes],
        "policy": None if request.takes else request.policy, "environment": environment,
        "engine": env.engine.name, "device": env.device, "episodes": request.episodes, "seed": own.seed,
        "rate": rate, "actions": form, "pictures": list(request.pictures), "size": list(request.size),
        "only_success": request.only_success, "versions": versions,
    }  # fmt: skip
    return Dataset(folder, env, signals, rate, language_of(env), pictures, request.size, about)


def _fill(request: Request, source: _Source, dataset: Dataset) -> None:
    """Add the episodes that are not there yet."""
    folder, wanted = dataset.folder, request.episodes
    count, tries = len(numbers(folder)), 0
    stride = round(1 / dataset.env.control_dt) // dataset.rate
    cameras = Cameras(dataset.env.scene, dataset.pictures, dataset.size) if dataset.pictures else None
    films = dataset.pictures if FORMATS[request.format].films else ()
    bar = progress(wanted or count, "episode", f"exporting {dataset.env.task_name}", begun=count)
    before = count
    if wanted is None or count < wanted:
        for recording in source.episodes(last_place(folder)):
            tries += 1
            if recording.succeeded or not request.only_success:
                add_episode(folder, count, recording.every(stride), cameras, films, dataset.rate)
                count += 1
                bar.update()
            elif not request.takes and tries >= TRIES and count - before < LEAST * tries:
                raise ValueError(
                    f"{count - before} of {tries} episodes of {request.policy!r} succeed: choose another policy, or "
                    "leave --only-success out"
                )
            if count == wanted:
                break
    bar.close()
    if not count:
        which = "no whole episode that succeeds" if request.only_success else "no episode from its start"
        raise ValueError(f"the takes hold {which}: nothing is exported")


def check_rate(rate: int | None, control_rate: int) -> int:
    """Return how many rows a second there are; ValueError unless the rate of control steps is a multiple of it."""
    good = [number for number in range(1, control_rate + 1) if control_rate % number == 0]
    if rate is not None and rate not in good:
        listed = ", ".join(map(str, good[:-1]))
        raise ValueError(f"--rate must be {listed} or {good[-1]}, so that each row is at a control step, not {rate}")
    return control_rate if rate is None else rate


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
