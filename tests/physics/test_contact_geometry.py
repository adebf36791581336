"""Contacts in random places, against searches by numpy and scipy that know nothing of how the package computes them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from surgical_marl.physics.contact.arm_contacts import SLOTS, Pairs
from surgical_marl.physics.contact.contact_patch import (
    ALIKE,
    ASIDE,
    AWAY,
    BLEND,
    LEAN,
    POINTS,
    TILT,
    find_patch,
    no_patch,
    tangents,
)
from surgical_marl.physics.contact.friction_cone import (
    Cone,
    Stuck,
    between,
    curvature,
    nearest,
    parting,
    stretched,
    wrench,
)
from surgical_marl.physics.contact.shapes import (
    EVEN,
    NEAR,
    Plate,
    Points,
    Segments,
    between_segments,
    on_plate,
    plate_of_box,
)
from surgical_marl.physics.solver.cholesky import packed
from surgical_marl.physics.tree_utils import picked, row_of
from tests.physics.test_search import drawn

COUNT = 200
SHARES = np.linspace(0, 1, 2001)
STEP = 2e-3


def single(array: Any) -> Any:
    return jnp.asarray(array, jnp.float32)


def numpy(found: Any) -> Any:
    return jax.tree.map(lambda x: np.asarray(x, float), found)


def ends(rng: np.random.Generator, count: int, half: tuple[float, float]) -> np.ndarray:
    """Start and end of segments about the origin, [count, 2, 3], mm rather than m, so that nothing is tiny."""
    way = rng.normal(size=(count, 3))
    way *= rng.uniform(*half, (count, 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    return rng.uniform(-1.5, 1.5, (count, 1, 3)) + np.stack([-way, way], 1)


def test_capsules_touch_where_the_nearest_of_many_points_are() -> None:
    """Of capsules that are not parallel, spheres among them: distance, place and normal."""
    rng = np.random.default_rng(0)
    one, other = ends(rng, COUNT, (0.2, 1.0)), ends(rng, COUNT, (0.2, 1.0))
    one[:30, 1], other[15:45, 1] = one[:30, 0], other[15:45, 0]  # spheres, of one of them or both
    radii = rng.uniform(0.05, 0.2, (2, COUNT))
    found = numpy(
        jax.jit(between_segments)(
            *(Segments(*single(np.moveaxis(e, 1, 0)), single(r)) for e, r in zip((one, other), radii, strict=True))
        )
    )
    seen = 0
    for k in range(COUNT):
        ways = [e[k, 1] - e[k, 0] for e in (one, other)]
        lengths = [np.linalg.norm(way) for way in ways]
        if min(lengths) > 0 and abs(ways[0] @ ways[1]) > 0.95 * lengths[0] * lengths[1]:
            continue  # nearly parallel: below
        points = one[k, 0] + SHARES[:, None] * ways[0]  # and the nearest place on the other one to each of them
        shares = np.clip((points - other[k, 0]) @ ways[1] / max(lengths[1] ** 2, 1e-12), 0, 1)
        gaps = points - other[k, 0] - shares[:, None] * ways[1]
        best = np.linalg.norm(gaps, axis=1).argmin()
        away = np.linalg.norm(gaps[best])
        if away < 0.05:
            continue
        seen += 1
        depth, normal = radii[:, k].sum() - away, gaps[best] / away
        assert found.depth[k] == pytest.approx(depth, abs=2e-3), k
        np.testing.assert_allclose(found.normal[k], normal, atol=0.03)
        # midway between the two surfaces
        np.testing.assert_allclose(found.place[k], points[best] - (radii[0, k] - depth / 2) * normal, atol=0.03)
    assert seen > 120


def test_parallel_capsules_touch_in_the_middle_of_what_they_share() -> None:
    rng, compiled = np.random.default_rng(1), jax.jit(between_segments)
    for _ in range(10):
        shift, turn = rng.uniform(-0.5, 0.5), Rotation.random(rng=rng).as_matrix()
        one = np.array([[-1.0, 0.3, 0.0], [1.0, 0.3, 0.0]]) @ turn.T
        other = np.array([[-0.4 + shift, 0.0, 0.0], [0.4 + shift, 0.0, 0.0]]) @ turn.T
        found = compiled(Segments(*single(other), single(0.1)), Segments(*single(one), single(0.05)))
        place = turn @ [shift, 0.3 - 0.05 - 0.075, 0.0]
        np.testing.assert_allclose(found.place, place, atol=1e-3)
        assert float(found.depth) == pytest.approx(-0.15, abs=1e-5)
        np.testing.assert_allclose(found.normal, turn @ [0, -1, 0], atol=1e-4)


def test_points_on_a_plate_are_where_distance_and_price_are_least() -> None:
    """One point for the middle and one for each end of a capsule: each found among 2,001, for plates turned anyhow."""
    rng = np.random.default_rng(2)
    capsule, radius = ends(rng, COUNT, (0.2, 1.5)), rng.uniform(0.02, 0.1, COUNT)
    frames, centre = Rotation.random(COUNT, rng=rng).as_matrix(), rng.normal(size=(COUNT, 3))
    half, thick = rng.uniform(0.3, 1.0, (COUNT, 2)), rng.uniform(0.02, 0.1, COUNT)
    capsule[: COUNT // 2, :, 2] *= 0.1  # about flat on the plate
    capsule[:, :, 2] += 0.4
    world = centre[:, None] + np.einsum("nij,nej->nei", frames, capsule)
    found = numpy(
        jax.jit(on_plate)(
            Segments(*single(np.moveaxis(world, 1, 0)), single(radius)),
            Plate(single(centre), single(frames), single(half), single(thick)),
        )
    )
    for k in range(COUNT):
        start, way = capsule[k, 0], capsule[k, 1] - capsule[k, 0]
        points = start + SHARES[:, None] * way
        off = points - np.concatenate([np.clip(points[:, :2], -half[k], half[k]), np.zeros((len(points), 1))], 1)
        length = np.linalg.norm(way)
        for n, (anchor, angle) in enumerate(((0.5, NEAR), (0.0, EVEN), (1.0, EVEN))):
            price = angle * (radius[k] + thick[k]) * length * (SHARES - anchor) ** 2
            best = (np.sum(off**2, 1) + price).argmin()
            away = np.linalg.norm(off[best])
            if away < 0.1 or abs(way[2]) < 1e-3 * length:
                continue
            assert found.depth[k, n] == pytest.approx(radius[k] + thick[k] - away, abs=2e-3), (k, n)
            normal = frames[k] @ off[best] / away
            np.testing.assert_allclose(found.normal[k, n], normal, atol=0.02)
            middle = world[k, 0] + SHARES[best] * (world[k, 1] - world[k, 0])
            expected = middle - (radius[k] - found.depth[k, n] / 2) * normal
            np.testing.assert_allclose(found.place[k, n], expected, atol=6e-3 * max(1.0, length))


def test_a_box_is_the_plate_in_its_middle() -> None:
    for order in ((0.3, 0.2, 0.1), (0.1, 0.3, 0.2), (0.2, 0.1, 0.3)):
        size = np.array(order)
        frame, half, radius = plate_of_box(size)
        assert radius == 0.1 and np.linalg.det(frame) == pytest.approx(1.0)
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.abs(frame @ [*(half + radius), radius]), size, atol=1e-12)


def test_tangents_are_the_frame_of_a_right_hand() -> None:
    normals = np.random.default_rng(3).normal(size=(COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.concatenate([normals, np.eye(3), -np.eye(3)])
    frames = np.asarray(tangents(single(normals)), float)
    np.testing.assert_allclose(frames[:, 0], normals, atol=1e-6)
    np.testing.assert_allclose(frames @ np.swapaxes(frames, 1, 2), np.tile(np.eye(3), (len(frames), 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-5)


@jax.jit
def found_patch(points: Points, soon: Any, count: Any, centre: Any) -> Any:
    look, rows, middle = lambda n: row_of((points, soon), n), len(soon), points.place[0, 0]
    return find_patch(look, count, rows, middle, jnp.eye(3)[:2], TILT, jnp.float32(0.002), centre)


def patch_of(
    depths: Any, places: Any, soon: Any = None, centre: Any = None, count: Any = None, normals: Any = None
) -> Any:
    """The patch of points with normals along z, one a shape; shapes beyond them are deep, and not counted."""
    more = 9 - len(places)
    fill = lambda values, with_: single(np.concatenate([values, np.tile(with_, (more, *np.shape(values)[1:]))]))  # noqa: E731
    normals = np.tile([0.0, 0.0, 1.0], (len(places), 1)) if normals is None else np.asarray(normals, float)
    points = Points(
        fill(depths, 1.0)[:, None], fill(np.asarray(places, float), 1.0)[:, None], fill(normals, 1.0)[:, None]
    )
    then = points.depth if soon is None else fill(soon, 1.0)[:, None]
    number = len(places) if count is None else count
    return numpy(found_patch(points, then, np.int32(number), None if centre is None else single(centre)))


def test_a_patch_has_the_deepest_point_and_those_that_a_tilt_brings_in() -> None:
    rng = np.random.default_rng(4)
    directions = np.array([[1.0, 0.0], [-0.5, 0.866], [-0.5, -0.866]])
    for _ in range(20):
        places = np.concatenate([rng.uniform(-0.02, 0.02, (9, 2)), rng.uniform(0, 1e-4, (9, 1))], 1)
        depths, soon = rng.uniform(-1e-3, 2e-4, 9), rng.uniform(-1e-3, 2e-4, 9)
        counted = np.maximum(depths, soon)
        patch = patch_of(depths, places, soon)
        deepest = counted.argmax()
        tilted = np.minimum(counted, ALIKE)[:, None] + TILT * places[:, :2] @ directions.T
        which = [deepest, *tilted.argmax(0)]
        others = np.sort(tilted, 0)
        if min(np.diff(np.sort(counted))[-1], (others[-1] - others[-2]).min()) < 2e-5:
            continue
        np.testing.assert_allclose(patch.points.place, places[which], atol=1e-6)
        np.testing.assert_allclose(patch.points.depth, depths[which], atol=1e-7)
        np.testing.assert_allclose(patch.points.normal, np.tile([0, 0, 1], (POINTS, 1)), atol=1e-6)
        assert float(patch.reach) == pytest.approx(counted.max(), abs=1e-7)
        weight = np.maximum(depths[which], 1e-9)
        weight /= weight.sum()
        centre = weight @ places[which]
        spread = np.sqrt(weight @ np.sum((places[which] - centre) ** 2, 1))
        np.testing.assert_allclose(patch.centre, centre, atol=1e-6)
        assert float(patch.radius) == pytest.approx(np.hypot(0.002, spread), abs=1e-6)
        np.testing.assert_allclose(patch.normal, [0, 0, 1], atol=1e-6)


CORNERS = np.array([[0.01, 0.0, 0.0], [-0.005, 0.00866, 0.0], [-0.005, -0.00866, 0.0]])


def test_a_weight_beyond_the_rim_leans_to_its_side() -> None:
    """A triangle bears a weight within it. Beyond an edge a further point on that side is the deepest one."""
    places = np.concatenate([CORNERS, [[0.004, 0.006, 0.0], [-0.009, 0.0, 0.0]]])
    depths = np.full(5, 1e-4)
    within = patch_of(depths, places, centre=[0.0, 0.0, 0.01])
    np.testing.assert_allclose(within.points.place[0], places.mean(0), atol=1e-6)  # of those that are alike
    np.testing.assert_allclose(within.points.place[1:], CORNERS, atol=1e-6)
    edge = 0.005 - ASIDE / 2  # half of `ASIDE` within an edge a quarter of the tilt is there
    for x, y, way, share in ((0.01, 0.0173, [0.5, 0.866], 1), (-0.02, 0, [-1, 0], 1), (-edge, 0, [-1, 0], 0.25)):
        leaning = depths + share * LEAN * places[:, :2] @ way
        weight = np.maximum(leaning - leaning.max() + BLEND, 0)
        found = patch_of(depths, places, centre=[x, y, 0.0])
        np.testing.assert_allclose(found.points.place[0], weight @ places / weight.sum(), atol=1e-5)


def test_a_fork_is_led_by_its_first_point_and_nothing_is_no_patch() -> None:
    fork = patch_of([1e-3, 1e-3], [[-0.01, 0, 0], [0.01, 0, 0]], normals=[[1, 0, 0], [-1, 0, 0]])
    assert abs(abs(float(fork.normal[0])) - 1) < 1e-3
    few = patch_of([1e-3, 2e-3], [[-0.01, 0, 0], [0.01, 0, 0]], count=1)
    np.testing.assert_allclose(few.points.place, np.tile([-0.01, 0, 0], (POINTS, 1)), atol=1e-7)
    assert float(patch_of([1e-3], [[0, 0, 0]], count=0).reach) == 2 * AWAY
    none = no_patch()
    assert none.points.depth.tolist() == [AWAY] * POINTS and float(none.reach) == AWAY and float(none.radius) == 1
    assert not none.normal.any() and none.centre.tolist() == [0, 0, 0] and not none.points.normal.any()


def test_forces_are_the_nearest_ones_in_the_friction_cone() -> None:
    """In the metric of the springs, found by a general method (SLSQP)."""
    rng, seen = np.random.default_rng(5), set()
    compiled = jax.jit(nearest)
    for _ in range(30):
        c, stuck = drawn(rng)
        if rng.random() < 0.2:
            stuck = Stuck(-jnp.abs(stuck.push) - 0.5, 0.1 * stuck.pull)
        felt = compiled(c.springs, stuck)
        stiff, rub, mu = (np.asarray(part, float) for part in c.springs)
        push, pull = (np.asarray(part, float) for part in stuck)

        def cost(f: np.ndarray, push: Any = push, pull: Any = pull, stiff: Any = stiff, rub: Any = rub) -> float:
            return float(np.sum((f[:4] - push) ** 2 / stiff) + np.sum((f[4:] - pull) ** 2) / rub)

        bound = {"type": "ineq", "fun": lambda f, mu=mu: mu * f[:4].sum() - np.sqrt(f[4:] @ f[4:] + 1e-12)}
        begin = np.concatenate([np.maximum(push, 0) + 0.5, 0.1 * mu * pull / np.linalg.norm(pull)])
        best = minimize(cost, begin, bounds=[(0, None)] * 4 + [(None, None)] * 3, constraints=bound, method="SLSQP",
                        options={"maxiter": 300, "ftol": 1e-12})  # fmt: skip
        found = np.concatenate([felt.normal, felt.friction]).astype(float)
        assert np.linalg.norm(found[4:]) <= mu * found[:4].sum() + 1e-4 and (found[:4] >= 0).all()
        assert cost(found) <= cost(best.x) + 1e-3 * (1 + cost(best.x))
        np.testing.assert_allclose(found, best.x, atol=2e-2)
        np.testing.assert_allclose(felt.direction, pull / np.linalg.norm(pull), atol=1e-5)
        assert float(felt.left) == pytest.approx(np.linalg.norm(found[4:]) / np.linalg.norm(pull), abs=1e-4)
        sticks = np.linalg.norm(pull) <= mu * np.maximum(push, 0).sum()
        assert bool(felt.slips) == (not sticks)
        seen.add((sticks, bool(found.any())))
    assert seen == {(True, True), (False, True), (False, False)}


@jax.jit
def curvatures(c: Cone, stuck: Stuck, other: Cone, at: Any) -> Any:
    """Three curvatures, and how the wrench falls as the first or the second body accelerates, by differences."""

    def felt(mine: Any, its: Any) -> Any:
        moved = stretched(c.springs, stretched(c.springs, stuck, parting(c, at + mine)), parting(other, its))
        return nearest(c.springs, moved)

    pulled = lambda mine, its: wrench(c, felt(mine, its))  # noqa: E731
    zero, steps = jnp.zeros(6), STEP * jnp.eye(6)
    here = felt(zero, zero)
    own = jax.vmap(lambda d: pulled(-d, zero) - pulled(d, zero), out_axes=1)(steps) / (2 * STEP)
    its = jax.vmap(lambda d: pulled(zero, -d) - pulled(zero, d), out_axes=1)(steps) / (2 * STEP)
    presses = lambda d: felt(d, zero).normal > 0  # noqa: E731
    corner = jax.vmap(lambda d: presses(d) != presses(-d))(steps).any()
    return here.slips, corner, curvature(c, here)[packed(6)], between(c, c, here), between(c, other, here), own, its


def test_curvatures_are_differences_of_the_wrench() -> None:
    """Of one body, and of a second one whose twists have another origin: its own and the mixed one."""
    rng, seen = np.random.default_rng(6), []
    for _ in range(60):
        (one, stuck), (ways, _) = drawn(rng), drawn(rng)
        other = one._replace(normal=ways.normal, along=ways.along)
        slips, corner, *parts = curvatures(one, stuck, other, single(rng.normal(size=6)))
        whole, same, mixed, own, its = (np.asarray(part, float) for part in parts)
        np.testing.assert_allclose(same, whole, atol=1e-3, rtol=1e-3)
        np.testing.assert_array_equal(whole, whole.T)
        if not corner:  # where a point begins to press there is no derivative
            errors = (
                np.abs(whole - own).max() / (1 + np.abs(own).max()),
                np.abs(mixed - its).max() / (1 + np.abs(its).max()),
            )
            seen.append((bool(slips), *errors))
    assert {slips for slips, *_ in seen} == {True, False} and len(seen) > 20
    assert max(max(off) for _, *off in seen) < 0.01


def test_few_pairs_are_never_too_many() -> None:
    """As many as there are slots are never left out, and one more is."""
    for count, left in ((SLOTS, 0), (SLOTS + 1, 1)):
        spheres = "".join(f'<body><freejoint/><geom name="{k}" size="0.1"/></body>' for k in range(count + 1))
        pairs = "".join(f'<pair geom1="0" geom2="{k + 1}"/>' for k in range(count))
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody>{spheres}</worldbody><contact>{pairs}</contact></mujoco>"
        )
        known = Pairs(model)
        places = single(np.zeros((count + 1, 3)) + np.linspace(0, 0.01, count + 1)[:, None])
        frames, none = jnp.tile(jnp.eye(3), (count + 1, 1, 1)), np.zeros((model.nv + model.nbody, 6), np.float32)
        distance = known.distance(places, frames)
        poses = {"geom_xpos": places, "geom_xmat": frames, "cdof": none[: model.nv], "subtree_com": none[:, :3]}
        found = known.deepest(SimpleNamespace(**poses), distance)
        assert (np.asarray(distance) < 0).all() and int(found.left_out) == left
        np.testing.assert_allclose(known.closest(places, frames, np.arange(known.count)).distance, distance)


shapes = st.lists(st.lists(st.integers(1, 3), max_size=2).map(tuple), min_size=1, max_size=3)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 4), shapes, st.data())
def test_a_row_out_of_one_flat_array_is_the_row(rows: int, shapes: list[tuple[int, ...]], data: st.DataObject) -> None:
    rng, i = np.random.default_rng(0), data.draw(st.integers(0, rows - 1))
    tree = {str(n): jnp.asarray(rng.normal(size=(rows, *shape)), jnp.float32) for n, shape in enumerate(shapes)}
    jax.tree.map(np.testing.assert_array_equal, picked(tree, jnp.int32(i)), row_of(tree, i))
