"""A system of a stranger's, a string of beads: it hangs as statics say, a finger pushes it, on both engines."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.simulator import Simulator
from surgical_marl.plugins.systems import SYSTEMS
from tests.helpers.bead_string import BeadString

BESIDE, PUSH = 0.012, 0.15
"""Where the string hangs beside the tool tip, m, and the angle by which the arm turns towards it, rad."""
ENVS, STEPS = 2, 40


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    sm.register_system("bead_string", BeadString)
    yield
    SYSTEMS._registered.pop("bead_string")


def scene_file(folder: Path, **settings: Any) -> str:
    """Write a scene of a PSM with a string of beads, the lowest of which hangs beside the tool tip."""
    given: dict[str, Any] = {"type": "bead_string", "position": [BESIDE, 0.0, 0.1057]} | settings
    content = {"arms": {"psm_0": {"arm": "psm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.11]}}}
    path = folder / "beads.yaml"
    path.write_text(yaml.safe_dump(content | {"systems": {"beads": given}}))
    return str(path)


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Simulator, Any, Any]:
    """Return a simulator, and the physics once the string has come to rest, and once a finger pushes it."""
    sm.register_system("bead_string", BeadString)
    simulator = Simulator(sm.load_scene(scene_file(tmp_path_factory.mktemp("beads"))))

    @jax.jit
    def rest(physics: Any) -> Any:
        return jax.lax.fori_loop(0, 1200, lambda _, now: simulator.step(now, simulator.untouched)[0], physics)

    hanging = rest(simulator.home)
    yaw = simulator.home.ctrl.at[0].add(PUSH)
    return simulator, hanging, rest(hanging.with_arms(ctrl=yaw))


def test_it_hangs_as_the_springs_say(pushed: tuple[Simulator, Any, Any]) -> None:
    simulator, hanging, _ = pushed
    system: Any = simulator.scene.systems["beads"]
    np.testing.assert_allclose(hanging.systems["beads"].position, system.hanging, atol=2e-7)


def test_a_finger_pushes_it_as_hard_as_its_springs_pull_back(pushed: tuple[Simulator, Any, Any]) -> None:
    """And the arm feels that force: its generalised force is the transposed Jacobian of C MuJoCo times it."""
    simulator, hanging, now = pushed
    step, system = simulator.step, simulator.scene.systems["beads"]
    way = np.asarray(now.systems["beads"].position - hanging.systems["beads"].position)
    drift = np.asarray(now.systems["beads"].velocity)
    assert way[-1, 0] > 4e-3 and np.abs(drift).max() < 1e-3
    poses = step.arms.dynamics.pose(now.qpos)
    found = step.find(now, poses)
    met = step._meetings(now, found)["beads"]
    force = np.asarray(met.response.force, float)
    resists = system.stiffness * way[0, 0] + system.damping * drift[:, 0].sum()
    np.testing.assert_allclose(-force.sum(0)[0], resists, rtol=2e-2)

    coupling, free = step._couplings["beads"], step.arms.free_motion(now.arms)
    still = 0 * met.expected[0]
    loaded = coupling.on_arms(free, met.response, met.ends, found.joints, still, step.arms.dt)
    model, data = simulator.scene.model, mujoco.MjData(simulator.scene.model)
    data.qpos[:] = now.qpos
    mujoco.mj_fwdPosition(model, data)
    expected = np.zeros(model.nv)
    tables, places = step.bodies.tables, np.asarray(met.ends.rows.place)
    geoms = [*tables.pad_geoms, *tables.near[tables.bare]]
    for row in range(int(met.ends.moving)):
        jacobian, shape = np.zeros((3, model.nv)), int(met.ends.rows.shape[row])
        mujoco.mj_jac(model, data, jacobian, None, places[row], int(model.geom_bodyid[geoms[shape]]))
        expected += force[row] @ jacobian
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(step.arms.by_joint(loaded.smooth - free.smooth), expected, atol=1e-6)


def test_what_a_finger_feels_is_in_the_outputs(pushed: tuple[Simulator, Any, Any]) -> None:
    simulator, hanging, now = pushed
    for physics, felt in ((hanging, False), (now, True)):
        _, touch = jax.jit(simulator.step)(physics, simulator.untouched)
        assert (float(touch.handled[0, 0]) > 0.01) == felt


@pytest.mark.slow
def test_both_engines_move_it_alike(tmp_path: Path) -> None:
    found = []
    for engine in ("mjx", "fused"):
        env = BatchedEnv("reach", scene_file(tmp_path), num_envs=ENVS, engine=engine, device="cpu")
        env.reset(seed=0)
        action = np.zeros((ENVS, len(env.scene.mounts["psm_0"].arm.actuated)), np.float32)
        action[:, 0] = 1.0, -1.0  # towards the string, and away from it
        for _ in range(STEPS):
            env.step({"psm_0": action})
        found.append([env.engine.read(f".physics.{part}", "numpy") for part in ("beads.position", "arms.qpos")])
        env.close()
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-6)
    beads = found[0][0]
    assert np.abs(beads[0, -1, 0] - BESIDE) > 2e-3 > np.abs(beads[1, -1, 0] - BESIDE)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"type": "bead_strings"}, "did you mean 'bead_string'"),
        ({"type": 3}, "lacks its type, one of bead_string"),
        ({"beads": 0}, "from 1 to 64"),
        ({"colour": "red"}, "unknown key 'colour'"),
    ],
)
def test_a_bad_entry_is_one_sentence(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        sm.load_scene(scene_file(tmp_path, **settings))
    assert "\n" not in str(caught.value)


def test_a_name_is_taken_once(tmp_path: Path) -> None:
    path = Path(scene_file(tmp_path))
    path.write_text(path.read_text().replace("beads:\n", "psm_0:\n").replace("psm_0:\n    arm", "psm_0:\n    arm"))
    with pytest.raises(ValueError, match="has something else of this name already"):
        sm.load_scene(path)


def test_what_is_no_system_is_refused() -> None:
    with pytest.raises(ValueError, match="must be a subclass of"):
        sm.register_system("nothing", dict)


def test_a_string_of_one_bead_is_a_particle_on_a_spring(tmp_path: Path) -> None:
    """Without damping it swings with the period of its mass and its spring."""
    settings = {"beads": 1, "damping": 0.0, "mass": 0.01, "position": [0.3, 0.0, 0.1]}
    system: Any = sm.load_scene(scene_file(tmp_path, **settings)).systems["beads"]
    dt = 2.5e-4

    def step(state: Any, _: Any) -> Any:
        motion = system.free_motion(state, dt)
        acceleration = motion[1] / jnp.diagonal(motion[0], axis1=1, axis2=2)
        velocity = state.velocity + dt * acceleration
        state = state._replace(position=state.position + dt * velocity, velocity=velocity)
        return state, state.position[0, 2]

    _, height = jax.lax.scan(step, system.start(jnp.zeros((0, 3))), None, length=4000)
    signs = np.flatnonzero(np.diff(np.signbit(np.asarray(height) - system.hanging[0, 2])))
    period = 2 * np.diff(signs).mean() * dt
    np.testing.assert_allclose(period, 2 * np.pi * np.sqrt(system.mass / system.stiffness), rtol=1e-2)
