"""A needle that is led through a piece of tissue, without arms: its pose is given at each step."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from surgical_marl.physics.contact.part_detection import no_end
from surgical_marl.physics.systems.channel_state import ChannelView
from surgical_marl.physics.systems.needle import Needle
from surgical_marl.physics.systems.system import Ends, Followed
from surgical_marl.physics.systems.tissue import Tissue, TissueState
from surgical_marl.physics.tree_utils import room
from surgical_marl.robots.rotation import turned
from surgical_marl.scenes.channel_file import ChannelFile
from surgical_marl.scenes.objects import Surface

DT, CHUNK = 2.5e-3, 50
SIZE, CELLS = (0.04, 0.02, 0.005), (8, 4, 1)
PRESENT = np.ones(CELLS, bool)
PRESENT[5, 1:3] = False
"""Which bricks are there: all but those of a slit from 25 to 30 mm along x, 5 to 15 mm along y."""
PIN = Needle("pin", (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), 1e-3, 0.02, 3e-4)
"""A straight needle that points down, its tip at the origin of its frame."""
ARC = Needle("arc", (-0.008, 0.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), 125.0, 0.008 * np.pi, 3e-4)
"""A half circle about the y axis of its frame, whose tip points down."""


def sheet(needles: Sequence[Needle] = (PIN, ARC), channel: ChannelFile | None = None, **settings: Any) -> Tissue:
    """Return a sheet of 40 x 20 x 5 mm with a slit, without weight, whose rim is held."""
    given: dict[str, Any] = {
        "size": SIZE, "present": tuple(tuple(map(tuple, plane)) for plane in PRESENT.tolist()),
        "young": 27040.0, "poisson": 0.4287, "density": 1000.0, "damping": 2e-3, "springs": (),
        "fixed": ("left", "right", "front", "back"), "position": (0.0, 0.0, 0.0),
        "rotation": tuple(map(tuple, np.eye(3).tolist())), "surface": Surface(0.3, 0.0, 5e3),
        "channel": channel or ChannelFile(), "needles": tuple(needles),
    }  # fmt: skip
    tissue = Tissue(**given | settings)
    tissue.solver.gravity = np.zeros(3, np.float32)
    return tissue


class Pose(NamedTuple):
    """Where needles are at each step: origins, m, [t, n, 3], and axes, [t, n, 3, 3], of their frames."""

    origin: np.ndarray
    axes: np.ndarray


class Seen(NamedTuple):
    """The notes of each step."""

    force: Any
    """Of the tissue on each needle, N, [t, n, 3]."""
    work: Any
    """Done on the tissue by the needles in the step, J, [t]."""
    pressed: Any
    """By each tip, N, [t, n]."""
    does: Any
    """Of each tip, [t, n]."""
    channels: ChannelView


def straight(way: np.ndarray, axes: np.ndarray | None = None) -> Pose:
    """Return poses of one needle whose origin moves along a way, m, [t, 3]."""
    turn = np.eye(3) if axes is None else axes
    return Pose(way[:, None], np.broadcast_to(turn, (len(way), 1, 3, 3)))


def turning(centre: Sequence[float], angle: np.ndarray) -> Pose:
    """Return poses of one needle whose origin stays, and which turns about y by angles, rad, [t]; it drives it in."""
    axes = np.array([turned((0.0, float(np.degrees(one)), 0.0)) for one in angle])
    return Pose(np.broadcast_to(np.array(centre), (len(angle), 1, 3)), axes[:, None])


def joined(*poses: Pose) -> Pose:
    """Return one needle after the other as one pose at each step."""
    return Pose(*(np.concatenate(part, 1) for part in zip(*poses, strict=True)))


def away(steps: int) -> Pose:
    """Return poses of a needle that is far from the tissue."""
    return straight(np.full((steps, 3), 0.3))


def bodies_at(origins: Any, axes: Any = None, velocity: Any = None) -> Followed:
    """Return needles with one shape each, whose origins are there, m, [n, 3]."""
    n, origins = len(origins), jnp.asarray(origins, jnp.float32)
    axes = jnp.broadcast_to(jnp.eye(3), (n, 3, 3)) if axes is None else axes
    velocity = jnp.zeros((n, 6)) if velocity is None else velocity
    return Followed(origins, axes, jnp.ones(n), origins, velocity, jnp.arange(n), jnp.ones(n, jnp.int32))


def no_ends(tissue: Tissue) -> Ends:
    """Return no contacts, with room for those of the tissue."""
    rows = jax.tree.map(jnp.zeros_like, room(jax.eval_shape(no_end), tissue.contacts))
    return Ends(rows, *[jnp.int32(0)] * 3)


@cache
def _stepper(tissue: Tissue) -> Any:
    count = len(tissue.needles)

    def step(state: TissueState, rows: Any) -> tuple[TissueState, Seen]:
        state, ends = tissue.follow(state, no_ends(tissue), bodies_at(*rows), DT)
        response = tissue.respond(state, tissue.free_motion(state, DT), ends, DT)
        work = -jnp.sum(response.force * ends.rows.shift)
        state = tissue.apply(state, response, ends, jnp.zeros_like(ends.rows.shift), DT)
        mine = jnp.arange(count)[:, None] == ends.rows.shape
        mine &= jnp.arange(len(ends.rows.shape)) < ends.total
        force = jnp.where(mine[..., None], response.force, 0.0).sum(1)
        inner, view = state.channels, tissue.view(state).channels
        assert inner and view
        return state, Seen(force, work, inner.tips.pressed, inner.tips.does, view)

    return jax.jit(lambda state, rows: jax.lax.scan(step, state, rows))


def lead(tissue: Tissue, pose: Pose, state: TissueState | None = None) -> tuple[TissueState, Seen]:
    """Return the state and what was seen as needles are led along poses."""
    turns = np.einsum("tnij,tnkj->tnik", pose.axes[1:], pose.axes[:-1])
    spin = np.stack([turns[..., 2, 1] - turns[..., 1, 2], turns[..., 0, 2] - turns[..., 2, 0],
                     turns[..., 1, 0] - turns[..., 0, 1]], -1) / (2 * DT)  # fmt: skip
    velocity = np.concatenate([np.diff(pose.origin, axis=0) / DT, spin], -1)
    rows = tuple(np.asarray(x, np.float32) for x in (pose.origin[:-1], pose.axes[:-1], velocity))
    state, step, noted = tissue.start(jnp.zeros((0, 3))) if state is None else state, _stepper(tissue), []
    for at in range(0, len(velocity), CHUNK):  # of one length, so that it is compiled once
        part = [row[at : at + CHUNK] for row in rows]
        assert len(part[0]) == CHUNK, f"poses must be {CHUNK} k + 1"
        state, seen = step(state, part)
        noted.append(jax.tree.map(np.asarray, seen))
    return state, jax.tree.map(lambda *parts: np.concatenate(parts), *noted)
