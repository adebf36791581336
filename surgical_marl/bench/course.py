"""The motion of the arms while engines are timed."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import rollout

from surgical_marl.bench.physics import PhysicsAlone
from surgical_marl.bench.starts import Starts, grasps, played, policy_of
from surgical_marl.bench.workload import DISTINCT, Workload
from surgical_marl.control.controller import Controller, actuators_of
from surgical_marl.engines.choose import make_engine
from surgical_marl.envs.env import Env
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.state import ARMS, RIGID_BODIES, Physics
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.scenes.grasps import graspers
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.timing import DECIMATION

HOLD = DECIMATION
"""Physics steps for which an action is held: a control step of training, whatever is timed."""
LAPS = 4
"""Actions after which a course begins again. The second half reverses the first, so that no joint drifts away."""
_AWAY = {"random": 50, "rough": 25, "grasp": 25}
"""Control steps before the start, 1 and 0.5 s. random: a new action every control step, as when training begins. rough:
one action all the time, so that arms cross their ranges, and each other's way. grasp: jaws close on objects and carry
them. Where a policy plays, `bench/starts.py` says when it stops."""
GENTLE = 0.05
"""Share of their speed at which two arms move that hold one object: faster, one would tear it from the other."""


class Course(NamedTuple):
    """Random actions and the states that they lead to, for n different environments."""

    qpos: np.ndarray
    """[n, nq], in the middle of a motion; `qvel` [n, nv] and `ctrl` [n, nu] beside it."""
    qvel: np.ndarray
    ctrl: np.ndarray
    commands: np.ndarray
    """Commands of the actions to the actuators, [LAPS, n, nu]."""
    actions: list[dict[str, np.ndarray]]
    """Agent -> [n, its actions], LAPS of them."""
    touching: float
    """Share of the environments in which something touches at the start, from 0 to 1."""
    objects: Any = ()
    """The state of the free objects, a tree like `Physics.rigid_bodies`; [n, ...]."""

    @property
    def parts(self) -> dict[str, np.ndarray]:
        """The arrays of the start by their path in an environment's carry, as in ".physics.arms.qpos"."""
        start = {f"{ARMS}.{name}": getattr(self, name) for name in ("qpos", "qvel", "ctrl")}
        start[RIGID_BODIES] = self.objects
        return {f".physics.{name}{path}": v for name, tree in start.items() for path, v in _leaves(tree).items()}


def make_course(workload: Workload) -> Course:
    """Draw a course: every environment moves from home by random actions of its own, then to and fro.

    C MuJoCo moves the arms. The states therefore come from none of this package's own engines. Only where there are
    objects an engine moves all. With motion `policy` environments are where the policy that ships has come to, and go
    on as it does.

    Raises:
        ValueError: motion `grasp` in a scene without anything to grasp, or motion `policy` where no policy ships.
    """
    # otherwise JAX would reserve most of a GPU's memory, and leave too little for the fused engine
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax

    player = policy_of(workload) if workload.motion == "policy" else None  # refused before anything is compiled
    scene = load_scene(workload.scene, actuators_of(workload.control))
    rng, n = np.random.default_rng(workload.seed), min(workload.distinct, max(workload.count, DISTINCT))
    simulator = Simulator(scene, HOLD)
    controller = Controller(scene, workload.control, dt=simulator.control_dt)
    command = jax.jit(jax.vmap(controller.apply))
    roll = _by_engine(workload, n) if scene.objects else partial(_by_mujoco, scene.model)
    now = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], n, 0), simulator.home)
    if player:
        paths = [f".physics{path}" for path in _leaves(now)]
        parts, actions = played(player, workload, n, LAPS, paths, rng)
        now = jax.tree.unflatten(jax.tree.structure(now), parts)
    else:
        now, actions = _drawn(
            controller,
            workload.motion,
            now,
            rng,
            jax.vmap(simulator.at),
            lambda now, action: roll(command(now, action)),
        )
    start, commands = jax.tree.map(np.asarray, now), []
    for action in actions:
        now = command(now, action)
        commands.append(np.asarray(now.ctrl))
        now = roll(now)
    held = start.rigid_bodies.grips.force > 0 if scene.objects else None
    touching = float(held.any((1, 2)).mean()) if held is not None else _touching(scene.model, start.qpos)
    objects = start.systems.get(RIGID_BODIES, ())
    return Course(start.qpos, start.qvel, start.ctrl, np.array(commands), actions, touching, objects)


def _drawn(
    controller: Controller,
    motion: str,
    now: Physics,
    rng: np.random.Generator,
    at: Callable[..., Physics],
    move: Callable[[Physics, dict[str, np.ndarray]], Physics],
) -> tuple[Physics, list[dict[str, np.ndarray]]]:
    """Return the states [n, ...] to which random actions lead from `now`, and the actions of a course from there.

    `at` returns the states of arms at rest at some qpos; `move` makes a control step.
    """
    scene, n = controller.scene, len(now.qpos)
    closed, share = [], np.ones((n, 1), np.float32)
    if motion == "grasp":
        closed, starts = graspers(scene), grasps(scene, min(n, DISTINCT), rng)
        starts = Starts(*(tile(values, n) for values in starts))
        now = _grasping(now, starts, at)
        share = np.where(starts.arms[:, None] > 1, GENTLE, share)

    def draw() -> dict[str, np.ndarray]:
        drawn = {a: share * rng.uniform(-1, 1, (n, controller.num_actions(a))) for a in scene.agents}
        for agent in closed:
            drawn[agent][:, -1] = -1.0
        return {agent: values.astype(np.float32) for agent, values in drawn.items()}

    half = [draw() for _ in range(LAPS // 2)]
    actions = [*half, *(_back(drawn, closed) for drawn in half[::-1])]
    away = draw()
    for _ in range(_AWAY[motion]):
        now = move(now, away)
        away = draw() if motion != "rough" else away
    return now, actions


def _back(drawn: dict[str, np.ndarray], closed: list[str]) -> dict[str, np.ndarray]:
    """Return the actions that reverse a motion, with some jaws kept closed."""
    back = {agent: -action for agent, action in drawn.items()}
    for agent in closed:
        back[agent][:, -1] = -1.0
    return back


def _grasping(now: Physics, starts: Starts, at: Callable[..., Physics]) -> Physics:
    """Return the state [n, ...] in which jaws are about to close on objects."""
    qpos, position, turned = (x.astype(np.float32) for x in starts[:3])
    objects = now.rigid_bodies._replace(bodies=now.rigid_bodies.bodies._replace(position=position, quaternion=turned))
    return at(qpos).with_systems(rigid_bodies=objects)


def tile(values: np.ndarray, num_envs: int) -> np.ndarray:
    """Return rows over and over: [n, ...] -> [num_envs, ...]."""
    return np.ascontiguousarray(values[np.arange(num_envs) % len(values)])


def with_objects(scene: Scene, course: Course) -> tuple[np.ndarray, np.ndarray]:
    """Return `qpos` and `qvel` of the exported scene, in which free objects have joints behind those of the arms."""
    qpos, qvel, (bodies, _) = [course.qpos], [course.qvel], course.objects
    for o, item in enumerate(place.object for place in scene.free_objects.values()):
        axes = np.stack([matrix_of(quaternion) for quaternion in bodies.quaternion[:, o]])
        lever, spin = axes @ item.center, bodies.velocity[:, o, 3:]
        qpos += [bodies.position[:, o] - lever, bodies.quaternion[:, o]]
        qvel += [bodies.velocity[:, o, :3] - np.cross(spin, lever), (spin[:, None] @ axes)[:, 0]]
    return np.concatenate(qpos, 1), np.concatenate(qvel, 1)


def full_state(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Return C MuJoCo's state [n, 1 + nq + nv] at time 0."""
    return np.concatenate([np.zeros((len(qpos), 1)), qpos, qvel], 1)


def _leaves(tree: Any) -> dict[str, Any]:
    """Return the arrays of a tree by their path in it, as in ".bodies.position"."""
    import jax

    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}


def _by_engine(workload: Workload, count: int) -> Callable[[Physics], Physics]:
    """Return a function that makes HOLD physics steps of `count` environments, by the fastest engine that can."""
    import jax

    engine = make_engine(PhysicsAlone(Env(**workload.of_environment())), count, "auto", workload.where)
    engine.reset(0)

    def roll(now: Physics) -> Physics:
        paths = [f".physics{path}" for path in _leaves(now)]
        for path, values in zip(paths, jax.tree.leaves(now), strict=True):
            engine.write(path, np.asarray(values))
        for _ in range(HOLD):
            engine.step({})
        return jax.tree.unflatten(jax.tree.structure(now), [engine.read(path, "numpy") for path in paths])

    return roll


def _by_mujoco(model: mujoco.MjModel, now: Physics) -> Physics:
    """Make HOLD physics steps of C MuJoCo."""
    state = full_state(np.asarray(now.qpos), np.asarray(now.qvel))
    data = mujoco.MjData(model)
    found, _ = rollout.rollout(model, data, state, np.asarray(now.ctrl, float)[:, None], nstep=HOLD)
    end = np.asarray(found[:, -1], np.float32)
    return now.with_arms(qpos=end[:, 1 : 1 + model.nq], qvel=end[:, 1 + model.nq :])


def _touching(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    data, count = mujoco.MjData(model), 0
    for posture in qpos:
        data.qpos[:] = posture
        mujoco.mj_fwdPosition(model, data)
        count += data.ncon > 0
    return count / len(qpos)
