"""Takes of the viewer: files that can be stepped again to the same numbers.

`surgical-marl view --record DIR` writes takes, and `surgical-marl replay FILE` steps one again. A take is an npz file:

    about               JSON text: layout, environment (its options), engine, device, num_envs, seed, movers, versions
    start<path>         all that the first step depends on, as in "start.physics.arms.qpos", [N, ...]
    actions/<agent>     what each arm was commanded, [T, N, a] float32
    rewards/<agent>     [T, N] float32
    qpos                joint positions after each step, [T, N, nq] float32
    objects             position and quaternion of free objects after each step, [T, N, k, 7] float32
    ended               where an episode ended with the step, [T, N] bool

`movers` lists [step, agent, who]: who moved an agent from this step on. A replay does not ask them: it has the actions.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.files import write_npz
from surgical_marl.runs.content import stored_scene
from surgical_marl.runs.fault import PACKAGES, changed_versions, made_in
from surgical_marl.runs.settings import Settings, make_env
from surgical_marl.untrusted.arrays import read_npz
from surgical_marl.untrusted.values import check_count, shown

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.envs.state import BatchStep

LAYOUT = 1
MOST_STEPS = 10_000
"""Steps of a take, so that its arrays stay small; the next take goes on from there."""
MOST_ENVS = 4
"""Environments of a viewer, and so of a take."""
_START = "start"


class Take:
    """A recording that has begun where an environment now is, before its next step."""

    def __init__(self, env: BatchedEnv, settings: Settings, seed: int, movers: Mapping[str, str]) -> None:
        self._env, self._start = env, env.carry()
        self._about: dict[str, Any] = {
            "layout": LAYOUT,
            "environment": settings.of_environment(),
            "engine": env.engine.name,
            "device": env.device,
            "num_envs": env.num_envs,
            "seed": seed,
            "movers": [[0, agent, who] for agent, who in movers.items()],
            "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        }
        self._steps: list[dict[str, np.ndarray]] = []

    def __len__(self) -> int:
        return len(self._steps)

    def moved_by(self, agent: str, who: str) -> None:
        """Note who moves an arm from the next step on."""
        self._about["movers"].append([len(self), agent, who])

    def add(self, actions: Mapping[str, np.ndarray], step: BatchStep) -> None:
        """Note the actions of a step that the environment has just done, and its outcome."""
        self._steps.append(
            {f"actions/{agent}": np.array(own) for agent, own in actions.items()} | _after(self._env, step)
        )

    def write(self, path: Path) -> Path:
        """Write the file, completely or not at all, and return its path."""
        environment = self._about["environment"]
        scene = stored_scene(environment["scene"], path.parent)
        about = {**self._about, "environment": {**environment, "scene": scene}}
        content = {"about": np.array(json.dumps(about))}
        content |= {f"{_START}{name}": value for name, value in self._start.items()}
        content |= {name: np.stack([step[name] for step in self._steps]) for name in self._steps[0]}

        path.parent.mkdir(parents=True, exist_ok=True)
        write_npz(path, content)
        return path


class Replayed(NamedTuple):
    """Outcome of stepping a take again."""

    steps: int
    differs_at: int | None
    """The first step that led to other numbers, from 0; None if none did."""
    largest: float
    """The largest difference of a joint position, rad or m, or of an object's position, m."""
    versions: list[str]
    """Packages that have another version than when the take was recorded."""


def replay(path: Path) -> Replayed:
    """Step a take again, and compare all numbers bit by bit.

    Raises:
        ValueError: it is no take, or what it was recorded in can't be made here.
    """
    take = open_take(path)
    env, arrays, first, largest = take.env, take.arrays, None, 0.0
    env.set_carry(start_of(arrays))
    for number in range(take.steps):
        step = env.step({agent: arrays[f"actions/{agent}"][number] for agent in env.agents})
        for name, value in _after(env, step).items():
            wanted = arrays[name][number]
            if wanted.shape != value.shape:
                raise ValueError(f"{path} is no whole take: {name} has the shape {wanted.shape}, not {value.shape}")
            if not np.array_equal(wanted, value, equal_nan=True):
                first = number if first is None else first
                if name in ("qpos", "objects"):
                    largest = max(largest, float(np.max(np.abs(wanted - value), initial=0.0)))
    env.close()
    return Replayed(take.steps, first, largest, changed_versions(take.about["versions"]))


class OpenTake(NamedTuple):
    """A take, and environments of its own in which it can be stepped again."""

    settings: Settings
    env: BatchedEnv
    about: dict[str, Any]
    arrays: dict[str, np.ndarray]
    steps: int


def open_take(path: Path, **options: Any) -> OpenTake:
    """Read a take, and make its environments; `options` replace some of theirs.

    Raises:
        ValueError: it is no take, or what it was recorded in can't be made here.
    """
    about, arrays = read_take(path)
    try:
        own = {**about["environment"], **options}
        settings = made_in(own, path, engine=about["engine"], device=about["device"])
    except TypeError:  # options of another version
        raise ValueError(f"{path} was recorded in an environment that this version does not know") from None
    env = make_env(settings, about["num_envs"], "numpy")
    needed = {
        "qpos",
        "objects",
        "ended",
        *(f"{kind}/{agent}" for kind in ("actions", "rewards") for agent in env.agents),
    }
    if missing := sorted(needed - arrays.keys()):
        raise ValueError(f"{path} is no whole take: it lacks {', '.join(missing)}")
    counts = {len(arrays[name]) if arrays[name].ndim else 0 for name in needed}
    if len(counts) != 1:
        raise ValueError(f"{path} is no whole take: its arrays are of different numbers of steps: {sorted(counts)}")
    steps = counts.pop()
    check_count(steps, MOST_STEPS, "steps", path)
    return OpenTake(settings, env, about, arrays, steps)


def start_of(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return all that the first step of a take depends on, as `BatchedEnv.carry` does."""
    return {name.removeprefix(_START): value for name, value in arrays.items() if name.startswith(_START)}


def read_take(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the content of `about`, and all arrays by name; ValueError if the file is no take."""
    try:
        arrays = read_npz(path)
        about = json.loads(str(arrays.pop("about")))
    except (ValueError, KeyError, RecursionError):
        about, arrays = {}, {}
    known = {"layout", "environment", "engine", "device", "num_envs", "versions"}
    if not isinstance(about, dict) or not known <= about.keys() or "qpos" not in arrays:
        raise ValueError(f"{path} is not a take that `surgical-marl view --record` wrote")
    if about["layout"] != LAYOUT:
        raise ValueError(f"{path} is a take of layout {shown(about['layout'])}: this version reads layout {LAYOUT}")
    texts = all(isinstance(about[name], str) for name in ("engine", "device"))
    mappings = all(isinstance(about[name], dict) for name in ("environment", "versions"))
    if not (texts and mappings) or any(value.dtype.kind not in "fiub" for value in arrays.values()):
        raise ValueError(f"{path} is no whole take: something in it is of another type than what `view` writes")
    if type(about["num_envs"]) is not int or not 1 <= about["num_envs"] <= MOST_ENVS:
        raise ValueError(f"{path} is a take of {shown(about['num_envs'])} environments; 1 to {MOST_ENVS} are replayed")
    return about, arrays


def _after(env: BatchedEnv, step: BatchStep) -> dict[str, np.ndarray]:
    """Return the numbers of a step that a replay is compared in."""
    poses = env.drawn_poses
    return {
        **{f"rewards/{agent}": np.array(reward, np.float32) for agent, reward in step.rewards.items()},
        "qpos": np.array(env.qpos, np.float32),
        "objects": np.concatenate([poses.origin, poses.quaternion], -1).astype(np.float32),
        "ended": np.asarray(step.terminated | step.truncated),
    }
