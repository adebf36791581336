"""The free objects of the environments that an engine runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.scenes.poses import Poses, along, frames

if TYPE_CHECKING:
    from surgical_marl.engines.choose import Engine
    from surgical_marl.scenes.scene import Scene

STATE = ".physics.rigid_bodies.bodies"
"""Names of the parts of a carry with the objects' centres of mass and orientations."""
SIZE = ".hidden.objects.size"
"""Name of the part with the factors of the objects' lengths, if the scene randomises objects."""
HELD = ".physics.rigid_bodies.grips.held"
"""Name of the part with the times for which arms have held objects."""
FORCE = ".physics.rigid_bodies.grips.force"
"""Name of the part with the normal forces of fingers on objects."""


class FreeObjects:
    """Reads where the free objects of a scene are."""

    def __init__(self, scene: Scene) -> None:
        centers = [place.object.center for place in scene.free_objects.values()]
        self.count, self._arms = len(centers), len(scene.agents)
        self._bars = scene.drawn
        self.drawn = self.count + sum(len(bars.ends) for bars in self._bars.values())
        """Number of things in `read_drawn`."""
        self._centers: Any = np.array(centers, np.float32).reshape(-1, 3)

    def held(self, engine: Engine, num_envs: int) -> np.ndarray:
        """Return which arms hold which objects, [N, k, arms] bool."""
        if not self.count:
            return np.zeros((num_envs, 0, self._arms), bool)
        from surgical_marl.physics.contact.grips import DWELL

        return np.asarray(engine.read(HELD, "numpy") >= np.float32(DWELL))

    def grip_forces(self, engine: Engine, num_envs: int) -> np.ndarray:
        """Return the normal forces of fingers on objects, [N, k, fingers], N."""
        if not self.count:
            return np.zeros((num_envs, 0, 0), np.float32)
        return np.array(engine.read(FORCE, "numpy"))

    def read_drawn(self, engine: Engine, num_envs: int, library: str = "numpy", place: str = "") -> Poses:
        """Return the poses of all that moves but arms, as `read`: free objects, then the bars of systems."""
        found = [self.read(engine, num_envs, library, place)] if self.count or not self._bars else []
        for name, nodes in self.read_nodes(engine, library, place).items():
            bars = self._bars[name]
            found.append(Poses(*along(*(nodes[:, bars.ends[:, side]].mean(2) for side in (0, 1)))))
        if len(found) == 1:
            return found[0]
        joined: Any = np.concatenate
        if library == "torch":
            import torch

            joined = torch.cat
        return Poses(*(joined([getattr(own, field) for own in found], 1) for field in ("origin", "quaternion")))

    def read_nodes(self, engine: Engine, library: str = "numpy", place: str = "") -> dict[str, Any]:
        """Return where the nodes of systems are that pictures show, [N, n, 3] each, m, by name; arguments as `read`."""
        return {name: engine.read(f"{place}.physics.{name}.{bars.state}", library) for name, bars in self._bars.items()}

    def read(self, engine: Engine, num_envs: int, library: str = "numpy", place: str = "") -> Poses:
        """Return poses in arrays of "numpy" or "torch".

        Args:
            engine: runs the environments.
            num_envs: their number.
            library: of the arrays.
            place: "" for where objects are now, "pictures" for where they are in that stage of a step.
        """
        if not self.count:
            return Poses(np.zeros((num_envs, 0, 3), np.float32), np.zeros((num_envs, 0, 4), np.float32))
        position, quaternion = (engine.read(f"{place}{STATE}.{part}", library) for part in ("position", "quaternion"))
        if library == "torch" and isinstance(self._centers, np.ndarray):
            self._centers = position.new_tensor(self._centers)  # once: it waits for the device
        if SIZE not in engine.carry_shapes:
            return frames(position, quaternion, self._centers)
        return frames(position, quaternion, engine.read(f"{place}{SIZE}", library)[..., None] * self._centers)
