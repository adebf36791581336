"""Measure the throughput of the engines, of C MuJoCo and of MuJoCo Warp, in physics and environment steps.

    speeds, left_out = measure(Workload("reach", "psm", num_envs=4096), ("fused", "mjx", "mujoco"))
    speeds["fused"].physics_steps_per_s / speeds["mujoco"].physics_steps_per_s

docs/benchmarks.md says what is timed, and how.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from surgical_marl import machine
from surgical_marl.bench import clock
from surgical_marl.bench.course import Course, make_course
from surgical_marl.bench.engines import ENGINES, prepare
from surgical_marl.bench.other_simulators import MOST_ROLLED, Contender
from surgical_marl.bench.workload import Workload
from surgical_marl.engines.choose import DeviceName
from surgical_marl.runs.progress import say
from surgical_marl.scenes.timing import TIMESTEP

SWEEP = tuple(4**k for k in range(12))
"""Environments of a sweep: 1 to 4 million."""
LEFT_OUT = (("mujoco", "cuda"), ("mujoco_warp", "cpu"))
"""Not in a sweep: C MuJoCo runs on a CPU alone, and MuJoCo Warp is made for GPUs."""
LONGEST = 10.0
"""Seconds that a step may take in a sweep."""


@dataclass(frozen=True)
class Speed:
    """Speed of an engine."""

    physics_steps_per_s: float
    env_steps_per_s: float | None
    """Steps of the task: observation, reward and reset included. None for other simulators, which have no tasks."""
    simulated_s_per_s: float
    """Simulated time of all environments together, by environment steps where there are any."""
    num_envs: int
    engine: str
    device: str
    """"cpu" or "cuda"."""
    dt: float
    """Physics step, s."""
    decimation: int
    """Physics steps an environment step."""
    compile_s: float
    """Time from imported packages to the end of the first step, s."""


def measure(
    workload: Workload,
    engines: Sequence[str] = ENGINES,
    course: Course | None = None,
    seconds: float = clock.SECONDS,
    repeats: int = clock.REPEATS,
) -> tuple[dict[str, Speed], dict[str, str]]:
    """Return speeds by engine, and for each engine that is left out the reason.

    Raises:
        ValueError: the one engine asked for can't run here, or has no room.
    """
    contenders, left_out = _contenders(workload, engines, course or make_course(workload))
    if not contenders:
        raise ValueError("; ".join(left_out.values()))
    for name, why in left_out.items():
        say(f"{name} is left out: {why}")
    return _time(workload, contenders, seconds, repeats), left_out


def _contenders(
    workload: Workload, engines: Sequence[str], course: Course
) -> tuple[dict[str, Contender], dict[str, str]]:
    contenders, left_out = {}, {}
    for name in engines:
        try:
            contenders[name] = prepare(name, workload, course)
        except (ValueError, MemoryError) as error:
            left_out[name] = str(error)
    return contenders, left_out


def _time(workload: Workload, contenders: dict[str, Contender], seconds: float, repeats: int) -> dict[str, Speed]:
    clocks = {f"{name} physics": contender.physics for name, contender in contenders.items()}
    clocks |= {f"{name} env": contender.env for name, contender in contenders.items() if contender.env}
    took = clock.race(clocks, seconds, repeats)
    speeds = {}
    for name, contender in contenders.items():
        physics = contender.num_envs * contender.stride / took[f"{name} physics"]
        env = contender.num_envs / took[f"{name} env"] if contender.env else None
        speeds[name] = Speed(
            physics_steps_per_s=physics,
            env_steps_per_s=env,
            simulated_s_per_s=TIMESTEP * (env * workload.decimation if env else physics),
            num_envs=contender.num_envs,
            engine=name,
            device=contender.device,
            dt=TIMESTEP,
            decimation=workload.decimation,
            compile_s=contender.compile_s,
        )
    return speeds


class Point(NamedTuple):
    """A point of a sweep."""

    speed: Speed
    bytes_per_env: int | None
    """Bytes of the arrays of the fused engine's kernel; None for other engines."""


def sweep(
    workload: Workload,
    engines: Sequence[str] = ENGINES,
    counts: Sequence[int] = SWEEP,
    seconds: float = clock.SECONDS,
    repeats: int = 3,
) -> Iterator[Point]:
    """Yield speeds against the number of environments, on every device of this machine or on one.

    An engine ends where the next number has no room or would take too long a step, and says so.
    """
    course = make_course(workload)
    devices: list[DeviceName] = [workload.where]
    if workload.device == "auto" and workload.where == "cuda":
        devices.append("cpu")
    for device in devices:
        for name in engines:
            if (name, device) not in LEFT_OUT:
                yield from _sweep_one(name, replace(workload, device=device), course, counts, seconds, repeats)


def _sweep_one(
    name: str, workload: Workload, course: Course, counts: Sequence[int], seconds: float, repeats: int
) -> Iterator[Point]:
    where = f"{name} on {workload.where}"
    for count, following in zip(counts, [*counts[1:], None], strict=True):
        say(f"{where}, {count} environments")
        had, sized = machine.restart_peak(), replace(workload, num_envs=count)
        contenders, left_out = _contenders(sized, (name,), course)
        if left_out:
            return say(f"{where} ends before {count} environments: {left_out[name]}")
        speed = _time(sized, contenders, seconds, repeats)[name]
        used = machine.peak() - had
        yield Point(speed, contenders.pop(name).bytes_per_env)
        if following is None:
            return
        growth = following / count
        if name == "mujoco" and following > MOST_ROLLED:
            why = "it steps one after the other, so more make it no faster"
        elif workload.where == "cpu" and used * growth > machine.free():
            why = f"there is no memory for {following}"
        elif growth * count / (speed.env_steps_per_s or speed.physics_steps_per_s) > LONGEST:
            why = f"a step of {following} would take more than {LONGEST:.0f} s"
        else:
            continue
        say(f"{where} ends at {count} environments: {why}")
        return
