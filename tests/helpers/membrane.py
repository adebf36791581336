"""A system whose physics step has two block stages: a membrane, stretched in a frame, that a finger pushes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.engines.stages import block_stage
from surgical_marl.physics.systems.system import Ends, Response, Shapes, System
from surgical_marl.scenes.objects import Surface
from surgical_marl.untrusted.schema import Vector, lengths

ROWS, COLUMNS, SWEEPS, ROOM = 16, 4, 4, 8
NODES = ROWS * COLUMNS
MIDDLE = np.array([29, 30, 33, 34], np.int32)
"""The nodes that a finger can touch: parts of the system."""
SPACING, RADIUS = 0.005, 0.003
MASS, TENSION, DAMPING = 5e-3, 10.0, 0.3
"""kg and N s/m of a node, N/m between two."""


class Nodes(NamedTuple):
    """The state of the membrane. Nodes move along x alone."""

    height: Array
    """m, [nodes]"""
    speed: Array
    """m/s, [nodes]"""


def press(
    speed: Array, middle: Array, total: Array, part: Array, depth: Array, normal: Array, shift: Array,
    stiffness: Array, dt: Array,
) -> dict[str, Array]:  # fmt: skip
    """Return the forces of springs on the ends of contacts, N, [c, 3], and by how much they yield, N per m/s2, [c]."""
    ahead = depth + jnp.sum(shift * normal, -1) - dt * speed[middle[part]] * normal[:, 0]
    pressing = (np.arange(ROOM) < total) & (depth > 0) & (ahead > 0)
    felt = jnp.where(pressing, stiffness, 0.0)
    return {"force": -(felt * ahead)[:, None] * normal, "solved": dt**2 * felt}


PRESS = """
struct Vector {
    static __device__ float dot(const float *x, const float *y) { return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; }
};
if (thread < in.depth.size) {
    const float dt = in.dt[0], depth = in.depth[thread];
    float normal[3], shift[3];
    for (int i = 0; i < 3; i++) {
        normal[i] = in.normal[3 * thread + i];
        shift[i] = in.shift[3 * thread + i];
    }
    const float ahead = depth + Vector::dot(shift, normal) - dt * in.speed[in.middle[in.part[thread]]] * normal[0];
    const bool pressing = thread < in.total[0] && depth > 0 && ahead > 0;
    const float felt = pressing ? in.stiffness[thread] : 0.0f;
    for (int i = 0; i < 3; i++) out.force[3 * thread + i] = -felt * ahead * normal[i];
    out.solved[thread] = dt * dt * felt;
}
"""


def relax(
    state: Nodes, middle: Array, part: Array, normal: Array, response: Response, accelerations: Array, dt: Array
) -> Nodes:
    """Return the membrane after a step in which the ends of contacts accelerate."""
    felt = -response.force[:, 0] + response.solved * jnp.sum(normal * accelerations, -1) * normal[:, 0]
    push = jnp.zeros(NODES).at[middle[part]].add(felt).reshape(ROWS, COLUMNS)
    h = dt / SWEEPS

    def sweep(_: Any, now: tuple[Array, Array]) -> tuple[Array, Array]:
        height, speed = now
        padded = jnp.pad(height, 1)
        around = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
        speed = speed + h / MASS * (TENSION * (around - 4.0 * height) - DAMPING * speed + push)
        return height + h * speed, speed

    start = state.height.reshape(ROWS, COLUMNS), state.speed.reshape(ROWS, COLUMNS)
    height, speed = jax.lax.fori_loop(0, SWEEPS, sweep, start)
    return Nodes(height.ravel(), speed.ravel())


def found(ends: Ends, rows: Any) -> Any:
    """Return rows of contacts with zeros where there are none: those are not defined."""

    def there(x: Array) -> Array:
        return jnp.where((np.arange(ROOM) < ends.total).reshape(-1, *[1] * (x.ndim - 1)), x, jnp.zeros_like(x))

    return jax.tree.map(there, rows)


RELAX = (
    f"""
enum {{ ROWS = {ROWS}, COLUMNS = {COLUMNS}, SWEEPS = {SWEEPS} }};
const float MASS = {MASS}f, TENSION = {TENSION}f, DAMPING = {DAMPING}f, h = in.dt[0] / SWEEPS;
"""
    + """
__shared__ float height[ROWS + 2][COLUMNS + 2], push[ROWS * COLUMNS];
for (int k = thread; k < (ROWS + 2) * (COLUMNS + 2); k += threads) (&height[0][0])[k] = 0.0f;
push[thread] = 0.0f;
__syncthreads();
const int i = thread / COLUMNS + 1, j = thread % COLUMNS + 1;
float own = in.state_height[thread], speed = in.state_speed[thread];
height[i][j] = own;
if (thread < in.middle.size) {
    float sum = 0.0f;
    for (int k = 0; k < in.part.size; k++) {
        if (in.part[k] != thread) continue;
        float along = 0.0f;
        for (int l = 0; l < 3; l++) along += in.normal[3 * k + l] * in.accelerations[3 * k + l];
        sum += in.response_solved[k] * along * in.normal[3 * k] - in.response_force[3 * k];
    }
    push[in.middle[thread]] = sum;
}
for (int sweep = 0; sweep < SWEEPS; sweep++) {
    __syncthreads();
    const float around = height[i - 1][j] + height[i + 1][j] + height[i][j - 1] + height[i][j + 1];
    speed += h / MASS * (TENSION * (around - 4.0f * own) - DAMPING * speed + push[thread]);
    own += h * speed;
    __syncthreads();
    height[i][j] = own;
}
out.height[thread] = own;
out.speed[thread] = speed;
"""
)


@dataclass(frozen=True)
class Membrane(System):
    """A membrane in the plane of y and z."""

    position: Vector = lengths()
    """Of its middle."""
    surface: ClassVar[Surface] = Surface(sliding=0.3, torsion=0.0, stiffness=200.0)

    @property
    def contacts(self) -> int:
        return ROOM

    def start(self, places: Array) -> Nodes:
        return Nodes(jnp.zeros(NODES), jnp.zeros(NODES))

    def shapes(self, state: Nodes) -> Shapes:
        rows, columns = np.divmod(MIDDLE, COLUMNS)
        offset = SPACING * np.stack([0 * rows, columns - (COLUMNS - 1) / 2, rows - (ROWS - 1) / 2], -1)
        centre = np.float32(offset + self.position) + state.height[MIDDLE, None] * np.float32([1, 0, 0])
        return Shapes(centre, centre, jnp.full(len(MIDDLE), RADIUS, jnp.float32), jnp.abs(state.speed[MIDDLE]))

    def free_motion(self, state: Nodes, dt: Any) -> tuple[()]:
        return ()

    def respond(self, state: Nodes, motion: Any, ends: Ends, dt: Any) -> Response:
        r = found(ends, ends.rows)
        seen = state.speed, MIDDLE, ends.total, r.part, r.depth, r.normal, r.shift, r.stiffness
        return Response(**block_stage(press, PRESS, threads=32)(*seen, np.float32(dt)))

    def yielding(self, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Array:
        normal, accelerations = found(ends, (ends.rows.normal, accelerations))
        return (response.solved * jnp.sum(normal * accelerations, -1))[:, None] * normal

    def apply(self, state: Nodes, response: Response, ends: Ends, accelerations: Array, dt: Any) -> Nodes:
        stage = block_stage(relax, RELAX, threads=NODES)
        part, normal, accelerations = found(ends, (ends.rows.part, ends.rows.normal, accelerations))
        return stage(state, MIDDLE, part, normal, response, accelerations, np.float32(dt))
