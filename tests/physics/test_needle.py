"""The centre line of a needle, and the map between the material of tissue and the world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import surgical_marl as sm
from surgical_marl.physics.systems.brick_grid import BrickGrid
from surgical_marl.physics.systems.material import Material
from surgical_marl.physics.systems.needle import Needle

STEEL = {"free": True, "density": 7900.0, "friction": {"sliding": 0.8, "torsion": 0.0}, "stiffness": 1e6}
GRID = BrickGrid((0.03, 0.02, 0.01), np.ones((3, 4, 2), bool), 1000.0)
MATERIAL = Material(GRID)
LOCATE = jax.jit(MATERIAL.locate)


def needle_file(folder: Path, shapes: list[dict[str, Any]], tip: list[float], tail: list[float]) -> str:
    path = folder / "pin.yaml"
    sites = {"tip": {"position": tip}, "tail": {"position": tail}}
    path.write_text(yaml.safe_dump(STEEL | {"shapes": shapes, "sites": sites}))
    return str(path)


@pytest.mark.parametrize(("name", "radius"), [("needle_sh", 0.0082), ("needle_40", 0.02)])
def test_a_shipped_needle_is_a_half_circle(name: str, radius: float) -> None:
    needle = Needle.of(name, sm.load_object(name))
    assert needle and needle.bend == pytest.approx(1 / radius) and needle.length == pytest.approx(np.pi * radius)
    arc = needle.at(jnp.zeros(3), jnp.eye(3))
    for share in (0.0, 0.1, 0.5, 0.9, 1.0):
        angle = np.pi * (1 - share)  # of the file: from the tail on the x axis to the tip
        place, tangent = arc.point(share * needle.length)
        np.testing.assert_allclose(place, radius * np.array([np.cos(angle), np.sin(angle), 0]), atol=2e-8)
        np.testing.assert_allclose(tangent, [-np.sin(angle), np.cos(angle), 0], atol=1e-6)
        beside = place + 0.3 * radius * jnp.array([np.cos(angle), np.sin(angle), 0.4])
        assert arc.nearest(beside) == pytest.approx(share * needle.length, abs=2e-8)


def test_a_straight_needle_is_a_line(tmp_path: Path) -> None:
    path = needle_file(tmp_path, [{"capsule": {"radius": 3e-4, "from": [0, 0, 0], "to": [0, 0.02, 0]}}],
                       [0, 0.02, 0], [0, 0, 0])  # fmt: skip
    needle = Needle.of("pin", sm.load_object(path))
    assert needle and needle.length == pytest.approx(0.02)
    arc = needle.at(jnp.zeros(3), jnp.eye(3))
    assert arc.nearest(jnp.array([0.001, 0.015, -0.002])) == pytest.approx(0.005, abs=1e-6)
    np.testing.assert_allclose(arc.point(0.02)[0], [0, 0, 0], atol=3e-7)


def test_what_has_no_tip_or_is_fixed_is_no_needle() -> None:
    for name in ("block", "ring", "tray"):
        assert Needle.of(name, sm.load_object(name)) is None


def test_a_needle_that_is_no_arc_is_refused_in_one_sentence(tmp_path: Path) -> None:
    bent = [{"capsule": {"radius": 3e-4, "from": [0, 0, 0], "to": [0.01, 0, 0]}},
            {"capsule": {"radius": 3e-4, "from": [0.01, 0, 0], "to": [0.01, 0.01, 0.002]}},
            {"capsule": {"radius": 3e-4, "from": [0.01, 0.01, 0.002], "to": [0.03, 0.0, 0.0]}}]  # fmt: skip
    for shapes in (bent, [{"sphere": {"radius": 1e-3}}]):
        path = needle_file(tmp_path, shapes, [0, 0, 0], [0.03, 0, 0])
        with pytest.raises(ValueError, match="capsules along one arc") as caught:
            Needle.of("pin", sm.load_object(path))
        assert "\n" not in str(caught.value)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.tuples(*[st.floats(0.01, 0.99)] * 3))
def test_a_place_is_found_again_in_deformed_tissue(seed: int, share: tuple[float, ...]) -> None:
    rng = np.random.default_rng(seed)
    at = np.float32(share * MATERIAL.cells)
    moved = jnp.asarray(GRID.rest + rng.uniform(-5e-4, 5e-4, GRID.rest.shape), jnp.float32)
    spot = MATERIAL.spot(at)
    np.testing.assert_allclose(spot.weights.sum(), 1.0, atol=1e-6)
    assert (spot.weights > -1e-6).all()
    np.testing.assert_allclose(spot.weights @ GRID.rest[spot.nodes], at * GRID.cell, atol=1e-8)
    guess = jnp.asarray(at + rng.uniform(-0.3, 0.3, 3), jnp.float32)
    np.testing.assert_allclose(LOCATE(moved, guess, MATERIAL.place(moved, at)), at, atol=2e-4)


def test_neighbouring_bricks_agree_on_their_faces() -> None:
    rng = np.random.default_rng(0)
    moved = jnp.asarray(GRID.rest + rng.uniform(-1e-3, 1e-3, GRID.rest.shape), jnp.float32)
    for axis in range(3):
        at = rng.uniform(0.1, 0.9, 3) * MATERIAL.cells
        at[axis] = 1.0
        near = np.eye(3)[axis] * 1e-5
        sides = [MATERIAL.place(moved, jnp.asarray(at + sign * near, jnp.float32)) for sign in (-1, 1)]
        np.testing.assert_allclose(*sides, atol=1e-6)
