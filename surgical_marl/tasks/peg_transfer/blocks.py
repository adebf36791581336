"""Blocks that stand on pegs: where they are, how a jaw grips them with a finger between block and peg, grip terms."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.physics.outputs import ObjectView
from surgical_marl.robots.rotation import quaternion
from surgical_marl.runtime import jnp
from surgical_marl.scenes.objects import Object
from surgical_marl.scenes.scene import Mount, Scene
from surgical_marl.tasks.base.grasp_poses import DOWN, frames, tool_of, tool_poses
from surgical_marl.tasks.base.object_task import FAR
from surgical_marl.tasks.base.terms import Term
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array


OUT = 0.0009
"""Distance outside the bar of the middle between the fingers before they close, m: the inner one is near the peg."""


def upright(place: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Return poses [n, 4, 4] at places [n, 3], turned about z by `yaw` [n], degrees."""
    half = np.radians(yaw) / 2
    return frames(place, np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], -1))


def as_numbers(poses: np.ndarray) -> np.ndarray:
    """Return poses [..., 4, 4] as places and quaternions [..., 7]."""
    turns = np.array([quaternion(turn) for turn in poses[..., :3, :3].reshape(-1, 3, 3)])
    return np.concatenate([poses[..., :3, 3], turns.reshape(*poses.shape[:-2], 4)], -1)


def gripping(mount: Mount, body: np.ndarray, site: np.ndarray, beyond: float) -> np.ndarray:
    """Return poses [n, 4, 4] of tools that point down at a bar of blocks at poses [n, 4, 4], a finger in the hole.

    Args:
        mount: the arm.
        body: of the blocks.
        site: middle of the bar in the block's frame, [3] or [n, 3].
        beyond: how far the tool tip is past the bar, m.
    """
    way = np.einsum("nij,nj->ni", body[:, :3, :3], np.broadcast_to(site * [1.0, 1.0, 0.0], (len(body), 3)))
    outward = way * [1.0, 1.0, 0.0] / np.linalg.norm(way[:, :2], axis=-1, keepdims=True)
    along = np.cross(np.array([0.0, 0.0, 1.0]), outward)
    along = np.where((along @ tool_of(mount, mount.arm.home)[:3, 0])[:, None] < 0, -along, along)
    place = body[:, :3, 3] + np.einsum("nij,nj->ni", body[:, :3, :3], np.broadcast_to(site, (len(body), 3)))
    return tool_poses(place + OUT * outward, along, DOWN, np.full(len(body), beyond))


def find_pegs(scene: Scene, task: str) -> np.ndarray:
    """Return where the axes of pegs meet the plate in the world, [pegs, 3], m. ValueError if there is no peg."""
    found = [
        place.position + place.rotation @ site
        for place in scene.objects.values()
        for name, (site, _) in place.object.sites.items()
        if name.startswith("peg_")
    ]
    if not found:
        raise ValueError(f"{task} needs a scene with a board that has sites peg_0, peg_1, ...; {scene.name!r} has none")
    return np.array(found)


def side_pegs(scene: Scene, agent: str, moved: Collection[str]) -> np.ndarray:
    """Return the pegs [n, 3] that are nearer to an arm than to others with a jaw, and free of blocks that stay.

    `moved` are the blocks that do not stay.
    """
    pegs, mounts = find_pegs(scene, "peg_transfer"), scene.mounts

    def away(place: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm((pegs - place)[:, :2], axis=-1))

    jaws = [own for name, own in mounts.items() if name != agent and own.arm.jaw]
    taken = [place.position for name, place in scene.free_objects.items() if name not in moved]
    good = [away(mounts[agent].position) < away(other.position) for other in jaws]
    return pegs[np.all([*good, *(away(place) > 0.01 for place in taken)], axis=0)]


def grasp_terms(mount: Mount, agent: str, item: Object, body: Callable[[World], ObjectView]) -> dict[str, Term]:
    """Return `to_grasp` and `grasp_axis`, [3] each, in an arm's base frame and SI units.

    The bar at hand is the one that is most along the tool's x axis, of those with a site `grasp_0`, `grasp_1`, ...
    `to_grasp` is the way from the tool tip to its middle, `grasp_axis` its direction: the one that is less than a right
    angle from the tool's x axis. Which bar that is jumps as the block is turned; a network that has only the block's
    pose brings the tool between two of them (docs/tuning.md).

    Args:
        mount: the arm.
        agent: its name.
        item: the object.
        body: returns where the object is in a world.
    """
    sites = [site for name, site in item.sites.items() if name.startswith("grasp_")]
    middles, axes = (np.array(part, np.float32) for part in zip(*sites, strict=True))
    turn, origin = mount.rotation.astype(np.float32), mount.position.astype(np.float32)

    def grasp(world: World) -> tuple[Array, Array]:
        here, view = body(world), world.arms[agent]
        along = axes[:, :, 0] @ (turn.T @ here.rotation).T
        share = along @ view.tool_axes[:, 0]
        best = jnp.argmax(jnp.abs(share))
        places = here.position + here.size * middles @ here.rotation.T - origin
        return (places @ turn)[best] - view.tool_tip, jnp.where(share[best] < 0, -along[best], along[best])

    far, one = np.full(3, FAR), np.ones(3)
    return {
        "to_grasp": Term(lambda world: grasp(world)[0], -far, far, "object"),
        "grasp_axis": Term(lambda world: grasp(world)[1], -one, one, "object"),
    }
