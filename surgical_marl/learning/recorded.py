"""Exported data sets as demonstrations: what agents observed and did, of an oracle, a policy or people.

A set holds what critics observe, which has what agents observe in it, and the targets of joints or tips. Both are
turned back into what an actor sees and does in this environment.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict

from surgical_marl.data.reading import Table, check_set, read_set
from surgical_marl.policies.adapter import STATE, SURROUNDINGS
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.row_actions import RowActions
from surgical_marl.policies.signals import FORMS, Signals
from surgical_marl.runs.content import scene_label
from surgical_marl.runs.settings import Settings
from surgical_marl.untrusted.values import listed, shown

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.envs.env import Env

LIKE = ("task", "scene", "knowledge", "messages", "observe")
"""Options that say what critics observe: those of the set must be those of the run."""
STILL = 1e-5
"""Change of a joint's target, rad or m, below which nothing was commanded in a row."""
_COLUMNS = (STATE, SURROUNDINGS, "action", "next.success", "episode_index")


def check_recorded(settings: Settings) -> None:
    """Raise ValueError if a run can't imitate the data set that it names, before that is read."""
    check_set(Path(settings.imitation.data))
    if settings.imitation.rounds:
        raise ValueError(f"imitation.rounds must be 0 with imitation.data, not {settings.imitation.rounds}")
    if settings.control_frame != "base" or settings.messages:
        raise ValueError("imitation.data needs control_frame 'base' and no messages")


class Recorded:
    """Pairs of an exported data set, on the device of a run.

    Rows in which no arm was told to move are left out, unless the task was done: an actor that imitates waiting waits
    forever, because what it observes stays the same. Where targets move all rows are kept.

    Args:
        settings: the run.
        layout: how agents are stacked.
        env: the environments of the run.
        device: where the pairs are kept.

    Attributes:
        shown: what agents observe, [n, ...] for each group of the layout.
        actions: what they do then, flat joint actions [n, sum] in [-1, 1].

    Raises:
        ValueError: the set is damaged, of another task or scene, or of another robot; or what `check_recorded` refuses.
    """

    def __init__(self, settings: Settings, layout: Layout, env: BatchedEnv, device: str) -> None:
        check_recorded(settings)
        folder = Path(settings.imitation.data)
        table = read_set(folder, _COLUMNS)
        _check_fits(folder, table, settings, env)
        signals = Signals(env, table.about["actions"], round(1 / env.control_dt) // table.about["rate"])
        if table.names != signals.action_names:
            raise ValueError(
                f"{folder} has the actions {listed(table.names)}, and those of scene {env.scene.name!r} are "
                f"{listed(signals.action_names)}"
            )
        seen = {agent: _observed(env.env, agent, table.columns[SURROUNDINGS]) for agent in env.agents}
        actions = _actions(env, signals, seen, table)
        kept = np.flatnonzero(_moves(env, signals, seen, table))
        if not len(kept):
            raise ValueError(f"{folder} has no row in which an arm is told to move")
        scales = {agent: env.env.observed[agent].scales[False] for agent in seen}
        told = {a: scales[a].apply(own[kept]) if env.env.scaled else own[kept] for a, own in seen.items()}
        groups = layout.stack(told)
        self.shown = TensorDict(
            {
                name: torch.from_numpy(np.ascontiguousarray(part, np.float32)).to(device)
                for name, part in groups.items()
            },
            batch_size=[len(kept)],
        )
        flat = np.concatenate([np.clip(actions[agent][kept], -1.0, 1.0) for agent in layout.agents], -1)
        self.actions = torch.from_numpy(flat.astype(np.float32)).to(device)


def _check_fits(folder: Path, table: Table, settings: Settings, env: BatchedEnv) -> None:
    made, own = table.about["environment"], {key: getattr(settings, key) for key in LIKE}
    own = {**own, "scene": scene_label(settings.scene), "task": env.task_name, "observe": _plain(settings.observe)}
    for key, value in own.items():
        theirs = _plain(made.get(key)) if key == "observe" else made.get(key)
        if theirs != value:
            raise ValueError(f"imitation.data {folder} is of {key} {shown(theirs)}, not {shown(value)}")
    rate, control_rate = table.about.get("rate"), round(1 / env.control_dt)
    if not isinstance(rate, int) or rate < 1 or control_rate % rate or table.about.get("actions") not in FORMS:
        raise ValueError(
            f"{folder} has actions {shown(table.about.get('actions'))} at rate {shown(rate)}: the form must be one of "
            f"{', '.join(FORMS)}, and {control_rate} a multiple of the rate"
        )
    if table.columns[SURROUNDINGS].shape[1:] != env.state_space.shape:
        raise ValueError(
            f"{folder} has {table.columns[SURROUNDINGS].shape[1]} numbers of {SURROUNDINGS}, and critics of this "
            f"version observe {env.state_space.shape[0]}: export it anew"
        )


def _plain(observe: object) -> object:
    """Return which terms are observed as JSON has it."""
    return {key: list(names) for key, names in observe.items()} if isinstance(observe, dict) else observe


def _observed(env: Env, agent: str, state: np.ndarray) -> np.ndarray:
    """Return what an agent observes, [n, d] in SI units, from what critics do, [n, s] in SI units."""
    seen = env.observed[agent]
    first = sum(len(env.observed[name].bounds(stated=True)[0]) for name in env.agents[: env.agents.index(agent)])
    if missing := [name for name in seen.names if name not in seen.stated_slices]:
        raise ValueError(
            f"imitation.data can't tell {missing[0]!r}, which {agent!r} observes: critics do not observe it"
        )
    parts = (seen.stated_slices[name] for name in seen.names)
    return np.concatenate([state[:, first + part.start : first + part.stop] for part in parts], 1)


def _actions(env: BatchedEnv, signals: Signals, seen: dict[str, np.ndarray], table: Table) -> dict[str, np.ndarray]:
    """Return the environment's actions [n, a] by agent that begin what the rows of a set want."""
    measured, command = (
        {agent: signals.read(own, agent, term) for agent, own in seen.items()} for term in ("qpos", "command")
    )
    rows = RowActions(env, signals)
    return rows.actions(rows.targets(table.columns["action"], measured, command), command, signals.stride)


def _moves(env: BatchedEnv, signals: Signals, seen: dict[str, np.ndarray], table: Table) -> np.ndarray:
    """Return the rows in which a target moves, or the task is done, [n] bool."""
    if env.task.follows:
        return np.ones(len(table.columns["action"]), bool)
    episode = table.columns["episode_index"]
    moves = np.append(episode[1:] != episode[:-1], True) | table.columns["next.success"].astype(bool)
    for agent, own in seen.items():
        command = signals.read(own, agent, "command")
        moves |= np.append((np.abs(np.diff(command, axis=0)) > STILL).any(1), False)
    return moves
