"""Measures environment steps of two PSMs over tissue, as arms move at random and as they go into it.

On a CPU time is that of its cores, whatever else runs. On a GPU each stage of a step is timed too, one after the other.

Run: python -m docs.studies.tissue_speed --num-envs 16384 --device cuda
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from functools import partial
from typing import Any

import numpy as np

from docs.studies.command import make_parser, run
from surgical_marl.engines.fused.engine import FusedEngine
from surgical_marl.engines.fused.kernel_layout import Stage
from surgical_marl.envs.env import Env

HELD, SETTLE = 25, 80
"""Control steps for which arms that go into tissue hold an action, and those before anything is timed."""
MOTIONS = ("random", "into it")


def actions_of(motion: str, env: Env, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return random actions; into tissue instruments go straight down, but for a little, and jaws open or close."""
    found = {}
    for agent, mount in env.scene.mounts.items():
        own = rng.uniform(-1, 1, (count, len(mount.arm.actuated))).astype(np.float32)
        if motion == "into it":
            jaw, own = np.sign(own[:, -1]), 0.1 * own
            own[:, 2], own[:, -1] = 1.0, jaw
        found[agent] = own
    return found


def waited(device: str) -> float:
    """Return the time, s, once the device has done all its work: on a CPU that of this process on all cores."""
    if device == "cpu":
        return time.process_time()
    import torch

    torch.cuda.synchronize()
    return time.perf_counter()


def measured(engine: Any, drawn: list[Any], hold: int, steps: int) -> tuple[float, float]:
    """Return environment steps/s, and the share of environments in which something touches the tissue."""
    start = waited(engine.device)
    for k in range(steps):
        engine.step(drawn[k // hold % len(drawn)])
    rate, name = steps * engine.num_envs / (waited(engine.device) - start), next(iter(engine.env.scene.systems))
    return rate, float((engine.read(f".physics.{name}.force", "numpy") > 0).mean())


def settled(engine: Any, drawn: list[Any], motion: str, rng: np.random.Generator) -> None:
    """Bring episodes to times like those of a training: at random all, into tissue none that ends meanwhile."""
    engine.reset(seed=0)
    if motion == "random":
        engine.write(".steps", rng.integers(0, engine.env.max_steps, engine.num_envs, dtype=np.int32))
    measured(engine, drawn, 1 if motion == "random" else HELD, SETTLE)


def stage_times(engine: Any, actions: Any, steps: int) -> dict[str, float]:
    """Return what each stage takes of a control step, s, by its name: all calls together."""
    spent: dict[str, float] = defaultdict(float)
    plain = engine._run

    def timed(stages: list[Stage], sense: Any) -> None:
        for stage in stages:
            if stage.kind == "loop":
                for _ in range(stage.length):
                    timed(stage.stages, sense)
                continue
            start = waited(engine.device)
            plain([stage], sense)
            spent[f"{stage.kind} {stage.name}".strip()] += (waited(engine.device) - start) / steps

    engine._run = timed
    for _ in range(steps):
        engine.step(actions)
    engine._run = plain
    return spent


def report(scene: str, count: int, device: str, steps: int) -> int:
    """Print tables."""
    start, env = time.perf_counter(), Env("reach", scene)
    engine, rng = FusedEngine(env, count, device), np.random.default_rng(0)
    print(f"{count} environments on {device}, compiled in {time.perf_counter() - start:.1f} s")
    of = "a core" if device == "cpu" else "the GPU"
    stages: dict[str, dict[str, float]] = {}
    print(f"\n| motion | environment steps/s of {of} | tissue touched in |\n|---|---|---|")
    for motion in MOTIONS:
        drawn: list[Any] = [actions_of(motion, env, count, rng) for _ in range(64 if motion == "random" else 4)]
        if device == "cuda":
            import torch

            drawn = [{name: torch.from_numpy(own).cuda() for name, own in one.items()} for one in drawn]
        settled(engine, drawn, motion, rng)
        rate, touched = measured(engine, drawn, 1 if motion == "random" else HELD, steps)
        print(f"| {motion} | {rate:,.0f} | {touched:.0%} |", flush=True)
        if device == "cuda":
            stages[motion] = stage_times(engine, drawn[0], 10)
    if stages:
        print("\n| stage, ms of a control step |", " | ".join(stages), "|")
        print("|---" * (1 + len(stages)) + "|")
        for name in stages[MOTIONS[0]]:
            print(f"| {name} |", " | ".join(f"{1e3 * one[name]:.3f}" for one in stages.values()), "|")
    engine.close()
    return 0


def main(argv: list[str] | None = None) -> int:
    """Measure, and print tables."""
    parser = make_parser(__doc__)
    parser.add_argument("--scene", default="bimanual_psm_tissue")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--steps", type=int, default=50)
    a = parser.parse_args(argv)
    return run("tissue_speed", partial(report, a.scene, a.num_envs, a.device, a.steps))


if __name__ == "__main__":
    sys.exit(main())
