"""Attachments: bilateral constraints that hold a free body at a link of an arm, until a flag releases it.

An attachment is a stiff spring for each of the six directions in which the body could move away from where it
was fastened. Contacts can only push and slip; an attachment pulls too, and never slips. So it is linear, and the solver
needs no cone for it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import Joints
from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.solver.problem import AttachmentRows
from surgical_marl.physics.systems.rigid_motion import Bodies, conjugate, product, rotation
from surgical_marl.scenes.scene import Scene

STIFFNESS = 1e5
"""Stiffness of an attachment, N/m: a needle of 0.1 g hangs 10 nm below where it was fastened."""
ARM = 0.005
"""Distance at which this stiffness resists turning, m: the stiffness about an axis is STIFFNESS * ARM**2, N m/rad."""


class AttachmentState(NamedTuple):
    """The state of w attachments."""

    active: Array
    """Attachments that hold, [w] bool."""
    position: Array
    """Centre of mass of the body in the frame of the link, m, [w, 3]."""
    quaternion: Array
    """Orientation of the body in the frame of the link, [w, 4]."""


class Attachments:
    """The attachments of a scene."""

    def __init__(self, scene: Scene, tables: ContactPairs) -> None:
        self._tables, model = tables, scene.model
        self.names = tuple(scene.attachments)
        entries = list(scene.attachments.values())
        self.bodies = np.array([tables.names.index(entry.body) for entry in entries], int)
        """Number of the body of each attachment, [w]."""
        self.links = np.array([model.body(entry.link).id for entry in entries], int)
        self.arms, self._moves = tables.joints_of(model, scene.agents, self.links)
        """The arm that each attachment is on, [w]."""
        self._active = np.array([entry.active for entry in entries], bool)

    def start(self, poses: Any, bodies: Bodies) -> AttachmentState:
        """Return the attachments as the scene file has them, from the poses of links and bodies at the start."""
        state = AttachmentState(jnp.zeros(len(self.links), bool), *self._relative(poses, bodies))
        return state._replace(active=jnp.asarray(self._active))

    def fasten(self, state: AttachmentState, number: int, poses: Any, bodies: Bodies) -> AttachmentState:
        """Return the state in which an attachment holds its body where it is now."""
        position, quaternion = self._relative(poses, bodies)
        return AttachmentState(
            state.active.at[number].set(True),
            state.position.at[number].set(position[number]),
            state.quaternion.at[number].set(quaternion[number]),
        )

    def rows(
        self, state: AttachmentState, poses: Any, joints: Joints, qvel: Array, bodies: Bodies, dt: Any
    ) -> AttachmentRows:  # fmt: skip
        """Return the attachments as the solver wants them.

        Args:
            state: of the attachments.
            poses: MJX's data with the poses of links.
            joints: axes of the arms' joints.
            qvel: velocities of the arms' joints, [nv].
            bodies: the free bodies.
            dt: duration of a step, s.
        """
        t = self._tables
        place, turn = bodies.position[self.bodies], bodies.quaternion[self.bodies]
        frames, faces = rotation(poses.xquat[self.links]), poses.xquat[self.links]
        wanted = poses.xpos[self.links] + jnp.einsum("wij,wj->wi", frames, state.position)
        turns = product(turn, conjugate(jax.vmap(product)(faces, state.quaternion)))
        angle = 2 * turns[:, 1:] * jnp.where(turns[:, :1] < 0, -1.0, 1.0)
        error = jnp.concatenate([place - wanted, angle], -1)
        moving, turning = joints.columns(jnp.asarray(t.slides)[self.arms], place[:, None])
        columns = jnp.concatenate([moving, turning], -1) * self._moves[..., None]
        jacobian = -jnp.swapaxes(columns, -1, -2)  # of the body relative to the link
        joint_speeds = jnp.append(qvel, 0.0)[t.dofs][self.arms]
        speed = bodies.velocity[self.bodies] + jnp.einsum("wij,wj->wi", jacobian, joint_speeds)
        k = np.array([STIFFNESS] * 3 + [STIFFNESS * ARM**2] * 3, np.float32)
        wrench = -k * (error + dt * speed)  # of springs at the end of the step: an implicit step damps them
        stiffness = jnp.diag(jnp.asarray(dt * dt * k))
        return AttachmentRows(self.bodies, self.arms, state.active, jacobian, wrench, stiffness)

    def _relative(self, poses: Any, bodies: Bodies) -> tuple[Array, Array]:
        """Return positions [w, 3] and orientations [w, 4] of bodies in the frames of their links."""
        faces, place = poses.xquat[self.links], bodies.position[self.bodies]
        offset = place - poses.xpos[self.links]
        position = jnp.einsum("wji,wj->wi", rotation(faces), offset)
        return position, jax.vmap(product)(conjugate(faces), bodies.quaternion[self.bodies])
