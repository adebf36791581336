"""Splines and the paths made of them: what they pass through, how fast, how bent, and whether arms can follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.load import load_scene
from surgical_marl.tasks.base import spline
from surgical_marl.tasks.base.paths import (
    DURATION,
    KNOT,
    SEGMENTS,
    SLOWEST,
    TURNING,
    loops_and_lines,
    path_table,
    walks,
)
from surgical_marl.tasks.base.task import Level

FINE = np.linspace(0, SEGMENTS, 20 * SEGMENTS + 1)
SEEDS = st.integers(0, 2**32 - 1)


def speeds(control: np.ndarray) -> np.ndarray:
    """Of targets along paths [N, SEGMENTS + 3, 3], m/s, [N, 20 SEGMENTS]."""
    steps = np.diff(spline.evaluate(control, FINE), axis=-2)
    return np.asarray(np.linalg.norm(steps, axis=-1) / (KNOT * (FINE[1] - FINE[0])))


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(4, 12), st.booleans())
def test_a_spline_passes_through_its_waypoints_smoothly(seed: int, count: int, closed: bool) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    if closed:
        points[-1] = points[0]
    control = spline.through(points, closed)
    n = count - 1
    np.testing.assert_allclose(spline.evaluate(control, np.arange(count)), points, atol=1e-9)
    if closed:  # place, velocity and acceleration go on
        np.testing.assert_allclose(control[:3], control[n:], atol=1e-9)
    else:  # the first two segments are one cubic
        np.testing.assert_allclose(np.diff(control, 4, axis=0)[[0, -1]], 0, atol=1e-8)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_cubic_is_its_own_spline(degree: int) -> None:
    u = np.linspace(0, 6, 50)
    curve = lambda u: np.stack([u**degree, -(u**degree), 0 * u], -1)  # noqa: E731
    np.testing.assert_allclose(spline.evaluate(spline.through(curve(np.arange(7.0)), False), u), curve(u), atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.booleans())
def test_points_at_equal_arc_length(seed: int, closed: bool) -> None:
    """Equal to 2 % of the step, by the arc length of a polygon far finer than that of the code."""
    rng = np.random.default_rng(seed)
    waypoints = np.cumsum(rng.normal((2, 0, 0), 1, (6, 3)), axis=0)
    control = spline.through(np.concatenate([waypoints, waypoints[:1]]) if closed else waypoints, closed)
    points, length = spline.equal_steps(control, 40)
    dense = spline.evaluate(control, np.linspace(0, control.shape[0] - 3, 20001))
    passed = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=-1))])
    nearest = [np.argmin(np.linalg.norm(dense[5:-5] - point, axis=-1)) + 5 for point in points[1:-1]]
    assert length == pytest.approx(passed[-1], rel=2e-3)
    np.testing.assert_allclose(np.diff(passed[nearest]), length / 40, rtol=0.02)


@pytest.mark.parametrize("radius", [0.005, 0.5])
def test_curvature_of_a_circle(radius: float) -> None:
    angle = np.linspace(0, 2 * np.pi, 41)
    ring = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    ring[-1] = ring[0]
    assert spline.curvature(spline.through(ring, True)) == pytest.approx(1 / radius, rel=5e-3)


@pytest.mark.parametrize(("count", "closed"), [(1, False), (3, False), (3, True)])
def test_too_few_waypoints_are_one_sentence(count: int, closed: bool) -> None:
    with pytest.raises(ValueError, match=f"a spline needs at least 4 waypoints, not {count}"):
        spline.through(np.zeros((count, 3)), closed)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.floats(0.005, 0.2), st.floats(0.005, 0.2))
def test_walks_keep_their_bounds_and_do_not_rest_on_them(seed: int, speed: float, extent: float) -> None:
    start = np.array([0.1, -0.2, 0.3])
    control = walks(np.random.default_rng(seed), 64, start, Level(extent, 0.0, speed))
    away = np.linalg.norm(spline.evaluate(control, FINE) - start, axis=-1)
    assert speeds(control).max() <= speed * (1 + 1e-6) and away.max() <= extent * (1 + 1e-9)
    np.testing.assert_allclose(away[:, 0], 0, atol=1e-12)
    assert speeds(control)[:, 0].max() < 0.1 * speed  # it starts at rest
    assert (away[:, -1] > 0.98 * extent).mean() < 0.5  # the released code's end on a wall in 94 %


@settings(max_examples=4, deadline=None)
@given(SEEDS, st.sampled_from([(0.05, 0.01), (0.05, 0.02), (0.07, 0.03)]))
def test_paths_have_one_speed_bounded_curvature_and_their_place(seed: int, size: tuple[float, float]) -> None:
    extent, most = size
    start = np.array([0.1, -0.2, 0.3])
    control = loops_and_lines(np.random.default_rng(seed), 40, start, Level(extent, 0.0, most))
    passed = speeds(control)
    assert (np.abs(passed / passed.mean(-1, keepdims=True) - 1) < 0.1).all()
    assert np.percentile(np.abs(passed / passed.mean(-1, keepdims=True) - 1), 99) < 0.03
    assert (passed.mean(-1) < 1.01 * most).all() and (passed.mean(-1) > 0.99 * SLOWEST * most).all()
    assert (spline.curvature(control, fine=40) * passed.mean(-1)).max() < 1.1 * TURNING
    points = spline.evaluate(control, FINE)
    assert np.linalg.norm(points - start, axis=-1).max() <= extent + 1e-9
    ends = np.linalg.norm(points[:, -1] - points[:, 0], axis=-1)
    np.testing.assert_allclose(points[:, 0], np.tile(start, (40, 1)), atol=1e-9)
    assert (ends[::2] < 1e-9).all() and (ends[1::2] > 1e-3).all()


def test_paths_that_do_not_fit_are_one_sentence() -> None:
    with pytest.raises(ValueError, match="paths of 500 mm don't fit within 20 mm"):
        loops_and_lines(np.random.default_rng(0), 64, np.zeros(3), Level(0.02, 0.0, 0.1))


@pytest.mark.parametrize(
    ("draw", "start"),
    [
        (walks, "random"),
        *(pytest.param(draw, "home", marks=pytest.mark.slow) for draw in (walks, loops_and_lines)),
        pytest.param(loops_and_lines, "random", marks=pytest.mark.slow),
    ],
)
def test_arms_can_follow_their_paths_together(draw: object, start: str) -> None:
    """At ten times as many moments as were checked: in reach, within joint limits and speeds, and apart."""
    scene = load_scene("bimanual_psm")
    found = path_table(scene, draw, Level(0.05, 0.1, 0.02), start=start)  # type: ignore[arg-type]
    table = found["paths"][::64]
    points = np.moveaxis(spline.evaluate(np.moveaxis(table, 2, 1), np.linspace(0, SEGMENTS, 251)), 1, 2)
    begin = np.tile(scene.home, (len(table), 1)) if start == "home" else found["postures"][::64]
    assert np.ptp(begin, axis=0).any() == (start == "random")
    q = {agent: begin[:, scene.qpos_index(agent)] for agent in scene.agents}
    for i, (agent, mount) in enumerate(scene.mounts.items()):
        tips = mount.arm.forward_kinematics(q[agent])[:, :3, 3]
        np.testing.assert_allclose(points[:, 0, i], tips, atol=1e-6)
    for moment in range(1, 251):
        for i, (agent, mount) in enumerate(scene.mounts.items()):
            arm, last = mount.arm, q[agent]
            q[agent] = inverse_kinematics(arm, points[:, moment, i], last, starts=1, iterations=4)
            off = np.linalg.norm(arm.forward_kinematics(q[agent])[:, :3, 3] - points[:, moment, i], axis=-1)
            assert off.max() < 2e-4
            assert (np.abs(q[agent] - last) <= arm.speed * DURATION / 250).all()
        assert scene.clearance(q).min() > 0.008
