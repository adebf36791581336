"""What forces a grip bears, and what stops a finger."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import surgical_marl as sm
from docs.studies.shaking import CLOSING, Grasps
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.systems import rigid_bodies
from tests.helpers.commands import commander

STEPS = 240
FRICTIONS = (0.12, 0.18, 0.25)
"""With more friction the arm, which bears 9.9 N along its shaft, would give way before the grip does."""


BALL = """
description: a ball
free: true
mass: 0.001
friction: {sliding: 0.8, torsion: 0.002}
stiffness: 1.0e+6
colour: [0.5, 0.5, 0.5]
shapes:
  - sphere: {radius: 0.0005, position: [0.0, 0.0, 0.0]}
sites:
  grasp: {position: [0.0, 0.0, 0.0]}
"""


@pytest.mark.slow
def test_a_held_object_breaks_away_at_the_force_that_coulomb_says(tmp_path: Path) -> None:
    """Balls in grips of three frictions are pulled out of the jaw, harder and harder. The pads lean outwards."""
    (tmp_path / "ball.yaml").write_text(BALL)
    jaw, each = Grasps([str(tmp_path / "ball.yaml")]), 3
    held, mu = np.zeros(3 * each, int), np.repeat(FRICTIONS, each)
    assert jaw.simulator.step.bodies
    tables = jaw.simulator.step.bodies.tables
    mass, fingers, pads = float(tables.masses.mass[0]), tables.bodies["pads"], tables.pad_geoms
    physics, _ = jaw.play(jaw.begin(held, seed=3), jaw.still(len(held), CLOSING), held)

    def frame(physics: Any) -> tuple[Any, Any, Any]:
        """Return the way out of the jaw, how far out the object is, and how far the pads' normals point that way."""
        data = jaw.simulator.step.arms.dynamics.pose(physics.qpos)
        out = -data.xmat[fingers][:, :, 2].sum(0)
        out /= jnp.linalg.norm(out)
        lean = jnp.abs(data.geom_xmat[pads][:, :, 0] @ out)  # they are thinnest in x
        return out, out @ (physics.rigid_bodies.bodies.position[0] - data.xpos[fingers].mean(0)), lean

    def pull(physics: Any, mu: Any) -> Any:
        out, _, _ = frame(physics)

        def step(physics: Any, force: Any) -> Any:
            sliding = jnp.full(len(tables.sliding), mu)
            with patch.object(rigid_bodies, "GRAVITY", out * force / mass), patch.object(tables, "sliding", sliding):
                physics, _ = jaw.simulator.step(physics, jaw.simulator.untouched)
            return physics, (*frame(physics)[1:], physics.rigid_bodies.grips.force[0])

        return jax.lax.scan(step, physics, 60 * mu * jnp.arange(STEPS) / STEPS)[1]

    way, lean, normal = (np.asarray(x, float) for x in jax.jit(jax.vmap(pull))(physics, jnp.float32(mu)))
    for e, friction in enumerate(mu):
        loose = int(np.argmax(way[e] > way[e, 0] + 1e-4))
        assert loose > 0, "it is held for ever"
        found = 60 * friction * loose / STEPS
        coulomb = normal[e, 0] @ (friction * np.sqrt(1 - lean[e, 0] ** 2) - lean[e, 0])
        assert abs(found / coulomb - 1) < 0.15, (friction, found, coulomb)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "place", "most"), [("pad", (0.0, 0.0), 5e-4), ("peg_board_icra2026", (-0.02, 0.0), 1e-4)]
)
def test_a_finger_pressed_on_something_stops_there(
    tmp_path: Path, name: str, place: tuple[float, float], most: float
) -> None:
    """The arm moves down at its full speed and goes on pressing with full effort."""
    thing = f"{{object: {name}, position: [{place[0]}, {place[1]}, 0.02]}}"
    needle = "{object: needle_sh, position: [0.0, 1.0, 0.0]}"
    text = f"arms:\n  psm_0: {{arm: psm, position: [0.0, 0.0, 0.15]}}\nobjects:\n  thing: {thing}\n  needle: {needle}\n"
    (tmp_path / "pressing.yaml").write_text(text)
    simulator = Simulator(sm.load_scene(tmp_path / "pressing.yaml"))
    objects, scene = simulator.step.bodies, simulator.scene
    assert objects
    on_arm = np.flatnonzero(objects.tables.owner < objects.tables.arms)
    joints = [joint.name for joint in scene.mounts["psm_0"].arm.actuated]
    down = jnp.zeros(len(joints)).at[joints.index("insertion")].set(1.0).at[-1].set(-1.0)

    command = commander(simulator)

    def step(physics: Any, _: None) -> Any:
        physics, _, views = simulator.advance(command(physics, {"psm_0": down}))
        return physics, (
            simulator.step.depths(physics)[on_arm].max(),
            views["psm_0"].bump_force,
            jnp.abs(physics.qvel).max(),
        )

    _, (depth, force, speed) = jax.jit(lambda physics: jax.lax.scan(step, physics, None, length=75))(simulator.home)
    assert depth.max() < most and force[-1] > 4 and speed[-1] < 1e-2, (depth.max(), force[-1], speed[-1])


def test_a_grip_is_no_bump() -> None:
    """The force of a finger on a needle counts in `contact_force` alone, that of another part of the arm in both."""
    step = Simulator(sm.load_scene("psm_needle")).step
    assert step.bodies
    tables = step.bodies.tables
    ours = tables.owner < tables.arms
    bump = int(np.flatnonzero(ours & (tables.finger == len(tables.fingers)))[0])
    number = jnp.array([tables.grip[0, 0], tables.grip[0, 1], bump])
    for total, expected in ((2, [[20.0], [0.0]]), (3, [[20.0], [3.0]])):
        slots: Any = SimpleNamespace(number=number, total=total)
        pressed: Any = SimpleNamespace(normal=jnp.array([20.0, 19.0, 3.0]))
        np.testing.assert_array_equal(step._hardest(slots, pressed), expected)
