"""No pair of geoms that can touch within the joint limits goes unwatched: searched by descent in C MuJoCo."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from surgical_marl import load_scene
from surgical_marl.physics.contact.arm_contacts import Pairs
from surgical_marl.physics.systems.dynamics import Dynamics
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.contacts import collision_geoms, neighbours
from surgical_marl.scenes.placing import scenes_without_objects
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.separation import Limb, ball, can_meet

SEEDS = st.integers(0, 2**32 - 1)
CLOSED = 0.02
UNSEEN = [
    ("bimanual_psm", ("psm_0/jaw_right", "psm_1/carriage"), 0.017, {
        "psm_0": (1.578, -0.925, 0.235, -4.13, -0.838, -0.253, CLOSED),
        "psm_1": (0.371, 0.886, 0.23, -0.248, -0.073, 0.709, CLOSED)}),
    ("trimanual_psm_ecm", ("psm_1/jaw_left", "ecm_0/camera_head"), 0.012, {
        "psm_0": (1.569, 0.147, 0.028, 2.728, 1.06, 1.025, CLOSED),
        "psm_1": (1.588, -0.92, 0.233, -2.71, 0.663, 0.416, CLOSED),
        "ecm_0": (-1.284, 1.065, 0.19, -1.283)}),
]  # fmt: skip
"""Deep overlaps that 20,000 random postures missed: scene, pair, depth in m and joint positions."""


class Descent:
    """Least distances of pairs of geoms by gradient descent in C MuJoCo, from the nearest of some random postures."""

    def __init__(self, model: mujoco.MjModel, starts: int, samples: int = 1000) -> None:
        self.model, self.data, self.starts = model, mujoco.MjData(model), starts
        self.postures = np.random.default_rng(0).uniform(*model.jnt_range.T, (samples, model.nq))

    def least(self, pairs: list[tuple[int, int]]) -> list[float]:
        """Least distance found of each pair, m; no more than 0 once a posture is found in which they touch."""
        distances = np.array([[self._distance(pair, q)[0] for pair in pairs] for q in self.postures])
        nearest = np.argsort(distances, 0)[: self.starts].T
        return [self._descend(pair, self.postures[first]) for pair, first in zip(pairs, nearest, strict=True)]

    def _descend(self, pair: tuple[int, int], starts: np.ndarray) -> float:
        least = np.inf
        for start in starts:
            found = minimize(
                lambda q: self._distance(pair, q), start, jac=True, method="L-BFGS-B", bounds=self.model.jnt_range
            )
            least = min(least, found.fun)
            if least <= 0:
                break
        return least

    def _distance(self, pair: tuple[int, int], q: np.ndarray) -> tuple[float, np.ndarray]:
        """The distance of two geoms, m, and its gradient [n]."""
        model, data, ends = self.model, self.data, np.zeros(6)
        if not np.array_equal(data.qpos, q) or not data.time:
            data.qpos[:], data.time = q, 1.0
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
        distance = mujoco.mj_geomDistance(model, data, *pair, 100.0, ends)
        normal = (ends[3:] - ends[:3]) / (distance or 1.0)
        speeds = np.zeros((2, 3, model.nv))
        for speed, end, geom in zip(speeds, ends.reshape(2, 3), pair, strict=True):
            mujoco.mj_jac(model, data, speed, None, end, model.geom_bodyid[geom])
        return distance, normal @ (speeds[1] - speeds[0])


def unwatched(scene: Scene) -> list[tuple[int, int]]:
    """Ids of the geoms of a scene that are no pair, though nothing but distance keeps them apart."""
    model, data = scene.model, mujoco.MjData(scene.model)
    watched = {frozenset(map(int, ids)) for ids in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    data.qpos[:] = scene.home
    mujoco.mj_kinematics(model, data)
    owner = {geom: agent for agent in scene.agents for geom in collision_geoms(model, agent)}
    found = []
    for a, b in combinations(owner, 2):
        by_design = neighbours(model, a, b) or mujoco.mj_geomDistance(model, data, a, b, 1.0, None) <= 0
        if {a, b} not in watched and not (owner[a] == owner[b] and by_design):
            found.append((a, b))
    return found


@pytest.mark.parametrize("name", scenes_without_objects())
def test_no_pair_that_is_not_watched_can_touch(name: str) -> None:
    scene = load_scene(name)
    pairs = unwatched(scene)
    names = [tuple(scene.model.geom(geom).name for geom in pair) for pair in pairs]
    least = dict(zip(names, Descent(scene.model, starts=6).least(pairs), strict=True))
    assert not {pair: distance for pair, distance in least.items() if distance <= 0}


@pytest.mark.parametrize("name", ["bimanual_psm", "trimanual_psm_ecm"])
def test_no_pair_is_watched_in_vain(name: str) -> None:
    """The same descent makes every watched pair touch: it would find one that goes unwatched, and no pair costs time
    for nothing."""
    model = load_scene(name).model
    pairs = [(int(a), int(b)) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)]
    least = Descent(model, starts=60).least(pairs)
    apart = {tuple(model.geom(g).name for g in pair): d for pair, d in zip(pairs, least, strict=True) if d > 0}
    assert not apart


@pytest.mark.parametrize(("name", "pair", "depth", "q"), UNSEEN, ids=[case[0] for case in UNSEEN])
def test_an_overlap_that_is_hard_to_find_is_seen(
    name: str, pair: tuple[str, str], depth: float, q: dict[str, tuple[float, ...]]
) -> None:
    """By the scene's clearance and, as a contact, by C MuJoCo."""
    scene = load_scene(name)
    joints = {agent: np.array(values) for agent, values in q.items()}
    assert pair in scene.pairs
    assert float(scene.clearance(joints)) < 0.002 - depth
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.full_qpos(joints)
    mujoco.mj_forward(scene.model, data)
    touching = {tuple(scene.model.geom(int(g)).name for g in contact.geom): contact.dist for contact in data.contact}
    assert touching[pair] == pytest.approx(-depth, abs=0.001)


@pytest.mark.parametrize("seed", range(4))
def test_no_pair_goes_unwatched_wherever_arms_stand(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    lines = ["arms:"]
    for agent in ("psm_0", "ecm_0"):
        position, tilt = rng.uniform(-0.3, 0.3, 3).tolist(), rng.uniform(-180, 180, 3).tolist()
        lines.append(f"  {agent}: {{arm: {agent[:-2]}, position: {position}, tilt: {tilt}}}")
    (tmp_path / "odd.yaml").write_text("\n".join(lines))
    scene = load_scene(tmp_path / "odd.yaml")
    assert min(Descent(scene.model, starts=20).least(unwatched(scene))) > 0


def test_arms_out_of_each_others_reach_have_no_pairs(tmp_path: Path) -> None:
    """However many: all are ruled out by the balls that they stay in."""
    arms = "".join(f"  psm_{i}: {{arm: psm, position: [{3 * (i % 6)}, {3 * (i // 6)}, 0]}}\n" for i in range(30))
    (tmp_path / "hall.yaml").write_text(f"arms:\n{arms}")
    assert load_scene(tmp_path / "hall.yaml").pairs == ()


def two_chains(seed: int) -> mujoco.MjModel:
    """Two chains of three hinges and slides with a capsule or a sphere at their ends, somewhere near each other."""
    rng, chains = np.random.default_rng(seed), ""
    text = lambda values: " ".join(map(str, values))  # noqa: E731
    for chain in range(2):
        shape = f'<geom name="{chain}" type="capsule" size="0.02 {rng.uniform(0.01, 0.1)}" mass="1"/>'
        if rng.random() < 0.3:
            shape = f'<geom name="{chain}" type="sphere" size="0.03" mass="1"/>'
        for _ in range(3):
            slides, low = rng.random() < 0.3, rng.uniform(-2, 0)
            kind, unit = ("slide", 0.1) if slides else ("hinge", 1.0)
            joint = (f'<joint type="{kind}" axis="{text(rng.normal(size=3))}" '
                     f'range="{unit * low} {unit * (low + 1.5)}"/>')  # fmt: skip
            place = f'pos="{text(rng.uniform(-0.15, 0.15, 3))}" euler="{text(rng.uniform(-3, 3, 3))}"'
            shape = f'<body {place}>{joint}<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{shape}</body>'
        chains += shape
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{chains}</worldbody></mujoco>'
    )


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(SEEDS)
def test_what_is_proven_apart_stays_apart(seed: int) -> None:
    model = two_chains(seed)
    meet, _ = can_meet(model, 0, 1, near=0.0, most=10_000)
    assume(not meet)
    assert Descent(model, starts=5, samples=100).least([(0, 1)])[0] > 0


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(SEEDS)
def test_what_descent_makes_touch_can_meet(seed: int) -> None:
    """Found, not given up on."""
    model = two_chains(seed)
    assume(Descent(model, starts=5, samples=100).least([(0, 1)])[0] <= 0)
    meet, boxes = can_meet(model, 0, 1, near=0.001, most=50_000)
    assert meet and boxes <= 50_000


def test_a_search_that_is_cut_short_counts_as_found() -> None:
    model = load_scene("star").model
    one, other = (model.geom(f"star_0/{part}").id for part in ("link_1", "link_4"))
    assert can_meet(model, one, other, near=0.001)[0] is False
    assert can_meet(model, one, other, near=0.001, most=2)[0] is True


@settings(max_examples=200, deadline=None)
@given(SEEDS, st.sampled_from(["psm_0/jaw_left", "psm_1/carriage", "star_0/needle"]), st.floats(0.001, 1.0))
def test_no_point_moves_farther_than_joints_move_it(seed: int, name: str, size: float) -> None:
    """Anywhere in a box of joint positions, its corners above all; in all directions and in one."""
    scene = load_scene("star" if "star" in name else "bimanual_psm")
    limb, rng = Limb(scene.model, scene.model.geom(name).id), np.random.default_rng(seed)
    whole = limb.limits()[0]
    half = size * whole[1] * rng.uniform(0, 1, len(whole[1]))
    middle = whole[0] + rng.uniform(-1, 1, len(half)) * (whole[1] - half)
    shares = rng.uniform(-1, 1, (200, len(half)))
    shares[:100] = np.sign(shares[:100])
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    ends = []
    for q in (middle[None], middle + shares * half):
        capsule, speeds = limb.place(q)
        ends.append(capsule.centre[:, None] + [[[-1.0], [1.0]]] * (capsule.half * capsule.axis[:, None]))
        if len(q) == 1:
            farthest = limb.moves(speeds, half[None])[0].sum()
            along = limb.moves_along(normal[None], speeds, half[None]).sum()
    moved = ends[1] - ends[0]
    assert np.linalg.norm(moved, axis=-1).max() <= farthest + 1e-12
    assert np.abs(moved @ normal).max() <= along + 1e-12


@pytest.mark.parametrize("name", ["trimanual_psm_ecm", "bimanual_star"])
def test_geoms_are_where_c_mujoco_has_them_and_stay_in_their_balls(name: str) -> None:
    scene = load_scene(name)
    model, data, rng = scene.model, mujoco.MjData(scene.model), np.random.default_rng(0)
    geoms = [geom for agent in scene.agents for geom in collision_geoms(model, agent)]
    limbs, balls = {geom: Limb(model, geom) for geom in geoms}, {geom: ball(model, geom) for geom in geoms}
    for q in rng.uniform(*model.jnt_range.T, (200, model.nq)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for geom in geoms:
            centre, radius = balls[geom]
            far = np.linalg.norm(data.geom_xpos[geom] - centre) + model.geom_size[geom, :2].sum()
            assert far <= radius
            own = [j for j in range(model.njnt) if carries(model, int(model.jnt_bodyid[j]), geom)]
            capsule, _ = limbs[geom].place(q[own][None])
            np.testing.assert_allclose(capsule.centre[0], data.geom_xpos[geom], atol=1e-6)
            np.testing.assert_allclose(capsule.axis[0], data.geom_xmat[geom].reshape(3, 3)[:, 2], atol=1e-6)


def carries(model: mujoco.MjModel, body: int, geom: int) -> bool:
    """Whether a geom moves with a body."""
    at = int(model.geom_bodyid[geom])
    while at not in (0, body):
        at = int(model.body_parentid[at])
    return at == body


@pytest.mark.parametrize("name", ["bimanual_psm", "trimanual_psm_ecm", "bimanual_star"])
def test_whether_anything_overlaps_is_what_distances_say(name: str) -> None:
    """At random postures, and with tools side by side, where short shapes are taken for spheres first."""
    scene, rng = load_scene(name), np.random.default_rng(0)
    dynamics, pairs = Dynamics(scene.model), Pairs(scene.model)

    @jax.jit
    @jax.vmap
    def look(qpos: Any) -> Any:
        data = dynamics.pose(qpos)
        return pairs.overlap(data.geom_xpos, data.geom_xmat), pairs.distance(data.geom_xpos, data.geom_xmat).min()

    spread = {a: rng.uniform(m.arm.lower, m.arm.upper, (1500, len(m.arm.lower))) for a, m in scene.mounts.items()}
    meeting = {
        a: inverse_kinematics(m.arm, (rng.normal(0, 0.006, (1500, 3)) - m.position) @ m.rotation)
        for a, m in scene.mounts.items()
    }
    shares = []
    for postures in (spread, meeting):
        overlaps, least = look(scene.full_qpos(postures).astype(np.float32))
        clear = np.abs(least) > 1e-6
        assert np.array_equal(np.asarray(overlaps)[clear], np.asarray(least < 0)[clear])
        shares.append(np.mean(overlaps))
    assert 0.01 < np.mean(shares) < 0.99
