"""Measures how the success of oracles with tissue depends on how tissue is simulated: docs/suturing.md.

    python -m docs.studies.sensitivity                                     # all tasks, 64 unseen starts a cell
    python -m docs.studies.sensitivity --task needle_drive --starts 200 --only "half steps"

A cell is a task and a change of its physics. Each is another program, which compiles for minutes on a CPU.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

from docs.studies.command import make_parser, run
from surgical_marl.cli.flags import whole
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.evaluate import MAX_BATCH, evaluate
from surgical_marl.physics.systems.soft import Material, Soft
from surgical_marl.physics.systems.tissue import Tissue
from surgical_marl.policies.policy import load_policy
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.scene import Randomisation, Scene
from surgical_marl.scenes.timing import DECIMATION

TASKS = ("suture", "needle_drive", "tissue_retract")
OFF = 0.3
"""Share by which Young's modulus and coefficients of friction are off, at most."""


def as_shipped(scene: Scene) -> Scene:
    """Return the scene."""
    return scene


def half_steps(scene: Scene) -> Scene:
    """Return a scene whose physics steps are half as long."""
    model = copy.copy(scene.model)
    model.opt.timestep /= 2
    return replace(scene, model=model)


def two_layers(scene: Scene) -> Scene:
    """Return a scene whose tissue has twice as many layers of bricks, half as thick."""

    def finer(system: Any) -> Any:
        if not isinstance(system, Tissue):
            return system
        present = np.repeat(np.array(system.present), 2, 2)
        return replace(system, present=tuple(tuple(map(tuple, plane)) for plane in present.tolist()))

    return replace(scene, systems={name: finer(system) for name, system in scene.systems.items()})


def drawn(scene: Scene) -> Scene:
    """Return a scene whose episodes draw Young's moduli and coefficients of friction, off by `OFF` at most."""
    ranges = Randomisation(
        object_friction=OFF, thread_stiffness=OFF, thread_friction=OFF, tissue_stiffness=OFF, tissue_friction=OFF
    )
    systems = {
        name: replace(system, ranges=Material(OFF, OFF)) if isinstance(system, Soft) else system
        for name, system in scene.systems.items()
    }
    return replace(scene, randomisation=ranges, systems=systems)


CHANGES: dict[str, Callable[[Scene], Scene]] = {
    "as shipped": as_shipped,
    "half steps": half_steps,
    "two layers": two_layers,
    "E and friction": drawn,
}


def make_env(task: str, change: str, count: int) -> BatchedEnv:
    """Return environments of a task with unseen starts, whose physics has a change of `CHANGES`."""

    def load(name: str, control: str) -> Scene:
        return CHANGES[change](load_scene(name, control))

    decimation = DECIMATION * (2 if change == "half steps" else 1)
    with patch("surgical_marl.envs.env.load_scene", load):
        return BatchedEnv(task, None, num_envs=count, device="cpu", goals="held_out", decimation=decimation)


def measure(task: str, change: str, starts: int) -> dict[str, Any]:
    """Return the evaluation of a task's oracle with a change of its physics."""
    env = make_env(task, change, min(starts, MAX_BATCH))
    try:
        return dict(evaluate(env, load_policy("oracle", env), starts, 0))
    finally:
        env.close()


def cell(found: dict[str, Any]) -> str:
    """Return the success of an evaluation with its 95 % interval, %."""
    low, high = found["intervals"]["success_rate"]
    return f"{100 * found['success_rate']:.0f} ({100 * low:.0f} to {100 * high:.0f})"


def main(argv: list[str] | None = None) -> int:
    parser = make_parser(__doc__)
    parser.add_argument("--task", choices=TASKS, help="all of them by default")
    parser.add_argument("--only", choices=CHANGES, help="change of the physics; all of them by default")
    parser.add_argument("--starts", type=whole(2, 1_000_000), default=64, metavar="N", help="a cell (%(default)s)")
    asked = parser.parse_args(argv)
    tasks, changes = [asked.task] if asked.task else TASKS, [asked.only] if asked.only else list(CHANGES)
    print("\n".join(["| | " + " | ".join(changes) + " |", "|---" * (len(changes) + 1) + "|"]), flush=True)
    for task in tasks:
        cells = []
        for change in changes:
            found = measure(task, change, asked.starts)
            force = found["max_tissue_force_n"]
            print(f"{task}, {change}: {cell(found)} %, at most {force:.1f} N in the mean", file=sys.stderr, flush=True)
            cells.append(cell(found))
        print(f"| `{task}` | " + " | ".join(cells) + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run("sensitivity", main))
