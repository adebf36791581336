"""The policy that follows a task's script: inverse kinematics of each step, at the joints' speeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.envs.observations import proprioception
from surgical_marl.policies.acting import like, to_numpy
from surgical_marl.policies.target_mover import TargetMover
from surgical_marl.tasks.base.grasp_poses import frames, joints_at, tool_of
from surgical_marl.tasks.base.oracle_script import Snapshot, Step, Wish

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


class Scripted:
    """The policy of a script, for all environments of a batch.

    In each environment joints follow straight lines to where a step wants the tools, all at the same pace. Then the
    agents wait as the step says, and the next one is planned. Where a step was not good an earlier one is done again.
    The last step is planned again and again until the episode ends. Agents that attend to what the others do
    (`Task.attends`) follow no step, and nobody waits for them.

    Args:
        env: the environments, with position targets.
        steps: the script.
        agents: those that the policy moves, if others have another one.

    Attributes:
        waits: whether an environment's tools are where they should be and wait for the next step, [N] bool.
    """

    def __init__(self, env: BatchedEnv, steps: Sequence[Step], agents: Sequence[str]) -> None:
        self._env, self._steps = env, steps
        self._tools = {agent: _Tool(env, agent) for agent in env.agents}
        self._moved = [agent for agent in env.agents if agent in agents]
        self._attending = [agent for agent in self._moved if agent in env.task.attends]
        self._led = [agent for agent in self._moved if agent not in env.task.attends]
        """Agents that follow the script."""
        self._now = np.zeros(env.num_envs, int)
        """Number of each environment's step."""
        self._left = np.zeros(env.num_envs, int)
        """Control steps until the next one is planned."""
        self._pauses = np.array([round(step.wait / env.control_dt) for step in steps])
        """Number of control steps that each step waits."""
        self._paces = np.array([step.pace for step in steps])
        self.waits = np.zeros(env.num_envs, bool)

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        env = self._env
        own = env.restated({agent: observations[agent] for agent in self._moved}, "si")
        seen = {agent: proprioception(observation) for agent, observation in own.items()}
        for agent in self._moved:
            self._tools[agent].look(to_numpy(seen[agent]))
        began = to_numpy(env.steps) == 0
        due = np.flatnonzero(began | (self._left <= 0))
        if len(due) and self._led:
            self._plan(due, began[due])
        self._left -= 1
        self.waits = self._left <= self._pauses[self._now]
        share = np.minimum(1.0, self._paces[self._now] / np.maximum(self._furthest(), 1e-9))[:, None]
        moves = {agent: self._tools[agent].action(share) for agent in self._led} | self._attend()
        return {agent: like(seen[agent], moves[agent]) for agent in self._moved}

    def _attend(self) -> dict[str, np.ndarray]:
        """Return the actions of agents that attend to others, [N, a]."""
        if not self._attending:
            return {}
        every = np.arange(self._env.num_envs)
        wishes = self._env.task.attend(self._look(every))
        for agent in self._attending:
            self._tools[agent].send([(every, wishes[agent])])
        return {agent: np.clip(self._tools[agent].action(), -1.0, 1.0) for agent in self._attending}

    def _furthest(self, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return in how many control steps at full speed all tools are there, in some environments, [n]."""
        return np.max([self._tools[agent].steps(rows) for agent in self._led], axis=0, initial=0.0)

    def _plan(self, due: np.ndarray, began: np.ndarray) -> None:
        """Plan the next step of the environments `due`; those that `began` an episode start with the first step."""
        now, last = self._now[due], len(self._steps) - 1
        snapshot, qpos = self._look(due), np.asarray(self._env.qpos, float)
        after = np.minimum(now + 1, last)
        for number, step in enumerate(self._steps):
            if step.good is not None and (now == number).any():
                missed = np.flatnonzero((now == number) & ~step.good(snapshot))
                after[missed] = step.back(_rows(snapshot, missed)) if callable(step.back) else step.back
        after[began] = 0
        self._now[due] = after
        for agent, tool in self._tools.items():
            tool.start(due[began], qpos[:, self._env.scene.qpos_index(agent)])
        wishes: dict[str, list[tuple[np.ndarray, Wish]]] = {}
        for number in np.unique(after):
            rows = np.flatnonzero(after == number)
            for agent, wish in self._steps[number].plan(_rows(snapshot, rows)).items():
                wishes.setdefault(agent, []).append((due[rows], wish))
        for agent, wanted in wishes.items():
            self._tools[agent].send(wanted)
        steps_away = np.ceil(self._furthest(due) / self._paces[after] - 1e-6)
        self._left[due] = steps_away + self._pauses[after] + 1

    def _look(self, due: np.ndarray) -> Snapshot:
        env = self._env
        qpos, poses = np.asarray(env.qpos, float)[due], env.object_poses
        joints = {agent: qpos[:, env.scene.qpos_index(agent)] for agent in env.agents}
        tools = {agent: tool_of(mount, joints[agent]) for agent, mount in env.scene.mounts.items()}
        every = frames(poses.origin[due], poses.quaternion[due])
        objects = {name: every[:, number] for number, name in enumerate(env.scene.free_objects)}
        goal = SimpleNamespace(**{name: np.asarray(value)[due] for name, value in vars(env.goal).items()})
        held = {agent: env.held[due, :, number] for number, agent in enumerate(env.agents)}
        return Snapshot(tools, objects, held, goal, joints)


class _Tool:
    """Path of an agent's tool."""

    def __init__(self, env: BatchedEnv, agent: str) -> None:
        self.mount = env.scene.mounts[agent]
        arm = self.mount.arm
        self._mover = TargetMover(env, agent)
        self._jaw = arm.moves_jaw
        self.q = np.tile(arm.home, (env.num_envs, 1))
        self.command = self.q.copy()
        self.opens = np.zeros(env.num_envs)
        self.terms = env.observation_terms(agent)
        if "command" not in self.terms:
            raise ValueError(f"the oracle needs to observe command of {agent!r}")

    def look(self, observation: np.ndarray) -> None:
        """Read the commands of the joints."""
        self.command = observation[:, self.terms["command"]]

    def start(self, rows: np.ndarray, qpos: np.ndarray) -> None:
        """Stay where the arm is in some environments, with a closed jaw."""
        self.q[rows], self.opens[rows] = qpos[rows], 0.0

    def send(self, wanted: Sequence[tuple[np.ndarray, Wish]]) -> None:
        """Go where wishes say, each for some environments [n].

        Inverse kinematics of all of them is one call: its time is hardly longer for many than for a few.
        """
        home, poses, starts, places = self.mount.arm.home, [], [], []
        for rows, wish in wanted:
            self.opens[rows] = wish.opens
            if wish.joints is not None:
                self.q[rows] = wish.joints
            elif wish.tool is not None:
                poses.append(wish.tool)
                starts.append(np.tile(home, (len(rows), 1)) if wish.from_home else self.q[rows])
                places.append(rows)
        if places:
            self.q[np.concatenate(places)], _ = joints_at(self.mount, np.concatenate(poses), np.concatenate(starts))

    def steps(self, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return in how many control steps at full speed the tool is there, in some environments, [n]."""
        return self._mover.steps(self.command[rows], (self.q - self.command)[rows])

    def action(self, share: float | np.ndarray = 1.0) -> np.ndarray:
        """Return the action that moves the commands by a share of their way, and opens or closes the jaw."""
        return self._mover.action(self.command, share * (self.q - self.command), self._jaw_number())

    def _jaw_number(self) -> float | np.ndarray:
        """Return the number of the jaw in an action, [N], if the arm has a jaw."""
        jaw = self.mount.arm.jaw
        if jaw is None:
            return 0.0
        aim = jaw.closed + self.opens * (jaw.open - jaw.closed)
        wider = (self.opens >= 1.0) | (self.command[:, self._jaw][:, 0] < aim - 1e-6)
        return np.where(wider, 1.0, -1.0)


def _rows(snapshot: Snapshot, rows: np.ndarray) -> Snapshot:
    """Return some environments of a snapshot."""

    def some(of: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: value[rows] for name, value in of.items()}

    goal = SimpleNamespace(**some(vars(snapshot.goal)))
    objects, qpos = some(snapshot.objects), some(snapshot.qpos)
    return Snapshot(some(snapshot.tools), objects, some(snapshot.held), goal, qpos)
