"""Trace rays among the shapes of a picture: to the first shape, and from a point to a lamp.

`list_shapes` lists for every tile of a camera's or a lamp's picture the shapes that some of its rays may meet; rays
then test only those. The kernels run on a CPU, one picture a thread of the caller.
"""

# Kernels are Warp's language, which only looks like Python. Annotations are read as they are, without a
# `from __future__`; a number that a loop or a branch changes is told its type.
# ruff: noqa: UP018, RUF046, SIM109
# mypy: ignore-errors
from surgical_marl.runtime import prepare_warp
from surgical_marl.view.lighting import OPTIONS, hidden, ramp
from surgical_marl.vision.rays import BOX, CYLINDER, FAR, MESH, outwards, reach, span

wp = prepare_warp()
wp.set_module_options(OPTIONS)

TILE = wp.constant(8)
"""Pixels along each side of a tile."""
HALF_OPEN = wp.constant(0.7)
"""Share of the sky that counts as seen from surfaces that look down."""
SIDES = wp.constant(4)
"""Sides of a shape that edges are smoothed between, at most."""
RAYS = wp.constant(12)
"""Rays from a point to a lamp that a mesh may hide."""
DARK = wp.constant(0.004)
"""Share of a lamp that counts as nothing."""
PLANE = wp.constant(5)
"""Kind of a shape, besides those of `vision/rays.py`: all below z = 0 in its frame."""


@wp.struct
class Eye:
    """A camera, or a lamp that asks which shapes stand between it and a point."""

    place: wp.vec3
    axes: wp.mat33
    """Right, up and back as columns."""
    tile: wp.float32
    """Width of a tile at distance 1."""
    columns: wp.int32
    rows: wp.int32
    left: wp.float32
    """Place of the picture's left edge at distance 1."""
    top: wp.float32
    spread: wp.float32
    """Radius of a lamp over its distance; 0 for a camera."""
    far: wp.float32
    """Height above a point from which on nothing throws a shadow there, m; shadows grow weaker until there."""
    margin: wp.float32
    """Margin of shapes, m: so far a half shadow may reach beyond them."""
    first: wp.int32
    """Row of the lists of shapes that belongs to its first tile."""


@wp.struct
class Shape:
    """A shape of a picture."""

    kind: wp.int32
    """One of `vision/rays.py`, or `PLANE`."""
    size: wp.vec3
    radius: wp.float32
    """Radius of a ball about the shape's origin that holds the shape, m."""
    place: wp.vec3
    viewer: wp.vec3
    """The viewpoint, in the shape's frame."""
    near: wp.float32
    """Distance from the viewpoint to the ball about the shape, m; below 0 inside it."""
    bottom: wp.float32
    """Height of its lowest point, or less, m."""
    top: wp.float32
    """Height of its highest point, or more, m."""
    back: wp.mat33
    """Rotation from the world's frame to the shape's."""
    shadow_kind: wp.int32
    """Number of the shape that throws its shadow; -1 if it throws none."""
    shadow_size: wp.vec3
    breadth: wp.vec2
    """Half width and half length as seen from the side."""
    colour: wp.vec3
    alpha: wp.float32
    gloss: wp.vec3
    pattern: wp.int32
    mesh: wp.uint64
    first_face: wp.int32


@wp.struct
class World:
    """All that a picture is drawn of, and which of it each tile of an eye may show."""

    shapes: wp.array[Shape]
    balls: wp.int32
    """Number of the first ball that is no part of the model; balls come last, the farthest first."""
    through: wp.float32
    """Share of a ball's colour that is seen through shapes in front of it."""
    fade: wp.float32
    """Distance at which planes have faded, m."""
    grain: wp.array3d[wp.vec4]
    """Noise that patterns are made of."""
    face_normals: wp.array2d[wp.vec3]
    """At the corners of all faces of meshes."""
    eyes: wp.array[Eye]
    """The camera, the lamp, and the sky as a lamp overhead."""
    listed: wp.array2d[wp.uint16]
    """Shapes that rays through a tile may meet [tiles, shapes], of all eyes."""
    counts: wp.array[int]
    """Number of the shapes that are listed for each tile, [tiles]."""


@wp.func
def meets(world: World, eye: Eye, shape: int, n: wp.vec3):
    """Return whether a shape reaches beyond a plane through the eye; n is normal to it, in the eye's frame."""
    if world.shapes[shape].kind == PLANE:
        return True
    local = world.shapes[shape].back @ (eye.axes @ n)
    away = wp.dot(local, world.shapes[shape].back @ (eye.place - world.shapes[shape].place))
    return reach(world.shapes[shape].kind, world.shapes[shape].size, local) + eye.margin * wp.length(n) >= away


@wp.kernel
def list_shapes(world: World, order: wp.array[int], number: int):
    """List shapes for every tile of an eye; one thread does all, so that all lists are in the same order.

    Args:
        order: numbers of the shapes to list, in this order.
        number: of the eye. A lamp lists what throws shadows.
    """
    eye = world.eyes[number]
    for place in range(order.shape[0]):
        shape = order[place]
        at = wp.transpose(eye.axes) @ (world.shapes[shape].place - eye.place)
        radius = world.shapes[shape].radius + eye.margin
        near, far = -at[2] - radius, -at[2] + radius
        first_column, last_column, first_row, last_row = int(0), int(eye.columns) - 1, int(0), int(eye.rows) - 1
        if near > 1e-3:
            left = (at[0] - radius) / wp.where(at[0] < radius, near, far)
            right = (at[0] + radius) / wp.where(at[0] > -radius, near, far)
            low = (at[1] - radius) / wp.where(at[1] < radius, near, far)
            high = (at[1] + radius) / wp.where(at[1] > -radius, near, far)
            first_column = wp.max(int(wp.floor((left - eye.left) / eye.tile)), 0)
            last_column = wp.min(int(wp.floor((right - eye.left) / eye.tile)), eye.columns - 1)
            first_row = wp.max(int(wp.floor((eye.top - high) / eye.tile)), 0)
            last_row = wp.min(int(wp.floor((eye.top - low) / eye.tile)), eye.rows - 1)
        if far <= 0.0 or (eye.spread > 0.0 and world.shapes[shape].shadow_kind < 0):
            last_row = -1
        for row in range(first_row, last_row + 1):
            top = eye.top - float(row) * eye.tile
            seen = meets(world, eye, shape, wp.vec3(0.0, 1.0, top - eye.tile))
            if seen and meets(world, eye, shape, wp.vec3(0.0, -1.0, -top)):
                for column in range(first_column, last_column + 1):
                    edge = eye.left + float(column) * eye.tile
                    seen = meets(world, eye, shape, wp.vec3(1.0, 0.0, edge))
                    if seen and meets(world, eye, shape, wp.vec3(-1.0, 0.0, -edge - eye.tile)):
                        tile = eye.first + row * eye.columns + column
                        world.listed[tile, world.counts[tile]] = wp.uint16(shape)
                        world.counts[tile] += 1


@wp.func
def lit(world: World, lamp: Eye, point: wp.vec3, own: int, joint: float):
    """Return the share of a lamp that a point of a shape sees.

    Args:
        joint: 0 if shapes that hide the same part of the lamp count once, 1 if each of them counts.
    """
    at = wp.transpose(lamp.axes) @ (point - lamp.place)
    if at[2] >= -1e-6:
        return 1.0
    column = int(wp.floor((-at[0] / at[2] - lamp.left) / lamp.tile))
    row = int(wp.floor((lamp.top + at[1] / at[2]) / lamp.tile))
    if column < 0 or row < 0 or column >= lamp.columns or row >= lamp.rows:
        return 1.0
    way = lamp.place - point
    distance = wp.length(way)
    way = way / distance
    light, each = float(1.0), float(1.0)
    tile = lamp.first + row * lamp.columns + column
    for i in range(world.counts[tile]):
        shape = int(world.listed[tile, i])
        if world.shapes[shape].bottom > point[2] + lamp.far or light + joint * (each - light) < DARK:
            break
        towards = world.shapes[shape].place - point
        along = wp.dot(towards, way)
        radius = world.shapes[shape].radius
        wide = radius + lamp.spread * wp.max(along + radius, 0.0)
        near = (
            world.shapes[shape].top > point[2]
            and along > -radius
            and along - radius < lamp.far
            and wp.dot(towards, towards) - along * along < wide * wide
        )
        if near and (shape != own or world.shapes[shape].kind == MESH):
            cover = float(0.0)
            p, v = -(world.shapes[shape].back @ towards), world.shapes[shape].back @ way
            if world.shapes[shape].kind == MESH:
                for k in range(RAYS):  # to points all over the lamp, in a spiral
                    away, angle = lamp.spread * distance * wp.sqrt((float(k) + 0.5) / float(RAYS)), 2.4 * float(k)
                    aim = way * distance + away * (lamp.axes @ wp.vec3(wp.cos(angle), wp.sin(angle), 0.0))
                    turned = world.shapes[shape].back @ wp.normalize(aim)
                    if wp.mesh_query_ray(world.shapes[shape].mesh, p, turned, distance).result:
                        cover += 1.0 / float(RAYS)
            else:
                cover = hidden(
                    world.shapes[shape].shadow_kind,
                    world.shapes[shape].shadow_size,
                    world.shapes[shape].breadth,
                    p,
                    v,
                    lamp.spread,
                )
            cover = cover * world.shapes[shape].alpha * (1.0 - ramp(0.0, 1.0, (along - radius) / lamp.far))
            light = wp.min(light, 1.0 - cover)
            each = each * (1.0 - cover)
    return light + joint * (each - light)


@wp.func
def lamps(world: World, shape: int, point: wp.vec3, normal: wp.vec3):
    """Return the shares of the lamp and of the sky that a point of a shape sees."""
    raised = point + 2e-5 * normal
    light, open = float(0.0), float(HALF_OPEN)
    if wp.dot(normal, world.eyes[1].place - point) > -0.2 * wp.length(world.eyes[1].place - point):
        light = lit(world, world.eyes[1], raised, shape, 0.0)
    upwards = ramp(-0.3, 0.2, normal[2])
    if upwards > 0.0:
        open += upwards * (lit(world, world.eyes[2], raised, shape, 1.0) - open)
    return wp.vec2(light, open)


@wp.func
def ray_of(eye: Eye, column: float, row: float):
    """Return the unit vector through a place of the picture."""
    x, y = eye.left + column * eye.tile / float(TILE), eye.top - row * eye.tile / float(TILE)
    return wp.normalize(eye.axes @ wp.vec3(x, y, -1.0))


@wp.func
def meet(world: World, column: float, row: float):
    """Return the length of a ray, the normal where it ends, and the side of which shape that is; 0 for nothing."""
    eye = world.eyes[0]
    ray = ray_of(eye, column, row)
    tile = int(row) // TILE * eye.columns + int(column) // TILE
    best, hit, face = float(FAR), int(-1), int(-1)
    u, w = float(0.0), float(0.0)
    for i in range(world.counts[tile]):
        shape = int(world.listed[tile, i])
        if world.shapes[shape].near > best:  # so are all that follow
            break
        kind, p, v = world.shapes[shape].kind, world.shapes[shape].viewer, world.shapes[shape].back @ ray
        t = float(-1.0)
        if kind == MESH:
            query = wp.mesh_query_ray(world.shapes[shape].mesh, p, v, best)
            if query.result:
                t, u, w, face = float(query.t), float(query.u), float(query.v), int(query.face)
        elif kind == PLANE:
            t = -p[2] / wp.where(wp.abs(v[2]) > 1e-9, v[2], 1e-9)
        else:
            depths = span(kind, world.shapes[shape].size, p, v)
            if depths[0] <= depths[1]:
                t = depths[0]  # below 0 if the eye is inside, as a scope's is in its sleeve: then it looks out
        # of two in one place the later one of the model is seen
        if t >= 0.0 and t <= best * wp.where(shape > hit, 1.000001, 0.999999):
            best, hit = t, shape
    normal, side = wp.vec3(0.0, 0.0, 1.0), int(0)
    if hit >= 0:
        turn, made = world.shapes[hit].back, world.shapes[hit].kind
        if made == MESH:
            f = world.shapes[hit].first_face + face
            normal = (
                u * world.face_normals[f, 0] + w * world.face_normals[f, 1] + (1.0 - u - w) * world.face_normals[f, 2]
            )
        elif made != PLANE:
            normal = outwards(made, world.shapes[hit].size, turn @ (eye.place + best * ray - world.shapes[hit].place))
            if made == BOX or made == CYLINDER:
                side = wp.where(normal[2] != 0.0, 1, wp.where(normal[1] != 0.0, 2, 3))
        normal = wp.normalize(wp.transpose(turn) @ normal)
        if wp.dot(normal, ray) > 0.0:
            normal = -normal
        side += SIDES * (hit + 1)
    return best, normal, side
