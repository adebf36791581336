"""Measures what each pass of the fused engine's compiler saves: kernels without it take turns with those that have all.

Run: python -m docs.studies.passes --scene bimanual_psm_needle --task needle_handover --motion grasp
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from docs.studies.command import make_parser
from surgical_marl.bench.clock import race
from surgical_marl.bench.course import make_course, tile
from surgical_marl.bench.engines import clock_of
from surgical_marl.bench.workload import Workload
from surgical_marl.engines.fused.options import PASSES
from surgical_marl.engines.fused.pipeline import CSE
from surgical_marl.engines.fused.pipeline import PASSES as ALL
from surgical_marl.envs.batch import BatchedEnv


def on_device(values: np.ndarray, workload: Workload) -> Any:
    """Return values of each environment of a course, repeated for all, as an array of the device."""
    tiled = tile(values, workload.count)
    if workload.where == "cpu":
        return tiled
    import torch

    return torch.from_numpy(tiled).cuda()


def batch_without(name: str, variable: str, workload: Workload) -> BatchedEnv:
    """Return environments that are compiled without what a variable names; "" is for none."""
    os.environ[variable] = f"-{name}" if name else ""
    print(f"compiling {workload.scene} without {name or 'none'}", file=sys.stderr, flush=True)
    arrays: Any = "torch" if workload.where == "cuda" else "numpy"
    given = workload.of_environment()
    return BatchedEnv(**given, num_envs=workload.count, engine="fused", device=workload.where, arrays=arrays)


def compile_all(names: Sequence[str], variable: str, workload: Workload, processes: int) -> None:
    """Compile kernels without each of the names in turn into the caches, by several processes side by side."""
    if processes > 1:
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # otherwise one takes most of a GPU's memory
        with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
            list(pool.map(partial(_compile, variable=variable, workload=workload), names))


def _compile(name: str, variable: str, workload: Workload) -> None:
    batch_without(name, variable, workload).close()


def begin(batch: BatchedEnv, start: dict[str, Any]) -> None:
    """Put environments to the start of a course: parts of the state by their paths."""
    for path, values in start.items():
        batch.engine.write(path, values)


def passes_on(target: str) -> list[str]:
    """Return the passes that can be left out for "cpu" or "cuda"."""
    return [CSE, *(one.name for one in ALL if not one.required and one.target in ("", target))]


def measure(
    workload: Workload, names: Sequence[str], repeats: int, variable: str = PASSES, processes: int = 1
) -> dict[str, float]:
    """Return how much longer an environment step takes without each pass, as a share of the step with all.

    An environment `variable` switches off what `names` are of: passes, or skips of the physics. So many `processes`
    compile, and one times.
    """
    compile_all(("", *names), variable, workload, processes)
    os.environ[variable] = ""
    course = make_course(workload)
    actions = [{agent: on_device(rows, workload) for agent, rows in lap.items()} for lap in course.actions]
    start = {path: on_device(values, workload) for path, values in course.parts.items()}
    clocks = {}
    for name in ("", *names):
        batch = batch_without(name, variable, workload)
        batch.reset(seed=0)
        begin(batch, start)
        steps = np.random.default_rng(0).integers(0, batch.max_steps, workload.distinct, dtype=np.int32)
        batch.steps = on_device(steps, workload)  # otherwise all episodes would end in the same step
        clocks[name] = clock_of(batch, actions, partial(begin, batch, start) if workload.motion == "grasp" else None)
    took = race(clocks, repeats=repeats)
    return {name: took[name] / took[""] - 1 for name in names}


def main(argv: list[str] | None = None) -> None:
    """Print a row for each pass."""
    a, workload = parsed(__doc__, argv)
    names = a.only or passes_on(workload.where)
    report("pass", measure(workload, names, a.repeats, processes=a.processes), workload)


def report(noun: str, found: dict[str, float], workload: Workload) -> None:
    """Print a table of what was measured."""
    print(f"| {noun} | more time without it, `{workload.scene}` on {workload.where} |\n|---|---|")
    for name, more in found.items():
        print(f"| `{name}` | {more:+.1%} |")


def parsed(about: str | None, argv: list[str] | None) -> tuple[Any, Workload]:
    """Return the options of the command line, and the workload that they name."""
    parser = make_parser(about)
    parser.add_argument("--scene", default="psm")
    parser.add_argument("--task", default="reach")
    parser.add_argument("--motion", default="random")
    parser.add_argument("--num-envs", type=int)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--processes", type=int, default=1, help="compile so many kernels side by side (%(default)s)")
    parser.add_argument("--only", nargs="*", help="names (default: all)")
    a = parser.parse_args(argv)
    workload = Workload(task=a.task, scene=a.scene, motion=a.motion, num_envs=a.num_envs, device=a.device, decimation=8)
    return a, workload


if __name__ == "__main__":
    main()
