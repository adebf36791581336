"""A policy of another library that acts in environments: what it observes, when it is asked, and what its answers do.

policy = adapted("lerobot:outputs/act", env)
actions = policy(observations)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.content import unknown
from surgical_marl.envs.observations import proprioception
from surgical_marl.plugins.adapters import ADAPTERS, COMMON, read_adapted
from surgical_marl.policies.acting import Policy, like, to_numpy
from surgical_marl.policies.adapter import PICTURE, STATE, SURROUNDINGS, TASK, PolicyAdapter
from surgical_marl.policies.row_actions import Joints, RowActions
from surgical_marl.policies.signals import FORMS, Signals, language_of
from surgical_marl.untrusted.values import listed, one_line, shown
from surgical_marl.vision.cameras import NODES, PICTURES, Cameras, find_pictures

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


LONGEST_TOLD = 500
"""Letters of what code of others says of an error."""


def adapted(name: str, env: BatchedEnv) -> Policy:
    """Load a policy of another library for all agents of an environment.

    Args:
        name: SCHEME:PLACE, then settings such as `,rate=25`, of which `rate`, `actions` and `horizon` go before what
            the adapter says.
        env: the environment that it will act in.

    Raises:
        ValueError: there is no such adapter or policy, or it does not fit the environment.
    """
    scheme, place, settings = read_adapted(name)
    own = {key: value for key, value in settings.items() if key not in COMMON}
    with _told(f"{name} can't be loaded"):
        adapter: PolicyAdapter = ADAPTERS.load(scheme)(place, **own)
    for key in ("rate", "horizon"):
        if key in settings:
            setattr(adapter, key, int(settings[key]) if settings[key].isdecimal() else settings[key])
    adapter.actions = settings.get("actions", adapter.actions)
    return _Adapted(name, adapter, env)


class _Adapted:
    """The policy of an adapter. Each environment has its own clock of rows, which begins with its episode."""

    def __init__(self, name: str, adapter: PolicyAdapter, env: BatchedEnv) -> None:
        self._name, self._adapter, self._env = name, adapter, env
        self._stride = _stride(name, adapter, env)
        if adapter.actions not in FORMS:
            raise ValueError(_unsaid(name, "what its actions are", "actions", adapter.actions, FORMS))
        self._signals = Signals(env, adapter.actions, self._stride)
        self._rows = RowActions(env, self._signals)
        known = self._signals.action_names
        if adapter.names is not None and tuple(adapter.names) != known:
            raise ValueError(
                f"{name} gives {listed(adapter.names)}, and {adapter.actions} actions in scene {env.scene.name!r} are "
                f"{listed(known)}"
            )
        for key in ("horizon", "history"):
            if not isinstance(count := getattr(adapter, key), int) or count < 1:
                raise ValueError(f"{name}: {key} must be a whole number of 1 or more, not {shown(count)}")
        self._observer = _Observer(name, adapter, env, self._signals)
        many = env.num_envs
        self._chunk = np.zeros((many, adapter.horizon, len(known)), np.float32)
        self._used = np.full(many, adapter.horizon)
        """Rows of the chunk that are used up."""
        self._phase = np.zeros(many, int)
        """Control steps of the row that are done."""
        self._next = np.full(many, -1.0)
        """The number of the step in which the policy acts again, if no other one does before."""
        self._targets: dict[str, np.ndarray] = {}

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        env, signals = self._env, self._signals
        seen = {agent: to_numpy(proprioception(own)) for agent, own in env.restated(observations, "si").items()}
        measured, command = (
            {agent: signals.read(seen[agent], agent, term) for agent in env.agents} for term in ("qpos", "command")
        )
        steps = to_numpy(env.steps)
        begins, self._next = steps != self._next, steps + 1
        self._used[begins], self._phase[begins] = self._adapter.horizon, 0
        if (rows := self._phase == 0).any():
            self._begin_rows(rows, begins, measured, command)
        actions = self._rows.actions(self._targets, command, self._stride - self._phase)
        self._phase = (self._phase + 1) % self._stride
        return {agent: like(proprioception(observations[agent]), actions[agent]) for agent in env.agents}

    def reset(self, ended: Any = None) -> None:
        """Begin anew when the policy is next asked: in all environments, or where an episode has `ended`, [N] bool."""
        self._next[slice(None) if ended is None else to_numpy(ended).astype(bool)] = -1

    def _begin_rows(self, rows: np.ndarray, begins: np.ndarray, measured: Joints, command: Joints) -> None:
        """Look, ask the adapter where its last answer is used up, and set the targets of the rows [N] that begin."""
        adapter = self._adapter
        left = adapter.horizon - self._used
        self._observer.look(rows, rows & (left < adapter.history), begins, measured)
        due = np.flatnonzero(rows & (left == 0))
        if len(due):
            with _told(f"{self._name} can't act"):
                answer = np.asarray(adapter.act(self._observer.batch(due)))
            wanted = (len(due), adapter.horizon, self._chunk.shape[2])
            if answer.ndim != 3 or answer[:, : wanted[1]].shape != wanted:
                raise ValueError(
                    f"{self._name} gives actions of shape {list(answer.shape)}, and {adapter.actions} actions in scene "
                    f"{self._env.scene.name!r} are {list(wanted)}: episodes, horizon, numbers"
                )
            if not np.isfinite(answer).all():
                raise ValueError(f"{self._name} gives actions that are not finite numbers")
            self._chunk[due], self._used[due] = answer[:, : wanted[1]], 0
        which = np.flatnonzero(rows)
        now = self._chunk[which, self._used[which]]
        self._used[which] += 1
        found = self._rows.targets(now, *({a: q[which] for a, q in of.items()} for of in (measured, command)))
        for agent, target in found.items():
            kept = self._targets.setdefault(agent, np.zeros((len(rows), target.shape[1])))
            kept[which] = target


class _Observer:
    """Keeps the last rows that an adapter observes.

    Args:
        name: of the policy, for errors.
        adapter: says what it observes.
        env: the environments.
        signals: the form of states.
    """

    def __init__(self, name: str, adapter: PolicyAdapter, env: BatchedEnv, signals: Signals) -> None:
        self._env, self._signals = env, signals
        asked = dict(adapter.observes)
        self._language = [language_of(env)] if TASK in asked else []
        widths = {STATE: len(signals.state_names), SURROUNDINGS: env.state_space.shape[0]}
        for key, shape in asked.items():
            if key not in (*widths, TASK) and not key.startswith(PICTURE):
                raise unknown(f"observation of {name}", key, [*widths, *(PICTURE + own for own in PICTURES), TASK])
            if key in widths and shape not in (None, (None,), (widths[key],)):
                what = f"{signals.form} states" if key == STATE else "states for critics"
                raise ValueError(
                    f"{name} observes {key} of shape {list(shape or ())}, and {what} in scene {env.scene.name!r} have "
                    f"{widths[key]} numbers"
                )
        if SURROUNDINGS in asked and env.env.scaled:
            raise ValueError(f"{name} observes {SURROUNDINGS} in SI units: observations must be 'si', not 'scaled'")
        self._vectors = [key for key in asked if key in widths]
        self._cameras = _cameras(name, {key: shape for key, shape in asked.items() if key.startswith(PICTURE)}, env)
        self._state: np.ndarray | None = None
        self._history = adapter.history
        self._kept: dict[str, np.ndarray] = {}

    def look(self, rows: np.ndarray, wanted: np.ndarray, begins: np.ndarray, measured: Joints) -> None:
        """Note a row where one begins; of those that are `wanted` keep all that is observed. All are [N] bool."""
        fresh = self._signals.state_now(measured)
        if self._state is None:
            self._state = fresh
        after = self._signals.state_now(measured, self._state)
        self._state = np.where(begins[:, None], fresh, np.where(rows[:, None], after, self._state))
        which = np.flatnonzero(wanted)
        if not len(which):
            return
        for key, values in self._values(which):
            if key not in self._kept:
                shape = (self._env.num_envs, self._history, *values.shape[1:])
                self._kept[key] = np.zeros(shape, values.dtype)
            kept = self._kept[key]
            before = np.where(begins[which].reshape(-1, *[1] * (kept.ndim - 1)), values[:, None], kept[which])
            kept[which] = np.concatenate([before[:, 1:], values[:, None]], 1)

    def batch(self, which: np.ndarray) -> dict[str, Any]:
        """Return what an adapter observes in some environments, by their numbers."""
        return {key: kept[which] for key, kept in self._kept.items()} | (
            {TASK: self._language * len(which)} if self._language else {}
        )

    def _values(self, which: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
        """Yield what is observed in a row in some environments, [n, ...] each."""
        env = self._env
        for key in self._vectors:
            assert self._state is not None
            yield key, self._state[which] if key == STATE else _surroundings(env)[which]
        if self._cameras is not None:
            drawn = env.drawn_poses
            seen = {"qpos": env.qpos, "origin": drawn.origin, "quaternion": drawn.quaternion}
            seen |= {f"{NODES}{name}": nodes for name, nodes in env.drawn_nodes.items()}
            parts = list(self._cameras.draw({key: np.asarray(value, np.float32)[which] for key, value in seen.items()}))
            for key in parts[0]:
                yield PICTURE + key, np.concatenate([part[key] for part in parts])


def _cameras(name: str, asked: Mapping[str, Any], env: BatchedEnv) -> Cameras | None:
    """Return the cameras that draw pictures of the names and shapes that are asked for; None for none."""
    if not asked:
        return None
    pictures = find_pictures([key.removeprefix(PICTURE) for key in asked], env.scene)
    sizes = {tuple(shape or ())[:2] for shape in asked.values()}
    for picture, shape in zip(pictures, asked.values(), strict=True):
        channels = 3 if picture.channel == "rgb" else 1
        if len(shape or ()) != 3 or shape[2] != channels or len(sizes) > 1 or not all(shape):
            raise ValueError(
                f"{name} observes {PICTURE}{picture.name} of shape {shown(shape and list(shape))}: it must be height, "
                f"width, {channels}, and all pictures must have the same size"
            )
    ((height, width),) = sizes
    return Cameras(env.scene, pictures, (width, height))


def _surroundings(env: BatchedEnv) -> np.ndarray:
    """Return what critics observe, [N, d] float32 in SI units, as a data set has it."""
    return np.asarray(env.engine.outcome("numpy")["state"], np.float32)


def _stride(name: str, adapter: PolicyAdapter, env: BatchedEnv) -> int:
    """Return how many control steps a row stands for; ValueError for a rate that does not divide that of steps."""
    control_rate = round(1 / env.control_dt)
    good = [number for number in range(1, control_rate + 1) if control_rate % number == 0]
    if adapter.rate not in good:
        raise ValueError(_unsaid(name, "how many rows a second it was trained on", "rate", adapter.rate, good))
    return control_rate // int(adapter.rate)


def _unsaid(name: str, what: str, key: str, value: object, good: Any) -> str:
    words = ", ".join(map(str, good[:-1]))
    if value is None:
        return f"{name} does not say {what}: add ,{key}={good[-1]} to its name, or {words} instead of {good[-1]}"
    return f"{name}: {key} must be {words} or {good[-1]}, not {shown(value)}"


@contextmanager
def _told(what: str) -> Iterator[None]:
    """Turn anything that code of others raises into a ValueError of one sentence."""
    try:
        yield
    except Exception as error:
        kind = "" if type(error) is ValueError else f"{type(error).__name__}: "
        raise ValueError(f"{what}: {kind}{one_line(' '.join(str(error).split()), LONGEST_TOLD)}") from error
