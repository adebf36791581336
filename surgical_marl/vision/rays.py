"""Casts a ray through every pixel of many cameras' pictures, in three kernels.

Every shape except a mesh and a part of a skin is convex, so a ray is inside it between two depths. `place` puts the
shapes into the cameras' frames, `cull` lists for every tile of a picture the shapes that some of its rays may meet, and
`draw` tests only those. Threads of a warp share a tile, so they test the same shapes at the same time.
"""

# Kernels are Warp's language, which only looks like Python. Annotations are read as they are, without a
# `from __future__`; a number that a loop changes is told its type; what is static has an `if` of its own.
# ruff: noqa: UP018, RUF046, SIM102, SIM109
# mypy: ignore-errors
from functools import cache
from typing import Any

from surgical_marl.runtime import prepare_warp

wp = prepare_warp()
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

TILE = wp.constant(8)
"""Pixels along each side of a tile."""
TINY, FAR = wp.constant(1e-9), wp.constant(1e6)
ELLIPSOID, CAPSULE, CYLINDER, BOX, MESH, SKIN = map(wp.constant, range(6))


@wp.struct
class Light:
    """The lamp in the room and the headlight, as MuJoCo knows them."""

    position: wp.vec3
    direction: wp.vec3
    cutoff: wp.float32
    """Cosine of the angle at which the lamp's cone ends."""
    exponent: wp.float32
    diffuse: wp.vec3
    specular: wp.vec3
    head_ambient: wp.vec3
    head_diffuse: wp.vec3
    head_specular: wp.vec3


@wp.func
def ball(p: wp.vec3, v: wp.vec3):
    """Return the depths t between which p + t v is in the unit ball; the first is greater if there are none."""
    a = wp.max(wp.dot(v, v), 1e-12)
    middle = -wp.dot(p, v) / a
    nearest = p + middle * v
    inside = 1.0 - wp.dot(nearest, nearest)  # b^2 - a c, without its cancellation
    half = wp.where(inside >= 0.0, wp.sqrt(wp.max(inside, 0.0) / a), -1.0)
    return wp.vec2(middle - half, middle + half)


@wp.func
def slab(p: float, v: float, size: float):
    """Return the depths t between which |p + t v| < size."""
    scale = 1.0 / wp.where(wp.abs(v) > TINY, v, TINY)
    return wp.vec2(-p * scale - size * wp.abs(scale), -p * scale + size * wp.abs(scale))


@wp.func
def both(a: wp.vec2, b: wp.vec2):
    return wp.vec2(wp.max(a[0], b[0]), wp.min(a[1], b[1]))


@wp.func
def span(kind: int, size: wp.vec3, p: wp.vec3, v: wp.vec3):
    """Return the depths t between which p + t v is in a shape; the first is greater if there are none."""
    if kind == BOX:
        return both(both(slab(p[0], v[0], size[0]), slab(p[1], v[1], size[1])), slab(p[2], v[2], size[2]))
    if kind == ELLIPSOID:
        return ball(wp.cw_div(p, size), wp.cw_div(v, size))
    side = ball(wp.vec3(p[0], p[1], 0.0) / size[0], wp.vec3(v[0], v[1], 0.0) / size[0])
    if kind == CYLINDER:
        return both(side, slab(p[2], v[2], size[1]))
    if side[0] <= side[1]:  # a capsule: beyond an end of the tube, the ball there
        first, last = p[2] + side[0] * v[2], p[2] + side[1] * v[2]
        if wp.abs(first) > size[1]:
            end = wp.vec3(0.0, 0.0, wp.sign(first) * size[1])
            cap = ball((p - end) / size[0], v / size[0])
            side[0] = wp.where(cap[0] <= cap[1], cap[0], FAR)
        if wp.abs(last) > size[1]:
            end = wp.vec3(0.0, 0.0, wp.sign(last) * size[1])
            cap = ball((p - end) / size[0], v / size[0])
            side[1] = wp.where(cap[0] <= cap[1], cap[1], -FAR)
    return side


@wp.func
def outwards(kind: int, size: wp.vec3, p: wp.vec3):
    """Return a vector that is normal to the surface of a shape at a point p of it, and points out of the shape.

    Its length is not 1 in general.
    """
    if kind == BOX:
        away = wp.abs(p) - size
        if away[0] >= away[1] and away[0] >= away[2]:
            return wp.vec3(p[0], 0.0, 0.0)
        if away[1] >= away[2]:
            return wp.vec3(0.0, p[1], 0.0)
        return wp.vec3(0.0, 0.0, p[2])
    if kind == ELLIPSOID:
        return wp.cw_div(wp.cw_div(p, size), size)
    if kind == CYLINDER:
        if wp.abs(p[2]) - size[1] > wp.sqrt(p[0] * p[0] + p[1] * p[1]) - size[0]:
            return wp.vec3(0.0, 0.0, p[2])
        return wp.vec3(p[0], p[1], 0.0)
    return wp.vec3(p[0], p[1], p[2] - wp.clamp(p[2], -size[1], size[1]))


@wp.func
def reach(kind: int, size: wp.vec3, n: wp.vec3):
    """Return the greatest value of n . x over all points x of a shape."""
    if kind == BOX or kind == MESH:  # a mesh is in its box
        return wp.dot(size, wp.abs(n))
    if kind == ELLIPSOID or kind == SKIN:  # a part of a skin is in its ball
        return wp.length(wp.cw_mul(size, n))
    if kind == CYLINDER:
        return size[0] * wp.sqrt(n[0] * n[0] + n[1] * n[1]) + size[1] * wp.abs(n[2])
    return size[0] * wp.length(n) + size[1] * wp.abs(n[2])


@wp.func
def size_of(kind: int, shape: int, env: int, sizes: wp.array[wp.vec3], balls: wp.array2d[wp.vec4]):
    if kind == SKIN:
        return wp.vec3(balls[env, shape][3])
    return sizes[shape]


@wp.func
def meets(p: wp.vec3, v: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Return the depth t at which p + t v is in a triangle, and its shares of b and c; t is -1 if it never is.

    Möller and Trumbore, Journal of Graphics Tools 2(1), 1997. Neighbours overlap by a millionth, so that no ray passes.
    """
    one, other, away = b - a, c - a, p - a
    across = wp.cross(v, other)
    volume = wp.dot(one, across)
    scale = 1.0 / wp.where(wp.abs(volume) > 1e-18, volume, 1e-18)
    around = wp.cross(away, one)
    u, w, t = scale * wp.dot(away, across), scale * wp.dot(v, around), scale * wp.dot(other, around)
    inside = u >= -1e-6 and w >= -1e-6 and u + w <= 1.000001
    return wp.vec3(wp.where(inside, t, -1.0), u, w)


@wp.func
def shine(light: wp.vec3, normal: wp.vec3, view: wp.vec3, colour: wp.vec3, diffuse: wp.vec3, specular: wp.vec3):
    """Return the light that comes to the eye from one lamp, as in MuJoCo for a geom without material settings."""
    facing = wp.dot(normal, light)
    if facing <= 0.0:
        return wp.vec3(0.0)
    gleam = wp.max(wp.dot(normal, wp.normalize(light + view)), 0.0)
    return wp.cw_mul(colour, diffuse) * facing + specular * (0.5 * wp.pow(gleam, 64.0))


@wp.kernel
def place(
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
    geoms: wp.array[int],
    kinds: wp.array[int],
    cam_xpos: wp.array2d[wp.vec3],
    cam_xmat: wp.array2d[wp.mat33],
    cameras: wp.array[int],
    balls: wp.array2d[wp.vec4],
    turns: wp.array2d[wp.mat33],
    eyes: wp.array2d[wp.vec3],
):
    """Rotations from a camera's frame to a shape's, and places of the eye there; both [pictures, shapes].

    The frame of a part of a skin is the world's, about the middle of its ball.
    """
    picture, shape = wp.tid()
    env, camera, geom = picture // cameras.shape[0], cameras[picture % cameras.shape[0]], geoms[shape]
    if kinds[shape] == SKIN:
        turns[picture, shape] = cam_xmat[env, camera]
        ball_of = balls[env, shape]
        eyes[picture, shape] = cam_xpos[env, camera] - wp.vec3(ball_of[0], ball_of[1], ball_of[2])
        return
    back = wp.transpose(geom_xmat[env, geom])
    turns[picture, shape] = back @ cam_xmat[env, camera]
    eyes[picture, shape] = back @ (cam_xpos[env, camera] - geom_xpos[env, geom])


@wp.kernel
def cull(
    kinds: wp.array[int],
    sizes: wp.array[wp.vec3],
    turns: wp.array2d[wp.mat33],
    eyes: wp.array2d[wp.vec3],
    balls: wp.array2d[wp.vec4],
    cameras: int,
    pixel: float,
    width: int,
    height: int,
    listed: wp.array3d[wp.uint16],
    counts: wp.array2d[int],
):
    """List the shapes that rays of a tile may meet, in ascending order.

    A shape is left out if it is wholly behind the eye, or wholly beyond one of the planes through the eye and a side of
    the tile.
    """
    picture, tile = wp.tid()
    columns = (width + TILE - 1) // TILE
    left = (float(tile % columns * TILE) - 0.5 * float(width)) * pixel
    top = (0.5 * float(height) - float(tile // columns * TILE)) * pixel
    right, bottom = left + float(TILE) * pixel, top - float(TILE) * pixel
    count = int(0)
    for shape in range(kinds.shape[0]):
        kind, turn, eye = kinds[shape], turns[picture, shape], eyes[picture, shape]
        size = size_of(kind, shape, picture // cameras, sizes, balls)
        n = turn @ wp.vec3(0.0, 0.0, -1.0)
        seen = reach(kind, size, n) >= wp.dot(n, eye)
        if seen:
            n = turn @ wp.vec3(1.0, 0.0, left)
            seen = reach(kind, size, n) >= wp.dot(n, eye)
        if seen:
            n = turn @ wp.vec3(-1.0, 0.0, -right)
            seen = reach(kind, size, n) >= wp.dot(n, eye)
        if seen:
            n = turn @ wp.vec3(0.0, 1.0, bottom)
            seen = reach(kind, size, n) >= wp.dot(n, eye)
        if seen:
            n = turn @ wp.vec3(0.0, -1.0, -top)
            seen = reach(kind, size, n) >= wp.dot(n, eye)
        if seen:
            listed[picture, tile, count] = wp.uint16(shape)
            count += 1
    counts[picture, tile] = count


@cache
def make_draw(meshes: bool, skins: bool) -> Any:
    """Return the last kernel, `draw`; without meshes or skins it needs fewer registers."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def draw(
        kinds: wp.array[int],
        sizes: wp.array[wp.vec3],
        colours: wp.array[wp.vec3],
        geoms: wp.array[int],
        mesh_ids: wp.array[wp.uint64],
        first_faces: wp.array[int],
        face_normals: wp.array2d[wp.vec3],
        nodes: wp.array2d[wp.vec3],
        faces: wp.array2d[int],
        firsts: wp.array[int],
        face_counts: wp.array[int],
        corner_normals: wp.array2d[wp.vec3],
        turns: wp.array2d[wp.mat33],
        eyes: wp.array2d[wp.vec3],
        listed: wp.array3d[wp.uint16],
        counts: wp.array2d[int],
        cam_xpos: wp.array2d[wp.vec3],
        cam_xmat: wp.array2d[wp.mat33],
        cameras: wp.array[int],
        pixel: float,
        width: int,
        height: int,
        light: Light,
        background: wp.vec3,
        rgb: wp.array3d[wp.vec3ub],
        depth: wp.array3d[float],
        segmentation: wp.array3d[int],
    ):
        """Draw colour, depth and geom of a pixel, each if it has pictures to write to."""
        picture, tile, place_in_tile = wp.tid()
        columns = (width + TILE - 1) // TILE
        column = tile % columns * TILE + place_in_tile % TILE
        row = tile // columns * TILE + place_in_tile // TILE
        if column >= width or row >= height:
            return
        # so long that t is the depth along the optical axis
        ray = wp.vec3(
            (float(column) + 0.5 - 0.5 * float(width)) * pixel, (0.5 * float(height) - float(row) - 0.5) * pixel, -1.0
        )
        best, hit, face = float(FAR), int(-1), int(-1)
        u, w = float(0.0), float(0.0)
        for i in range(counts[picture, tile]):
            shape = int(listed[picture, tile, i])
            kind, p, v = kinds[shape], eyes[picture, shape], turns[picture, shape] @ ray
            t = float(-1.0)
            if wp.static(meshes):
                if kind == MESH:
                    query = wp.mesh_query_ray(mesh_ids[shape], p, v, best)
                    if query.result:
                        t, u, w, face = float(query.t), float(query.u), float(query.v), int(query.face)
            if wp.static(skins):
                if kind == SKIN:
                    own, nearest = picture // cameras.shape[0], float(best)
                    eye = cam_xpos[own, cameras[picture % cameras.shape[0]]]
                    for k in range(2 * firsts[shape], 2 * (firsts[shape] + face_counts[shape])):
                        quad, half = k // 2, k % 2
                        a, b = nodes[own, faces[quad, 0]], nodes[own, faces[quad, 1 + half]]
                        found = meets(eye, v, a, b, nodes[own, faces[quad, 2 + half]])
                        if found[0] >= 0.0 and found[0] < nearest:
                            t, u, w, face = float(found[0]), float(found[1]), float(found[2]), int(k)
                            nearest = float(found[0])
            if kind < MESH:
                depths = span(kind, sizes[shape], p, v)
                if depths[0] <= depths[1]:
                    t = wp.where(depths[0] >= 0.0, depths[0], depths[1])  # from inside, its far side
            if t >= 0.0 and t <= best * 1.000001:  # of two geoms at the same depth the later one, as in MuJoCo
                best, hit = t, shape
        if depth.shape[0] > 0:
            depth[picture, row, column] = wp.where(hit >= 0, best, 0.0)
        if segmentation.shape[0] > 0:
            segmentation[picture, row, column] = wp.where(hit >= 0, geoms[wp.max(hit, 0)], -1)
        if rgb.shape[0] == 0:
            return
        seen = background
        if hit >= 0:
            turn, at = turns[picture, hit], best * ray
            normal = outwards(kinds[hit], sizes[hit], eyes[picture, hit] + turn @ at)
            if wp.static(meshes):
                if kinds[hit] == MESH:
                    f = first_faces[hit] + face
                    normal = u * face_normals[f, 0] + w * face_normals[f, 1] + (1.0 - u - w) * face_normals[f, 2]
            if wp.static(skins):
                if kinds[hit] == SKIN:
                    own, corner, half = picture // cameras.shape[0], 4 * (face // 2), face % 2
                    normal = (1.0 - u - w) * corner_normals[own, corner]
                    normal += u * corner_normals[own, corner + 1 + half] + w * corner_normals[own, corner + 2 + half]
            normal = wp.normalize(wp.transpose(turn) @ normal)
            view = -wp.normalize(ray)
            if wp.dot(normal, view) < 0.0:  # seen from inside
                normal = -normal
            env, camera, colour = picture // cameras.shape[0], cameras[picture % cameras.shape[0]], colours[hit]
            home = wp.transpose(cam_xmat[env, camera])
            to_lamp = wp.normalize(home @ (light.position - cam_xpos[env, camera]) - at)
            along = -wp.dot(to_lamp, home @ light.direction)
            seen = wp.cw_mul(colour, light.head_ambient)
            seen += shine(wp.vec3(0.0, 0.0, 1.0), normal, view, colour, light.head_diffuse, light.head_specular)
            if along >= light.cutoff:
                fade = wp.pow(along, light.exponent)
                seen += fade * shine(to_lamp, normal, view, colour, light.diffuse, light.specular)
        seen = 255.0 * wp.min(seen, wp.vec3(1.0, 1.0, 1.0))
        rgb[picture, row, column] = wp.vec3ub(wp.uint8(seen[0]), wp.uint8(seen[1]), wp.uint8(seen[2]))

    return draw
