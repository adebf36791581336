"""Results of `bench sim` as a table, as JSON and as a picture."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from surgical_marl.bench.course import Course, make_course
from surgical_marl.bench.sim import SWEEP, Point, Speed, measure, sweep
from surgical_marl.bench.workload import Workload
from surgical_marl.evaluation.report import aligned
from surgical_marl.files import write_atomic
from surgical_marl.machine import describe_machine, machine
from surgical_marl.plugins.task_file import label

QUOTED = {
    "SurRoL": 4_124,
    "dVRL": 473,
    "LapGym": 461,
    "UnityFlexML": 56,
    "UnityFlexML, nothing deformable": 156,
    "Surgical Gym": 344_828,
}
"""Steps/s from Table I of Schmidgall et al., "Surgical Gym", 2023, arXiv:2310.04676. Surgical Gym: 20,000 environments
on an 8 GB Quadro RTX 4000."""

NAMES = {"fused": "fused engine", "mjx": "MJX engine", "mujoco": "C MuJoCo", "mujoco_warp": "MuJoCo Warp"}
_COLORS = {"fused": "#1f6f8b", "mjx": "#b23a48", "mujoco": "#7a7a7a", "mujoco_warp": "#6a994e"}


def run(
    workload: Workload, engines: Sequence[str], sweeping: bool = False, as_json: bool = False, out: Path | None = None
) -> str:
    """Run `surgical-marl bench sim`; return the text of its table, or JSON."""
    if sweeping:
        counts = [count for count in SWEEP if count <= (workload.num_envs or SWEEP[-1])]
        points, title = [], f"{label(workload.task)} on {workload.scene}; {describe_machine()}"
        for point in sweep(workload, engines, counts):
            points.append(point)
            if out:  # anew with each: a sweep takes minutes, and may be stopped
                draw(points, title, out)
        if not points:
            raise ValueError(f"nothing to show: {', '.join(engines)} can't run here")
        return json.dumps(sweep_summary(workload, points)) if as_json else sweep_table(points)
    course = make_course(workload)
    speeds, left_out = measure(workload, engines, course)
    if as_json and len(engines) == 1:
        return json.dumps(asdict(speeds[engines[0]]))
    found = summary(workload, course, speeds, left_out)
    return json.dumps(found) if as_json else table(found)


def ratios(speeds: Mapping[str, Speed]) -> dict[str, dict[str, float]]:
    """Return the speed of the fused engine over that of each other one, as {"physics": {"mujoco": ...}, "env": ...}."""
    found: dict[str, dict[str, float]] = {"physics": {}, "env": {}}
    fused = speeds.get("fused")
    for name, speed in speeds.items():
        if fused and name != "fused":
            found["physics"][name] = fused.physics_steps_per_s / speed.physics_steps_per_s
            if fused.env_steps_per_s and speed.env_steps_per_s:
                found["env"][name] = fused.env_steps_per_s / speed.env_steps_per_s
    return found


def summary(
    workload: Workload, course: Course, speeds: Mapping[str, Speed], left_out: Mapping[str, str]
) -> dict[str, Any]:
    """Return the results of a run that times several engines, for JSON."""
    return {
        "task": workload.task,
        "scene": workload.scene,
        **machine(),
        "motion": workload.motion,
        "touching": course.touching,
        "engines": [asdict(speed) for speed in speeds.values()],
        "left_out": dict(left_out),
        "ratios": ratios(speeds),
        "quoted": QUOTED,
    }


def sweep_summary(workload: Workload, points: Iterable[Point]) -> dict[str, Any]:
    """Return the results of a sweep in a form that JSON can hold."""
    rows = [{**asdict(point.speed), "bytes_per_env": point.bytes_per_env} for point in points]
    return {"task": workload.task, "scene": workload.scene, **machine(), "points": rows}


def table(found: Mapping[str, Any]) -> str:
    """Return a `summary` as a text table, in the form of the paper's Table I."""
    rows = [(name, "a step of its own", speed, "quoted") for name, speed in found["quoted"].items()]
    for speed in found["engines"]:
        where = f"{speed['num_envs']} envs, {speed['device']}, first step after {speed['compile_s']:.1f} s"
        kinds = (("physics step", "physics_steps_per_s"), ("environment step", "env_steps_per_s"))
        rows += [(NAMES[speed["engine"]], kind, speed[key], where) for kind, key in kinds if speed[key]]
    head = ("simulator", "what is a step", "1 M steps (s)", "steps/s", "")
    cells = [head, *((name, kind, f"{1e6 / speed:.4g}", f"{speed:,.0f}", note) for name, kind, speed, note in rows)]
    first = found["engines"][0]
    return "\n".join(
        [
            f"{found['task']} on {found['scene']}: physics steps of {1e3 * first['dt']:g} ms, "
            f"{first['decimation']} to an environment step; {found['touching']:.1%} of environments touch something",
            describe_machine(found),
            "",
            *aligned(cells),
            "",
            *(f"{NAMES[name]} is left out: {why}" for name, why in found["left_out"].items()),
            *_ratio_lines(found["ratios"]),
            "quoted: Surgical Gym's paper (arXiv:2310.04676), Table I, on its authors' hardware; not measured here.",
        ]
    )


def _ratio_lines(found: Mapping[str, Mapping[str, float]]) -> list[str]:
    names = {"physics": "physics steps", "env": "environment steps"}
    return [
        f"{names[kind]}, fused engine over {NAMES[other]}: {times:.1f}"
        for kind, others in found.items()
        for other, times in others.items()
    ]


def sweep_table(points: Iterable[Point]) -> str:
    """Return the results of a sweep as a text table for people."""
    cells = [("engine", "device", "environments", "physics steps/s", "environment steps/s", "bytes/environment")]
    for speed, size in points:
        env = f"{speed.env_steps_per_s:,.0f}" if speed.env_steps_per_s else "-"
        physics = f"{speed.physics_steps_per_s:,.0f}"
        cells.append((speed.engine, speed.device, f"{speed.num_envs:,}", physics, env, f"{size}" if size else "-"))
    return "\n".join(aligned(cells))


def draw(points: Sequence[Point], title: str, out: Path) -> None:
    """Draw the results of a sweep as a picture and write it to `out`, as PNG.

    Physics steps are solid lines, environment steps dashed ones. Filled dots are of a GPU, white ones of a CPU.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    figure = Figure(figsize=(8, 4.8), layout="constrained")
    axis = figure.subplots()
    for engine, device in dict.fromkeys((p.speed.engine, p.speed.device) for p in points):
        own = [p for p in points if (p.speed.engine, p.speed.device) == (engine, device)]
        size = f", {own[0].bytes_per_env} bytes each" if own[0].bytes_per_env else ""
        style: dict[str, Any] = {"color": _COLORS[engine], "marker": "o", "markersize": 4}
        style["markerfacecolor"] = _COLORS[engine] if device == "cuda" else "white"
        counts = [p.speed.num_envs for p in own]
        device_name = "GPU" if device == "cuda" else "CPU"
        axis.plot(counts, [p.speed.physics_steps_per_s for p in own],
                  label=f"{NAMES[engine]}, {device_name}: physics", **style)  # fmt: skip
        steps = [p.speed.env_steps_per_s for p in own if p.speed.env_steps_per_s]
        if steps:
            axis.plot(counts, steps, "--", label=f"{NAMES[engine]}, {device_name}: environment{size}", **style)
    axis.set(xscale="log", yscale="log", xlabel="environments", ylabel="steps/s")
    axis.set_title(title, fontsize=10)
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_formatter(EngFormatter(sep=""))
    axis.grid(True, which="major", color="#dddddd", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize=8, frameon=False)
    write_atomic(out, lambda path: figure.savefig(path, format="png", dpi=150))
