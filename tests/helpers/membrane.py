"""A system whose physics step has two block stages: a membrane, stretched in a frame, that a finger pushes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.engines.stages import block_stage
from surgical_marl.physics.systems.system import Ends, Loads, Spheres, System
from surgical_marl.scenes.objects import Surface
from surgical_marl.untrusted.schema import Vector, lengths

ROWS, COLUMNS, SWEEPS = 16, 4, 4
NODES = ROWS * COLUMNS
MIDDLE = np.array([29, 30, 33, 34])
"""The nodes that a finger can touch."""
SPACING, RADIUS = 0.005, 0.003
MASS, TENSION, DAMPING, CONTACT = 5e-3, 10.0, 0.3, 200.0
"""kg and N s/m of a node; N/m between two nodes, and of a contact."""
COMMON = f"""
enum {{ ROWS = {ROWS}, COLUMNS = {COLUMNS}, SWEEPS = {SWEEPS}, MIDDLE = {len(MIDDLE)} }};
const float MASS = {MASS}f, TENSION = {TENSION}f, DAMPING = {DAMPING}f;
struct Contact {{
    static __device__ float dot(const float *x, const float *y) {{ return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; }}
    static __device__ float force(float depth, float speed, const float *n, const float *velocity, float dt) {{
        const float ahead = depth + dt * (dot(velocity, n) - speed * n[0]);
        return depth > 0 && ahead > 0 ? {CONTACT}f * ahead : 0.0f;
    }}
    static __device__ float stiffness(float force, float dt) {{ return force > 0 ? {CONTACT}f * dt * dt : 0.0f; }}
}};
"""
"""The code of both kernels begins with this. Functions are members of a local struct."""


class Nodes(NamedTuple):
    """The state of the membrane. Nodes move along x alone."""

    height: Array
    """m, [nodes]"""
    speed: Array
    """m/s, [nodes]"""


def springs(speed: Array, depth: Array, normal: Array, velocity: Array, dt: Array) -> tuple[Array, Array]:
    """Return the forces of springs between nodes [n] and shapes [n, r], and how much they fall by acceleration."""
    ahead = depth + dt * (jnp.sum(velocity * normal, -1) - speed[:, None] * normal[..., 0])
    force = jnp.where(depth > 0, CONTACT * jnp.maximum(ahead, 0.0), 0.0)
    return force, jnp.where(force > 0, CONTACT * dt**2, 0.0)


def press(speed: Array, depth: Array, normal: Array, velocity: Array, dt: Array) -> Loads:
    """Return the loads on shapes."""
    force, stiff = springs(speed, depth, normal, velocity, dt)
    return Loads(-force[..., None] * normal, stiff[..., None, None] * normal[..., :, None] * normal[..., None, :])


PRESS = (
    COMMON
    + """
const int shapes = in.depth.size / in.speed.size;
for (int k = thread; k < in.depth.size; k += threads) {
    const float n[3] = {in.normal[3 * k], in.normal[3 * k + 1], in.normal[3 * k + 2]}, dt = in.dt[0];
    const float velocity[3] = {in.velocity[3 * k], in.velocity[3 * k + 1], in.velocity[3 * k + 2]};
    const float force = Contact::force(in.depth[k], in.speed[k / shapes], n, velocity, dt);
    for (int i = 0; i < 3; i++) {
        out.force[3 * k + i] = -force * n[i];
        for (int j = 0; j < 3; j++) out.stiffness[9 * k + 3 * i + j] = Contact::stiffness(force, dt) * n[i] * n[j];
    }
}
"""
)


def relax(
    state: Nodes, middle: Array, depth: Array, normal: Array, velocity: Array, accelerations: Array, dt: Array
) -> Nodes:
    """Return the membrane after a step in which the ends of contacts accelerate."""
    force, stiff = springs(state.speed[middle], depth, normal, velocity, dt)
    force = force + stiff * jnp.sum(normal * accelerations, -1)
    push = jnp.zeros(NODES).at[middle].set(jnp.sum(force * normal[..., 0], 1)).reshape(ROWS, COLUMNS)
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


RELAX = (
    COMMON
    + """
__shared__ float height[ROWS + 2][COLUMNS + 2], push[ROWS * COLUMNS];
for (int k = thread; k < (ROWS + 2) * (COLUMNS + 2); k += threads) (&height[0][0])[k] = 0.0f;
push[thread] = 0.0f;
__syncthreads();
const int i = thread / COLUMNS + 1, j = thread % COLUMNS + 1, shapes = in.depth.size / MIDDLE;
float own = in.state_height[thread], speed = in.state_speed[thread];
height[i][j] = own;
if (thread < MIDDLE) {
    const int node = in.middle[thread];
    for (int k = thread * shapes; k < (thread + 1) * shapes; k++) {
        float n[3], velocity[3], moves[3];
        for (int l = 0; l < 3; l++) {
            n[l] = in.normal[3 * k + l];
            velocity[l] = in.velocity[3 * k + l];
            moves[l] = in.accelerations[3 * k + l];
        }
        const float force = Contact::force(in.depth[k], in.state_speed[node], n, velocity, in.dt[0]);
        push[node] += (force + Contact::stiffness(force, in.dt[0]) * Contact::dot(n, moves)) * n[0];
    }
}
const float h = in.dt[0] / SWEEPS;
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
    surface: ClassVar[Surface] = Surface(sliding=0.3, torsion=0.0, stiffness=CONTACT)

    def start(self) -> Nodes:
        return Nodes(jnp.zeros(NODES), jnp.zeros(NODES))

    def shapes(self, state: Nodes) -> Spheres:
        rows, columns = np.divmod(MIDDLE, COLUMNS)
        offset = SPACING * np.stack([0 * rows, columns - (COLUMNS - 1) / 2, rows - (ROWS - 1) / 2], -1)
        along, rest = np.array([1.0, 0.0, 0.0], np.float32), np.float32(offset + self.position)
        radius = jnp.full(len(MIDDLE), RADIUS, jnp.float32)
        return Spheres(rest + state.height[MIDDLE, None] * along, radius, state.speed[MIDDLE, None] * along)

    def free_motion(self, state: Nodes, dt: Any) -> tuple[()]:
        return ()

    def respond(self, state: Nodes, motion: Any, ends: Ends, dt: Any) -> Loads:
        stage = block_stage(press, PRESS, threads=32)
        return stage(state.speed[MIDDLE], ends.depth, ends.normal, ends.velocity, np.float32(dt))

    def apply(self, state: Nodes, motion: Any, ends: Ends, accelerations: Array, dt: Any) -> Nodes:
        stage = block_stage(relax, RELAX, threads=NODES)
        middle = MIDDLE.astype(np.int32)
        return stage(state, middle, ends.depth, ends.normal, ends.velocity, accelerations, np.float32(dt))
