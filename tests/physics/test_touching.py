"""What touches objects and fixed things is found, whatever the search for it passes by."""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml

from surgical_marl.physics.contact.broadphase import Places
from surgical_marl.physics.contact.detection import AHEAD, MARGIN, NEAR, NEAREST, Slots
from surgical_marl.physics.contact.shapes import on_plate
from surgical_marl.physics.simulator import Physics, Simulator
from surgical_marl.physics.step import Step
from surgical_marl.physics.systems.dynamics import Dynamics
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.mjcf import mjcf
from surgical_marl.scenes.scene import Scene
from tests.helpers.every_patch import every_patch, lying
from tests.helpers.falling import DT, Falling, random_turns
from tests.helpers.falling import thrown as moved

STATES = 512


class Thrown(NamedTuple):
    """Two arms at postures over a board, and blocks among their tips, the pegs and the wall."""

    scene: Scene
    step: Step
    find: Any
    """The search, compiled for states [STATES]."""
    depths: Any
    """Likewise how deep all pairs overlap."""
    states: Physics
    """[STATES, ...]; nothing moves."""
    dt: float
    """Of a physics step, s."""

    def search(self, states: Physics) -> Slots:
        return jax.tree.map(np.asarray, self.find(states))

    @property
    def kinds(self) -> np.ndarray:
        """Number of the meeting that each pair is of, [g]."""
        meetings = self.step.bodies.tables.meetings
        return np.repeat(np.arange(len(meetings)), [len(meeting.one) for meeting in meetings])


@pytest.fixture(scope="module")
def thrown() -> Thrown:
    scene, rng = load_scene("bimanual_psm_pegs"), np.random.default_rng(0)
    dynamics, home = Dynamics(scene.model), Simulator(scene).home
    step = Step(scene)
    qpos = np.asarray(home.qpos) + rng.uniform(-0.5, 0.5, (STATES, len(home.qpos)))
    depth = np.flatnonzero(step.bodies.tables.slides.any(0))[0] + np.array([0, len(home.qpos) // 2])
    qpos[:, depth] = np.asarray(home.qpos)[depth] + rng.uniform(-0.02, 0.1, (STATES, 2))
    board = scene.objects["board"].position
    places = board + rng.uniform([-0.1, -0.05, 0.0], [0.1, 0.05, 0.1], (STATES, 2, 3))
    pegs = board + [[x, y, 0.01] for x in (-0.08, -0.06, 0.04, 0.06) for y in (-0.03, 0.0, 0.03)]
    near = rng.random((STATES, 2)) < 0.7
    places[near] = rng.choice(pegs, near.sum()) + rng.normal(size=(near.sum(), 3)) * 0.005
    fingers = jax.vmap(dynamics.pose)(jnp.asarray(qpos, jnp.float32)).geom_xpos[:, step.bodies.tables.pad_geoms[::2]]
    held = rng.random((STATES, 2)) < 0.3
    places[held] = np.asarray(fingers)[held] + rng.normal(size=(held.sum(), 3)) * 0.005
    one = jax.tree.map(lambda x: jnp.repeat(x[None], STATES, 0), home)
    bodies = one.rigid_bodies.bodies._replace(
        position=jnp.asarray(places, jnp.float32),
        quaternion=jnp.asarray(random_turns(rng, STATES, 2), jnp.float32),
    )
    states = one.with_arms(qpos=jnp.asarray(qpos, jnp.float32)).with_systems(
        rigid_bodies=one.rigid_bodies._replace(bodies=bodies)
    )
    return searched(scene, step, states, float(dynamics.dt))


def searched(scene: Scene, step: Step, states: Physics, dt: float) -> Thrown:
    find, depths = (jax.jit(jax.vmap(what)) for what in (step.slots, step.depths))
    return Thrown(scene, step, find, depths, states, dt)


def rod(start: list[float], end: list[float]) -> dict[str, Any]:
    return {"capsule": {"radius": 0.001, "from": start, "to": end}}


def foot(x: float, y: float) -> dict[str, Any]:
    return {"sphere": {"radius": 0.0005, "position": [x, y, 0.0]}}


TEETH = NEAREST + 3


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Thrown:
    """A floor, a bar just above the teeth of a comb, and a stool on four small feet."""
    folder, felt = (
        tmp_path_factory.mktemp("bench"),
        {"friction": {"sliding": 0.5, "torsion": 0.001}, "stiffness": 1.0e6},
    )
    rows = [0.003 * (k - (TEETH - 1) / 2) for k in range(TEETH)]
    things: dict[str, tuple[list[dict[str, Any]], list[float]]] = {
        "floor": ([{"plane": {}}], [0.0, 0.0, 0.0]),
        "comb": ([rod([x, -0.01, 0.0], [x, 0.01, 0.0]) for x in rows], [0.0, 0.0, 1.0]),
        "bar": ([rod([-0.04, 0.0, 0.0], [0.04, 0.0, 0.0])], [0.0, 0.0, 1.00205]),
        "stool": ([foot(x, y) for x in (-0.008, 0.008) for y in (-0.008, 0.008)], [0.2, 0.0, 0.01]),
    }
    for name, (shapes, _) in things.items():
        weight = {"free": True, "mass": 0.001} if name in ("bar", "stool") else {"free": False}
        (folder / f"{name}.yaml").write_text(yaml.safe_dump({**weight, **felt, "shapes": shapes}))
    space = Falling(folder, {name: {"object": f"{name}.yaml", "position": at} for name, (_, at) in things.items()})
    states = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[None], STATES, 0), space._arms)
    return searched(space.scene, space.step, states.with_systems(rigid_bodies=space.begin(STATES)), DT)


def test_every_pair_that_overlaps_is_found_and_none_that_is_far(thrown: Thrown) -> None:
    depths, slots, met = np.asarray(thrown.depths(thrown.states)), thrown.search(thrown.states), set()
    for own, numbers, total in zip(depths, slots.number, slots.total, strict=True):
        found = set(numbers[:total].tolist())
        assert all(own[number] > -2 * NEAR for number in found)
        assert len(found) == min(total, len(numbers))  # none twice
        if total <= len(numbers):
            within = set(np.flatnonzero(own > -MARGIN).tolist())  # from there on points are stiff
            assert within <= found
            met |= set(thrown.kinds[list(within)].tolist())
    assert met >= {k for k, meeting in enumerate(thrown.step.bodies.tables.meetings) if meeting.second != "objects"}


def flying(states: Physics, speed: float) -> Physics:
    """Return states in which objects fly straight."""
    flies = np.zeros((STATES, 2, 6), np.float32)
    flies[..., :3] = np.random.default_rng(1).normal(size=(STATES, 2, 3)) * speed
    return states.with_systems(rigid_bodies=moved(states.rigid_bodies, velocity=flies))


def test_what_will_overlap_after_a_step_is_found_before_it(thrown: Thrown) -> None:
    """Convex shapes that fly straight are at no time nearer than where they were says, with how fast they come."""
    states = flying(thrown.states, 0.8)  # 2 mm in a step, 9 at most: within AHEAD
    bodies, slots, come = states.rigid_bodies.bodies, thrown.search(states), 0
    after = moved(states.rigid_bodies, position=bodies.position + thrown.dt * bodies.velocity[..., :3])
    before, then = (np.asarray(thrown.depths(each)) for each in (states, states.with_systems(rigid_bodies=after)))
    for own, were, numbers, total in zip(then, before, slots.number, slots.total, strict=True):
        if total <= len(numbers):
            overlaps = set(np.flatnonzero(own > 1e-5).tolist())
            assert overlaps <= set(numbers[:total].tolist())
            come += sum(were[number] < -2 * NEAR for number in overlaps)
    assert come > 50


def test_what_flies_fast_is_looked_for_ahead_but_not_everywhere(thrown: Thrown) -> None:
    states = flying(thrown.states, 80.0)  # 0.2 m in a step
    slots, depths = thrown.search(states), np.asarray(thrown.depths(states))
    own = np.concatenate([own[n[:total]] for own, n, total in zip(depths, slots.number, slots.total, strict=True)])
    assert own.min() > -AHEAD - 2 * NEAR and AHEAD <= 0.02  # m
    assert (own < -AHEAD / 2).sum() > 50


@pytest.mark.parametrize("world", ["thrown", "bench"])
def test_patches_are_those_of_all_capsules_of_all_pairs(world: str, request: pytest.FixtureRequest) -> None:
    """What the search leaves out has no part in a patch, for objects that lie about flat, move and spin."""
    there: Thrown = request.getfixturevalue(world)
    states, meetings = lying(there.step, there.states, seed=2), there.step.bodies.tables.meetings
    slots, every = there.search(states), every_patch(there.step, there.scene, states, there.dt)
    assert (slots.total <= slots.number.shape[1]).all()
    for own, numbers, total in zip(every.reach, slots.number, slots.total, strict=True):
        found = set(numbers[:total].tolist())
        assert set(np.flatnonzero(own > -NEAR + 3e-6)) <= found <= set(np.flatnonzero(own > -NEAR - 3e-6))
    e, s = np.nonzero(np.arange(slots.number.shape[1]) < slots.total[:, None])
    number = slots.number[e, s]
    one, all_ = jax.tree.map(lambda x: x[e, s], slots.patch), jax.tree.map(lambda x: x[e, number], every)
    # of two points that are as deep, rounding decides how much each counts: `BLEND`
    for name, most in (("depth", 3e-6), ("place", 3e-5), ("normal", 2e-3)):
        np.testing.assert_allclose(getattr(one.points, name), getattr(all_.points, name), atol=most)
    for name, most in (("centre", 1e-5), ("radius", 1e-6), ("reach", 2e-6)):
        np.testing.assert_allclose(getattr(one, name), getattr(all_, name), atol=most)
    # tangents may turn where a normal is level
    np.testing.assert_allclose(one.normal, all_.normal, atol=2e-3)
    met = np.bincount(there.kinds[number], minlength=len(meetings))
    assert met.max() > 300
    if world == "thrown":
        assert (met > 10).all()


def test_no_capsule_is_nearer_to_a_plate_than_it_seems(thrown: Thrown) -> None:
    """And few seem to be near: balls around the capsules let nearly twice as many seem to be."""
    tables, model = thrown.step.bodies.tables, Dynamics(thrown.scene.model)
    places, capsules = Places(tables), np.arange(tables.radius.shape[1], dtype=np.int32)

    def gaps(state: Physics) -> Any:
        data, bodies = model.pose(state.qpos), state.rigid_bodies.bodies
        placed = places.place(data, places.joints(data), state.qvel, bodies, 0.0)

        def of_pair(pair: Any) -> Any:
            i, j = pair
            bound, ends = places.capsule_gap(placed, i, "pads", j), places.capsules(placed, "objects", i)
            middle, plate = (ends.start + ends.end) / 2, places.plate(placed, "pads", j)
            balls = jax.vmap(lambda at: places.distance(placed, "pads", j, at))(middle) - jnp.asarray(tables.around)[i]
            exact = -jnp.max(jax.vmap(lambda capsule: on_plate(capsule, plate).depth)(ends), -1)
            return jax.vmap(bound)(capsules), exact, balls

        pairs = np.array(list(product(range(2), range(len(tables.pad_geoms)))), np.int32).T
        return jax.vmap(of_pair)((pairs[0], pairs[1]))

    bound, exact, balls = (np.asarray(x) for x in jax.jit(jax.vmap(gaps))(thrown.states))
    assert (balls - 1e-6 <= bound).all() and (bound <= exact + 1e-6).all()
    near = 0.0015
    assert (exact < near).sum() > 100
    assert 1.5 * (bound < near).sum() < (balls < near).sum()


def test_overlaps_of_capsules_are_those_of_mujoco(thrown: Thrown) -> None:
    """Of all pairs of capsules that are within 5 cm, as `mj_geomDistance` measures them."""
    tables, scene, seen, far = thrown.step.bodies.tables, thrown.scene, 0, 0.05
    depths, bodies = np.asarray(thrown.depths(thrown.states)), thrown.states.rigid_bodies.bodies
    model = mujoco.MjModel.from_xml_string(mjcf(scene))
    data, shapes = mujoco.MjData(model), {name: len(place.object.shapes) for name, place in scene.objects.items()}
    geoms = {"links": [[model.geom(scene.model.geom(int(geom)).name).id] for geom in tables.near],
             "objects": [[model.geom(f"{name}/{k}").id for k in range(shapes[name])] for name in tables.names],
             "rods": [[model.geom(f"board/{k}").id] for k in range(2, shapes["board"])]}  # fmt: skip
    for e in range(64):
        data.qpos[: scene.model.nq] = thrown.states.qpos[e]
        for o, name in enumerate(tables.names):
            turn = np.asarray(bodies.quaternion[e, o], float)
            origin = np.asarray(bodies.position[e, o]) - matrix_of(turn) @ scene.objects[name].object.center
            data.joint(name).qpos[:] = [*origin, *turn]
        mujoco.mj_kinematics(model, data)
        own = iter(depths[e])
        for meeting in tables.meetings:
            for i, j, depth in zip(meeting.one, meeting.other, own, strict=False):
                if depth > -far and meeting.second in geoms:
                    pairs = product(geoms[meeting.first][i], geoms[meeting.second][j])
                    apart = min(mujoco.mj_geomDistance(model, data, *pair, far, None) for pair in pairs)
                    assert depth == pytest.approx(-apart, abs=1e-5), (meeting.first, meeting.second)
                    seen += 1
    assert seen > 1000


def test_more_pairs_than_are_looked_at_are_counted(bench: Thrown) -> None:
    """As many teeth under the bar as are looked at are found, and more are counted."""
    slots = bench.search(bench.states)
    assert (slots.total == TEETH).all() and slots.number.shape == (STATES, NEAREST)
    assert (np.diff(np.sort(slots.number, 1)) == 1).all()
    np.testing.assert_allclose(slots.patch.reach, -5e-5, atol=1e-6)
