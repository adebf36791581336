"""Some environments go on from states that the oracle was in, so that late parts of a long task are learned early.

By chance hardly any arm picks a needle up, hands it over and presents it. From a state along a demonstration it is a
short way to the next reward. Such starts are known as reference state initialisation (X. B. Peng et al., 2018, arXiv
1804.02717; T. Salimans and R. Chen, 2018, arXiv 1812.03381).

Environments are moved between two rollouts. Returns are bootstrapped there anyway, so that this cuts nothing off.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import trange

from surgical_marl.cache import cached
from surgical_marl.engines.stepper import describe
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.oracle import oracle
from surgical_marl.runs.environment import make_env
from surgical_marl.runs.settings import Settings

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

EPISODES = 256
"""Episodes that the oracle plays."""
STATES = 8192
"""States that are kept of them."""
EVERY = 4
"""Control steps between two states of an episode."""
BEYOND = 25
"""States are kept up to so many control steps after the oracle's first success."""
OWN = (".key", ".episode")
"""Parts of a carry that an environment keeps, whatever state it goes on from: its next episodes are drawn with them."""


class OracleStates:
    """States along the oracle's episodes, on the device of a run.

    Args:
        settings: the run. The oracle plays its task, with the goals of training.
        layout: how agents are stacked.

    Attributes:
        carry: name in `Engine.carry_shapes` -> [STATES, ...].
        observations: what agents and critics observe there, [STATES, ...] for each group of the layout.

    Raises:
        ValueError: the control is not "position", the task has no oracle, its oracle never succeeds, or an agent
            observes pictures.
    """

    def __init__(self, settings: Settings, layout: Layout, device: str) -> None:
        if settings.control != "position":
            raise ValueError(
                f"oracle_states.rate must be 0 with control {settings.control!r}: the oracle needs position"
            )
        if any(layout.pictures.values()):
            raise ValueError("oracle_states.rate must be 0 where agents observe pictures")
        env = make_env(settings, EPISODES, "numpy")
        try:
            tables = (np.asarray(table).tobytes() for _, table in sorted(env.task.tables.items()))
            about = env.env.content, describe(env.env.parameters).encode(), str(env.max_steps).encode()
            rows = cached("oracle_states", lambda: _record(env), *about, *tables, roots=env.env.roots)
            cut = dict(zip(_shapes(env), _cut(rows, env), strict=True))
        finally:
            env.close()
        parts = {name: torch.from_numpy(part).to(device) for name, part in cut.items()}
        groups = {**layout.stack({agent: parts.pop(agent) for agent in env.agents}), "state": parts.pop("state")}
        self.carry: dict[str, Tensor] = parts
        self.observations = TensorDict(groups, batch_size=[len(rows)])

    def draw(self, count: int) -> tuple[dict[str, Tensor], TensorDict]:
        """Draw `count` states: their carry, and what is observed in them."""
        chosen = torch.randint(len(self.observations), (count,), device=self.observations["state"].device)
        return {name: part[chosen] for name, part in self.carry.items()}, self.observations[chosen]


def _record(env: BatchedEnv) -> np.ndarray:
    """Return states of the oracle's episodes, [STATES, columns] float32: see `_shapes`."""
    policy = oracle(env)
    observations, *_ = env.reset(seed=0)
    goes_on, solved = np.ones(env.num_envs, bool), np.full(env.num_envs, -1)
    rows, numbers, steps = [], [], []
    for step in trange(1, env.max_steps, desc="the oracle's episodes", unit="step", leave=False, disable=None):
        result = env.step(policy(observations))
        observations = result.observations
        goes_on &= ~(result.terminated | result.truncated)
        success = np.all([result.infos[agent]["success"] for agent in env.agents], axis=0)
        solved = np.where((solved < 0) & success & goes_on, step, solved)
        if step % EVERY == 0:
            at = np.flatnonzero(goes_on)
            rows.append(_joined(env, observations, result.state)[at])
            numbers.append(at)
            steps.append(np.full(len(at), step))
    last = solved[np.concatenate(numbers)]
    useful = np.flatnonzero((last >= 0) & (np.concatenate(steps) <= last + BEYOND))
    if not len(useful):
        raise ValueError(f"oracle_states.rate must be 0 for {env.task_name}: its oracle never succeeded")
    return np.concatenate(rows)[np.random.default_rng(0).choice(useful, STATES)]


def _joined(env: BatchedEnv, observations: dict[str, np.ndarray], state: np.ndarray) -> np.ndarray:
    """Return the parts of `_shapes` side by side, [N, columns] float32, which holds all whole numbers in them."""
    every = {**env.carry(), **observations, "state": state}
    return np.concatenate([every[name].reshape(env.num_envs, -1) for name in _shapes(env)], 1, dtype=np.float32)


def _shapes(env: BatchedEnv) -> dict[str, tuple[int, ...]]:
    """Return name -> shape of what is kept of one environment: of its carry, of what each agent and critics observe."""
    carry = {name: shape for name, shape in env.engine.carry_shapes.items() if name not in OWN}
    seen = {agent: env.observation_space(agent).shape or () for agent in env.agents}
    return {**carry, **seen, "state": env.state_space.shape}


def _cut(rows: np.ndarray, env: BatchedEnv) -> Iterator[np.ndarray]:
    """Yield the parts of `_shapes`, [STATES, ...] each."""
    first = 0
    for shape in _shapes(env).values():
        size = int(np.prod(shape))
        yield rows[:, first : first + size].reshape(len(rows), *shape)
        first += size
