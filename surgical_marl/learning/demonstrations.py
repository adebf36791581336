"""The oracle's episodes as demonstrations: states to go on from, and actions to imitate.

By chance hardly any arm picks a needle up, hands it over and presents it. From a state along a demonstration it is a
short way to the next reward. Such starts are known as reference state initialisation (X. B. Peng et al., 2018, arXiv
1804.02717; T. Salimans and R. Chen, 2018, arXiv 1812.03381). Environments are moved between two rollouts. Returns are
bootstrapped there anyway, so that this cuts nothing off.

Imitation of the oracle's actions before reinforcement learning is behaviour cloning, as in A. Rajeswaran et al., 2018,
arXiv 1709.10087. While the oracle acts its arms are disturbed, so that its actions show how to come back to its way (M.
Laskey et al., 2017, arXiv 1703.09327).

What an actor has not learned it shows where it acts itself: there the oracle can say what it would do (S. Ross et al.,
2011, arXiv 1011.0686).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from surgical_marl.cache import cached_arrays
from surgical_marl.engines.stepper import describe
from surgical_marl.envs.env import Env
from surgical_marl.plugins.task_file import label
from surgical_marl.policies.actor import acting_policy
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.target_mover import moves_targets
from surgical_marl.runs.progress import progress
from surgical_marl.runs.settings import Settings, make_env

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.policies.networks import MultiAgentActor

STATES = 8192
"""States that are kept of them."""
EVERY = 4
"""Control steps between two states of an episode."""
BEYOND = 25
"""States and actions are kept up to so many control steps after the oracle's first success."""
OWN = (".key", ".episode")
"""Parts of a carry that an environment keeps, whatever state it goes on from: its next episodes are drawn with them."""
DISTURBED, LASTS = 0.1, 0.8
"""Standard deviation of the noise on actions of all joints but jaws, and the share of it that lasts to the next step.
With 0.3 an arm that holds a needle misses most handovers."""
_NEITHER = "oracle_states.rate, imitation.steps and imitation.weight must be 0"


def check_demonstrations(settings: Settings) -> None:
    """Refuse a run whose task the oracle can't demonstrate, before anything is compiled for it.

    Raises:
        ValueError: the control has no position targets, or an agent observes pictures; or there are rounds of
            imitation, and the oracle follows a script of several steps.
    """
    if not moves_targets(settings.control):
        raise ValueError(f"{_NEITHER} with control {settings.control!r}: the oracle moves position targets")
    env = Env(**settings.of_environment())
    if any(seen.pictures for seen in env.observed.values()):
        raise ValueError(f"{_NEITHER} where agents observe pictures")
    if settings.imitation.rounds and len(env.task.script()) > 1:
        raise ValueError(
            f"imitation.rounds must be 0 for this task, not {settings.imitation.rounds}: its oracle goes step "
            "by step, and can't say what to do where another one came"
        )


class Demonstrations:
    """Pairs of the oracle's episodes, on the device of a run.

    Args:
        settings: the run. The oracle plays its task, with the goals of training.
        layout: how agents are stacked.

    Attributes:
        carry: name in `Engine.carry_shapes` -> [STATES, ...].
        observations: what agents and critics observe there, [STATES, ...] for each group of the layout.
        shown: what agents observe in [n] other steps, likewise, without "state".
        actions: what the oracle does then, flat joint actions [n, sum] in [-1, 1].

    Raises:
        ValueError: the task has no oracle, or it never succeeds; or what `check_demonstrations` refuses.
    """

    def __init__(self, settings: Settings, layout: Layout, device: str) -> None:
        check_demonstrations(settings)
        env = make_env(settings, settings.oracle_episodes, "numpy")
        try:
            tables = (np.asarray(table).tobytes() for _, table in sorted(env.task.tables.items()))
            about = env.env.content, describe(env.env.parameters).encode(), f"{env.max_steps} {env.num_envs}".encode()
            rows = cached_arrays("demonstrations", lambda: _record(env), *about, *tables, classes=env.env.classes)
            states, pairs = (
                {name: torch.from_numpy(part).to(device) for name, part in _cut(rows[kind], shapes)}
                for kind, shapes in _shapes(env).items()
            )
            agents = env.agents
        finally:
            env.close()
        if not len(rows["states"]):
            raise ValueError(f"{_NEITHER} for {label(settings.task)}: its oracle never succeeded")
        groups = {**layout.stack({agent: states.pop(agent) for agent in agents}), "state": states.pop("state")}
        self._settings, self._layout, self._asked = settings, layout, 0
        self.carry: dict[str, Tensor] = states
        self.observations = TensorDict(groups, batch_size=[len(rows["states"])])
        shown = layout.stack({agent: pairs[agent] for agent in agents})
        self.shown = TensorDict(shown, batch_size=[len(rows["pairs"])])
        self.actions = torch.cat([pairs[f"action of {agent}"] for agent in layout.agents], -1)

    def draw(self, count: int) -> tuple[dict[str, Tensor], TensorDict]:
        """Draw `count` states; return their carry and observations."""
        chosen = torch.randint(len(self.observations), (count,), device=self.actions.device)
        return {name: part[chosen] for name, part in self.carry.items()}, self.observations[chosen]

    def ask(self, actor: MultiAgentActor) -> None:
        """Add the oracle's actions in every step of `oracle_episodes` other episodes, which an actor plays."""
        self._asked += 1
        env = make_env(self._settings, self._settings.oracle_episodes, "numpy")
        try:
            seen, actions = _answers(env, actor, self._layout, self._asked)
        finally:
            env.close()
        device = self.actions.device
        self.actions = torch.cat([self.actions, torch.from_numpy(actions).to(device)])
        every = {n: torch.cat([self.shown[n], torch.from_numpy(part).to(device)]) for n, part in seen.items()}
        self.shown = TensorDict(every, batch_size=[len(self.actions)])


def _answers(
    env: BatchedEnv, actor: MultiAgentActor, layout: Layout, seed: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Let an actor play one episode in each environment, and ask the oracle.

    Returns:
        What groups observe in all steps, [n, ...] each, and what the oracle would do there, flat joint actions
        [n, sum].
    """
    asked, policy = oracle(env), acting_policy(actor, layout, str(next(actor.parameters()).device))
    observations, *_ = env.reset(seed=seed)
    seen: dict[str, list[np.ndarray]] = {}
    actions = []
    bar = progress(env.max_steps, "step", "asking the oracle", leave=False)
    for _ in range(env.max_steps):
        for name, part in layout.stack(observations).items():
            seen.setdefault(name, []).append(part.astype(np.float32))
        answers = asked(observations)
        actions.append(np.concatenate([np.clip(answers[agent], -1.0, 1.0) for agent in layout.agents], -1))
        observations = env.step(policy(observations)).observations
        bar.update()
    bar.close()
    return {name: np.concatenate(parts) for name, parts in seen.items()}, np.concatenate(actions, dtype=np.float32)


def _record(env: BatchedEnv) -> dict[str, np.ndarray]:
    """Return `states` [STATES, columns] and `pairs` [n, columns] float32, with the columns that `_shapes` names.

    Both are of episodes in which the oracle succeeded: up to `BEYOND` steps later, and all of those whose targets move,
    in which nobody waits.
    """
    follows = env.task.follows
    beyond = env.max_steps if follows else BEYOND
    policy, rng = oracle(env), np.random.default_rng(0)
    observations, state, _ = env.reset(seed=0)
    goes_on, solved = np.ones(env.num_envs, bool), np.full(env.num_envs, -1)
    disturbance, shapes = _Disturbance(env, rng), _shapes(env)
    before: Mapping[str, np.ndarray] = {}
    rows: dict[str, list[np.ndarray]] = {kind: [] for kind in shapes}
    places: dict[str, list[np.ndarray]] = {kind: [] for kind in shapes}

    def keep(kind: str, step: int, which: np.ndarray, parts: Mapping[str, np.ndarray]) -> None:
        at = np.flatnonzero(which)
        rows[kind].append(_joined([parts[name] for name in shapes[kind]], at))
        places[kind].append(np.stack([at, np.full(len(at), step)]))

    bar = progress(env.max_steps, "step", "oracle's episodes", leave=False)
    for step in range(env.max_steps):
        actions = {agent: np.clip(action, -1.0, 1.0) for agent, action in policy(observations).items()}
        if step and step % EVERY == 0:
            keep("states", step, goes_on, {**env.carry(), **observations, "state": state})
        # Imitated, a pair of waiting would have an arm wait forever, because what it observes does not change.
        moves = follows | (solved >= 0) | ~(policy.waits & _jaws_rest(env, actions, before or actions, observations))
        keep("pairs", step, goes_on & moves, {**observations, **{f"action of {a}": x for a, x in actions.items()}})
        result, before = env.step(disturbance.added(actions)), actions
        observations, state = result.observations, result.state
        goes_on &= ~(result.terminated | result.truncated)
        success = np.all([result.infos[agent]["success"] for agent in env.agents], axis=0)
        solved = np.where((solved < 0) & success & goes_on, step, solved)
        bar.set_postfix_str(f"{(solved >= 0).mean():.0%} solved", refresh=False)
        bar.update()
        if not (goes_on & ((solved < 0) | (step < solved + beyond))).any():
            break
    bar.close()
    found = {}
    keep("states", 0, np.zeros(env.num_envs, bool), {**env.carry(), **observations, "state": state})  # if none is
    for kind, (numbers, steps) in ((kind, np.concatenate(places[kind], 1)) for kind in shapes):
        useful = np.flatnonzero((solved[numbers] >= 0) & (steps <= solved[numbers] + beyond))
        chosen = rng.choice(useful, STATES) if kind == "states" and len(useful) else useful
        found[kind] = np.concatenate(rows[kind])[chosen]
    return found


class _Disturbance:
    """Noise on actions: random numbers that change slowly, none for jaws and messages."""

    def __init__(self, env: BatchedEnv, rng: np.random.Generator) -> None:
        self._rng = rng
        self._free = {agent: np.ones(env.action_space(agent).shape or (), bool) for agent in env.agents}
        for agent, free in self._free.items():
            for name in {"jaw", "message"} & env.action_terms(agent).keys():
                free[env.action_terms(agent)[name]] = False
        self._now = {agent: np.zeros((env.num_envs, free.size)) for agent, free in self._free.items()}

    def added(self, actions: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return disturbed actions [N, n] by agent."""
        found = {}
        for agent, action in actions.items():
            fresh = self._rng.normal(0.0, DISTURBED * np.sqrt(1 - LASTS**2), action.shape)
            self._now[agent] = LASTS * self._now[agent] + fresh * self._free[agent]
            found[agent] = np.clip(action + self._now[agent], -1.0, 1.0).astype(np.float32)
        return found


def _jaws_rest(
    env: BatchedEnv,
    actions: Mapping[str, np.ndarray],
    before: Mapping[str, np.ndarray],
    observations: Mapping[str, np.ndarray],
) -> np.ndarray:
    """Return whether no jaw moves, [N].

    It does not at the end of its way, and where the oracle keeps it half open, by opening and closing it in turn.

    Args:
        env: the environments.
        actions: of the oracle, [N, n] by agent.
        before: its actions in the step before.
        observations: [N, d] by agent.
    """
    rest = np.ones(env.num_envs, bool)
    for agent, action in actions.items():
        arm = env.scene.mounts[agent].arm
        if arm.jaw is None or (jaw := env.action_terms(agent).get("jaw")) is None:
            continue
        own = env.restated({agent: observations[agent]}, "si")[agent]
        command = own[:, env.observation_terms(agent)["command"]][:, arm.moves_jaw]
        opens = action[:, jaw] > 0
        ends = np.where(opens, arm.jaw.open, arm.jaw.closed)
        rest &= ((np.abs(ends - command) < 1e-3) | (opens != (before[agent][:, jaw] > 0))).all(-1)
    return rest


def _shapes(env: BatchedEnv) -> dict[str, dict[str, tuple[int, ...]]]:
    """Return name -> shape of the arrays that are kept of one environment.

    Of `states` that is its carry and what each agent and critics observe, of `pairs` what agents observe and do.
    """
    carry = {name: shape for name, shape in env.engine.carry_shapes.items() if name not in OWN}
    seen = {agent: env.observation_space(agent).shape or () for agent in env.agents}
    done = {f"action of {agent}": env.action_space(agent).shape or () for agent in env.agents}
    return {"states": {**carry, **seen, "state": env.state_space.shape}, "pairs": {**seen, **done}}


def _joined(parts: Sequence[np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Return some rows of parts [N, ...] side by side, float32, which holds all whole numbers in them."""
    return np.concatenate([part.reshape(len(part), -1)[rows] for part in parts], 1, dtype=np.float32)


def _cut(rows: np.ndarray, shapes: Mapping[str, tuple[int, ...]]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the names and parts [n, ...] that `_joined` has put side by side."""
    first = 0
    for name, shape in shapes.items():
        size = int(np.prod(shape))
        yield name, rows[:, first : first + size].reshape(len(rows), *shape)
        first += size
