"""A needle that is welded to a jaw goes where the jaw goes, in any direction, until a flag releases it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.physics.simulator import Simulator
from surgical_marl.physics.systems.rigid_motion import conjugate, product, rotation

LINK = "psm_0/jaw_left_link"


def welded(folder: Path, **changes: Any) -> str:
    """Write a scene in which a needle hangs in the air, half a centimetre beside the tool tip, welded to a finger."""
    content: dict[str, Any] = {
        "arms": {"psm_0": {"arm": "psm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.11]}},
        "objects": {"needle": {"object": "needle_sh", "position": [0.0, 0.02, 0.046]}},
        "attachments": {"weld": {"body": "needle", "link": LINK} | changes},
    }
    path = folder / "welded.yaml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


def test_a_welded_needle_goes_with_the_jaw_until_it_is_released(tmp_path: Path) -> None:
    simulator = Simulator(sm.load_scene(welded(tmp_path)))
    step, link = simulator.step, simulator.scene.model.body(LINK).id

    @jax.jit
    def run(physics: Any) -> Any:
        """Return the physics after half a second, and the pose of the needle in the frame of the link all the time."""

        def one(now: Any, _: Any) -> Any:
            now, _touch = step(now, simulator.untouched)
            data, bodies = step.arms.dynamics.pose(now.qpos), now.rigid_bodies.bodies
            back = conjugate(data.xquat[link])
            offset = bodies.position[0] - data.xpos[link]
            return now, (rotation(back) @ offset, product(back, bodies.quaternion[0]), data.xpos[link])

        return jax.lax.scan(one, physics, None, length=200)

    begin = simulator.home
    assert begin.systems["attachments"].active.all()
    moves = begin.ctrl.at[:6].add(jnp.asarray([0.3, -0.2, 0.02, 1.0, 0.5, -0.5]))
    after, (offset, turn, place) = run(begin.with_arms(ctrl=moves))
    assert np.ptp(np.asarray(place), axis=0).max() > 0.02, "the arm did not move"
    fastened = np.asarray(begin.systems["attachments"].position[0])
    assert np.abs(np.asarray(offset) - fastened).max() < 1e-4  # as the wrist turns at its full speed
    np.testing.assert_allclose(offset[-1], fastened, atol=1e-6)
    np.testing.assert_allclose(np.abs(turn @ np.asarray(begin.systems["attachments"].quaternion[0])), 1.0, atol=1e-4)

    weld = after.systems["attachments"]
    free, _ = run(after.with_systems(attachments=weld._replace(active=~weld.active)))
    held, _ = run(after)
    fallen = np.asarray(held.rigid_bodies.bodies.position - free.rigid_bodies.bodies.position)[0]
    assert fallen[2] > 1.0, "it falls freely for half a second"

    data, bodies = step.arms.dynamics.pose(free.qpos), free.rigid_bodies.bodies
    again = step.attachments.fasten(free.systems["attachments"], 0, data, bodies)  # type: ignore[union-attr]
    assert bool(again.active[0])
    where = data.xpos[link] + rotation(data.xquat[link]) @ again.position[0]
    np.testing.assert_allclose(where, bodies.position[0], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body": "needles"}, "unknown free object of scene 'welded' 'needles', did you mean 'needle'"),
        ({"link": "psm_0/jaw_left"}, "did you mean 'psm_0/jaw_left_link'"),
        ({"active": "maybe"}, "true or false"),
    ],
)
def test_a_bad_attachment_is_one_sentence(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sm.load_scene(welded(tmp_path, **changes))


def test_an_attachment_without_an_object_is_refused(tmp_path: Path) -> None:
    path = Path(welded(tmp_path))
    path.write_text(yaml.safe_dump({k: v for k, v in yaml.safe_load(path.read_text()).items() if k != "objects"}))
    with pytest.raises(ValueError, match=r"attachments.weld: unknown free object .* 'needle' \(choose from none\)"):
        sm.load_scene(path)
