"""Draw poses in which a free object lies at rest, on the host."""

from __future__ import annotations

import numpy as np

from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.scenes.object_contacts import RESTING, distances
from surgical_marl.scenes.poses import Pose
from surgical_marl.scenes.scene import Scene

LOOSE = 5e-5
"""Largest gap between an object at rest and its support, m."""
MOST_BATCHES = 8


def resting_poses(
    scene: Scene, name: str, count: int, centre: np.ndarray, spread: float, rng: np.random.Generator
) -> Pose:
    """Return places [count] of a free object, on the same fixed thing as in the scene's own place, which is level.

    The object is turned about the vertical at random, and lies on its other side in half of the draws, if it is so
    flat that it can. A draw is kept if the object touches something and overlaps nothing, with all arms at home.

    Args:
        scene: arms and objects.
        name: of the object in the scene.
        count: how many.
        centre: of the draws in the world, x and y, m, [2].
        spread: greatest distance of the frame's origin from there, m.
        rng: source of the draws.

    Raises:
        ValueError: hardly a draw can be kept.
    """
    place, kept = scene.objects[name], []
    for _ in range(MOST_BATCHES):
        away, bearing = spread * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
        position = np.tile(place.position, (count, 1))
        position[:, :2] = centre + away[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
        over = 180.0 * rng.integers(2, size=count)
        angle = rng.uniform(-180.0, 180.0, count)
        axes = [turned(np.array([0, 0, b])) @ place.rotation @ turned(np.array([a, 0, 0]))
                for a, b in zip(over, angle, strict=True)]  # fmt: skip
        turns = np.stack([quaternion(own) for own in axes])
        least = distances(scene, {name: Pose(position, turns)}).min(1)
        good = (least > -RESTING) & (least < LOOSE)
        kept.append(np.concatenate([position, turns], -1)[good])
        if sum(map(len, kept)) >= count:
            found = np.concatenate(kept)[:count]
            return Pose(found[:, :3], found[:, 3:])
    raise ValueError(
        f"scene {scene.name!r}: {name!r} lies at rest in hardly any place within {1000 * spread:.0f} mm of "
        f"{np.round(1000 * centre).tolist()} mm; make the surface under it larger"
    )
