"""Tissue, and a needle with its thread, without arms: needle and a weight at the thread's other end are led."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import yaml

import surgical_marl as sm
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.solver.cholesky import FULL
from surgical_marl.physics.systems.system import Springs
from surgical_marl.robots.rotation import quaternion

DT, CHUNK = 2.5e-3, 100
ARM = {"ecm_0": {"arm": "ecm", "position": [0.3, 0.0, 0.35], "workspace": [0.0, 0.0, -0.11]}}
WEIGHT = {"free": True, "density": 7900.0, "friction": {"sliding": 0.3, "torsion": 0.0}, "stiffness": 1e6,
          "shapes": [{"sphere": {"radius": 0.001, "position": [0.1, 0.0, 0.1]}}],
          "sites": {"tail": {"position": [0.0, 0.0, 0.0]}}}  # fmt: skip
"""A ball that leads the end of a thread from far away, so that it touches nothing."""


class Seen(NamedTuple):
    """The notes of each step."""

    tension: Any
    """Of the thread's edges, N, [t, n - 1]."""
    thread: Any
    """Places of its nodes, m, [t, n, 3]."""
    nodes: Any
    """Places of the tissue's nodes, m, [t, n, 3]."""
    load: Any
    """Of the thread on the tissue, N, [t, 3]."""
    channels: Any
    left_out: Any
    """Contacts that found no room, [t]."""


def pulling(force: Any) -> Springs:
    """Return springs that do nothing but pull nodes with a force [n, 3], N."""
    n = len(force)
    nodes, weights = jnp.repeat(jnp.arange(n)[:, None], 4, 1), jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (n, 1))
    return Springs(nodes, weights, force, jnp.zeros((n, 6)), jnp.int32(n))


def pulled(load: Springs, u: Any) -> Any:
    """Return the force of springs at displacements of the nodes, m, [n, 3]: N, [3]."""
    moved = jnp.einsum("cq,cqi->ci", load.weights, u[load.nodes])
    return (load.force - jnp.einsum("cij,cj->ci", load.stiffness[:, FULL], moved)).sum(0)


class Bench:
    """A scene far from its only arm, whose free bodies are led.

    Args:
        folder: for its files.
        objects: entries of the scene; "sheet" and "thread" are there.
        files: content of the files that these name.
    """

    def __init__(self, folder: Path, objects: Mapping[str, Any], files: Mapping[str, Any]) -> None:
        for name, content in files.items():
            (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
        path = folder / "sewing.yaml"
        path.write_text(yaml.safe_dump({"arms": ARM, "objects": dict(objects)}))
        simulator = Simulator(sm.load_scene(path))
        self.home, self.step, self.scene = simulator.home, simulator.step, simulator.scene
        self.tissue, self.strand = self.scene.systems["sheet"], self.scene.systems["thread"]
        self.tissue.solver.gravity = np.zeros(3, np.float32)
        names = self.step.bodies.tables.names
        self._centres = np.array([self.scene.objects[name].object.center for name in names])
        self._run = jax.jit(self._steps)

    def lead(self, physics: Any, origins: Any, axes: Any, pull: Any = 0.0) -> tuple[Any, Seen]:
        """Return the state, and what was seen, as the frames of bodies are led along origins [t + 1, k, 3].

        Args:
            physics: at the start.
            origins: m.
            axes: of the frames, [t + 1, k, 3, 3], or [k, 3, 3] if these do not turn.
            pull: forces on the tissue's nodes, N, [n, 3].
        """
        origins = np.asarray(origins, float)
        axes = np.broadcast_to(np.asarray(axes, float), (*origins.shape, 3))
        places = origins + np.einsum("tkij,kj->tki", axes, self._centres)
        turns = np.einsum("tkij,tklj->tkil", axes[1:], axes[:-1])
        spin = np.stack([turns[..., 2, 1] - turns[..., 1, 2], turns[..., 0, 2] - turns[..., 2, 0],
                         turns[..., 1, 0] - turns[..., 0, 1]], -1) / (2 * DT)  # fmt: skip
        velocity = np.concatenate([np.diff(places, axis=0) / DT, spin], -1)
        turned = np.array([[quaternion(one) for one in row] for row in axes[:-1]])
        rows = tuple(np.asarray(x, np.float32) for x in (places[:-1], turned, velocity))
        pulled, noted = jnp.broadcast_to(jnp.asarray(pull, jnp.float32), self.tissue.rest.shape), []
        for at in range(0, len(velocity), CHUNK):  # of one length, so that it is compiled once
            part = [row[at : at + CHUNK] for row in rows]
            assert len(part[0]) == CHUNK, f"ways must be {CHUNK} k + 1"
            physics, seen = self._run(physics, part, pulled)
            noted.append(jax.tree.map(np.asarray, seen))
        return physics, jax.tree.map(lambda *parts: np.concatenate(parts), *noted)

    def _steps(self, physics: Any, rows: Any, pull: Any) -> Any:
        return jax.lax.scan(lambda physics, row: self.once(physics, *row, pull), physics, rows)

    def once(self, physics: Any, position: Any, turn: Any, velocity: Any, pull: Any) -> tuple[Any, Seen]:
        """Step thread and tissue as `Step` does, with bodies as they are told, and with other forces on the tissue."""
        inner, step = physics.rigid_bodies, copy.copy(self.step)
        loads = step._loads

        def with_pull(name: str, others: Any) -> dict[str, tuple[Springs, ...]]:
            return {key: (*own, pulling(pull)) for key, own in loads(name, others).items()}

        step._loads = with_pull
        bodies = inner.bodies._replace(
            position=position, quaternion=turn, velocity=velocity, acceleration=jnp.zeros_like(velocity)
        )
        tissue, physics = physics.systems["sheet"], physics.with_systems(rigid_bodies=inner._replace(bodies=bodies))
        found = step.find(physics, step.arms.dynamics.pose(physics.qpos))
        meetings = step._meetings(physics, found)
        (load,) = loads("sheet", meetings)["loads"]
        after = step._systems_moved(physics, physics, found, meetings)
        chain, state = after.systems["thread"].chain, after.systems["sheet"]
        force = pulled(load, state.nodes.position - tissue.nodes.position)
        view, left_out = self.tissue.view(state).channels, meetings["thread"].ends.left_out
        return after, Seen(chain.tension[:-1], chain.position, state.nodes.position, force, view, left_out)
