"""Skins in many environments, for the ray caster: nodes, normals at the corners of faces, and balls around parts.

A part of a skin is drawn in place of a geom of the model, so that pictures name that geom.
"""

# Kernels are Warp's language, which only looks like Python: annotations are read as they are, without a
# `from __future__`; a number that a loop changes is told its type.
# mypy: ignore-errors
from collections.abc import Sequence

import numpy as np

from surgical_marl.runtime import prepare_warp
from surgical_marl.vision.skin import Skin

wp = prepare_warp()
wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

BLOCK = 128
"""Threads in a CUDA block."""


@wp.kernel
def bend(
    nodes: wp.array2d[wp.vec3],
    faces: wp.array2d[int],
    joined: wp.array[int],
    first: wp.array[int],
    normals: wp.array2d[wp.vec3],
):
    """Write the unit normal at each corner, that of the faces that are smoothly joined there, by their areas."""
    env, corner = wp.tid()
    total = wp.vec3(0.0)
    for k in range(first[corner], first[corner + 1]):
        face = joined[k]
        one = nodes[env, faces[face, 2]] - nodes[env, faces[face, 0]]
        total += wp.cross(one, nodes[env, faces[face, 3]] - nodes[env, faces[face, 1]])
    normals[env, corner] = wp.normalize(total)


@wp.kernel
def bound(
    nodes: wp.array2d[wp.vec3],
    faces: wp.array2d[int],
    firsts: wp.array[int],
    counts: wp.array[int],
    balls: wp.array2d[wp.vec4],
):
    """Write the ball around the faces of each shape that is a part of a skin: middle and radius."""
    env, shape = wp.tid()
    if counts[shape] == 0:
        return
    low = nodes[env, faces[firsts[shape], 0]]
    high = low
    for face in range(firsts[shape], firsts[shape] + counts[shape]):
        for k in range(4):
            node = nodes[env, faces[face, k]]
            low = wp.min(low, node)
            high = wp.max(high, node)
    middle = 0.5 * (low + high)
    balls[env, shape] = wp.vec4(middle[0], middle[1], middle[2], 0.5 * wp.length(high - low))


class Surfaces:
    """The skins of a scene in N environments, on Warp's current device.

    Args:
        skins: of the scene.
        geoms: of all shapes that are drawn.
        num_envs: N.

    Attributes:
        nodes: of all skins, one after the other, [N, nodes] of Warp's vectors; at rest until others are written.
        faces: their numbers around each face, [f, 4]; those of a shape follow each other.
        firsts, counts: of the faces of each shape; 0 for others.
        normals: at the corners of faces, [N, 4 f].
        balls: around the faces of each shape, [N, shapes].
        slices: of `nodes` by the name of the skin.
    """

    def __init__(self, skins: Sequence[Skin], geoms: np.ndarray, num_envs: int) -> None:
        faces, shapes, joined, firsts = [np.zeros((0, 4), int)], [np.zeros(0, int)], [], [0]
        self.slices, self.rest = {}, {skin.name: skin.rest.astype(np.float32) for skin in skins}
        nodes = count = 0
        for skin in skins:
            order = np.argsort(skin.owners, kind="stable")
            place = np.argsort(order)  # of each face among those in this order
            corners, others = skin.joined
            corners = 4 * place[corners // 4] + corners % 4
            by_corner = np.argsort(corners, kind="stable")
            joined += (count + place[others[by_corner]]).tolist()
            firsts += (firsts[-1] + np.cumsum(np.bincount(corners, minlength=4 * len(order)))).tolist()
            faces.append(nodes + skin.faces[order])
            shapes.append(np.searchsorted(geoms, skin.geoms[skin.owners[order]]))
            self.slices[skin.name] = slice(nodes, nodes + len(skin.rest))
            nodes, count = nodes + len(skin.rest), count + len(order)
        owned, shape = np.concatenate(faces), np.concatenate(shapes)
        counts = np.bincount(shape, minlength=len(geoms))
        self._joined, self._first = wp.array(joined, dtype=int), wp.array(firsts, dtype=int)
        self.faces = wp.array(owned, dtype=int, ndim=2)
        self.firsts = wp.array(np.searchsorted(shape, np.arange(len(geoms))), dtype=int)
        self.counts = wp.array(counts, dtype=int)
        rest = np.concatenate([*self.rest.values(), np.zeros((0, 3), np.float32)])
        self.nodes = wp.array(np.repeat(rest[None], num_envs, 0), dtype=wp.vec3, ndim=2)
        self.normals = wp.empty((num_envs, 4 * len(owned)), dtype=wp.vec3)
        self.balls = wp.empty((num_envs, len(geoms) if skins else 0), dtype=wp.vec4)

    def update(self) -> None:
        """Compute normals and balls for `nodes`."""
        if self.slices:
            given = [self.nodes, self.faces, self._joined, self._first, self.normals]
            wp.launch(bend, self.normals.shape, given, block_dim=BLOCK)
            given = [self.nodes, self.faces, self.firsts, self.counts, self.balls]
            wp.launch(bound, self.balls.shape, given, block_dim=BLOCK)
