"""Contacts without any search: every capsule of every pair of bodies, for comparison with what `Detection` finds."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation

from surgical_marl.physics.contact.broadphase import Displacement, Placed, Places
from surgical_marl.physics.contact.contact_pairs import Meeting
from surgical_marl.physics.contact.contact_patch import TILT, TILT_IN_JAW, Patch, find_patch
from surgical_marl.physics.contact.detection import AHEAD
from surgical_marl.physics.contact.shapes import between_segments, on_plate
from surgical_marl.physics.simulator import Physics
from surgical_marl.physics.step import Step
from surgical_marl.scenes.scene import Scene

UNEVEN = 0.03
"""By which objects do not lie flat, rad: about what `find_patch` tilts them by."""


class Upright(NamedTuple):
    """Plates on which objects may lie, [p]: the fingers of jaws and what is fixed."""

    centre: np.ndarray
    frame: np.ndarray
    half: np.ndarray
    radius: np.ndarray


def lying(step: Step, states: Physics, seed: int) -> Physics:
    """Return states [n] in which each object lies about flat on a finger or on something fixed.

    Arms move in all of them, objects in half.
    """
    rng, tables, count = np.random.default_rng(seed), step.bodies.tables, len(states.qpos)
    poses = jax.jit(jax.vmap(step.arms.dynamics.pose))(states.qpos)
    centres, frames = (np.asarray(x)[:, tables.pad_geoms] for x in (poses.geom_xpos, poses.geom_xmat))
    position, turned = np.zeros((count, tables.count, 3)), np.zeros((count, tables.count, 4))
    for e in range(count):
        parts = zip(tables.plates, (centres[e], frames[e] @ tables.pad_axes, tables.pad_half, tables.pad_radius),
                    strict=True)  # fmt: skip
        plates = Upright(*(np.concatenate(part) for part in parts))
        for o in range(tables.count):
            position[e, o], turned[e, o] = _laid(step, o, plates, rng)
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    flies = rng.normal(size=(count, tables.count, 6)) * [*[0.1] * 3, *[10.0] * 3] * (rng.random((count, 1, 1)) < 0.5)
    bodies = states.rigid_bodies.bodies._replace(
        position=single(position), quaternion=single(turned), velocity=single(flies)
    )
    qvel = single(0.3 * rng.normal(size=states.qvel.shape))
    return states.with_arms(qvel=qvel).with_systems(rigid_bodies=states.rigid_bodies._replace(bodies=bodies))


def _laid(step: Step, o: int, plates: Upright, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return where an object is, and how it is turned, that lies somewhere on one of some plates."""
    tables, p = step.bodies.tables, rng.integers(len(plates.radius))
    frame, up = plates.frame[p], plates.frame[p][:, 2]
    side = Rotation.from_euler("zx", [rng.uniform(0, 2 * np.pi), rng.integers(4) * np.pi / 2])
    right_handed = Rotation.from_matrix(np.column_stack([frame[:, 0], np.cross(up, frame[:, 0]), up]))
    turn = right_handed * Rotation.from_rotvec(UNEVEN * rng.normal(size=3)) * side
    lowest = (turn.apply(np.concatenate([tables.start[o], tables.end[o]])) @ up - np.tile(tables.radius[o], 2)).min()
    beside = rng.uniform(-1.1, 1.1, 2) * np.minimum(plates.half[p], 0.06)  # of a table that ends nowhere a part
    height = plates.radius[p] - lowest + rng.uniform(-2e-4, 3e-4)
    return plates.centre[p] + frame[:, :2] @ beside + height * up, turn.as_quat(scalar_first=True)


def every_patch(step: Step, scene: Scene, states: Physics, dt: float) -> Patch:
    """Return the patches of all pairs in states [n], by numbers of pairs, [n, g]."""
    tables, places = step.bodies.tables, Places(step.bodies.tables)

    @jax.jit
    @jax.vmap
    def patches(state: Physics, ways: dict[str, Displacement]) -> Patch:
        data = step.arms.dynamics.pose(state.qpos)
        placed, found = places.place(data, places.joints(data), state.qvel, state.rigid_bodies.bodies, dt), []
        torsion = np.split(tables.torsion, np.cumsum([len(meeting.one) for meeting in tables.meetings])[:-1])
        for meeting, own in zip(tables.meetings, torsion, strict=True):
            one = lambda row, meeting=meeting: _patch(places, placed, ways, meeting, *row)  # noqa: E731
            found.append(jax.lax.map(one, (meeting.one, meeting.other, own)))
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)

    return jax.tree.map(np.asarray, patches(states, _ways(step, scene.model, states, dt)))


def _patch(
    places: Places, placed: Placed, ways: dict[str, Displacement], meeting: Meeting, i: Array, j: Array, torsion: Array
) -> Patch:
    """Return the patch of two bodies, as of one shape that has all places at which any of theirs may touch."""
    capsules, axes = places.capsules(placed, meeting.first, i), jnp.eye(3)[:2]
    if meeting.second in ("pads", "plates"):
        plate = places.plate(placed, meeting.second, j)
        points, axes = jax.vmap(lambda capsule: on_plate(capsule, plate))(capsules), plate.frame[:, :2].T
    else:
        others = places.capsules(placed, meeting.second, j)
        points = jax.vmap(lambda capsule: between_segments(capsule, others))(capsules)
    points = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), points)
    nearer = sum(
        sign * Displacement(ways[kind].shift[n], ways[kind].turn[n]).approach(points)
        for kind, n, sign in ((meeting.first, i, 1), (meeting.second, j, -1))
        if kind in ways
    )
    seen = points, points.depth + jnp.minimum(nearer, AHEAD)
    middle = placed.position[i] if meeting.first == "objects" else (placed.links.start[i] + placed.links.end[i]) / 2
    held, lies = meeting.second == "pads", meeting.first == "objects" and meeting.second != "pads"
    tilt = TILT_IN_JAW if held else TILT
    return find_patch(lambda _: seen, 1, 1, middle, axes, tilt, torsion, middle if lies else None)


def _ways(step: Step, model: mujoco.MjModel, states: Physics, dt: float) -> dict[str, Displacement]:
    """Return how bodies move in a step: fingers and links as C MuJoCo says, objects as they fly and spin."""
    tables, data, bodies = step.bodies.tables, mujoco.MjData(model), states.rigid_bodies.bodies
    geoms = {"pads": tables.pad_geoms, "links": tables.near}
    moves = {kind: np.zeros((len(states.qpos), len(of), 2, 3), np.float32) for kind, of in geoms.items()}
    for e, (qpos, qvel) in enumerate(zip(np.asarray(states.qpos), np.asarray(states.qvel), strict=True)):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        for kind, of in geoms.items():
            for k, geom in enumerate(of):
                twist = np.zeros(6)
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, twist, 0)
                moves[kind][e, k] = twist[3:] - np.cross(twist[:3], data.geom_xpos[geom]), twist[:3]
    turn = bodies.velocity[..., 3:]
    ways = {kind: Displacement(dt * of[:, :, 0], dt * of[:, :, 1]) for kind, of in moves.items()}
    return {
        **ways,
        "objects": Displacement(dt * (bodies.velocity[..., :3] - jnp.cross(turn, bodies.position)), dt * turn),
    }
