"""Runs `surgical-marl crossplay`: teams play each other's roles, and with partners that any team can be given."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.content import PARTNERS
from surgical_marl.evaluation.environment import common_settings, find_policy
from surgical_marl.evaluation.evaluate import MAX_BATCH, Played, play
from surgical_marl.evaluation.interval import interval
from surgical_marl.evaluation.metrics import Metric
from surgical_marl.evaluation.report import aligned, described
from surgical_marl.files import write_atomic
from surgical_marl.policies.oracle import oracle
from surgical_marl.policies.team import Team
from surgical_marl.runs.settings import make_env
from surgical_marl.scenes.load import load_scene

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

Pairing = tuple[str, tuple[tuple[str, str], ...]]
"""A team, and who plays which role instead of it."""


def crossplay(teams: Sequence[str], asked: Mapping[str, str | None], episodes: int, seed: int) -> dict[str, Any]:
    """Play the episodes of `surgical-marl crossplay`, all on the same goals.

    Args:
        teams: runs, shipped policies or names of `BASELINES`, of one task and scene.
        asked: as for `surgical_marl.evaluation.command.play_all`.
        episodes: of each pairing.
        seed: of the goals.

    Returns:
        The object that `surgical-marl crossplay --json` prints, see docs/crossplay.md.

    Raises:
        ValueError: something is unknown, teams don't fit together, or the scene has a single agent.
    """
    settings = common_settings(teams, asked)
    if len((scene := load_scene(settings.scene)).agents) < 2:
        raise ValueError(f"crossplay needs a scene with several agents, and {scene.name!r} has one")
    env = make_env(settings, min(episodes, MAX_BATCH))
    roles = env.agents[1:] if len(env.agents) == 2 else env.agents  # of two, one is the other one's transpose
    others = [(team, role, other) for role in roles for team in teams for other in teams]
    others += [(team, role, who) for team in teams for role in env.agents for who in _partners(env)]
    pairings = list(dict.fromkeys([*map(_pairing, teams), *(_pairing(*other) for other in others)]))
    known: dict[Pairing, Played] = {}
    for number, (team, changed) in enumerate(pairings, 1):
        who = f"{number} of {len(pairings)}: playing {team}" + "".join(f", {role} is {own}" for role, own in changed)
        known[team, changed] = play(env, Team(env, find_policy(team), dict(changed)), episodes, seed, who)

    def played(team: str, role: str = "", partner: str = "") -> Played:
        return known[_pairing(team, role, partner)]

    cells = {role: [[played(team, role, other) for other in teams] for team in teams] for role in roles}
    partners = {
        team: {role: {who: _cell(played(team, role, who), role) for who in _partners(env)} for role in env.agents}
        for team in teams
    }
    alone = [played(team) for team in teams]
    mixed = [played(team, role, other) for role in roles for team in teams for other in teams if other != team]
    found = {"self_play": _mean(alone), "cross_play": _mean(mixed) if mixed else None}
    return {
        **alone[0].about,
        "teams": list(teams),
        "roles": list(env.agents),
        "matrices": {role: [[_cell(one) for one in row] for row in rows] for role, rows in cells.items()},
        **found,
        "partners": partners,
    }


def _pairing(team: str, role: str = "", partner: str = "") -> Pairing:
    """Return a team, and who plays which role instead of it."""
    return team, () if role == "" or partner == team else ((role, partner),)


def _partners(env: BatchedEnv) -> tuple[str, ...]:
    """Return the partners that there are for a task: some have no oracle."""
    try:
        oracle(env)
    except ValueError:
        return tuple(who for who in PARTNERS if who != "oracle")
    return PARTNERS


def _cell(run: Played, role: str = "") -> dict[str, float]:
    """Return the shares of a pairing's episodes in which all arms succeed, and in which any collides.

    With the `role` of a partner also the share of the other arms that succeed.
    """
    success, collided = run.measures["success"], run.measures["collided"]
    cell = {"team_success": float(success.all(-1).mean()), "collision_rate": float(collided.any(-1).mean())}
    others = [i for i, agent in enumerate(run.agents) if agent != role]
    return {**cell, "others_success": float(success[:, others].mean())} if role else cell


def _mean(runs: Sequence[Played]) -> dict[str, Any]:
    """Return the mean team success of pairings, and its 95 % interval over pairings and episodes."""
    success = np.stack([run.measures["success"].all(-1, keepdims=True) for run in runs]).astype(float)
    bounds = interval(Metric(success, lambda values: values.mean(-1), share=True))
    return {"team_success": float(success.mean()), "interval": bounds}


def report(result: Mapping[str, Any], as_json: bool, figure: Path | None) -> str:
    """Draw the figure if one is asked for, and return the text for stdout. ValueError if it cannot be written."""
    if figure:
        try:
            _draw(figure, result)
        except OSError as error:
            raise ValueError(f"cannot write {error.filename}: {error.strerror}") from None
    return json.dumps(result) if as_json else format_table(result)


def format_table(result: Mapping[str, Any]) -> str:
    """Return the result of `crossplay` as plain text."""
    parts = [described(result)]
    for key, title in (("self_play", "self-play"), ("cross_play", "cross-play")):
        if (found := result[key]) is not None:
            bounds = "" if found["interval"] is None else " ({:.1%} to {:.1%})".format(*found["interval"])
            parts.append(f"{title}: team success {found['team_success']:.1%}{bounds}")
    for role, rows in result["matrices"].items():
        head = [f"{role} is of", *result["teams"]]
        lines = [[team, *map(_text, row)] for team, row in zip(result["teams"], rows, strict=True)]
        parts.append("\n".join(aligned([head, *lines])))
    lines = [
        [f"{team}, {role}", *map(_text, cells.values())]
        for team, roles in result["partners"].items()
        for role, cells in roles.items()
    ]
    whos = next(iter(next(iter(result["partners"].values())).values()))
    parts.append("\n".join(aligned([["team, and role of the partner", *whos], *lines])))
    parts.append("each cell: team success, others' success if there is a partner, collision rate")
    return "\n\n".join(parts)


def _text(cell: Mapping[str, float]) -> str:
    names = ("team_success", "others_success", "collision_rate")
    return " ".join(f"{cell[name]:.1%}" for name in names if name in cell)


def _draw(path: Path, result: Mapping[str, Any]) -> None:
    """Draw the matrices, and the success with partners, as heat maps in a PNG."""
    from matplotlib.figure import Figure

    teams = result["teams"]
    panels = [(f"{role} is of", teams, teams, rows) for role, rows in result["matrices"].items()]
    lines = {f"{team}\n{role}": cells for team, roles in result["partners"].items() for role, cells in roles.items()}
    whos = list(next(iter(lines.values())))
    panels.append(("that role is", list(lines), whos, [list(cells.values()) for cells in lines.values()]))
    figure = Figure(figsize=(1 + 4 * len(panels), 1.5 + 0.6 * len(lines)), layout="constrained")
    figure.suptitle("team success: {task} in {scene}, {difficulty}, {episodes} episodes".format(**result), fontsize=11)
    for axis, (title, names, columns, rows) in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
        values = np.array([[cell["team_success"] for cell in row] for row in rows])
        axis.imshow(values, vmin=0.0, vmax=1.0, cmap="viridis", aspect="auto")
        axis.set_xticks(range(len(columns)), columns, rotation=30, ha="right", fontsize=8)
        axis.set_yticks(range(len(names)), names, fontsize=8)
        axis.set_title(title, fontsize=9)
        for (row, column), value in np.ndenumerate(values):
            colour = "black" if value > 0.6 else "white"
            axis.text(column, row, f"{value:.0%}", ha="center", va="center", color=colour, fontsize=8)
    write_atomic(path, lambda temporary: figure.savefig(temporary, format="png", dpi=150))
