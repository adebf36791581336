"""The step of tissue with its contacts: on a GPU two stages, each with a block of threads an environment.

    answer = step.respond(nodes, held, ends)               # displacements, and the forces on contacts
    moved = step.move(nodes, held, ends, answer, pushed)   # the nodes after the step

Functions of JAX are the reference. `tissue_respond.cu` and `tissue_move.cu` are the same in CUDA, with `brick.cu` for
an element, `brick_solve.cu` for conjugate gradients, and `brick_block.cu` for what a block's threads share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.engines.stages import MOST_SHARED, block_stage
from surgical_marl.physics.contact.spring_contact import each, feel
from surgical_marl.physics.solver.cholesky import FULL, LOWER
from surgical_marl.physics.systems.brick import CRUSHED, EVENED, ITERATIONS, RESISTANCE
from surgical_marl.physics.systems.brick_solve import HALVINGS, LEAST, LEFT, BrickSolver, Nodes
from surgical_marl.physics.systems.channel import Channels
from surgical_marl.physics.systems.system import End, Ends, Springs
from surgical_marl.physics.tree_utils import put, row_of

ROUNDS, TURNS = 4, 3
"""Linearisations of contacts in a physics step, and conjugate gradients after each. With fewer, friction overshoots
where it begins to slide."""
ALONE = 6
"""Conjugate gradients where nothing touches: more exact than as many in rounds, which begin anew."""
ENOUGH = 1e-15
"""Residual, in the norm of the inverse of the nodes' own blocks, at which conjugate gradients stop, J: displacements
are then wrong by a few nm."""
PUSHES, LITTLE = 6, 1e-12
"""Conjugate gradients for displacements by additional forces on contacts, and the residual at which these stop, J."""
MOST_THREADS, PAD = 256, 25
"""Threads of a block, and numbers in shared memory for a brick: one more than needed, so that threads use all banks."""

R = TypeVar("R")


class Held(NamedTuple):
    """The points of c contacts, on q nodes each."""

    nodes: Array
    """[c, q]"""
    weights: Array
    """Shares of the nodes, [c, q]; they sum to 1."""


class Answer(NamedTuple):
    """A step of tissue whose contacts' ends move as expected. Rows from the number of contacts on are empty."""

    shift: Array
    """Displacements of the nodes, m, [n, 3]."""
    force: Array
    """Of each contact on the tissue, N, [c, 3]."""
    falls: Array
    """Of that force as the end moves, with what the tissue at its point gives way, N/m: lower halves, [c, 6]. Of
    contacts with what moves."""


class Moved(NamedTuple):
    """Tissue after a step. Rows of contacts are as in `Answer`."""

    position: Array
    """m, [n, 3]"""
    velocity: Array
    """m/s, [n, 3]"""
    points: Array
    """Displacements of the points of contacts, m, [c, 3]."""
    torn: Array
    """True if any brick is stretched past its limit, [] bool."""


class Mesh(NamedTuple):
    """The constants of nodes and bricks that kernels read."""

    mass: np.ndarray
    """kg, [n]"""
    support: np.ndarray
    """Stiffness of the springs to the places at rest, N/m, [n]."""
    free: np.ndarray
    """0 or 1, [n]"""
    rest: np.ndarray
    """m, [n, 3]"""
    bricks: np.ndarray
    """First node of each brick, [e]."""
    around: np.ndarray
    """Where forces of bricks on a node begin, among 25 numbers a brick, [n, 8]; -1 where no brick is."""


class TissueStep:
    """The step of one piece of tissue.

    Args:
        solver: of its bricks.
        tears: stretch past which it counts as torn; None for any.
        dt: duration of a step, s.
        channels: of needles; None if none can go through.
    """

    def __init__(
        self, solver: BrickSolver, tears: float | None, dt: float, channels: Channels | None = None
    ) -> None:  # fmt: skip
        self.solver, self.tears, self.dt, self.channels = solver, tears, dt, channels
        self.feel = channels.feel if channels else feel

    def respond(self, nodes: Nodes, held: Held, ends: Ends, loads: Sequence[Springs] = ()) -> Answer:
        """Return the displacements of nodes whose contacts' ends move as expected, and the forces on these."""
        stage = self._stage("respond", self.answered, held, loads)
        return stage(nodes, held, ends, tuple(loads), jnp.float32(self.solver.stiffer), self.mesh)

    def move(self, nodes: Nodes, held: Held, ends: Ends, answer: Answer, pushed: Array) -> Moved:
        """Return the tissue after displacements `answer.shift` and those by additional forces [c, 3] on contacts, N."""
        stage = self._stage("move", self.moved, held)
        stiffer = jnp.float32(self.solver.stiffer)
        return stage(nodes, held, ends.moving, ends.total, answer.shift, pushed, stiffer, self.mesh)

    def _stage(
        self, kernel: str, reference: Callable[..., R], held: Held, loads: Sequence[Springs] = ()
    ) -> Callable[..., R]:
        grid, (rows, q) = self.solver.grid, held.nodes.shape
        threads = min(MOST_THREADS, 32 * -(-grid.nodes // 64))
        springs = rows + sum(len(load.force) for load in loads)
        shared = 4 * (12 * grid.nodes + PAD * len(grid.first) + springs * (12 + 2 * q)) + 2 * grid.nodes + 640
        if shared > MOST_SHARED or 5 * grid.nodes > PAD * len(grid.first):  # kernels keep nodes where bricks were
            return reference
        return block_stage(reference, self.cuda(kernel, held, loads), threads, f"tissue_{kernel}")

    @cached_property
    def softness(self) -> tuple[float, float]:
        """By how much more the tissue gives way to contacts than the blocks of nodes say, along its face and across."""
        return self.solver.softness(self.dt)

    # -- the reference

    def answered(
        self, nodes: Nodes, held: Held, ends: Ends, loads: tuple[Springs, ...], stiffer: Any, mesh: Any
    ) -> Answer:  # fmt: skip
        """Return what `respond` does."""
        del mesh  # for the kernel
        solver, dt, touched = self.solver.stiffened(stiffer), self.dt, ends.total > 0
        for load in loads:
            touched |= load.used > 0
        linear = solver.linearise(nodes, dt)
        iterations = jnp.where(touched, TURNS, ALONE)

        def spring(row: Array, end: End, u: Array) -> tuple[Array, Array]:
            felt = self.feel(end, _point(held, row, u) - end.shift)
            return felt.force + felt.stiffness @ _point(held, row, u), felt.stiffness[LOWER]

        def springs_at(u: Array) -> Springs:
            force, stiffness = each(ends, lambda row, end: spring(row, end, u))
            return Springs(*held, force, stiffness, ends.total)

        def improve(_: Any, found: tuple[Array, ...]) -> tuple[Array, ...]:
            u, residual, *_ = found
            springs = springs_at(u)
            u, residual = solver.improved(linear, (springs, *loads), u, residual, dt, iterations, ENOUGH)
            return u, residual, springs.force, springs.stiffness

        def pulls(row: Array, _: End) -> Array:
            return force[row] - stiffness[row][FULL] @ _point(held, row, u)

        residual, rows = solver.residual(linear, linear.guess, dt), len(held.nodes)
        start = linear.guess, residual, jnp.zeros((rows, 3)), jnp.zeros((rows, 6))
        u, _, force, stiffness = jax.lax.fori_loop(0, jnp.where(touched, ROUNDS, 1), improve, start)
        if solver.loose:
            springs = Springs(*held, force, stiffness, ends.total), *loads
            left = solver.unbalanced(nodes, linear, springs, u, dt)
            u += solver.balanced(nodes.position, left, linear.inertia, springs)
        u = solver.shortened(nodes, u)  # tissue that is crushed presses back by what it really gives way
        force = each(ends, pulls)

        beside, across = self.softness

        def eased(row: Array, end: End) -> Array:
            # the contact's spring is in series with the tissue at its point
            own, weights = row_of(held, row)
            block, own_stiffness = linear.block[own], stiffness[row][FULL]
            gives = weights * weights * jnp.asarray(solver.free)[own]
            give = jnp.sum(gives / ((block[:, 0] + block[:, 2] + block[:, 5]) / 3))
            normal = end.normal @ own_stiffness @ end.normal
            along = (jnp.trace(own_stiffness) - normal) / 2
            normal, along = normal / (1 + normal * across * give), along / (1 + along * beside * give)
            return (along * jnp.eye(3) + (normal - along) * jnp.outer(end.normal, end.normal))[LOWER]

        return Answer(u, force, each(ends, eased, moving=True))

    def moved(
        self, nodes: Nodes, held: Held, moving: Array, total: Array, shift: Array, pushed: Array, stiffer: Any,
        mesh: Any,
    ) -> Moved:  # fmt: skip
        """Return what `move` does."""
        del mesh  # for the kernel
        solver, dt = self.solver.stiffened(stiffer), self.dt

        def add(row: Array, forces: Array) -> Array:
            for node, weight in zip(held.nodes[row], held.weights[row], strict=True):
                forces = forces.at[node].add(weight * pushed[row], mode="promise_in_bounds")
            return forces

        def pushed_on(shift: Array) -> Array:
            forces = jax.lax.fori_loop(0, moving, add, jnp.zeros_like(shift))
            linear = solver.linearise(nodes, dt)
            u, _ = solver.improved(linear, (), jnp.zeros_like(shift), forces, dt, PUSHES, LITTLE)
            if solver.loose:
                left = forces - linear.inertia[:, None] * u
                u += solver.balanced(nodes.position, left, linear.inertia)
            return shift + u

        def note(row: Array, points: Array) -> Array:
            return put(points, row, _point(held, row, u))

        u = jax.lax.cond(moving > 0, pushed_on, lambda shift: shift, shift)
        u = solver.shortened(nodes, u)
        after = solver.moved(nodes, u, dt)
        torn = jnp.bool_(False) if self.tears is None else solver.stretched(after.position, self.tears)
        return Moved(*after, jax.lax.fori_loop(0, total, note, jnp.zeros_like(pushed)), torn)

    # -- the kernels

    @property
    def mesh(self) -> Mesh:
        """The constants that kernels read."""
        grid, support = self.solver.grid, self.solver.support
        around = np.full((grid.nodes, 8), -1, np.int32)
        for corner, offset in enumerate(grid.offsets):
            around[grid.first + offset, corner] = PAD * np.arange(len(grid.first)) + 3 * corner
        return Mesh(grid.mass, support.stiffness, self.solver.free, support.rest, grid.first, around)

    def cuda(self, kernel: str, held: Held, loads: Sequence[Springs] = ()) -> str:
        """Return the CUDA code of a kernel, "respond" or "move", for contacts and loads of this form."""
        (rows, q), springs = held.nodes.shape, sum(len(load.force) for load in loads)
        solver, dt = self.solver, self.dt
        grid, brick = solver.grid, solver.brick
        wholes = {
            "NODES": grid.nodes, "BRICKS": len(grid.first), "ROOM": rows + springs, "HELD": q, "PAD": PAD,
            "LEVELS": grid.counts[2], "LOOSE": int(solver.loose),
            "STRIDE_X": grid.offsets[4], "STRIDE_Y": grid.offsets[2],
            "HOLDS": self.channels.first if self.channels else -1,
            "PRESSES": self.channels.pressing if self.channels else -1,
            "ROUNDS": ROUNDS, "TURNS": TURNS, "ALONE": ALONE, "PUSHES": PUSHES,
            "HALVINGS": HALVINGS, "EVENED": EVENED, "NEWTON": ITERATIONS,
        }  # fmt: skip
        diagonal = {
            f"DIAGONAL_{a}{b}": brick.diagonal[0, i, j]
            for i, a in enumerate("XYZ")
            for j, b in enumerate("XYZ")
            if i <= j
        }
        upright = {f"UPRIGHT_{a}{b}": brick.upright[0, i, j] for i, a in enumerate("XYZ") for j, b in enumerate("XYZ")}
        reals = diagonal | upright | {f"SLOPE_{axis}": x for axis, x in zip("XYZ", -2 / brick.size, strict=True)} | {
            "VOLUME": brick.volume, "LAME": brick.lame, "SHEAR": brick.shear, "CRUSHED": CRUSHED,
            "RESISTANCE": RESISTANCE * brick.young, "DT": dt, "BLEND": 1 + solver.damping / dt,
            "GRAVITY": solver.gravity[2], "ENOUGH": ENOUGH, "LITTLE": LITTLE, "LEFT": LEFT, "LEAST": LEAST,
            "TEARS": self.tears or 0, "BESIDE": self.softness[0], "ACROSS": self.softness[1],
        }  # fmt: skip
        terms = " ".join(
            f"y[{i}] = {' + '.join(f'{_real(row[j])} * x[{j}]' for j in np.flatnonzero(row))};"
            for i, row in enumerate(brick.hourglass)
        )
        names = ("nodes", "weights", "force", "stiffness", "used")
        borne = [", ".join(f"in.loads_{k}_{name}" for name in names) for k in range(len(loads))]
        parts = [
            f"#define BEAR_LOADS {' '.join(f'bear({own}[0]);' for own in borne)}",
            f"enum {{ {', '.join(f'{name} = {x}' for name, x in wholes.items())} }};",
            f"constexpr float {', '.join(f'{name} = {_real(x)}' for name, x in reals.items())};",
            f"#define HOURGLASS(x, y) {terms}",
            *map(_source, ("brick_block", "brick", "brick_solve", f"tissue_{kernel}")),
            "#undef BEAR_LOADS\n#undef HOURGLASS\n#undef EACH\n#undef EACH_NODE\n#undef UNROLL",
        ]
        return "\n".join(parts)


def _point(held: Held, row: Array, u: Array) -> Array:
    """Return the displacement [3] of the point of a contact by those of the nodes, [n, 3]."""
    return held.weights[row] @ u[held.nodes[row]]


def _real(x: Any) -> str:
    return f"{np.float32(x):.9e}f"


def _source(name: str) -> str:
    return Path(__file__).with_name(f"{name}.cu").read_text(encoding="utf-8")
