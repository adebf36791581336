"""Times a thread and a sheet of tissue in this package, C MuJoCo, MuJoCo Warp and, if it is installed, Newton.

    python -m docs.studies.soft_simulators                          # on the CPU
    python -m docs.studies.soft_simulators --device cuda --num-envs 16384

All step the same thing by 2.5 ms: 80 mm of nylon of 0.22 mm, 40 nodes, clamped at one end; or a sheet of 60 x 40 x 5 mm
of 12 x 8 x 1 cells, held at its rim, under a tenth of its weight. Here an endoscope stands beside it, and the thread is
tied, not clamped. The others step the thing alone, without contacts. A row has the physics steps/s and how far the
thing hangs down after a second, beside the elastica and a converged mesh. Tests measure that of this package.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import yaml
from mujoco import rollout

from docs.studies.command import make_parser, run
from surgical_marl.bench.clock import Clock, cpu_clock, cuda_clock, race
from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.cli.flags import whole
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.env import Env
from surgical_marl.machine import cores
from surgical_marl.physics import skip
from surgical_marl.runtime import prepare_mjx, prepare_warp

DT, STEPS = 0.0025, 8
"""Duration of a physics step, s, and physics steps that are timed as one."""
LENGTH, DIAMETER, NODES, NYLON = 0.08, 0.00022, 40, (2e9, 0.3, 1140.0)
SIZE, CELLS, TISSUE = (0.06, 0.04, 0.005), (12, 8, 1), (27040.0, 0.4287, 1000.0)
"""Young's modulus in Pa, Poisson's ratio, density in kg/m3."""
WEIGHT = {"thread": -9.81, "tissue": -0.981}
"""Gravity along z, m/s2."""
HANGS = {"thread": 9.36, "tissue": 0.0976}
"""Droop of the thread's end by the elastica, and of the sheet by a converged mesh (docs/tissue.md), mm."""
SETTLES = 0.05
"""Damping of the others' thread, as a share of its bending stiffness, s: about critical, so that it hangs still."""
MOST_ROLLED = 256
"""Environments for which C MuJoCo gets memory; more are not faster."""


class Timed(NamedTuple):
    """An engine that is ready."""

    clock: Clock
    steps: int
    """Physics steps of all environments that the clock counts as one."""
    droop: Callable[[], float] | None
    """Return how far the thing hangs down after a second, mm."""


def fused(what: str, count: int, device: str) -> Timed:
    """Return this package's fused engine."""
    item: dict[str, Any] = {"position": [0.05, 0.0, 0.05]}
    if what == "thread":
        item |= {"object": "thread", "tied": {"first": "world"}}
        about: dict[str, Any] = {"length": LENGTH, "diameter": DIAMETER, "material": "nylon", "nodes": NODES}
    else:
        item |= {"object": "tissue"}
        young, poisson, density = TISSUE
        about = {"size": [*SIZE], "cells": [*CELLS], "young": young, "poisson": poisson, "density": density}
        about |= {"fixed": ["left", "right", "front", "back"]}
    arms = {"ecm_0": {"arm": "ecm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.12]}}
    os.environ[skip.VARIABLE] = "-sleeping"  # the others move what hangs still, too
    with tempfile.TemporaryDirectory() as folder:
        own, scene = Path(folder) / "own.yaml", Path(folder) / "scene.yaml"
        about |= {"kind": what, "friction": {"sliding": 0.3, "torsion": 0.0}, "stiffness": 5e3}
        own.write_text(yaml.safe_dump(about), "utf-8")
        scene.write_text(yaml.safe_dump({"arms": arms, "objects": {"soft": {**item, "object": str(own)}}}), "utf-8")
        engine = make_engine(PhysicsAlone(Env("reach", str(scene)), STEPS), count, "fused", device)
    engine.reset(0)

    def step() -> None:
        engine.step({})

    step()
    clock = cuda_clock(step, 1) if device == "cuda" else cpu_clock(step)
    return Timed(clock, STEPS * count, None)


def c_mujoco(what: str, count: int, device: str) -> Timed:
    """Return C MuJoCo with a thread on every core: its cable, whose elasticity is a plugin, or its flex."""
    del device
    model, threads = mujoco.MjModel.from_xml_string(xml(what)), cores()
    mujoco.set_mju_user_warning(lambda _: None)  # in each step: its solve ends with a residual of 6e-8
    count = min(count, MOST_ROLLED)
    data, pool = [mujoco.MjData(model) for _ in range(threads)], rollout.Rollout(nthread=threads)
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros(size)
    mujoco.mj_getState(model, data[0], state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    begin, out = np.tile(state, (count, 1)), np.empty((count, STEPS, size))

    def lap() -> None:
        pool.rollout(model, data, begin, nstep=STEPS, state=out)

    def droop() -> float:
        for _ in range(round(1 / DT)):
            mujoco.mj_step(model, data[0])
        mujoco.mj_kinematics(model, data[0])
        mujoco.mj_flex(model, data[0])
        return hangs(what, _end_of_cable(model, data[0]) if what == "thread" else data[0].flexvert_xpos)

    return Timed(cpu_clock(lap), STEPS * count, droop)


def mujoco_warp(what: str, count: int, device: str) -> Timed:
    """Return MuJoCo Warp.

    Raises:
        NotImplementedError: it has no plugins, as a cable's elasticity is.
    """
    prepare_mjx()
    wp = prepare_warp()
    import mujoco_warp as mjw

    model = mujoco.MjModel.from_xml_string(xml(what))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with wp.ScopedDevice(device):
        m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=count)
        mjw.step(m, d)
        step: Callable[[], Any] = lambda: mjw.step(m, d)  # noqa: E731
        if device == "cuda":
            with wp.ScopedCapture() as capture:
                mjw.step(m, d)
            step = lambda: wp.capture_launch(capture.graph)  # noqa: E731

    def go() -> None:
        with wp.ScopedDevice(device):
            step()

    def droop() -> float:
        begin = mjw.put_data(model, data, nworld=1)
        for _ in range(round(1 / DT)):
            mjw.step(m, begin)
        return hangs(what, begin.flexvert_xpos.numpy()[0])

    return Timed(cpu_clock(go, wp.synchronize), count, droop)


def newton(what: str, count: int, device: str, iterations: int) -> Timed:
    """Return Newton's VBD with so many iterations a step: its rod or its grid of tetrahedra."""
    import newton as nt
    import warp as wp

    builder = nt.ModelBuilder(gravity=(0.0, 0.0, WEIGHT[what]))
    builder.replicate(_newton_rod(nt, wp) if what == "thread" else _newton_grid(nt, wp), count)
    builder.color()
    with wp.ScopedDevice(device):
        model = builder.finalize()
        solver = nt.solvers.SolverVBD(
            model, iterations=iterations, rigid_compliant_alm=True, particle_enable_tile_solve=False
        )
        states, control = [model.state(), model.state()], model.control()

        def two() -> None:
            for now, after in (states, states[::-1]):
                now.clear_forces()
                solver.step(now, after, control, None, DT)

        two()
        step: Callable[[], Any] = two
        if device == "cuda":
            with wp.ScopedCapture() as capture:
                two()
            step = lambda: wp.capture_launch(capture.graph)  # noqa: E731

    def go() -> None:
        with wp.ScopedDevice(device):
            step()

    def droop() -> float:
        for _ in range(round(1 / DT / 2)):
            go()
        where = states[0].particle_q if what == "tissue" else states[0].body_q
        return hangs(what, where.numpy()[:, :3])

    return Timed(cpu_clock(go, wp.synchronize), 2 * count, droop)


def _newton_rod(nt: Any, wp: Any) -> Any:
    (young, poisson, density), parts = NYLON, NODES - 1
    one = nt.ModelBuilder(gravity=(0.0, 0.0, WEIGHT["thread"]))
    points = nt.utils.cable_straight_points(
        start=wp.vec3(0.0, 0.0, 0.0), direction=wp.vec3(1.0, 0.0, 0.0), length=LENGTH, num_segments=parts
    )
    stretch, bend, twist = nt.utils.rod_stiffness_from_elastic_moduli(
        young, DIAMETER / 2, LENGTH / parts, poissons_ratio=poisson
    )
    bodies, _ = one.add_rod(
        positions=points, radius=DIAMETER / 2, cfg=nt.ModelBuilder.ShapeConfig(density=density),
        stretch_stiffness=stretch, bend_stiffness=bend, bend_damping=SETTLES * bend, twist_stiffness=twist,
        twist_damping=SETTLES * twist, body_frame_origin="com",
    )  # fmt: skip
    first = bodies[0]  # without mass a body does not move
    one.body_mass[first] = one.body_inv_mass[first] = 0.0
    one.body_inertia[first] = one.body_inv_inertia[first] = wp.mat33(0.0)
    return one


def _newton_grid(nt: Any, wp: Any) -> Any:
    (young, poisson, density), (x, y, z) = TISSUE, (s / c for s, c in zip(SIZE, CELLS, strict=True))
    one = nt.ModelBuilder(gravity=(0.0, 0.0, WEIGHT["tissue"]))
    one.add_soft_grid(
        pos=wp.vec3(0.0, 0.0, 0.0), rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, 0.0), density=density,
        dim_x=CELLS[0], dim_y=CELLS[1], dim_z=CELLS[2], cell_x=x, cell_y=y, cell_z=z, k_damp=0.0,
        k_mu=young / 2 / (1 + poisson), k_lambda=young * poisson / (1 + poisson) / (1 - 2 * poisson),
        particle_radius=DIAMETER,
    )  # fmt: skip
    places = np.array([tuple(place) for place in one.particle_q])[:, :2]
    for held in np.flatnonzero((np.minimum(places, np.array(SIZE[:2]) - places) < 1e-6).any(1)):
        one.particle_mass[held] = 0.0
    return one


def xml(what: str) -> str:
    """Return MuJoCo's model of the thread or the tissue."""
    if what == "thread":
        (young, poisson, density), parts = NYLON, NODES - 1
        bends = young * np.pi * DIAMETER**4 / 64 / (LENGTH / parts)
        # a segment of thread has less inertia than MuJoCo takes for a body
        return f"""<mujoco><compiler boundinertia="6e-14"/>
<option timestep="{DT}" integrator="implicitfast" gravity="0 0 {WEIGHT[what]}"><flag contact="disable"/></option>
<extension><plugin plugin="mujoco.elasticity.cable"/></extension><worldbody>
<composite type="cable" curve="s" count="{NODES} 1 1" size="{LENGTH}" initial="none" prefix="thread">
<plugin plugin="mujoco.elasticity.cable"><config key="bend" value="{young}"/>
<config key="twist" value="{young / 2 / (1 + poisson)}"/></plugin>
<joint kind="main" damping="{SETTLES * bends}" armature="0"/>
<geom type="capsule" size="{DIAMETER / 2}" density="{density}"/></composite></worldbody></mujoco>"""
    (young, poisson, density), counts = TISSUE, [c + 1 for c in CELLS]
    x, y, z = (s / c for s, c in zip(SIZE, CELLS, strict=True))
    inside = [range(1, count - 1) for count in counts[:2]]
    held = [
        str((i * counts[1] + j) * counts[2] + k)
        for i, j, k in product(*map(range, counts))
        if i not in inside[0] or j not in inside[1]
    ]
    return f"""<mujoco><option timestep="{DT}" integrator="discrete" gravity="0 0 {WEIGHT[what]}">
<flag contact="disable"/></option><worldbody>
<flexcomp name="sheet" type="grid" dim="3" count="{counts[0]} {counts[1]} {counts[2]}" spacing="{x} {y} {z}"
radius="1e-4" mass="{density * np.prod(SIZE)}"><elasticity young="{young}" poisson="{poisson}" damping="0.002"/>
<pin id="{" ".join(held)}"/><contact selfcollide="none"/></flexcomp></worldbody></mujoco>"""


def _end_of_cable(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return where the middles of segments and the free end are, m, [n + 1, 3]."""
    last = data.geom_xpos[-1] + model.geom_size[-1, 1] * data.geom_xmat[-1].reshape(3, 3)[:, 2]
    return np.vstack([data.geom_xpos, last])


def hangs(what: str, places: np.ndarray) -> float:
    """Return how far the lowest of these places is below where it began, mm."""
    lowest = places[:, 2].min()
    begin = 0.0 if what == "thread" else places[:, 2].max() - SIZE[2]  # the rim stays where it is
    return float(1e3 * (begin - lowest))


def engines(device: str, iterations: list[int]) -> dict[str, Callable[[str, int], Timed]]:
    """Return the functions that prepare each engine, by the names of rows."""
    found: dict[str, Callable[[str, int], Timed]] = {
        "fused": lambda what, count: fused(what, count, device),
        "C MuJoCo": lambda what, count: c_mujoco(what, count, device),
    }
    if device == "cuda":
        found["MuJoCo Warp"] = lambda what, count: mujoco_warp(what, count, device)
    if importlib.util.find_spec("newton"):
        for n in iterations:
            found[f"Newton, VBD, {n} iterations"] = partial(newton, device=device, iterations=n)
    return found


def rows(what: str, count: int, arguments: argparse.Namespace) -> list[str]:
    """Return a row of the table for each engine; those that can't run are named on stderr."""
    ready: dict[str, Timed] = {}
    for name, prepare in engines(arguments.device, arguments.iterations).items():
        try:
            ready[name] = prepare(what, count)
        except (NotImplementedError, ValueError) as error:
            print(f"{name}, {what}: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
    took = race({name: timed.clock for name, timed in ready.items()}, repeats=3)
    found = []
    for name, timed in ready.items():
        droop = f"{timed.droop():.3g} mm" if timed.droop else "its tests"
        found.append(f"| {what} | {name} | {timed.steps / took[name]:,.0f} | {droop} | {HANGS[what]} mm |")
    return found


def main(argv: list[str] | None = None) -> int:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--num-envs", type=whole(1), default=256, metavar="N", help="(%(default)s)")
    parser.add_argument("--iterations", type=whole(1), nargs="+", default=[10, 40], help="of VBD (%(default)s)")
    parser.add_argument("--only", choices=HANGS, nargs="+", default=list(HANGS))
    arguments = parser.parse_args(argv)
    print("| thing | engine | physics steps/s | hangs down | reference |\n" + "|---" * 5 + "|")
    for what in arguments.only:
        print("\n".join(rows(what, arguments.num_envs, arguments)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run("soft_simulators", main))
