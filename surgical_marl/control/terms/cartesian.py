"""Cartesian control: an action is the twist of the tool tip, in the arm's base frame or in an endoscope's.

The position targets of the joints follow the tip by damped least squares (S. Buss, "Introduction to inverse kinematics
with Jacobian transpose, pseudoinverse and damped least squares methods", 2004), from the last command.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.content import find, list_scenes
from surgical_marl.control.action_term import ActionTerm, Joints, lead_limit, symmetric
from surgical_marl.robots.arm import load_arm
from surgical_marl.robots.inverse_kinematics import rotation_vector
from surgical_marl.robots.reach import Box
from surgical_marl.runtime import jax, jnp
from surgical_marl.scenes.scene import Mount, Scene
from surgical_marl.yaml_file import read_yaml

if TYPE_CHECKING:
    from jax import Array

STEPS = 2
"""Steps of damped least squares in a control step: the second corrects what the first, a linear one, leaves."""
LENGTH = 0.01
"""Weight of a rotation relative to a translation, m/rad: about the length of an instrument's wrist. Where joints can't
do both, the tip keeps its path, and its orientation gives way."""
DAMPING = 1e-6
"""Damping as a share of the trace of the squared Jacobian: the least that keeps the matrix regular in float32. Speeds
of joints near a singularity are bounded by their limits."""
PLACES = 5
"""Places of a straight path of the joints at which the speed of the tip is looked at."""
CAMERA = np.diag([1.0, -1.0, -1.0])
"""From the frame of a picture, x right, y down and z along the view, to that of a MuJoCo camera."""


class Cartesian(ActionTerm):
    """Move the tool tip: three numbers are its velocity, three its angular velocity, up to `tip_speed` in `arm.yaml`.

    The target of the tip starts from the tip's pose at the last position targets of the joints. Each joint stays within
    its limits, its velocity limit and `lead_limit`. A joint that is held by one of them leaves its part to the others,
    so that the tip slides along the limit. The info `cartesian_error` is the distance in m by which the position
    targets miss the tip's target.
    """

    frames = ("base", "camera")

    def __init__(self, scene: Scene, agent: str, dt: float, frame: str = "base") -> None:
        super().__init__(scene, agent, dt, frame)
        self._camera = _endoscope(scene, agent) if frame == "camera" else None

    @property
    def bounds(self) -> Box:
        """Return the velocities, [6]: m/s along x, y and z, then rad/s about them."""
        speed = self.arm.tip_speed
        return symmetric(np.repeat([speed.translation, speed.rotation], 3))

    def to_commands(self, action: Array, arms: Mapping[str, Joints]) -> Array:
        """Return the next position targets of `joints`, [k]."""
        reach = self._reach(arms[self.agent])
        target = self._target(action, arms, reach)
        q = reach.start
        for _ in range(STEPS):
            q = self._nearer(q, reach, target)
        return q

    def infos(self, action: Array, arms: Mapping[str, Joints], commands: Array) -> dict[str, Array]:
        """Return `cartesian_error`, m, []."""
        target = self._target(action, arms, self._reach(arms[self.agent]))
        missed = self._pose(commands)[0][:3, 3] - target.position
        return {"cartesian_error": jnp.sqrt(jnp.sum(missed**2))}

    def steps_of(self, command: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return how many control steps a change of targets takes at the speeds of the joints and of the tip, [N]."""
        own = np.zeros(change.shape)
        own[:, self.joints] = change[:, self.joints]
        # the tip's path bends: it is as slow everywhere as it must be where it is longest
        path = command + np.linspace(0.0, 1.0, PLACES)[:, None, None] * own
        twist = (self.arm.jacobian(path) @ own[..., None])[..., 0].reshape(*path.shape[:2], 2, 3)
        speed = self.dt * np.array([self.arm.tip_speed.translation, self.arm.tip_speed.rotation])
        ways = (np.linalg.norm(twist, axis=-1) / speed).max((0, -1))
        return np.maximum(ways, super().steps_of(command, change))

    def action_of(self, change: np.ndarray, arms: Mapping[str, Joints]) -> np.ndarray:
        """Return the twist [N, 6] from the tip's pose at the targets to that at the changed ones."""
        command = arms[self.agent].command
        wanted = command.copy()
        wanted[:, self.joints] += change[:, self.joints]
        now, then = (self.arm.forward_kinematics(q) for q in (command, wanted))
        turn = rotation_vector(then[:, :3, :3] @ np.swapaxes(now[:, :3, :3], 1, 2))
        twist = np.stack([then[:, :3, 3] - now[:, :3, 3], turn], 1)
        if self._camera:
            twist = twist @ self._camera_axes(arms)
        return np.asarray(twist.reshape(-1, 6) / (self.dt * self.bounds.high))

    def _reach(self, joints: Joints) -> _Reach:
        """Return where the joints may be commanded to in this step, and the command that the step starts from."""
        own, most = self.joints, lead_limit(self.arm)[self.joints]
        speed = np.array([joint.velocity for joint in self.arm.actuated], np.float32)[own]
        lower, upper = (end[own].astype(np.float32) for end in (self.arm.lower, self.arm.upper))
        now, last = joints.position[own], joints.command[own]
        low, high = jnp.clip(now - most, lower, upper), jnp.clip(now + most, lower, upper)
        start, step = jnp.clip(last, low, high), speed * np.float32(self.dt)
        return _Reach(start, jnp.maximum(low, start - step), jnp.minimum(high, start + step))

    def _target(self, action: Array, arms: Mapping[str, Joints], reach: _Reach) -> _Target:
        """Return the pose that the tip should have at the end of the step."""
        twist = (action * (self.bounds.high * self.dt).astype(np.float32)).reshape(2, 3)
        if self._camera:
            twist = twist @ self._camera_axes(arms).T
        pose, _ = self._pose(reach.start)
        return _Target(pose[:3, 3] + twist[0], _rotation(twist[1]) @ pose[:3, :3])

    def _camera_axes(self, arms: Mapping[str, Joints]) -> Any:
        """Return the axes of the endoscope's picture in the base frame of this arm, columns, [..., 3, 3]."""
        mounts, camera = self.scene.mounts, self._camera
        assert camera is not None
        arm = mounts[camera].arm
        assert arm.camera is not None
        axes = arm.link_poses(arms[camera].position, (arm.camera.link,))[arm.camera.link][..., :3, :3]
        between = mounts[self.agent].rotation.T @ mounts[camera].rotation
        return between.astype(np.float32) @ axes @ CAMERA.astype(np.float32)

    def _pose(self, q: Array) -> tuple[Any, Any]:
        """Return the pose of the tip, [4, 4], and its Jacobian by the joints `q` [k], [6, k]."""
        every = jnp.asarray(self.arm.home, jnp.float32).at[self.joints].set(q)
        pose, jacobian = self.arm.pose_and_jacobian(every)
        return pose, jacobian[:, self.joints]

    def _nearer(self, q: Array, reach: _Reach, target: _Target) -> Array:
        """Return the joints [k] after one step of damped least squares towards the target."""
        pose, jacobian = self._pose(q)
        axes = pose[:3, :3]
        turn = 0.5 * jnp.sum(jnp.cross(axes, target.axes, axis=0), 1)  # of a small angle
        error = jnp.concatenate([target.position - pose[:3, 3], LENGTH * turn])
        # in m that each joint moves the tip at its speed in a step
        speed = (self.arm.speed[self.joints] * self.dt).astype(np.float32)
        slope = jacobian * np.repeat([1.0, LENGTH], 3).astype(np.float32)[:, None] * speed
        downhill = error @ slope
        held = ((q <= reach.low) & (downhill < 0)) | ((q >= reach.high) & (downhill > 0))
        change = _damped_least_squares(jnp.where(held, 0.0, slope), error)
        return jnp.clip(q + speed * change, reach.low, reach.high)


class _Reach(NamedTuple):
    """Position targets that joints may get in a step, [k] each."""

    start: Array
    low: Array
    high: Array


class _Target(NamedTuple):
    """A pose of the tip in the base frame."""

    position: Array
    """m, [3]"""
    axes: Array
    """Columns, [3, 3]."""


def _damped_least_squares(slope: Array, error: Array) -> Any:
    """Return the change [k] for which `slope @ change` [d, k] [k] is nearest to an error [d], damped.

    The system that is solved has the lesser of the two sizes.
    """
    wide = slope.shape[0] < slope.shape[1]
    square = slope @ slope.T if wide else slope.T @ slope
    damping = DAMPING * jnp.trace(square) + np.float32(1e-20)  # all joints may be held
    square = square + damping * np.eye(len(square), dtype=np.float32)
    factor = jax.lax.linalg.cholesky(square, symmetrize_input=False), True
    if wide:
        return jax.scipy.linalg.cho_solve(factor, error) @ slope
    return jax.scipy.linalg.cho_solve(factor, error @ slope)


def _rotation(vector: Array) -> Any:
    """Return the rotation matrix [3, 3] of axis times angle [3], rad (Rodrigues' formula)."""
    x, y, z = vector
    angle = jnp.sqrt(jnp.sum(vector**2) + np.float32(1e-12))
    cross = jnp.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x]).reshape(3, 3)
    whole = np.eye(3, dtype=np.float32)
    return whole + jnp.sin(angle) / angle * cross + (1 - jnp.cos(angle)) / angle**2 * (cross @ cross)


def _endoscope(scene: Scene, agent: str) -> str:
    """Return the agent whose camera a frame is of: the agent's own if it has one, or else the scene's first.

    ValueError for a scene without an endoscope.
    """
    mounts: Mapping[str, Mount] = scene.mounts
    found = [name for name, mount in mounts.items() if mount.arm.camera is not None]
    if found:
        return agent if agent in found else found[0]
    scenes = [name for name in list_scenes() if _has_camera(name)]
    raise ValueError(
        f"control_frame 'camera' needs an endoscope, and scene {scene.name!r} has none: use control_frame 'base', or a "
        f"scene with an endoscope ({', '.join(scenes)})"
    )


def _has_camera(scene: str) -> bool:
    """Return whether an arm of a shipped scene has a camera."""
    arms = read_yaml(find("scenes", scene))["arms"].values()
    return any(load_arm(entry["arm"], entry.get("tool")).camera is not None for entry in arms)
