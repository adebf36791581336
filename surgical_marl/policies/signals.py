"""State and action of all arms as one vector each, in the forms that imitation learning uses.

| form | state of an arm | action of an arm |
|---|---|---|
| env | joint positions | the numbers of the environment's own action |
| joint | joint positions | position targets of the joints |
| cartesian | tip: x, y, z, quaternion x, y, z, w; jaw | the same of the targets |
| relative | as of cartesian | the targets' tip in the frame of the tip: x, y, z, two columns of the rotation; jaw |

Joints are in rad or m. Tips are in their arm's base frame, m; the jaw is the angle of a finger, rad.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np

from surgical_marl.plugins.controls import CONTROLS, list_controls

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.robots.arm import Arm

FORMS = ("env", "joint", "cartesian", "relative")
"""Forms of states and actions."""

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_RELATIVE = ("x", "y", "z", "r00", "r10", "r20", "r01", "r11", "r21")


class Rows(Protocol):
    """The rows of an episode, as `surgical_marl/data/recording.py` has them."""

    @property
    def seen(self) -> Mapping[str, np.ndarray]:
        """Return [T + 1, ...] each, among them `observations/<agent>` in SI units."""
        ...

    @property
    def done(self) -> Mapping[str, np.ndarray]:
        """Return [T, ...] each, among them `actions/<agent>`."""
        ...


class Signals:
    """The vectors of one form, of episodes of one environment or of many environments at one instant.

    Args:
        env: the environments.
        form: one of `FORMS`.
        stride: control steps of a row.

    Attributes:
        state_names: of the numbers of a state, such as "psm_0/yaw".
        action_names: likewise.
        arms: of the agents, in their order.
        form, stride: as given.

    Raises:
        ValueError: the form needs position targets and the control has none, it needs single steps and rows stand for
            several, or an agent does not observe `qpos` and `command`.
    """

    def __init__(self, env: BatchedEnv, form: str, stride: int = 1) -> None:
        check_form(form, env.control, stride)
        self.form, self.stride = form, stride
        self.arms: dict[str, Arm] = {agent: env.scene.mounts[agent].arm for agent in env.agents}
        self._terms = {agent: env.observation_terms(agent) for agent in env.agents}
        for agent, terms in self._terms.items():
            if missing := sorted({"qpos", "command"} - terms.keys()):
                raise ValueError(f"an export needs {agent!r} to observe {' and '.join(missing)}: see `observe`")
        self._widths = {agent: env.action_space(agent).shape[0] for agent in env.agents}
        self._parts = {agent: env.action_terms(agent) for agent in env.agents}
        self.state_names = self._names("joint" if form in ("env", "joint") else "cartesian")
        self.action_names = self._names(form)

    def parts(self, names: tuple[str, ...]) -> dict[str, slice]:
        """Return where each arm stands in a vector with these names."""
        owners = [name.partition("/")[0] for name in names]
        return {
            agent: slice(owners.index(agent), owners.index(agent) + owners.count(agent))
            for agent in self.arms
            if agent in owners
        }

    def state(self, recording: Rows) -> np.ndarray:
        """Return the states of an episode, [T + 1, s] float32."""
        parts = []
        for agent, arm in self.arms.items():
            measured = self.measured(recording, agent)
            poses = self.form in ("cartesian", "relative")
            parts.append(np.concatenate([pose(arm, measured), _jaw(arm, measured)], 1) if poses else measured)
        return np.concatenate(parts, 1, dtype=np.float32)

    def state_now(self, measured: Mapping[str, np.ndarray], before: np.ndarray | None = None) -> np.ndarray:
        """Return the states of many environments at one instant, [N, s] float32.

        Args:
            measured: positions that joints measure, agent -> [N, n], rad or m.
            before: the states of the row before, [N, s]: a quaternion gets the sign that is nearer to that; None at
                the start of episodes, where it is nearer to the arm's at home.
        """
        if self.form in ("env", "joint"):
            return np.concatenate([measured[agent] for agent in self.arms], 1, dtype=np.float32)
        parts = []
        for agent, own in self.parts(self.state_names).items():
            arm, q = self.arms[agent], measured[agent]
            last = pose(arm, arm.home[None]) if before is None else before[:, own][:, : len(_POSE)]
            parts += [_nearest(_tips(arm, q), last), _jaw(arm, q)]
        return np.concatenate(parts, 1, dtype=np.float32)

    def action(self, recording: Rows) -> np.ndarray:
        """Return the actions of an episode, [T, a] float32."""
        if self.form == "env":
            return np.concatenate([recording.done[f"actions/{agent}"] for agent in self.arms], 1, dtype=np.float32)
        parts = []
        for agent, arm in self.arms.items():
            measured, command = self.measured(recording, agent)[:-1], self.command(recording, agent)
            if self.form == "joint":
                parts.append(command)
            elif self.form == "cartesian":
                parts += [_nearest(pose(arm, command), pose(arm, measured)), _jaw(arm, command)]
            else:
                parts += [_relative(arm, measured, command), _jaw(arm, command)]
        return np.concatenate(parts, 1, dtype=np.float32)

    def measured(self, recording: Rows, agent: str) -> np.ndarray:
        """Return the joint positions that an arm measures, [T + 1, n], rad or m."""
        return self.read(recording.seen[f"observations/{agent}"], agent, "qpos")

    def command(self, recording: Rows, agent: str) -> np.ndarray:
        """Return the commands of an arm's joints at the end of each row, [T, n]."""
        return self.read(recording.seen[f"observations/{agent}"][1:], agent, "command")

    def read(self, observations: np.ndarray, agent: str, term: str) -> np.ndarray:
        """Return the joints' `qpos` or `command` [n, joints] in observations [n, d] of an agent in SI units."""
        return observations[:, self._terms[agent][term]]

    def _names(self, form: str) -> tuple[str, ...]:
        found: list[str] = []
        for agent, arm in self.arms.items():
            joints, jaw = [joint.name for joint in arm.actuated], ["jaw"] if arm.moves_jaw.any() else []
            if form == "env":
                parts = self._parts[agent].items()
                own = [f"{term}_{i}" for term, part in parts for i in range(part.stop - part.start)]
            else:
                own = {"joint": joints, "cartesian": [*_POSE, *jaw], "relative": [*_RELATIVE, *jaw]}[form]
            found += [f"{agent}/{name}" for name in own]
        return tuple(found)


def check_form(form: str, control: str, stride: int = 1) -> None:
    """Raise ValueError if a form of actions does not fit a control, or rows of `stride` control steps."""
    if form == "env":
        if stride > 1:
            raise ValueError(
                f"--actions env are what arms do in one control step, and --rate gives rows of {stride}: leave --rate "
                f"out, or choose --actions {', '.join(FORMS[1:-1])} or {FORMS[-1]}"
            )
    elif CONTROLS.load(control).actuators != "position":
        good = ", ".join(name for name in list_controls() if CONTROLS.load(name).actuators == "position")
        raise ValueError(
            f"--actions {form} are position targets, and control {control!r} has none: choose --actions env, or a "
            f"--control of {good}"
        )


def language_of(env: BatchedEnv) -> str:
    """Return a task in words, as those learn it that are told what to do: from its description."""
    name, _, words = env.task.summary().partition(": ")
    text = words or name
    return text[:1].upper() + text[1:]


def pose(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return tips at joints [T, n]: x, y, z (m) and quaternion x, y, z, w without a jump, [T, 7]."""
    poses = _tips(arm, np.concatenate([arm.home[None], q]))
    turns = poses[:, 3:]
    # q and -q are the same rotation: the one that is nearer to that of the row before, and at first to that at home.
    # A jaw that points down has w near 0, so that w >= 0 would flip all other numbers between episodes.
    turns[1:] *= np.where((turns[1:] * turns[:-1]).sum(1) < 0, -1.0, 1.0).cumprod()[:, None]
    return poses[1:]


def _tips(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return tips at joints [n, joints]: x, y, z (m) and quaternion x, y, z, w with w >= 0, [n, 7]."""
    from scipy.spatial.transform import Rotation

    poses = np.asarray(arm.forward_kinematics(q.astype(float)))
    return np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)], 1)


def _nearest(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return poses [n, 7] with the sign of the quaternion that is nearer to that of others, [n, 7] or [1, 7]."""
    same = (poses[:, 3:] * others[:, 3:]).sum(1) >= 0
    return np.concatenate([poses[:, :3], np.where(same, 1.0, -1.0)[:, None] * poses[:, 3:]], 1)


def _relative(arm: Arm, measured: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return the tip at the commands in the frame of the measured tip: x, y, z, two columns of the rotation, [T, 9]."""
    now, then = (np.asarray(arm.forward_kinematics(q.astype(float))) for q in (measured, command))
    back = np.swapaxes(now[:, :3, :3], 1, 2)
    move = (back @ (then[:, :3, 3] - now[:, :3, 3])[..., None])[..., 0]
    turn = back @ then[:, :3, :3]
    return np.concatenate([move, turn[:, :, 0], turn[:, :, 1]], 1)


def _jaw(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return the jaw's angle, [T, 1], or [T, 0] of an arm without one."""
    return q[:, arm.moves_jaw]
