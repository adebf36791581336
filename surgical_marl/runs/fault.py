"""An environment that became NaN or infinite, as a file that reproduces it: `surgical-marl replay FILE`.

The file is an npz file without pickles:

    about               JSON text: layout, kind "fault", environment (its options), engine, device, seed, index (of the
                        environment), iteration (of a training, or null), place, versions
    start<path>         all that the first step depends on, as in "start.physics.arms.qpos", [1, ...]
    actions/<agent>     what each arm was commanded, [T, 1, a] float32; after the last of these steps the fault is there
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.engines.choose import DeviceName
from surgical_marl.engines.faults import checked
from surgical_marl.envs.fault_place import fault_place
from surgical_marl.files import write_npz
from surgical_marl.runs.content import found_scene, stored_scene
from surgical_marl.runs.settings import Settings, make_env
from surgical_marl.runtime import has_cuda
from surgical_marl.untrusted.arrays import read_npz
from surgical_marl.untrusted.values import check_count, one_line, shown

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

LAYOUT = 1
MOST_STEPS = 100_000
"""Steps of a file that is read."""
_START = "start"
PACKAGES = ("surgical-marl", "jax", "warp-lang", "numpy")
_KNOWN = {"environment", "engine", "device", "seed", "index", "place", "versions"}


class Reproduced(NamedTuple):
    """Outcome of stepping towards a fault again."""

    steps: int
    """All steps of the file."""
    at: int | None
    """The first step, from 0, after which a number is not finite; None if all stay finite."""
    places: list[str]
    """Places of the numbers that are not finite then, in the order in which faults spread."""
    told: str
    """Facts in the file: seed, environment and place."""
    device: str
    versions: list[str]
    """Packages that have another version than when the fault was found."""


def write_fault(
    path: Path,
    env: BatchedEnv,
    settings: Settings,
    start: Mapping[str, np.ndarray],
    actions: Mapping[str, np.ndarray],
    **told: Any,
) -> None:
    """Write a fault, completely or not at all.

    Args:
        path: of the file.
        env: where it was found.
        settings: of its environment.
        start: parts of the carry of the one environment before the first step, [1, ...].
        actions: agent -> what it was commanded from then on, [T, 1, a].
        told: seed, index, place and iteration.
    """
    about = {
        "layout": LAYOUT,
        "kind": "fault",
        "environment": {**settings.of_environment(), "scene": stored_scene(settings.scene, path.parent)},
        "engine": env.engine.name,
        "device": env.device,
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "iteration": None,
        **told,
    }
    content = {"about": np.array(json.dumps(about))}
    content |= {f"{_START}{name}": value for name, value in start.items()}
    content |= {f"actions/{agent}": np.asarray(own, np.float32) for agent, own in actions.items()}
    write_npz(path, content)


def read_fault(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """Return the content of `about`, and all arrays by name; None if the file is of another kind.

    Raises:
        ValueError: it is a fault, but not a whole one, or of another layout.
    """
    try:
        arrays = read_npz(path)
        about = json.loads(str(arrays.pop("about")))
    except (ValueError, KeyError, RecursionError):
        return None
    if not isinstance(about, dict) or about.get("kind") != "fault":
        return None
    if about.get("layout") != LAYOUT:
        raise ValueError(
            f"{path} is a fault of layout {shown(about.get('layout'))}: this version reads layout {LAYOUT}"
        )
    texts = all(isinstance(about.get(name), str) for name in ("engine", "device", "place"))
    mappings = all(isinstance(about.get(name), dict) for name in ("environment", "versions"))
    if not (about.keys() >= _KNOWN and texts and mappings):
        raise ValueError(f"{path} is no whole fault: it needs {', '.join(sorted(_KNOWN))}")
    about |= {name: one_line(about[name]) for name in ("seed", "index", "device")}
    return about, arrays


def reproduce(path: Path, about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Reproduced:
    """Step one environment from where the file begins until a number is not finite.

    It runs on the device of the file, or on the CPU if that one is not there: then numbers differ in their last bits.

    Args:
        path: for messages.
        about: what `read_fault` returned, with `arrays`.

    Raises:
        ValueError: what it was found in can't be made here, or the arrays don't fit it.
    """
    device: DeviceName = "cuda" if about["device"] == "cuda" and has_cuda() else "cpu"
    try:
        settings = made_in(about["environment"], path, engine=about["engine"], device=device)
    except TypeError:  # options of another version
        raise ValueError(f"{path} was found in an environment that this version does not know") from None
    env = make_env(settings, 1, "numpy")
    needed = {f"actions/{agent}" for agent in env.agents}
    if missing := sorted(needed - arrays.keys()):
        raise ValueError(f"{path} is no whole fault: it lacks {', '.join(missing)}")
    if any(value.dtype.kind not in "fiub" for value in arrays.values()):
        raise ValueError(f"{path} holds arrays that are not of numbers")
    env.set_carry({name.removeprefix(_START): value for name, value in arrays.items() if name.startswith(_START)})
    counts = {arrays[name].shape[0] if arrays[name].ndim else 0 for name in needed}
    if len(counts) != 1:
        raise ValueError(f"{path} has different numbers of actions: {sorted(counts)}")
    count = counts.pop()
    check_count(count, MOST_STEPS, "steps", path)
    found, at = list[str](), None
    for number in range(count):
        env.step_raw({agent: arrays[f"actions/{agent}"][number] for agent in env.agents})
        if found := not_finite(env):
            at = number
            break
    env.close()
    told = f"seed {about['seed']}, environment {about['index']}: {one_line(about['place'])}"
    return Reproduced(count, at, found, told, device, changed_versions(about["versions"]))


def made_in(environment: Mapping[str, Any], path: Path, **more: Any) -> Settings:
    """Return the settings of an environment that a recording names, whose copy of a scene may lie beside it.

    ValueError or TypeError if a setting is bad or unknown.
    """
    scene = environment.get("scene")
    own = {"scene": found_scene(scene, path.parent)} if isinstance(scene, str) else {}
    return Settings(**{**environment, **own, **more})


def changed_versions(versions: Mapping[str, Any]) -> list[str]:
    """Return the packages that have another version here than a recording says, as texts."""
    return [
        f"{name} {one_line(was)} -> {now}"
        for name, was in versions.items()
        if name in PACKAGES and (now := importlib.metadata.version(name)) != was
    ]


def not_finite(env: BatchedEnv) -> list[str]:
    """Return the places of the first environment that are not finite, after `env.step_raw`."""
    parts = {name: env.engine.read(name, "numpy") for name in env.engine.carry_shapes}
    parts |= {name: np.asarray(leaf) for name, leaf in checked(env.engine.outcome("numpy"))}
    found: dict[str, None] = {}
    for name, values in parts.items():
        if values.dtype.kind == "f":
            for index in np.flatnonzero(~np.isfinite(values[0].reshape(-1) if values[0].shape else values[:1])):
                found[str(fault_place(env.env, f"{name}[{index}]" if values[0].shape else name))] = None
    return list(found)
