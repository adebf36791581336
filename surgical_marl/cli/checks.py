"""Checks of a command's arguments: a value that is wrong is named before one that is missing.

A command that checks its own arguments has a function `check` beside `command`. `check` looks at the values that are
given; then `main` names those that are missing, and then `command` runs.
"""

from __future__ import annotations

# Only light imports here, as in main.py.
import argparse
from collections.abc import Sequence
from pathlib import Path

from surgical_marl.content import BASELINES, PARTNERS, find, list_policies, unknown
from surgical_marl.plugins.adapters import is_adapted, list_adapters, read_adapted
from surgical_marl.plugins.tasks import TASKS, find_task, list_tasks
from surgical_marl.untrusted.files import is_folder, user_path


def check_names(arguments: argparse.Namespace) -> None:
    """Raise ValueError if there is no such task or scene as the arguments name; either may be None.

    A task file gets its absolute path.
    """
    if arguments.task is not None:
        arguments.task = find_task(arguments.task)
    if arguments.scene is not None:
        find("scenes", arguments.scene)


def check_level(arguments: argparse.Namespace) -> None:
    """Raise ValueError if the task, or any task where none is named, lacks the difficulty that the arguments name."""
    if arguments.difficulty is None:
        return
    tasks = list_tasks() if arguments.task is None else [arguments.task]
    levels = sorted({level for task in tasks for level in TASKS.load(task).levels})
    if arguments.difficulty not in levels:
        raise unknown("difficulty", arguments.difficulty, levels)


def check_policies(policies: Sequence[str]) -> None:
    """Raise ValueError if one of some names is no run folder, no policy that ships or has an adapter, no baseline."""
    for policy in policies:
        _check_policy("run or policy", policy, BASELINES)


def _check_policy(noun: str, policy: str, others: Sequence[str]) -> None:
    if is_adapted(policy):
        read_adapted(policy)
    elif policy not in others and not is_folder(user_path(policy)) and policy not in list_policies():
        raise unknown(noun, policy, [*list_policies(), *others, *(f"{name}:PLACE" for name in list_adapters())])


def read_partners(given: Sequence[str]) -> dict[str, str]:
    """Return agent -> policy of flags ROLE=POLICY; ValueError if one has another form, or there is no such policy."""
    found: dict[str, str] = {}
    for text in given:
        role, _, policy = text.partition("=")
        if not (role and policy):
            raise ValueError(f"--partner must be ROLE=POLICY such as psm_0=frozen, not {text!r}")
        if role in found:
            raise ValueError(f"--partner names {role!r} twice")
        _check_policy("partner", policy, PARTNERS)
        found[role] = policy
    return found


def check_file(flag: str, path: Path | None, *suffixes: str) -> None:
    """Raise ValueError if a file that is to be written, if any, has none of the suffixes, or no folder to lie in."""
    if path and not (path.suffix in suffixes and is_folder(path.parent)):
        *others, last = suffixes
        good = f"{', '.join(others)} or {last}" if others else last
        raise ValueError(f"cannot write {flag} {path}: name a {good} file in a folder that exists")
