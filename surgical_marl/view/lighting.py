"""Light a point of a surface: patterns of materials, a room to be mirrored, soft shadows of convex shapes.

Functions of Warp for the kernels of `view/tracer.py`. Colours are linear light.
"""

# Kernels are Warp's language, which only looks like Python. Annotations are read as they are, without a
# `from __future__`; a number that a loop or a branch changes is told its type.
# ruff: noqa: UP018, E741
# mypy: ignore-errors
from surgical_marl.runtime import prepare_warp
from surgical_marl.vision.rays import BOX, ELLIPSOID, TINY

wp = prepare_warp()
OPTIONS = {
    "enable_backward": False,
    "default_grid_stride": False,
    "fast_math": True,
    "optimization_level": 3,
    # Sums and quotients in another order: a sixth less time. Not -ffast-math, which knows no infinity.
    "cpu_compiler_flags": "-march=native -funsafe-math-optimizations -ffp-contract=fast",
}
"""Options of all Warp modules with kernels that draw pictures for people."""
wp.set_module_options(OPTIONS)

PLAIN, TISSUE, DRAPE, FLOOR, GLOW = map(wp.constant, range(5))
"""Patterns of a material."""

GRAIN = wp.constant(32)
"""Side of the cube of noise that patterns are made of; a power of 2."""

_HORIZON, _CEILING = wp.constant(wp.vec3(0.52, 0.57, 0.62)), wp.constant(wp.vec3(0.30, 0.34, 0.39))
_WALL = wp.constant(wp.vec3(0.72, 0.75, 0.78))
_GROUND = wp.constant(wp.vec3(0.07, 0.15, 0.17))
_SOFTBOX = wp.constant(wp.vec3(1.9, 1.85, 1.75))
_KEY = wp.constant(wp.vec3(1.02, 0.98, 0.90))
_SKY = wp.constant(wp.vec3(0.50, 0.54, 0.60))
_BOUNCE = wp.constant(wp.vec3(0.20, 0.20, 0.20))


@wp.func
def ramp(low: float, high: float, x: float):
    """Return 0 below `low`, 1 above `high`, and a smooth step between."""
    t = wp.clamp((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def backdrop(ray: wp.vec3):
    """Return the background in a direction: a plain wall, lighter at the horizon."""
    up = wp.sqrt(wp.clamp(ray[2], 0.0, 1.0))
    return _HORIZON + up * (_CEILING - _HORIZON)


@wp.func
def room(ray: wp.vec3, blur: float, lamp: wp.vec3):
    """Return the reflection in a direction: drapes below, a wall around, a soft box overhead and one at the lamp.

    The more a mirror blurs, the wider and the weaker are the soft boxes.
    """
    seen = _GROUND + ramp(-0.25 - blur, 0.15 + blur, ray[2]) * (_WALL - _GROUND)
    overhead = ramp(0.72 - 0.5 * blur, 0.86 + 0.1 * blur, ray[2])
    side = ramp(0.80 - 0.5 * blur, 0.93 + 0.06 * blur, wp.dot(ray, lamp))
    return seen + (overhead + 0.7 * side) * (1.0 - 0.6 * blur) * _SOFTBOX


@wp.func
def grained(grain: wp.array3d[wp.vec4], p: wp.vec3):
    """Return smooth noise at a point, and its slope along x, y, z; it repeats after `GRAIN` units."""
    x, y, z = wp.floor(p[0]), wp.floor(p[1]), wp.floor(p[2])
    u, v, w = p[0] - x, p[1] - y, p[2] - z
    i, j, k = int(x) & (GRAIN - 1), int(y) & (GRAIN - 1), int(z) & (GRAIN - 1)
    l, m, n = (i + 1) & (GRAIN - 1), (j + 1) & (GRAIN - 1), (k + 1) & (GRAIN - 1)
    low = (1.0 - v) * ((1.0 - w) * grain[i, j, k] + w * grain[i, j, n])
    low += v * ((1.0 - w) * grain[i, m, k] + w * grain[i, m, n])
    high = (1.0 - v) * ((1.0 - w) * grain[l, j, k] + w * grain[l, j, n])
    high += v * ((1.0 - w) * grain[l, m, k] + w * grain[l, m, n])
    return (1.0 - u) * low + u * high


@wp.func
def patterned(grain: wp.array3d[wp.vec4], base: wp.vec3, p: wp.vec3, kind: int):
    """Return colour and slope of a pattern at a point: the slope is what it adds to the unit normal.

    Args:
        grain: noise.
        base: colour of the material.
        p: the point, in the shape's frame, m.
        kind: of pattern.
    """
    tint, slope = wp.vec3(base), wp.vec3(0.0)
    if kind == TISSUE:
        fine, coarse = grained(grain, 190.0 * p), grained(grain, 45.0 * p)
        vein = 1.0 - ramp(0.02, 0.16, wp.abs(coarse[0] + 0.25 * fine[0]))
        red = wp.cw_mul(base, wp.vec3(0.62, 0.36, 0.40))
        tint = base * (0.86 + 0.10 * coarse[0] + 0.05 * fine[0])
        tint = tint + (0.26 * vein) * (red - tint)
        slope = -0.07 * wp.vec3(fine[1], fine[2], fine[3]) - 0.10 * wp.vec3(coarse[1], coarse[2], coarse[3])
    elif kind == DRAPE:  # folds are longer than wide
        fold = grained(grain, wp.vec3(34.0 * p[0] + 13.0 * p[1], 9.0 * p[1] - 5.0 * p[0], 9.0 * p[2]))
        broad = grained(grain, wp.vec3(11.0 * p[1] - 4.0 * p[0], 7.0 * p[0] + 3.0 * p[1], 5.0 * p[2] + 9.0))
        slope = -0.10 * wp.vec3(fold[1] - 0.15 * fold[2], 0.4 * fold[1] + 0.3 * fold[2], 0.2 * fold[1])
        slope += -0.10 * wp.vec3(0.6 * broad[2] - 0.3 * broad[1], broad[1] + 0.3 * broad[2], 0.0)
        tint = base * (1.0 + 0.05 * fold[0] + 0.05 * broad[0])
    elif kind == FLOOR:
        x, y = p[0] / 0.6, p[1] / 0.6
        along = wp.min(wp.abs(x - wp.round(x)), wp.abs(y - wp.round(y)))
        tint = base * (0.82 + 0.18 * ramp(0.004, 0.012, along))
    return tint, slope


@wp.func
def shaded(
    base: wp.vec3, gloss: wp.vec3, kind: int, normal: wp.vec3, ray: wp.vec3, lamp: wp.vec3, light: float, open: float
):
    """Return the light that a point sends back along a ray.

    Args:
        base: colour.
        gloss: reflectance straight on, blur from 0 to 1, and how metallic it is from 0 to 1.
        kind: pattern.
        normal: towards the viewer.
        ray: from the viewer to the point.
        lamp: unit vector to the lamp.
        light: share of the lamp that the point sees.
        open: share of the sky above that the point sees.
    """
    facing = wp.clamp(-wp.dot(normal, ray), 0.0, 1.0)
    along = wp.dot(normal, lamp)
    if kind == GLOW:
        return base * (0.55 + 0.45 * facing + 0.20 * wp.max(along, 0.0))
    key = wp.max(along, 0.0) * light
    up = 0.5 + 0.5 * normal[2]
    ambient = (_BOUNCE + up * (_SKY - _BOUNCE)) * (0.25 + 0.75 * open)
    if kind == TISSUE:  # light that enters wet tissue comes out nearby, and redder
        key = wp.max(along + 0.2, 0.0) / 1.2 * light
        ambient = wp.cw_mul(ambient, wp.vec3(1.08, 0.92, 0.90))
    soft = wp.cw_mul(base, ambient + key * _KEY + wp.vec3(0.10 * facing))
    if gloss[1] >= 1.0:
        return soft
    mirrored = ray + 2.0 * facing * normal
    grazing = 1.0 - facing
    rim = grazing * grazing * grazing * grazing * (1.0 - gloss[1])
    strength = gloss[0] + (1.0 - gloss[0]) * 0.6 * rim
    half = wp.normalize(lamp - ray)
    sharp = 12.0 + 500.0 * (1.0 - gloss[1]) * (1.0 - gloss[1])
    spot = wp.pow(wp.max(wp.dot(normal, half), 0.0), sharp) * light * (0.3 + 0.012 * sharp)
    mirror = (room(mirrored, gloss[1], lamp) * (0.3 + 0.7 * open) + spot * _KEY) * strength
    metal = gloss[2]
    tint = (1.0 - metal) * wp.vec3(1.0) + metal * base
    return (1.0 - 0.85 * metal) * soft + wp.cw_mul(mirror, tint)


@wp.func
def hidden(kind: int, size: wp.vec3, breadth: wp.vec2, p: wp.vec3, v: wp.vec3, spread: float):
    """Return the share of a round lamp that a convex shape hides from a point.

    The half shadow follows from how far the ray passes from the shape's surface: less than 0 where the ray hits it.

    Args:
        kind: of the shape: a box, an ellipsoid or a capsule.
        size: of the shape.
        breadth: the shape's half width and half length as seen from the side, m.
        p: the point, in the shape's frame.
        v: unit vector from the point to the lamp, there.
        spread: the lamp's radius over its distance.
    """
    gap, t = float(0.0), float(0.0)
    if kind == BOX:
        s = wp.vec3(
            1.0 / wp.where(wp.abs(v[0]) > TINY, v[0], TINY),
            1.0 / wp.where(wp.abs(v[1]) > TINY, v[1], TINY),
            1.0 / wp.where(wp.abs(v[2]) > TINY, v[2], TINY),
        )
        a = wp.abs(s)
        middle, half = -wp.cw_mul(p, s), wp.cw_mul(size, a)
        near, far = middle - half, middle + half
        last = wp.min(far)
        if last <= 1e-5:
            return 0.0
        t = wp.max(0.5 * (wp.max(near) + last), 1e-4)
        if wp.max(near - spread * t * a) >= wp.min(far + spread * t * a):
            return 0.0
        # the least growth of the box by which the ray touches it: two of its slabs then meet
        gap = wp.max((near[0] - far[1]) / (a[0] + a[1]), (near[1] - far[0]) / (a[0] + a[1]))
        gap = wp.max(gap, wp.max((near[0] - far[2]) / (a[0] + a[2]), (near[2] - far[0]) / (a[0] + a[2])))
        gap = wp.max(gap, wp.max((near[1] - far[2]) / (a[1] + a[2]), (near[2] - far[1]) / (a[1] + a[2])))
    elif kind == ELLIPSOID:
        q, d = wp.cw_div(p, size), wp.cw_div(v, size)
        t = -wp.dot(q, d) / wp.dot(d, d)
        if t <= 1e-5:
            return 0.0
        nearest = q + t * d
        away = wp.length(nearest)
        gap = (away - 1.0) * wp.length(wp.cw_mul(nearest, size)) / wp.max(away, 1e-6)
    else:
        along = wp.dot(p, v)
        level = wp.clamp((p[2] - along * v[2]) / wp.max(1.0 - v[2] * v[2], 1e-6), -size[1], size[1])
        t = level * v[2] - along
        if t <= 1e-5:
            return 0.0
        gap = wp.length(p + t * v - wp.vec3(0.0, 0.0, level)) - size[0]
    wide = spread * t + 1e-5
    if gap >= wide:
        return 0.0
    return (1.0 - ramp(-wide, wide, gap)) * wp.min(breadth[0] / wide, 1.0) * wp.min(breadth[1] / wide, 1.0)
