"""The environment of an evaluation: that in which its policies were trained, with the options that can be chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from surgical_marl.content import BASELINES, find
from surgical_marl.plugins.adapters import is_adapted
from surgical_marl.policies.target_mover import check_control
from surgical_marl.runs.content import scene_label
from surgical_marl.runs.folder import check_trained, read_settings
from surgical_marl.runs.identity import setting
from surgical_marl.runs.settings import Settings
from surgical_marl.tasks.base.options import SAME

CHOSEN = ("difficulty", "start", "goals")
"""Options that can be chosen for any policy. A trained policy determines those of `SAME`."""


def common_settings(policies: Sequence[str], asked: Mapping[str, str | None]) -> Settings:
    """Return the settings of the environment that policies of one task and scene are evaluated in.

    Raises ValueError as `play_all` does.
    """
    if len(set(policies)) < len(policies):
        raise ValueError(f"{max(policies, key=policies.count)!r} is named twice")
    given = {"goals": "held_out", **{key: value for key, value in asked.items() if value is not None}}
    trained = [policy for policy in policies if not has_no_task(policy)]
    settings = {policy: _settings(policy, given) for policy in trained or policies}
    name, first = next(iter(settings.items()))
    for policy, other in settings.items():
        for key in (*SAME, *CHOSEN, "max_steps"):
            if (theirs := setting(other, key)) != (ours := setting(first, key)):
                advice = f"choose one for all with --{key}" if key in CHOSEN else "they can't be compared"
                raise ValueError(f"{policy} has {key} {theirs!r} and {name} has {ours!r}: {advice}")
    for policy in trained:
        check_trained(find("policies", policy))
    if "oracle" in policies:
        check_control(first.control)
    return first


def has_no_task(policy: str) -> bool:
    """Return whether a policy has no task and scene of its own: one of `BASELINES`, or of another library."""
    return policy in BASELINES or is_adapted(policy)


def find_policy(name: str) -> str | Path:
    """Return the folder of a run or policy; the name of one that `has_no_task` stays as it is."""
    return name if has_no_task(name) else find("policies", name)


def _settings(policy: str, asked: Mapping[str, str]) -> Settings:
    if has_no_task(policy):
        return Settings(**asked)  # type: ignore[arg-type]
    settings = read_settings(find("policies", policy))
    for key in SAME:
        if key not in asked:
            continue
        wanted = scene_label(asked[key]) if key == "scene" else asked[key]
        if wanted != (own := setting(settings, key)):
            raise ValueError(f"{policy} is of {key} {own!r}, not {wanted!r}: leave --{key} out")
    chosen: Any = {key: asked[key] for key in CHOSEN if key in asked}
    return replace(settings, engine="auto", device="auto", **chosen)
