"""Kernels that paint one picture: cast a ray per pixel, find the light, mix colours and cast more rays along edges.

They run on a CPU, one picture a thread of the caller. `view/render.py` calls them, in the order in which they stand.
"""

# Kernels are Warp's language, which only looks like Python. Annotations are read as they are, without a
# `from __future__`; a number that a loop or a branch changes is told its type.
# ruff: noqa: UP018, RUF046, SIM102, SIM108
# mypy: ignore-errors
from surgical_marl.runtime import prepare_warp
from surgical_marl.view.lighting import OPTIONS, backdrop, patterned, ramp, shaded
from surgical_marl.view.tracer import PLANE, SIDES, World, lamps, meet, ray_of
from surgical_marl.vision.rays import ball

wp = prepare_warp()
wp.set_module_options(OPTIONS)

COARSE = wp.constant(2)
"""Light is found for every so many pixels of every so many rows."""


@wp.struct
class Pixels:
    """Hits of rays through the middles of pixels."""

    depths: wp.array2d[float]
    """Lengths of the rays, m, [height, width]."""
    normals: wp.array2d[wp.vec3]
    """Normals of the surfaces that rays meet, [height, width]."""
    sides: wp.array2d[int]
    """Number of the side of the shape that each ray meets, [height, width]; 0 for nothing."""
    orbs: wp.array2d[int]
    """Code of the ball that each ray shows (`ball_at`), [height, width]."""
    lights: wp.array2d[wp.vec2]
    """Shares of the lamp and of the sky at every `COARSE`th pixel of every `COARSE`th row."""


@wp.func
def look(world: World, shape: int, point: wp.vec3, normal: wp.vec3, ray: wp.vec3, light: wp.vec2):
    """Return the light that a ray gets from a point of a shape; `light` are shares of the lamp and of the sky."""
    pattern, local = world.shapes[shape].pattern, world.shapes[shape].back @ (point - world.shapes[shape].place)
    base, slope = patterned(world.grain, world.shapes[shape].colour, local, pattern)
    bent = wp.normalize(normal + wp.transpose(world.shapes[shape].back) @ slope)
    to_lamp = wp.normalize(world.eyes[1].place - point)
    return shaded(base, world.shapes[shape].gloss, pattern, bent, ray, to_lamp, light[0], light[1])


@wp.func
def ball_at(world: World, ray: wp.vec3, best: float):
    """Return a code of the nearest ball that a ray shows, which tells too whether something hides it; -1 for none."""
    eye, found = world.eyes[0], int(-1)
    for orb in range(world.balls, world.shapes.shape[0]):
        cut = ball((eye.place - world.shapes[orb].place) / world.shapes[orb].size[0], ray / world.shapes[orb].size[0])
        if cut[0] <= cut[1] and cut[0] >= 0.0 and (cut[0] < best or world.through > 0.0):
            found = 2 * orb + wp.where(cut[0] < best, 0, 1)
    return found


@wp.func
def colour_of(world: World, pixels: Pixels, column: float, row: float, best: float, normal: wp.vec3, side: int):
    """Return the colour of a ray that meets a side of a shape, as a screen shows it."""
    eye = world.eyes[0]
    ray = ray_of(eye, column, row)
    seen = backdrop(ray)
    if side > 0:
        hit, point = side // SIDES - 1, eye.place + best * ray
        # the light of the nearest places where it was found, so far as they are on the same side
        x, y = (column - 0.5) / float(COARSE), (row - 0.5) / float(COARSE)
        i, j = int(wp.floor(y)), int(wp.floor(x))
        light, total = wp.vec2(0.0), float(1e-6)
        for k in range(4):
            m, n = i + k // 2, j + k % 2
            if m >= 0 and n >= 0 and m < pixels.lights.shape[0] and n < pixels.lights.shape[1]:
                if pixels.sides[COARSE * m, COARSE * n] == side:
                    near = (1.0 - wp.abs(y - float(m))) * (1.0 - wp.abs(x - float(n))) + 1e-3
                    light += near * pixels.lights[m, n]
                    total += near
        if total > 1e-3:
            light = light / total
        else:
            light = lamps(world, hit, point, normal)
        seen = look(world, hit, point, normal, ray, light)
        if world.shapes[hit].kind == PLANE:
            mist = ramp(0.35, 1.0, best / world.fade)
            seen = seen + mist * (backdrop(ray) - seen)
    for orb in range(world.balls, world.shapes.shape[0]):
        radius = world.shapes[orb].size[0]
        cut = ball((eye.place - world.shapes[orb].place) / radius, ray / radius)
        if cut[0] <= cut[1] and cut[0] >= 0.0 and (cut[0] < best or world.through > 0.0):
            front = eye.place + cut[0] * ray
            facing = (front - world.shapes[orb].place) / radius
            share = world.shapes[orb].alpha * wp.where(cut[0] < best, 1.0, world.through)
            lit_up = look(world, orb, front, facing, ray, wp.vec2(1.0, 1.0))
            seen = seen + share * (lit_up - seen)
    return wp.vec3(shown(seen[0]), shown(seen[1]), shown(seen[2]))


@wp.func
def shown(light: float):
    """Return a level of a screen, from 0 to 255: gamma 2, and bright light that bends towards white."""
    bent = wp.max(light, 0.0)
    if bent > 0.6:
        bent = 1.0 - 0.4 * wp.exp((0.6 - bent) / 0.4)
    return 255.0 * wp.sqrt(bent)


@wp.kernel
def cast(world: World, pixels: Pixels):
    """Cast a ray through the middle of every pixel: find how far it goes, and which side and which ball it meets."""
    row, column = wp.tid()
    x, y = float(column) + 0.5, float(row) + 0.5
    best, normal, side = meet(world, x, y)
    pixels.depths[row, column] = best
    pixels.normals[row, column] = normal
    pixels.sides[row, column] = side
    pixels.orbs[row, column] = ball_at(world, ray_of(world.eyes[0], x, y), best)


@wp.kernel
def light_up(world: World, pixels: Pixels):
    """Find how much light comes to every `COARSE`th pixel of every `COARSE`th row. Shadows are soft enough for that."""
    i, j = wp.tid()
    row, column = COARSE * i, COARSE * j
    side = pixels.sides[row, column]
    if side > 0:
        ray = ray_of(world.eyes[0], float(column) + 0.5, float(row) + 0.5)
        point = world.eyes[0].place + pixels.depths[row, column] * ray
        normal = wp.vec3(pixels.normals[row, column])
        pixels.lights[i, j] = lamps(world, side // SIDES - 1, point, normal)


@wp.kernel
def paint(world: World, pixels: Pixels, picture: wp.array2d[wp.vec3ub]):
    """Write the picture; where pixels side by side show different things, cast four finer rays."""
    row, column = wp.tid()
    edge = bool(False)
    for k in range(4):
        i = wp.clamp(row + (k // 2) * (2 * (k % 2) - 1), 0, pixels.sides.shape[0] - 1)
        j = wp.clamp(column + (1 - k // 2) * (2 * (k % 2) - 1), 0, pixels.sides.shape[1] - 1)
        edge = edge or pixels.sides[i, j] != pixels.sides[row, column] or pixels.orbs[i, j] != pixels.orbs[row, column]
    colour = wp.vec3(0.5)
    if edge:
        for k in range(4):  # a turned square: each ray has a row and a column of its own
            x = float(column) + 0.125 + 0.25 * float(k)
            y = float(row) + 0.375 + 0.5 * float(k % 2) - 0.25 * float(k // 2)
            best, normal, side = meet(world, x, y)
            colour += 0.25 * colour_of(world, pixels, x, y, best, normal, side)
    else:
        x_mid, y_mid, away = float(column) + 0.5, float(row) + 0.5, wp.vec3(pixels.normals[row, column])
        far, mine = float(pixels.depths[row, column]), int(pixels.sides[row, column])
        colour += colour_of(world, pixels, x_mid, y_mid, far, away, mine)
    picture[row, column] = wp.vec3ub(wp.uint8(colour[0]), wp.uint8(colour[1]), wp.uint8(colour[2]))
