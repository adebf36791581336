"""Action terms: names, sizes, bounds and commands, those of a stranger too."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.control.action_term import ActionTerm, symmetric
from surgical_marl.control.controller import Controller, actuators_of
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.plugins.controls import CONTROLS
from surgical_marl.robots.reach import Box

DT = 0.02


class Push(ActionTerm):
    """Push the shaft in or pull it out, and nothing else."""

    actuators = "torque"

    @property
    def bounds(self) -> Box:
        return symmetric(np.array([2.0]))

    def to_commands(self, action: Any, arms: Any) -> Any:
        return jnp.zeros(len(self.joints)).at[2].set(2.0 * action[0])

    def infos(self, action: Any, arms: Any, commands: Any) -> dict[str, Any]:
        return {"push": commands[2]}


class Grip(ActionTerm):
    """Command all joints, the jaw by how far it is open."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.joints = np.arange(len(self.arm.actuated))

    @property
    def bounds(self) -> Box:
        return Box(self.arm.lower, self.arm.upper)

    def to_commands(self, action: Any, arms: Any) -> Any:
        low, high = self.bounds
        return low + (action + 1) / 2 * (high - low)


@pytest.fixture(autouse=True, scope="module")
def registered() -> Iterator[None]:
    with mock.patch.dict(CONTROLS._registered):
        sm.register_control("push", Push)
        sm.register_control("grip", Grip)
        yield


def command(scene: str, control: str, actions: dict[str, np.ndarray]) -> tuple[np.ndarray, Any, Any]:
    loaded = sm.load_scene(scene, actuators_of(control))
    controller = Controller(loaded, control, dt=DT)
    qpos = jnp.asarray(loaded.home, jnp.float32)
    ctrl = jnp.asarray(loaded.moment @ loaded.home, jnp.float32)
    found, infos = controller.command(ctrl, qpos, actions)
    return np.asarray(found), infos, loaded


def test_the_controls_that_ship_are_listed() -> None:
    assert {"position", "velocity", "torque", "cartesian"} <= set(sm.list_controls())


@pytest.mark.parametrize(
    ("control", "first"), [("position", 6), ("velocity", 6), ("torque", 6), ("cartesian", 6), ("push", 1)]
)
def test_an_action_is_the_numbers_of_its_terms(control: str, first: int) -> None:
    env = Env("reach", "trimanual_psm_ecm", control=control, messages=2)
    end = first + 1
    assert env.action_terms("psm_0") == {
        control: slice(0, first), "jaw": slice(first, end), "message": slice(end, end + 2)
    }  # fmt: skip
    alone = {"cartesian": 6, "push": 1}.get(control, 4)
    assert env.action_terms("ecm_0") == {control: slice(0, alone), "message": slice(alone, alone + 2)}
    for agent in env.agents:
        assert env.action_space(agent).shape == (max(part.stop for part in env.action_terms(agent).values()),)


def test_faces_name_the_terms_of_actions_and_observations() -> None:
    env = sm.parallel_env("reach", scene="psm", engine="mjx", device="cpu")
    assert env.action_terms("psm_0") == {"position": slice(0, 6), "jaw": slice(6, 7)}
    assert env.observation_terms("psm_0") == env.batch.observation_terms("psm_0")
    with pytest.raises(ValueError, match="unknown agent 'psm_1'"):
        env.action_terms("psm_1")


def test_bounds_say_what_a_full_action_is() -> None:
    scene = sm.load_scene("psm")
    arm = scene.mounts["psm_0"].arm
    found, _, _ = command("psm", "position", {"psm_0": np.ones(7, np.float32)})
    term, jaw = Controller(scene, dt=DT).terms["psm_0"].values()
    np.testing.assert_allclose(found[:6] - arm.home[:6], term.bounds.high * DT, rtol=1e-5)
    assert (jaw.bounds.low, jaw.bounds.high) == (arm.jaw.closed, arm.jaw.open)
    efforts = [joint.effort for joint in arm.actuated[:6]]
    np.testing.assert_allclose(command("psm", "torque", {"psm_0": -np.ones(7, np.float32)})[0][:6], -np.array(efforts))


def test_numbers_beyond_one_count_as_one() -> None:
    for control, size in (("position", 7), ("velocity", 7), ("torque", 7), ("cartesian", 7)):
        far, _, _ = command("psm", control, {"psm_0": np.full(size, 9.0, np.float32)})
        full, _, _ = command("psm", control, {"psm_0": np.ones(size, np.float32)})
        np.testing.assert_array_equal(far, full)


def test_a_strangers_term_commands_and_tells() -> None:
    found, infos, scene = command(
        "bimanual_psm", "push", {"psm_0": np.array([0.5, 1.0]), "psm_1": np.array([-1.0, 0.0])}
    )
    names = [scene.model.actuator(i).name for i in range(scene.model.nu)]
    assert found[names.index("psm_0/insertion")] == 1.0 and found[names.index("psm_1/insertion")] == -2.0
    assert found[names.index("psm_0/jaw_left")] > found[names.index("psm_1/jaw_left")]
    assert {agent: float(told["push"]) for agent, told in infos.items()} == {"psm_0": 1.0, "psm_1": -2.0}


def test_a_term_that_commands_the_jaw_stands_alone() -> None:
    found, _, scene = command("psm", "grip", {"psm_0": np.ones(7, np.float32)})
    arm = scene.mounts["psm_0"].arm
    np.testing.assert_allclose(found[:7], arm.upper, rtol=1e-6)
    assert Env("reach", "psm", control="grip").action_terms("psm_0") == {"grip": slice(0, 7)}


def test_an_environment_has_a_strangers_actions_and_infos() -> None:
    env = Env("reach", "psm", control="push")
    reset = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), np.uint32))
    step = jax.eval_shape(env.step, reset.carry, {"psm_0": jax.ShapeDtypeStruct((2,), np.float32)})
    assert step.infos["psm_0"]["push"].shape == reset.infos["psm_0"]["push"].shape == ()
    assert jax.tree.structure(step) == jax.tree.structure(reset)
    assert Push in env.classes  # caches ask these whether code is a stranger's


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"control": "cartesain"}, "unknown control 'cartesain', did you mean 'cartesian'"),
        ({"control_frame": "camera"}, "control_frame of control 'position' must be base, not 'camera'"),
        ({"control": "cartesian", "control_frame": "tool"}, "control_frame must be one of base, camera, not 'tool'"),
        ({"control": "cartesian", "control_frame": "camera"}, r"scene 'psm' has none: .*\(ecm, trimanual_psm_ecm"),
    ],
)
def test_bad_controls_are_refused_in_a_sentence(options: dict[str, str], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        BatchedEnv("reach", "psm", **options)
