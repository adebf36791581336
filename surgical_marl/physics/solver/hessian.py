"""Sums over contacts that press: their forces, and by how much these fall with the acceleration of arms and objects."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.friction_cone import Forces, between, curvature, wrench
from surgical_marl.physics.contact.relative_motion import moved_cone
from surgical_marl.physics.solver.cholesky import packed
from surgical_marl.physics.solver.contact_line import ContactState
from surgical_marl.physics.solver.problem import AttachmentRows, Contact, Point, Problem
from surgical_marl.physics.tree_utils import add, empty_like, put, row_of, when

_WHOLE = packed(6)


class Hessian(NamedTuple):
    """Forces and curvature of contacts, summed up for a arms with m joints each at most, k objects, and no object."""

    arm_force: Array
    """[a, m]"""
    force: Array
    """On objects, with the rest of what their acceleration takes, [k + 1, 6]."""
    arm: Array
    """Curvature on arms, lower halves, [a, m (m + 1) / 2]; not defined for an arm on which nothing presses."""
    object: Array
    """Curvature on objects, with their masses, lower halves, [k + 1, 21]."""
    cross: Array
    """Curvature between two objects: see `schur.Eliminated.cross`."""
    coupling: Array
    """Curvature between object o and arm i in row a o + i, [(k + 1) a, 6, m]; not defined where they do not touch."""
    met: Array
    """Pairs of object and arm that press on each other, [(k + 1) a] bool."""
    on_arm: Array
    """On which arms anything presses, [a] bool."""
    linked: Array
    """True if objects press on each other, []."""

    @classmethod
    def of(cls, problem: Problem, forces: ContactState, here: Point) -> Hessian:
        """Return sums over contacts and attachments at accelerations `here`, where contacts have these forces."""

        def one(i: Array, sums: Hessian) -> Hessian:
            n = forces.pressing.numbers[i]
            return sums._and(problem.contacts.at(n), row_of(forces.felt, n))

        found: Hessian = jax.lax.fori_loop(0, forces.pressing.length, one, cls._none(problem, here.objects))
        return found if problem.attachments is None else found._and_attachments(problem.attachments, here)

    @classmethod
    def _none(cls, problem: Problem, objects: Array) -> Hessian:
        """Return sums over no contacts."""
        (a, m), k = problem.smooth.shape, len(objects)
        inertia = (problem.masses @ (problem.free - objects)[..., None])[..., 0]
        seconds = problem.contacts.second
        linked = ((np.arange(len(seconds)) < problem.total) & (seconds < k)).any() if k > 1 else jnp.bool_(False)
        return cls(
            jnp.zeros((a, m)),
            _with_room(inertia),
            empty_like(jax.ShapeDtypeStruct((a, m * (m + 1) // 2), jnp.float32)),
            _with_room(problem.masses[:, *np.tril_indices(6)]),
            jax.lax.cond(linked, jnp.zeros_like, empty_like, jnp.zeros(36 * k * k if k > 1 else 0)),
            empty_like(jax.ShapeDtypeStruct(((k + 1) * a, 6, m), jnp.float32)),
            jnp.zeros((k + 1) * a, bool),
            jnp.zeros(a, bool),
            jnp.bool_(False),
        )

    def _and(self, contact: Contact, felt: Forces) -> Hessian:
        """Return sums with one more contact."""
        a, k = len(self.arm_force), len(self.force) - 1
        first, second, cone = contact.first, contact.second, contact.cone
        pull, stiff = wrench(cone, felt), curvature(cone, felt)

        def on_other(sums: Hessian) -> Hessian:
            moved, at = moved_cone(contact), (36 * (k * first + second),)
            block = jax.lax.dynamic_slice(sums.cross, at, (36,)) + between(cone, moved, felt).ravel()
            return sums._replace(
                force=add(sums.force, second, wrench(moved, felt)),
                object=add(sums.object, second, curvature(moved, felt)),
                cross=jax.lax.dynamic_update_slice(sums.cross, block, at),
                linked=jnp.bool_(True),
            )

        def on_arm(sums: Hessian) -> Hessian:
            return sums._on_arm(first, contact.arm, contact.jacobian, pull, stiff[_WHOLE])

        sums = when(second < k, on_other, self) if k > 1 else self
        sums = sums._replace(force=add(sums.force, first, pull), object=add(sums.object, first, stiff))
        return when(contact.arm < a, on_arm, sums) if a else sums

    def _on_arm(self, body: Any, arm: Any, jacobian: Array, pull: Array, stiff: Array) -> Hessian:
        """Return sums with the end on an arm of a contact or an attachment.

        Args:
            body: number of the body at the other end.
            arm: number of the arm.
            jacobian: relative twist by velocity of the arm's joints, [6, m].
            pull: force and torque on the body, [6].
            stiff: by how much they fall, [6, 6].
        """
        half = stiff @ jacobian
        first_joint, second_joint = np.tril_indices(jacobian.shape[1])
        own, pair = jnp.sum(jacobian[:, first_joint] * half[:, second_joint], 0), len(self.arm_force) * body + arm
        return self._replace(
            arm_force=add(self.arm_force, arm, jacobian.T @ pull),
            arm=_begun(self.arm, arm, own, self.on_arm),
            coupling=_begun(self.coupling, pair, half, self.met),
            met=put(self.met, pair, True),
            on_arm=put(self.on_arm, arm, True),
        )

    def _and_attachments(self, rows: AttachmentRows, here: Point) -> Hessian:
        """Return sums with all active attachments."""
        sums, lower = self, rows.stiffness[np.tril_indices(6)]
        for n, (body, arm) in enumerate(zip(rows.body.tolist(), rows.arm.tolist(), strict=True)):
            felt = rows.wrench[n] - rows.stiffness @ rows.relative(n, here)

            def hold(sums: Hessian, n: int = n, body: int = body, arm: int = arm, felt: Array = felt) -> Hessian:
                sums = sums._replace(force=add(sums.force, body, felt), object=add(sums.object, body, lower))
                return sums._on_arm(body, arm, rows.jacobian[n], felt, rows.stiffness)

            sums = when(rows.active[n], hold, sums)
        return sums


def _with_room(each: Array) -> Array:
    """Return what belongs to objects [k, ...], and room for the one that stands for none, [k + 1, ...]."""
    return jnp.concatenate([each, empty_like(jax.ShapeDtypeStruct((1, *each.shape[1:]), each.dtype))])


def _begun(sums: Array, i: Array, row: Array, begun: Array) -> Array:
    """Return sums with more in one row, which begins with it if it was not `begun`."""
    return put(sums, i, jax.lax.cond(begun[i], lambda: sums[i] + row, lambda: row))
