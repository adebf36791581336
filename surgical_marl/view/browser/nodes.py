"""Three-dimensional nodes of the page: arms, objects, targets, trails, contacts, distances.

Nodes are made once for a session and then moved. Several environments stand side by side in one world.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from surgical_marl.runtime import jnp
from surgical_marl.tasks.base.path_task import PathTask
from surgical_marl.tasks.base.task import APPROACH
from surgical_marl.view.browser.shapes import body_glb, stage_glb
from surgical_marl.view.moment import Moment, Push
from surgical_marl.view.session import Session
from surgical_marl.view.shading import AGENTS, GAMMA, GOAL_RADIUS, flesh, materials
from surgical_marl.view.stage import paint, stage
from surgical_marl.vision.skin import Skin, skins

if TYPE_CHECKING:
    from viser import ViserServer

    from surgical_marl.envs.batch import BatchedEnv


POINTS = 120
"""Points of a path that is drawn."""


RED, GREY, GOLD = np.array([226, 40, 40]), np.array([120, 130, 140]), np.array([226, 168, 20])
PARTS = ("targets", "paths", "trails", "trocars", "contacts", "grips", "distance")
"""Layers that can be hidden, beside arms and objects."""
ROOM = 0.7
"""Gap between environments that stand side by side, m, beside the width of a scene."""
_TIP_RADIUS = 0.0025
_FADED = np.array([200, 205, 212])
_NONE = np.zeros((0, 2, 3), np.float32)


def colour(index: int) -> np.ndarray:
    """Return the colour of an agent by its number, [3], 0 to 255."""
    return (255 * np.array(AGENTS[index % len(AGENTS)])).astype(np.uint8)


def distance_colour(distance: float) -> np.ndarray:
    """Return the colour of a line between two arms, [3], 0 to 255: grey from `APPROACH` on, red where they touch."""
    share = np.clip(distance / APPROACH, 0.0, 1.0)
    return np.asarray(RED + share * (GREY - RED)).astype(np.uint8)


def offsets(count: int, width: float) -> np.ndarray:
    """Return where environments stand, [count, 3] in m: side by side about the middle of the world.

    The first one is where x is largest: who looks at the arms from across their bases has it on the left, where no menu
    is above it.
    """
    x = ((count - 1) / 2 - np.arange(count)) * width
    return np.stack([x, np.zeros(count), np.zeros(count)], 1)


def segments(points: np.ndarray) -> np.ndarray:
    """Return the pieces [T - 1, 2, 3] of a line through points [T, 3]."""
    return np.stack([points[:-1], points[1:]], 1)


class Nodes:
    """The nodes of a session in viser's scene. Their names are numbers: names of agents might hold anything."""

    def __init__(self, server: ViserServer, session: Session) -> None:
        self._scene, self._session = server.scene, session
        env = session.env
        first = session.moment()
        self.offsets = offsets(env.num_envs, ROOM + float(np.ptp(first.positions[..., 0])))
        """Places of the environments, [N, 3], m."""
        self._paths = Paths(env)
        self._shown = dict.fromkeys(PARTS, True)
        self._trailed = -1
        """The step of the session up to which trails are drawn."""
        still = np.tile([1.0, 0.0, 0.0, 0.0], (env.num_envs, 1))
        self._scene.add_batched_glb(
            "/stage", stage_glb(stage(env.scene)), still, self.offsets, lod="off", cast_shadow=False
        )
        self._make_bodies(first)
        self._make_marks(first)
        self._make_lines()
        self.draw()

    def show(self, part: str, visible: bool) -> None:
        """Show or hide one of `PARTS`."""
        self._shown[part] = visible
        for handle in self._parts[part]:
            handle.visible = visible

    def draw(self) -> None:
        """Move all nodes to the current moment."""
        moment = self._session.moment()
        for body, handle in self._moving.items():
            handle.batched_positions = (moment.positions[:, body] + self.offsets).astype(np.float32)
            handle.batched_wxyzs = moment.quaternions[:, body].astype(np.float32)
        for name, handles in self._skins.items():
            for handle, nodes in zip(handles, moment.nodes[name], strict=True):
                handle.vertices = nodes.astype(np.float32)
        self._tips.batched_positions = self._placed(moment.tips)
        if self._marks is not None:
            self._marks.batched_positions = self._placed(moment.marks)
        if self._shown["distance"]:
            self._draw_distances(moment)
        if self._shown["contacts"]:
            pushes = [[(push, RED) for push in own] for own in moment.pushes]
            self._draw_forces(self._arrows, pushes)
        if self._shown["grips"]:
            grips = [[(grip.push, colour(grip.arm)) for grip in own] for own in moment.grips]
            self._draw_forces(self._presses, grips, ahead=False)

    def draw_trails(self) -> None:
        """Show trails and paths: seldom enough that a browser keeps up with their points."""
        if self._shown["paths"] and (paths := self._paths.read(self._session.env)) is not None:
            self._draw_paths(paths)
        if self._trailed == self._session.steps or not self._shown["trails"]:
            return
        self._trailed = self._session.steps
        tips, objects, held = self._session.trails()
        lines, colours = [_NONE], [np.zeros((0, 2, 3), np.uint8)]
        age = np.linspace(0.0, 1.0, len(tips))[1:, None, None]
        for env, offset in enumerate(self.offsets):
            for arm in range(tips.shape[2]):
                lines.append(segments(tips[:, env, arm] + offset))
                colours.append(_fading(colour(arm), age))
            for number in range(objects.shape[2]):
                kept = held[1:, env, number]
                lines.append(segments(objects[:, env, number] + offset)[kept])
                colours.append(_fading(GOLD, age[kept]))
        _set(self._trails, np.concatenate(lines), np.concatenate(colours))

    def _placed(self, points: np.ndarray) -> np.ndarray:
        """Return points [N, m, 3] of all environments where they stand, [N * m, 3]."""
        return (points + self.offsets[:, None]).reshape(-1, 3).astype(np.float32)

    def _make_bodies(self, moment: Moment) -> None:
        scene = self._session.env.scene
        model, looks = scene.model, materials(scene.model, paint(scene))
        self._moving: dict[int, Any] = {}
        own = skins(scene.systems, model)
        self._skins = {skin.name: self._make_skin(skin, moment.nodes[skin.name]) for skin in own}
        covered = {int(model.geom_bodyid[geom]) for skin in own for geom in skin.geoms}
        for body in sorted({*range(model.nbody)} - covered):
            glb = body_glb(model, body, looks)
            if glb is None:
                continue
            moves = bool(model.body_weldid[body]) or model.body_mocapid[body] >= 0
            places = moment.quaternions[:, body], moment.positions[:, body] + self.offsets
            # Shadows of a body on its own sides flicker, so that only the ground of the scene shows any.
            handle = self._scene.add_batched_glb(f"/bodies/{body}", glb, *places, lod="off", receive_shadow=body == 0)
            if moves:
                self._moving[body] = handle

    def _make_skin(self, skin: Skin, nodes: np.ndarray) -> list[Any]:
        """Return a mesh for each environment, of nodes [N, n, 3]."""
        rgb = (255 * flesh(skin).colour ** (1 / GAMMA)).astype(np.uint8)
        return [
            self._scene.add_mesh_simple(
                f"/skins/{skin.name}/{env}", own.astype(np.float32), skin.triangles, color=rgb, position=offset
            )
            for env, (own, offset) in enumerate(zip(nodes, self.offsets, strict=True))
        ]

    def _make_marks(self, moment: Moment) -> None:
        env = self._session.env
        count, arms, marks = env.num_envs, len(env.agents), moment.marks.shape[1]
        each = np.array([colour(arm) for arm in range(arms)])
        self._tips = self._balls("/tips", moment.tips, np.tile(each, (count, 1)), _TIP_RADIUS)
        self._marks = None
        if marks:
            # a task with as many marks as arms marks a place for each arm; others mark places for objects
            own = each if marks == arms and env.task.has_targets else np.tile(GOLD, (marks, 1))
            self._marks = self._balls("/targets", moment.marks, np.tile(own, (count, 1)), GOAL_RADIUS, 0.75)
        ring = trimesh.creation.torus(0.009, 0.0014, major_sections=32, minor_sections=10)
        self._trocars: list[Any] = []
        for arm, (agent, mount) in enumerate(env.scene.mounts.items()):
            if mount.arm.remote_center:
                self._trocars.append(
                    self._scene.add_label(
                        f"/names/{arm}", env.scene.label(agent), position=mount.position + self.offsets[0]
                    )
                )
                places = self.offsets + mount.position
                wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
                mesh = np.asarray(ring.vertices), np.asarray(ring.faces)
                self._trocars.append(
                    self._scene.add_batched_meshes_simple(
                        f"/trocars/{arm}", *mesh, wxyz, places, batched_colors=colour(arm), lod="off"
                    )
                )

    def _balls(self, name: str, places: np.ndarray, colours: np.ndarray, radius: float, opacity: float = 1.0) -> Any:
        ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        points = self._placed(places)
        return self._scene.add_batched_meshes_simple(
            name,
            np.asarray(ball.vertices),
            np.asarray(ball.faces),
            np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
            points,
            batched_colors=colours.astype(np.uint8),
            opacity=opacity if opacity < 1 else None,
            lod="off",
            cast_shadow=False,
        )

    def _make_lines(self) -> None:
        def line(name: str, thickness: float) -> Any:
            return self._scene.add_line_segments(
                name, _NONE, np.zeros((0, 2, 3), np.uint8), thickness=thickness, thickness_units="screen"
            )

        self._trails, self._lines, self._ways = line("/trails", 3.0), line("/distance", 2.5), line("/paths", 1.5)

        def arrows(name: str, shaft: float) -> Any:
            size: Any = {"shaft_radius": shaft, "head_radius": 2.5 * shaft, "head_length": 5 * shaft}
            return self._scene.add_arrows(name, _NONE, np.zeros((0, 3), np.uint8), **size)

        self._arrows, self._presses = arrows("/contacts", 0.0012), arrows("/grips", 0.0008)
        self._parts = {
            "targets": [] if self._marks is None else [self._marks],
            "paths": [self._ways],
            "trails": [self._trails],
            "trocars": self._trocars,
            "contacts": [self._arrows],
            "grips": [self._presses],
            "distance": [self._lines],
        }

    def _draw_distances(self, moment: Moment) -> None:
        near = [(line, offset) for line, offset in zip(moment.nearest, self.offsets, strict=True) if line is not None]
        if near:
            colours = np.array([[distance_colour(line.distance)] * 2 for line, _ in near])
            _set(self._lines, np.array([line.ends + offset for line, offset in near]), colours)

    def _draw_forces(self, handle: Any, pushes: list[list[tuple[Push, np.ndarray]]], ahead: bool = True) -> None:
        """Draw arrows of forces and their colours, for each environment: from where they act, or up to there."""
        points, colours = [], []
        for own, offset in zip(pushes, self.offsets, strict=True):
            for push, rgb in own:
                place, way = push.place + offset, push.direction * min(0.05, 0.008 + 0.002 * push.force)
                points.append((place, place + way) if ahead else (place - way, place))
                colours.append(rgb)
        if points or len(handle.points):
            _set(handle, np.array(points) if points else _NONE, np.array(colours).reshape(-1, 3))

    def _draw_paths(self, paths: np.ndarray) -> None:
        arms = range(paths.shape[2])
        lines = [segments(paths[env, :, arm] + offset) for env, offset in enumerate(self.offsets) for arm in arms]
        pieces = len(lines[0])
        colours = [np.tile(colour(arm), (pieces, 2, 1)) for _ in self.offsets for arm in arms]
        points = np.concatenate(lines).astype(np.float32)
        if not np.array_equal(points, self._ways.points):
            _set(self._ways, points, np.concatenate(colours))


def _set(handle: Any, points: np.ndarray, colours: np.ndarray) -> None:
    handle.colors = colours.astype(np.uint8)
    handle.points = points.astype(np.float32)


def _fading(rgb: np.ndarray, age: np.ndarray) -> np.ndarray:
    """Return the colours of the pieces of a trail, [n, 2, 3], pale where it is old; age [n, 1, 1] from 0 to 1."""
    return np.broadcast_to(_FADED + age * (rgb - _FADED), (len(age), 2, 3)).astype(np.uint8)


class Paths:
    """The paths of the episodes of N environments; computed again only where a new episode has another path."""

    def __init__(self, env: BatchedEnv) -> None:
        self._mounts = list(env.scene.mounts.values())
        self._times = np.linspace(0, env.max_steps * env.control_dt, POINTS, dtype=np.float32)
        self._known: dict[int, np.ndarray] = {}

    def read(self, env: BatchedEnv) -> np.ndarray | None:
        """Return the paths of all arms' targets, [N, POINTS, arms, 3], m; None for a task whose targets follow none."""
        task = env.task
        if not isinstance(task, PathTask):
            return None
        rows = [int(row) for row in env.goal.row]
        self._known = {row: self._known[row] if row in self._known else self._path(task, row) for row in rows}
        return np.stack([self._known[row] for row in rows])

    def _path(self, task: PathTask, row: int) -> np.ndarray:
        own: np.ndarray = np.asarray(task.along(jnp.int32(row), jnp.asarray(self._times)))
        placed = [own[:, arm] @ mount.rotation.T + mount.position for arm, mount in enumerate(self._mounts)]
        return np.stack(placed, 1)
