"""Runs `surgical-marl eval`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgical_marl.evaluation.environment import common_settings, find_policy
from surgical_marl.evaluation.evaluate import EPISODES, MAX_BATCH, Played, difference, play, summarise, write_played
from surgical_marl.evaluation.goal_set import STANDARD_EPISODES, STANDARD_SEED
from surgical_marl.evaluation.report import ABOUT, format_table, write_csv
from surgical_marl.files import write_text
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.team import Team, check_partners
from surgical_marl.runs.folder import read_metrics, read_settings
from surgical_marl.runs.settings import make_env
from surgical_marl.untrusted.files import MAX_JSON, check_file, read_json
from surgical_marl.untrusted.values import as_number

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.policies.acting import Policy

RESULT, FILM = "eval.json", "video.mp4"
"""Files that `judge` adds to a run."""


def play_all(
    policies: Sequence[str],
    asked: Mapping[str, str | None],
    episodes: int,
    seed: int,
    partners: Mapping[str, str] | None = None,
) -> dict[str, Played]:
    """Return the episodes of each policy, on the same goals.

    Args:
        policies: runs or shipped policies of one task and scene, or one of `BASELINES` alone.
        asked: options of `SAME` and `CHOSEN` (`evaluation/environment.py`); None leaves an option out. Goals are
            held-out ones by default; all other defaults are those of the trained policy, which also refuses other
            values of `SAME`.
        partners: agent -> who moves it instead, see `surgical_marl.policies.team.Team`.

    Raises:
        ValueError: something is unknown, or does not fit together.
    """
    settings = common_settings(policies, asked)
    check_partners(partners or {}, settings)
    env = make_env(settings, min(episodes, MAX_BATCH))
    played = {}
    for policy in policies:
        acting = Team(env, find_policy(policy), partners or {})
        run = play(env, acting, episodes, seed, f"evaluating {Path(policy).name}")
        played[policy] = run._replace(about={**run.about, "partners": dict(partners)}) if partners else run
    return played


def report(
    played: Mapping[str, Played],
    older: tuple[str, Mapping[str, Any]] | None,
    as_json: bool,
    csv: Path | None,
    figure: Path | None,
) -> str:
    """Write the files that are asked for, and return the text for stdout.

    Args:
        older: name of a result to compare with, and the result.

    Raises:
        ValueError: the older result is of other goals, or a file cannot be written.
    """
    runs = [{"policy": name, **summarise([run])} for name, run in played.items()]
    several = len(runs) > 1
    whole = {"policy": "aggregate", **summarise(list(played.values()))} if several else runs[0]
    change = None if older is None else difference(whole, older[1], older[0])
    try:
        if csv:
            write_csv(csv, [*runs, whole] if several else runs)
        if figure:
            from surgical_marl.evaluation.figure import draw

            draw(figure, played)
    except OSError as error:
        raise ValueError(f"cannot write {error.filename}: {error.strerror}") from None
    if as_json:
        result: dict[str, Any] = {"runs": runs, "aggregate": whole} if several else whole
        return json.dumps(
            result if older is None else {**result, "against": {"result": older[0], "difference": change}}
        )
    if older is not None and change is not None:
        return format_table(whole, {older[0]: older[1], "difference": change})
    return format_table(whole, {run["policy"]: run for run in runs} if several else None)


def judge(run: Path) -> None:
    """Evaluate and film a run, as `surgical-marl train` does after training.

    The evaluation plays the standard goals; its result is written and printed, and its episodes are kept.
    """
    env, policy, played = play_standard(run)
    rows = read_metrics(run)
    result = {**summarise([played]), **({"iteration": int(rows[-1]["iteration"])} if rows else {})}
    text = json.dumps(result, indent=2) + "\n"
    write_played(run / EPISODES, played)
    write_text(run / RESULT, text)
    print(format_table(result), flush=True)

    from surgical_marl.view.record import record

    record(env, policy, run / FILM)


def play_standard(run: Path) -> tuple[BatchedEnv, Policy, Played]:
    """Play the standard goals with a run or a shipped policy; also return the environment and the policy."""
    env = make_env(read_settings(run, ["engine=auto", "device=auto", "goals=held_out"]), STANDARD_EPISODES)
    policy = load_policy(run, env)
    show = f"evaluating {STANDARD_EPISODES} episodes"
    return env, policy, play(env, policy, STANDARD_EPISODES, STANDARD_SEED, show)


def read_result(path: Path) -> dict[str, Any]:
    """Read a result that `surgical-marl eval --json` or a training run wrote.

    If the file holds several runs, this is the result of all of them together.

    ValueError if the file is no such result, or a metric in it is no number.
    """
    check_file(path, MAX_JSON)
    try:
        result = read_json(path)
        result = result.get("aggregate", result)
        known = {*ABOUT, "intervals"} - {"policy"} <= result.keys()
    except (ValueError, AttributeError):
        known = False
    if not known:
        raise ValueError(f"{path} is not a result that `surgical-marl eval --json` of this version wrote")
    agents = result.get("agents")
    try:
        good = isinstance(agents, dict) and all(_has_numbers(part) for part in (result, *agents.values()))
        good = good and isinstance(result["goal_set"], str)
    except (KeyError, TypeError, AttributeError):
        good = False
    if not good:
        raise ValueError(f"{path} is damaged: a metric in it is not a number")
    found: dict[str, Any] = result
    return found


def _has_numbers(part: Mapping[str, Any]) -> bool:
    """Return whether all metrics are numbers or None, and their intervals pairs of numbers or None."""
    return all(
        _is_number(part.get(name)) and (bounds is None or (len(bounds) == 2 and all(map(_is_number, bounds))))
        for name, bounds in part["intervals"].items()
    )


def _is_number(value: Any) -> bool:
    return value is None or math.isfinite(as_number(value))
