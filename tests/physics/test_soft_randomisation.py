"""Thread and tissue whose stiffness and friction are drawn anew in each episode."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.physics.contact.part_detection import PartDetection, Scenery
from surgical_marl.physics.contact.shapes import Plate, Segments
from surgical_marl.physics.systems.soft import Material
from surgical_marl.physics.systems.system import Ends, System
from surgical_marl.physics.systems.thread import Thread
from surgical_marl.physics.systems.tissue import Tissue
from tests.physics.test_tissue_contact import strip

DT = 2.5e-3


def load(folder: Path, **ranges: float) -> Any:
    """Return the systems of a scene with a thread and a sheet of tissue."""
    about = {
        "arms": {"ecm_0": {"arm": "ecm"}},
        "objects": {
            "thread": {"object": "thread_3_0", "position": [0.3, 0.0, 0.3]},
            "sheet": {"object": "tissue_sheet", "position": [0.3, 0.0, 0.2]},
        },
        "randomisation": ranges,
    }  # fmt: skip
    path = folder / "soft.yaml"
    path.write_text(yaml.safe_dump(about))
    return sm.load_scene(path).systems


def test_draws_fill_their_ranges_and_nothing_else_is_drawn(tmp_path: Path) -> None:
    systems = load(tmp_path, thread_stiffness=0.3, tissue_stiffness=0.5, tissue_friction=0.2)
    keys = jax.vmap(jax.random.PRNGKey)(jnp.arange(500))
    for name, ranges in (("thread", Material(0.3, 0.0)), ("sheet", Material(0.5, 0.2))):
        assert systems[name].ranges == ranges
        found = jax.vmap(lambda key, name=name: jax.tree.map(jnp.float32, systems[name].randomise(key).factors))(keys)
        for values, share in zip(found, ranges, strict=True):
            np.testing.assert_allclose([np.min(values), np.max(values)], [1 - share, 1 + share], rtol=0.02)
    assert load(tmp_path)["thread"].randomise(keys[0]).factors == Material(1.0, 1.0)


def no_ends(system: System) -> Ends:
    """Return the contacts of a system that touches nothing."""
    plates = Plate(jnp.zeros((0, 3)), jnp.zeros((0, 3, 3)), jnp.zeros((0, 2)), jnp.zeros(0))
    scenery = Scenery(plates, Segments(jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros(0)), jnp.zeros(0))
    detection = PartDetection(dict.fromkeys(("pads", "links", "objects", "plates", "rods"), 0), [], system.contacts)
    return detection.find(scenery, system.shapes(system.start(jnp.zeros((0, 3)))), [], [], DT)


def test_a_varied_thread_is_one_whose_file_says_so(tmp_path: Path) -> None:
    """It is thrown with a bend."""
    thread = load(tmp_path)["thread"]
    still = thread.start(jnp.zeros((0, 3)))
    bent = still.chain._replace(velocity=still.chain.velocity.at[:, 2].set(jnp.sin(jnp.arange(thread.nodes) * 0.3)))

    def thrown(system: Thread, stiffness: Any) -> Any:
        own = replace(system, factors=Material(stiffness, 1.0))
        ends, start = no_ends(own), still._replace(chain=bent)
        response = own.respond(start, own.free_motion(start, DT), ends, DT)
        return own.apply(start, response, ends, jnp.zeros((own.contacts, 3)), DT).chain.velocity

    assert_alike(thread, jax.jit(thrown, static_argnums=0))


def test_varied_tissue_is_as_its_file_says(tmp_path: Path) -> None:
    """It falls, held at one side."""
    tissue = strip()
    start = tissue.start(jnp.zeros((0, 3))).nodes

    def fallen(system: Tissue, stiffness: Any) -> Any:
        solver = replace(system, factors=Material(stiffness, 1.0)).solver
        return solver.step(solver.step(start, DT), DT).velocity

    assert_alike(tissue, jax.jit(fallen, static_argnums=0))


def assert_alike(system: Any, moved: Any) -> None:
    """Raise AssertionError unless a system with a factor moves as one whose Young's modulus is as much higher."""
    stiff = moved(replace(system, young=1.7 * system.young), 1.0)
    plain, varied = (moved(system, jnp.float32(factor)) for factor in (1.0, 1.7))
    close = 1e-4 * np.abs(stiff).max()
    assert np.abs(plain - stiff).max() > 10 * close
    np.testing.assert_allclose(varied, stiff, atol=close)


@pytest.mark.parametrize("system", [Thread, Tissue])
def test_friction_varies_by_the_root_as_that_of_two_surfaces_does(tmp_path: Path, system: type) -> None:
    own = next(
        item for item in load(tmp_path, thread_friction=0.5, tissue_friction=0.5).values() if type(item) is system
    )
    rougher = replace(own, factors=Material(1.0, jnp.float32(1.4)))
    surface = replace(own.surface, sliding=1.4 * own.surface.sliding)
    other = own.surface.against(own.surface)
    ends = no_ends(own)
    ends = ends._replace(rows=ends.rows._replace(sliding=jnp.full(own.contacts, own.surface.against(other).sliding)))
    np.testing.assert_allclose(rougher.rubbed(ends).rows.sliding, surface.against(other).sliding, rtol=1e-6)


@pytest.mark.parametrize(
    ("wrong", "words"), [({"tissue_stiffness": 1.0}, "from 0 to 0.999"), ({"thread_length": 0.1}, "unknown key")]
)
def test_a_wrong_range_is_one_sentence(tmp_path: Path, wrong: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        load(tmp_path, **wrong)
    assert "\n" not in str(caught.value)
