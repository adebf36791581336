"""Count the contacts of objects that a scene may need at one time, to say where slots may run out."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from surgical_marl.robots.spec import PAD_GROUP
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.scenes.object_contacts import SLOTS
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.timing import TIMESTEP

FALL, LOOK = 1.0, 0.5
"""Time in which objects fall, and time in which contacts are then counted, s: a pile needs about as long to come to
rest."""
JAW = 4
"""Contacts that the work of a jaw adds: both fingers touch an object, and what this lies on."""


class Crowd(NamedTuple):
    """Numbers of contacts of objects at one time. Each contact is between two bodies."""

    resting: int
    """Once all free objects have fallen, with the arms at home."""
    jaws: int
    """That the jaws may add."""

    @property
    def total(self) -> int:
        """Of all."""
        return self.resting + self.jaws


def crowd(scene: Scene) -> Crowd:
    """Return how many contacts of objects a scene needs once its objects have fallen and all jaws are at work.

    They fall in C MuJoCo. It is an estimate: what arms throw together may need more.
    """
    pads = np.flatnonzero(scene.model.geom_group == PAD_GROUP)
    jaws = {scene.model.geom(geom).name.split("/")[0] for geom in pads}
    return Crowd(_resting(scene), JAW * len(jaws)) if scene.objects else Crowd(0, 0)


def crowding(scene: Scene) -> str | None:
    """Return in one sentence that contacts of objects may find no slot, or None if they do."""
    needed = crowd(scene)
    if needed.total <= SLOTS:
        return None
    return (
        f"its objects may need {needed.total} contacts at one time, {needed.resting} where they come to rest and "
        f"{needed.jaws} at jaws, and there are {SLOTS}; use fewer free objects or fixed shapes, or watch "
        "contact_overflow in the infos: it counts contacts that are not felt"
    )


def _resting(scene: Scene) -> int:
    """Return how many contacts of objects there are once they have fallen, in the step with most."""
    model = mujoco.MjModel.from_xml_string(mjcf(scene))
    data, most = mujoco.MjData(model), 0
    mujoco.mj_resetDataKeyframe(model, data, 0)
    bodies = [_body(scene, model.geom(geom).name) for geom in range(model.ngeom)]
    ours = {name for name in bodies if name.split("/")[0] in scene.objects}
    for step in range(round((FALL + LOOK) / TIMESTEP)):
        mujoco.mj_step(model, data)
        if step * TIMESTEP >= FALL:
            pairs = {frozenset(bodies[geom] for geom in pair) for pair in data.contact.geom}
            most = max(most, sum(not ours.isdisjoint(pair) for pair in pairs))
    return most


def _body(scene: Scene, geom: str) -> str:
    """Return the name of what a geom is a part of: a free object, or itself."""
    name = geom.split("/")[0]
    return name if name in scene.free_objects else geom
