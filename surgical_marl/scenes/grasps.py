"""Draw starts of grasps: an arm's open jaw around an object, without touching it.

jaw = Jaw(scene, "psm_0")
grasp = jaw.draw("needle", scene.objects["needle"].object.sites["grasp"], rng)
other = Jaw(scene, "psm_1").join("needle", grasp, {"psm_0": grasp.q}, rng)
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np

from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.robots.spec import PAD_GROUP
from surgical_marl.scenes.object_contacts import distance, touches
from surgical_marl.scenes.scene import Scene

GAP = 3e-5
"""Between each pad and the object, m."""
DEPTHS = 0.006, 0.009
"""Distances from the jaw's hinge at which an object is grasped, m."""
APART = 1e-3
"""Least distance of two arms that hold one object, m."""
CENTRINGS = 5
"""Times that the object is moved to the middle between the pads, and the jaw opened as wide as its bends need."""
TRIES = 48
"""Postures in which an arm tries to join another's grasp."""
WRIST = [4, 5]
"""Numbers of the joints between the shaft and the jaw."""
STOPS = 9
"""Positions of each of them, from end to end, that are looked at."""
ROOM = 1e-3
"""Least distance of an object from the wrist there, m. Between two such positions it moves by about as much."""
ACROSS = np.stack([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], 1)
"""Axes of a wire across the jaw, by the axes of the jaw's link: x along the wire."""

Frame = tuple[np.ndarray, np.ndarray]
"""Origin [3] and axes [3, 3]."""


class Grasp(NamedTuple):
    """An open jaw around an object."""

    q: np.ndarray
    """Joints of the arm, [n]."""
    position: np.ndarray
    """Origin of the object's frame in the world, m, [3]."""
    rotation: np.ndarray
    """Axes of the object's frame in the world, [3, 3]."""


def graspers(scene: Scene) -> list[str]:
    """Return the agents whose jaws have pads, of arms built like a PSM."""
    return [a for a, mount in scene.mounts.items() if mount.arm.jaw and len(mount.arm.jaw.pads) == 2]


class Jaw:
    """The jaw of one arm, built like a PSM: its last joint opens it, and its fingers turn about y of the link before.

    Args:
        scene: with the arm and objects.
        agent: the arm, one of `graspers`.
    """

    def __init__(self, scene: Scene, agent: str) -> None:
        self.scene, self.agent, self.mount = scene, agent, scene.mounts[agent]
        model, self._data = scene.model, mujoco.MjData(scene.model)
        joint = model.joint(f"{agent}/{self.mount.arm.jaw.joint}")  # type: ignore[union-attr]
        self._link = int(model.body_parentid[joint.bodyid[0]])
        mine = [model.geom(g).name.startswith(f"{agent}/") for g in range(model.ngeom)]
        self._pads = np.flatnonzero((model.geom_group == PAD_GROUP) & mine)
        self._touches = [(t.one, t.other) for t in touches(scene)]
        (origin, axes), tip = self._place({}), self._data.site(f"{agent}/tool_tip")
        self._tip = axes.T @ (tip.xpos - origin), axes.T @ tip.xmat.reshape(3, 3)

    def draw(self, name: str, frame: Frame, rng: np.random.Generator) -> Grasp:
        """Return a random grasp, with the arm anywhere, and neither the object nor anything fixed in its way.

        Args:
            name: a free object.
            frame: the wire or bar to grasp in the object's frame, x along it.
            rng: draws the posture, and how the object lies in the jaw.
        """
        (site, axes), item, arm = frame, self.scene.objects[name].object, self.mount.arm
        away = item.center - site
        while True:
            q, depth = arm.home.copy(), rng.uniform(*DEPTHS)
            q[:2] += rng.uniform(-0.3, 0.3, 2)
            q[2:6] = [rng.uniform(0.06, 0.12), rng.uniform(-1, 1), *rng.uniform(-0.5, 0.5, 2)]
            q[-1] = self._opening(name, depth)
            hinge, link = self._place({self.agent: q})
            rotation = link @ _lying(rng) @ axes.T
            at = hinge + link @ [0, rng.uniform(-5e-4, 5e-4), -depth]
            if (rotation @ away) @ link[:, 2] > -0.2 * np.linalg.norm(away):
                continue  # most of the object would be in the wrist
            for _ in range(CENTRINGS):
                left, right = self._gaps(name, (at - rotation @ site, rotation))
                at = at + (right - left) / 2 * link[:, 0]
                q[-1] += (GAP - (left + right) / 2) / depth
                self._place({self.agent: q})
            if self._is_free(name, (at - rotation @ site, rotation)):
                return Grasp(q, at - rotation @ site, rotation)

    def join(
        self, name: str, grasp: Grasp, others: Mapping[str, np.ndarray], rng: np.random.Generator
    ) -> np.ndarray | None:
        """Return joints [n] with which this jaw is around an object too that another arm is about to hold.

        It grasps another of the object's capsules, across, as far from the arms as `APART`.

        Args:
            name: a free object.
            grasp: the other arm's.
            others: joints of other arms; those that are not given are at home.
            rng: draws what is tried.

        Returns:
            None if none of `TRIES` random ways to do so is within the arm's limits and in nobody's way.
        """
        frames = [(part.position, part.rotation[:, [2, 0, 1]]) for part in self.scene.objects[name].object.shapes
                  if part.kind == "capsule"]  # fmt: skip
        ways = [(frames[rng.integers(len(frames))], _lying(rng), rng.uniform(*DEPTHS)) for _ in range(TRIES)]
        links = [grasp.rotation @ axes @ lying.T for (_, axes), lying, _ in ways]
        hinges = [
            grasp.position + grasp.rotation @ site + depth * link[:, 2]
            for ((site, _), _, depth), link in zip(ways, links, strict=True)
        ]
        q = self._solve(np.array(hinges), np.array(links), starts=4)
        q[:, -1] = [self._opening(name, depth) for _, _, depth in ways]
        homes = {agent: mount.arm.home for agent, mount in self.scene.mounts.items()}
        apart = self.scene.clearance({**homes, **others, self.agent: q}) > APART
        object_frame = grasp.position, grasp.rotation
        for k in np.flatnonzero(apart & self._reaches(q, np.array(hinges), np.array(links))):
            found, hinge, depth = q[k], hinges[k], ways[k][2]
            for _ in range(CENTRINGS):
                _, link = self._place({**others, self.agent: found})
                left, right = self._gaps(name, object_frame)
                hinge = hinge + (left - right) / 2 * link[:, 0]
                opening = found[-1] + (GAP - (left + right) / 2) / depth
                found = self._solve(hinge, links[k], starts=1, start=found)
                found[-1] = opening
            self._place({**others, self.agent: found})
            if self._is_free(name, object_frame):
                return found
        return None

    def clears_wrist(self, name: str, grasp: Grasp) -> bool:
        """Return whether the wrist can turn with an object as far as it goes: only the fingers come near the object.

        Args:
            name: the object.
            grasp: around it, by this jaw.
        """
        model, limits = self.scene.model, zip(self.mount.arm.lower[WRIST], self.mount.arm.upper[WRIST], strict=True)
        hinge, link = self._place({self.agent: grasp.q})
        held = link.T @ (grasp.position - hinge), link.T @ grasp.rotation
        named = [pair for pair in self._touches if {geom.partition("/")[0] for geom in pair} == {name, self.agent}]
        pairs = [[model.geom(geom).id for geom in pair] for pair in named]
        pairs = [pair for pair in pairs if not np.isin(pair, self._pads).any()]
        for angles in product(*(np.linspace(*ends, STOPS) for ends in limits)):
            q = grasp.q.copy()
            q[WRIST] = angles
            hinge, link = self._place({self.agent: q})
            self._put(name, (hinge + link @ held[0], link @ held[1]))
            if min(distance(model, self._data, *pair) for pair in pairs) < ROOM:
                return False
        return True

    def _opening(self, name: str, depth: float) -> float:
        """Return the jaw's position at which a straight wire fits between the pads, rad."""
        radius = min(shape.size[0] for shape in self.scene.objects[name].object.shapes)
        return float(self.mount.arm.lower[-1] + (radius + GAP) / depth)

    def _solve(self, hinges: np.ndarray, links: np.ndarray, starts: int, start: np.ndarray | None = None) -> np.ndarray:
        """Return joints [..., n] with which the jaw's link is at origins [..., 3] with axes [..., 3, 3]."""
        return np.asarray(inverse_kinematics(self.mount.arm, self._tips(hinges, links), start, starts=starts))

    def _tips(self, hinges: np.ndarray, links: np.ndarray) -> np.ndarray:
        """Return the poses of the tool tip in the arm's base frame, [..., 4, 4]."""
        base, (offset, axes) = self.mount, self._tip
        poses = np.zeros((*hinges.shape[:-1], 4, 4))
        poses[..., :3, :3] = base.rotation.T @ links @ axes
        poses[..., :3, 3] = (hinges + links @ offset - base.position) @ base.rotation
        poses[..., 3, 3] = 1.0
        return poses

    def _reaches(self, q: np.ndarray, hinges: np.ndarray, links: np.ndarray) -> np.ndarray:
        """Return which joints [k, n] bring the link to its place, to 0.1 mm and 0.1 degrees."""
        off = self.mount.arm.forward_kinematics(q) - self._tips(hinges, links)
        return (np.abs(off[:, :3, 3]).max(1) < 1e-4) & (np.abs(off[:, :3, :3]).max((1, 2)) < 2e-3)

    def _place(self, q: Mapping[str, np.ndarray]) -> Frame:
        """Place all arms, at home if no joints are given, and return where the jaw's link is."""
        self._data.qpos[:] = self.scene.full_qpos(dict(q))
        mujoco.mj_kinematics(self.scene.model, self._data)
        return self._data.xpos[self._link].copy(), self._data.xmat[self._link].reshape(3, 3).copy()

    def _gaps(self, name: str, frame: Frame) -> tuple[float, float]:
        """Return the distances of an object from the pad on the side of the link's -x and from that on its +x, m."""
        model, data, body = self.scene.model, self._data, self.scene.model.body(name)
        self._put(name, frame)
        shapes = range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
        side = (data.geom_xpos[self._pads] - data.xpos[self._link]) @ data.xmat[self._link, ::3]
        left, right = (
            min(distance(model, data, shape, pad) for shape in shapes) for pad in self._pads[np.argsort(side)]
        )
        return left, right

    def _is_free(self, name: str, frame: Frame) -> bool:
        """Return whether an object touches nothing, nor this arm any other one, or anything that is fixed."""
        model, own = self.scene.model, (f"{name}/", f"{self.agent}/")
        self._put(name, frame)
        return all(
            distance(model, self._data, model.geom(one).id, model.geom(other).id) > 0
            for one, other in self._touches
            if one.startswith(own) or other.startswith(own)
        )

    def _put(self, name: str, frame: Frame) -> None:
        """Place an object."""
        mocap = self.scene.model.body(name).mocapid[0]
        self._data.mocap_pos[mocap], self._data.mocap_quat[mocap] = frame[0], quaternion(frame[1])
        mujoco.mj_kinematics(self.scene.model, self._data)


def _lying(rng: np.random.Generator) -> np.ndarray:
    """Return how a wire lies in a jaw: across it to half a radian, turned about itself. Axes in the jaw's link."""
    tilt, spin = rng.uniform(-0.5, 0.5), rng.uniform(-np.pi, np.pi)
    return turned(np.degrees([tilt, 0, 0])) @ ACROSS @ turned(np.degrees([spin, 0, 0]))
