"""Episodes step by step: of a policy that plays, or of a take that is stepped again.

A recording holds numbers and poses, and no pictures: these are drawn from the poses later, for the episodes and at the
rate that are wanted (`surgical_marl/vision/cameras.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.envs.observations import proprioception, replaced
from surgical_marl.evaluation.goal_set import episode_seed
from surgical_marl.policies.acting import forget
from surgical_marl.runs.fault import changed_versions
from surgical_marl.view.take import start_of
from surgical_marl.vision.cameras import NODES

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.envs.state import BatchStep

Act = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""Maps the observations of all agents to their actions."""


class Recording(NamedTuple):
    """One episode of T rows. Arrays of `seen` have one more row: after the last step."""

    seen: dict[str, np.ndarray]
    """[T + 1, ...] each: `observations/<agent>` in SI units, `state` of critics, `qpos` of the whole scene, `origin`
    and `quaternion` of all that moves but arms (`BatchedEnv.drawn_poses`), `objects`: position and quaternion of each
    free object, [T + 1, k, 7], and `nodes/<name>` of thread and tissue (`BatchedEnv.drawn_nodes`)."""
    done: dict[str, np.ndarray]
    """[T, ...] each: `actions/<agent>` in [-1, 1], `rewards/<agent>`, `success`, `terminated` and `truncated`."""
    place: tuple[int, int]
    """Where it was played: the block and the environment in it; or the take and the number of the episode in it."""

    def __len__(self) -> int:
        return len(self.done["success"])

    @property
    def succeeded(self) -> bool:
        """True if all agents succeed at the end."""
        return bool(self.done["success"][-1])

    @property
    def ended(self) -> np.ndarray:
        """True of the last row, and of one that ends the task, [T] bool."""
        return np.asarray(self.done["terminated"] | (np.arange(len(self)) == len(self) - 1))

    @property
    def reward(self) -> np.ndarray:
        """The sum of all arms' rewards, [T]."""
        return np.sum([values for name, values in self.done.items() if name.startswith("rewards/")], axis=0)

    def every(self, stride: int) -> Recording:
        """Return a recording with a row for each `stride` steps.

        Rewards are summed, an action is the last one before the next row, and what is true at the end of the steps is
        true of the row. The last row may stand for fewer steps.
        """
        starts = np.arange(0, len(self), stride)
        ends = np.append(starts[1:], len(self)) - 1
        seen = {name: values[[*starts, len(self)]] for name, values in self.seen.items()}
        done = {
            name: np.add.reduceat(values, starts) if name.startswith("rewards/") else values[ends]
            for name, values in self.done.items()
        }
        return Recording(seen, done, self.place)


def played(env: BatchedEnv, policy: Act, seed: int, after: tuple[int, int] | None = None) -> Iterator[Recording]:
    """Yield episodes that a policy plays, without end: the first episode of each environment, block after block.

    Args:
        env: environments with numpy arrays and observations in SI units.
        policy: moves all agents.
        seed: of the blocks. Block b of a seed is the same block each time.
        after: the place of a recording: those up to it are left out.
    """
    env.autoreset = False
    block, first = (0, 0) if after is None else (after[0], after[1] + 1)
    while True:
        recorder = _Recorder(env)
        if reseed := getattr(policy, "seed", None):
            reseed([seed, block])
        observations, state, _ = env.reset(episode_seed(seed, block))
        forget(policy)
        recorder.begin(np.arange(env.num_envs), observations, state)
        lengths = np.zeros(env.num_envs, int)
        for number in range(1, env.max_steps + 1):
            actions = dict(policy(observations))
            step = env.step(actions)
            recorder.add(actions, step)
            observations = step.observations
            lengths[(lengths == 0) & (step.terminated | step.truncated)] = number
            if lengths.all():
                break
        for index in range(first, env.num_envs):
            yield recorder.episode(index, lengths[index], (block, index))
        block, first = block + 1, 0


def replayed(
    env: BatchedEnv, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any], path: Path, number: int = 0
) -> Iterator[Recording]:
    """Yield the episodes of a take that is stepped again, with its actions.

    What a take has of an episode before its own first step is not known, so such an episode is left out. The last
    episode may have been left by a reset: it counts as truncated.

    Args:
        env: the environments of the take, as `surgical_marl.view.take.open_take` makes them.
        arrays: of the take.
        about: likewise.
        path: of the take, for errors.
        number: of the take, for the places of recordings.

    Raises:
        ValueError: it steps to other numbers here.
    """
    env.autoreset = False
    observations, state, known = _begun(env, start_of(arrays))
    recorder, everywhere = _Recorder(env), np.arange(env.num_envs)
    recorder.begin(everywhere, observations, state)
    lengths, episode = np.zeros(env.num_envs, int), 0
    for number_of_step, qpos in enumerate(arrays["qpos"]):
        actions = {agent: arrays[f"actions/{agent}"][number_of_step] for agent in env.agents}
        step = env.step(actions)
        recorder.add(actions, step)
        lengths += 1
        ended = np.asarray(step.terminated | step.truncated)
        for index in map(int, np.flatnonzero(ended)):
            if known[index]:
                yield recorder.episode(index, lengths[index], (number, episode))
                episode += 1
        if ended.any():
            new, state, _ = env.reset(mask=ended)
            rows = np.flatnonzero(ended)
            recorder.begin(rows, replaced(step.observations, rows, new), replaced(step.state, rows, state))
            lengths[ended], known[ended] = 0, True
        if not np.array_equal(env.qpos, qpos, equal_nan=True):
            changed = changed_versions(about["versions"])
            why = f", with other versions than it was recorded with: {', '.join(changed)}" if changed else ""
            raise ValueError(f"{path} leads to other numbers here from step {number_of_step} on{why}")
    for index in map(int, np.flatnonzero(known & (lengths > 0))):
        found = recorder.episode(index, lengths[index], (number, episode))
        found.done["truncated"][-1] = True
        yield found
        episode += 1


def _begun(env: BatchedEnv, carry: Mapping[str, np.ndarray]) -> tuple[dict[str, Any], Any, np.ndarray]:
    """Put environments where a carry is; return observations and state, and where an episode begins there, [N] bool.

    Elsewhere, in the middle of an episode, observations are not those of the carry: it holds none.
    """
    env.set_carry({**carry, ".episode": carry[".episode"] - 1})
    observations, state, _ = env.reset()
    now = env.carry()
    same = [
        np.array_equal(now[name][index], carry[name][index], equal_nan=values.dtype.kind == "f")
        for index in range(env.num_envs)
        for name, values in now.items()
    ]
    env.set_carry(dict(carry))
    return observations, state, np.all(np.reshape(same, (env.num_envs, -1)), axis=1)


class _Recorder:
    """Keeps what was seen and done in all environments, and cuts episodes out of it."""

    def __init__(self, env: BatchedEnv) -> None:
        self._env = env
        self._seen: list[dict[str, np.ndarray]] = []
        self._done: list[dict[str, np.ndarray]] = []
        self._rows: dict[int, list[int]] = {}
        """Environment -> rows of `_seen` of its episode; `_done` of a row is that of the step that led there."""

    def begin(self, which: np.ndarray, observations: Mapping[str, Any], state: np.ndarray) -> None:
        """Begin an episode in some environments, by their numbers."""
        self._look(observations, state)
        self._done.append({})
        for index in which:
            self._rows[int(index)] = [len(self._seen) - 1]

    def add(self, actions: Mapping[str, Any], step: BatchStep) -> None:
        """Note a step."""
        self._look(step.final_observations, step.final_state)
        agents = self._env.agents
        success = np.all([step.infos[agent]["success"] for agent in agents], axis=0)
        self._done.append(
            {f"actions/{agent}": np.clip(np.asarray(actions[agent], np.float32), -1.0, 1.0) for agent in agents}
            | {f"rewards/{agent}": np.array(step.rewards[agent], np.float32) for agent in agents}
            | {"success": success, "terminated": np.array(step.terminated), "truncated": np.array(step.truncated)}
        )
        for rows in self._rows.values():
            rows.append(len(self._seen) - 1)

    def episode(self, index: int, length: int, place: tuple[int, int]) -> Recording:
        """Return the episode of an environment, of `length` steps."""
        rows = self._rows[index][: length + 1]
        seen = {name: np.stack([self._seen[row][name][index] for row in rows]) for name in self._seen[0]}
        done = {name: np.stack([self._done[row][name][index] for row in rows[1:]]) for name in self._done[rows[1]]}
        return Recording(seen, done, place)

    def _look(self, observations: Mapping[str, Any], state: np.ndarray) -> None:
        env = self._env
        free, drawn = env.object_poses, env.drawn_poses
        self._seen.append(
            {f"observations/{agent}": np.array(proprioception(observations[agent])) for agent in env.agents}
            | {"state": np.array(state), "qpos": np.array(env.qpos, np.float32)}
            | {"origin": np.array(drawn.origin, np.float32), "quaternion": np.array(drawn.quaternion, np.float32)}
            | {"objects": np.concatenate([free.origin, free.quaternion], -1).astype(np.float32)}
            | {f"{NODES}{name}": np.array(nodes, np.float32) for name, nodes in env.drawn_nodes.items()}
        )
