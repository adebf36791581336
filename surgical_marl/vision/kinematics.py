"""Poses of a scene's bodies, geoms and cameras in many environments, in Warp kernels.

They follow from joint positions and from the poses of free objects, which are mocap bodies in a scene's model.
"""

# Kernels are Warp's language, which only looks like Python: annotations are read as they are, without a
# `from __future__`.
# mypy: ignore-errors
import mujoco
import numpy as np

from surgical_marl.runtime import prepare_warp

wp = prepare_warp()
wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

SLIDE = wp.constant(int(mujoco.mjtJoint.mjJNT_SLIDE))
_TYPES = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
BLOCK = 128
"""Threads in a CUDA block."""


@wp.kernel
def move(
    qpos: wp.array2d[float],
    home: wp.array[float],
    parents: wp.array[int],
    body_pos: wp.array[wp.vec3],
    body_quat: wp.array[wp.quat],
    first_joint: wp.array[int],
    joint_count: wp.array[int],
    joint_type: wp.array[int],
    joint_pos: wp.array[wp.vec3],
    joint_axis: wp.array[wp.vec3],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
):
    """Pose of each body in the world. Parents come before their children."""
    env = wp.tid()
    for body in range(parents.shape[0]):
        pos, quat = wp.vec3(body_pos[body]), wp.quat(body_quat[body])
        if body > 0:  # the world has no parent
            parent = parents[body]
            pos = xpos[env, parent] + wp.quat_rotate(xquat[env, parent], pos)
            quat = xquat[env, parent] * quat
        for joint in range(first_joint[body], first_joint[body] + joint_count[body]):
            moved = qpos[env, joint] - home[joint]
            if joint_type[joint] == SLIDE:
                pos += wp.quat_rotate(quat, joint_axis[joint]) * moved
            else:
                anchor = pos + wp.quat_rotate(quat, joint_pos[joint])
                quat = quat * wp.quat_from_axis_angle(joint_axis[joint], moved)
                pos = anchor - wp.quat_rotate(quat, joint_pos[joint])
        xpos[env, body] = pos
        xquat[env, body] = wp.normalize(quat)


@wp.kernel
def put(
    bodies: wp.array[int],
    pos: wp.array2d[wp.vec3],
    quat: wp.array2d[wp.vec4],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
):
    """Pose of each free object in the world; quaternions are given as MuJoCo has them, w first."""
    env, thing = wp.tid()
    body, turn = bodies[thing], quat[env, thing]
    xpos[env, body] = pos[env, thing]
    xquat[env, body] = wp.normalize(wp.quat(turn[1], turn[2], turn[3], turn[0]))


@wp.kernel
def attach(
    bodies: wp.array[int],
    pos: wp.array[wp.vec3],
    quat: wp.array[wp.quat],
    body_xpos: wp.array2d[wp.vec3],
    body_xquat: wp.array2d[wp.quat],
    xpos: wp.array2d[wp.vec3],
    xmat: wp.array2d[wp.mat33],
):
    """Pose in the world of each thing that is fixed to a body."""
    env, thing = wp.tid()
    body = bodies[thing]
    turn = body_xquat[env, body]
    xpos[env, thing] = body_xpos[env, body] + wp.quat_rotate(turn, pos[thing])
    xmat[env, thing] = wp.quat_to_matrix(turn * quat[thing])


class Kinematics:
    """Poses in N copies of a scene, on Warp's current device: `geom_xpos`, `geom_xmat`, `cam_xpos` and `cam_xmat`.

    MuJoCo Warp computes the same, but its import takes longer than all else that a process needs to draw pictures.

    Args:
        model: a scene's, with hinges and slides, and cameras that are fixed to their bodies.
        num_envs: N.

    Raises:
        ValueError: a joint or a camera of another type.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int) -> None:
        if not np.isin(model.jnt_type, _TYPES).all() or (model.cam_mode != mujoco.mjtCamLight.mjCAMLIGHT_FIXED).any():
            raise ValueError("pictures need a scene whose joints are hinges and slides, and whose cameras are fixed")
        self.qpos = wp.zeros((num_envs, model.nq), dtype=float)
        self.origins, self.turns = (wp.zeros((num_envs, model.nmocap), dtype=dtype) for dtype in (wp.vec3, wp.vec4))
        """Poses of free objects, in the order of mocap bodies; quaternions w, x, y, z."""
        self._objects = wp.array(np.flatnonzero(model.body_mocapid >= 0), dtype=int)
        tables = (model.qpos0, model.body_parentid, model.body_pos, model.body_quat, model.body_jntadr,
                  model.body_jntnum, model.jnt_type, model.jnt_pos, model.jnt_axis)  # fmt: skip
        self._bodies = [_given(table) for table in tables]
        self._poses = [wp.empty((num_envs, model.nbody), dtype=dtype) for dtype in (wp.vec3, wp.quat)]
        self._geoms = [_given(table) for table in (model.geom_bodyid, model.geom_pos, model.geom_quat)]
        self._cameras = [_given(table) for table in (model.cam_bodyid, model.cam_pos, model.cam_quat)]
        self.geom_xpos, self.geom_xmat = _places(num_envs, model.ngeom)
        self.cam_xpos, self.cam_xmat = _places(num_envs, model.ncam)

    def update(self, moved: bool = False) -> None:
        """Compute the poses at `qpos`, [N, nq].

        Free objects are at `origins` and `turns` if they have `moved`, and where the model has them otherwise.
        """
        wp.launch(move, len(self.qpos), [self.qpos, *self._bodies, *self._poses], block_dim=BLOCK)
        if moved:
            wp.launch(put, self.origins.shape, [self._objects, self.origins, self.turns, *self._poses], block_dim=BLOCK)
        for things, places in (
            (self._geoms, (self.geom_xpos, self.geom_xmat)),
            (self._cameras, (self.cam_xpos, self.cam_xmat)),
        ):
            wp.launch(attach, places[0].shape, [*things, *self._poses, *places], block_dim=BLOCK)


def _given(table: np.ndarray) -> wp.array:
    """Return a table of MuJoCo's on the device: of numbers, of vectors, or of quaternions, which Warp ends with w."""
    if table.ndim == 1:
        return wp.array(table, dtype=int if table.dtype.kind == "i" else float)
    turns = table.shape[1] == 4
    return wp.array(np.roll(table, -1, 1) if turns else table, dtype=wp.quat if turns else wp.vec3)


def _places(num_envs: int, count: int) -> tuple[wp.array, wp.array]:
    return tuple(wp.empty((num_envs, count), dtype=dtype) for dtype in (wp.vec3, wp.mat33))
