"""The episodes of an evaluation as a file: what each arm did in each episode, for histograms and curves."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from surgical_marl.evaluation.evaluate import Played
from surgical_marl.files import write_atomic
from surgical_marl.untrusted.arrays import read_npz

EPISODES = "episodes.npz"
MEASURES = ("error", "held", "squared", "distance", "center", "success", "collided", "time", "path", "smoothness",
            "action_change")  # fmt: skip
"""Measures of every task."""


def write_played(path: Path, played: Played) -> None:
    """Write episodes as an npz file of float32 arrays [E, A], one for each measure, and `about`, a text in JSON."""
    about = json.dumps({
        "about": played.about,
        "agents": played.agents,
        "follows": played.follows,
        "stages": played.stages,
    })  # fmt: skip
    measures: dict[str, Any] = {name: values.astype(np.float32) for name, values in played.measures.items()}

    def save(temporary: Path) -> None:
        with temporary.open("wb") as file:  # a name without .npz would get one
            np.savez_compressed(file, about=np.array(about), **measures)

    write_atomic(path, save)


def read_played(path: Path) -> Played:
    """Read what `write_played` wrote, as float64. ValueError if the file is damaged or of another kind."""
    try:
        found = read_npz(path)
        kept = json.loads(str(found.pop("about")))
        agents = [str(agent) for agent in kept["agents"]]
        measures = {name: values.astype(float) for name, values in found.items()}
        shape = measures["error"].shape
        if len(shape) != 2 or shape[1] != len(agents) or any(values.shape != shape for values in measures.values()):
            raise ValueError(shape)
        if not {*MEASURES} <= measures.keys():
            raise ValueError(list(measures))
        stages = tuple(str(stage) for stage in kept["stages"])
        return Played(dict(kept["about"]), agents, measures, bool(kept["follows"]), stages)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise ValueError(f"{path} is damaged, or not the episodes of an evaluation: evaluate the run again") from None
