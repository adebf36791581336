"""Names, signatures, commands, keys and numbers that others build on change only when somebody means it."""

from __future__ import annotations

import difflib
import json
from typing import Any

import pytest

from surgical_marl.plugins.tasks import list_tasks
from tests.helpers import surface

KEPT: dict[str, Any] = json.loads(surface.FILE.read_text())
MEANT = """
The public surface is not what {file} says (- it says, + it is).
If that is meant: say so in CHANGELOG.md, see "What stays the same" in docs/reliability.md for what else a change needs,
and write the file anew with `python -m tests.helpers.surface`.
"""


def check(found: dict[str, Any], kept: dict[str, Any]) -> None:
    """Fail with the lines that differ."""
    sides = (sorted(surface.lines(side)) for side in (kept, surface.settled(found, kept)))
    changed = [line for line in difflib.ndiff(*sides) if line[0] in "+-"]
    if changed:
        pytest.fail("\n".join([MEANT.format(file=surface.FILE.name), *changed]), pytrace=False)


def test_the_public_surface_is_what_it_was() -> None:
    found = surface.quick()
    check(found, {name: KEPT[name] for name in found})


def test_a_seed_leads_to_the_numbers_that_it_led_to() -> None:
    check(surface.environment("reach", "psm"), KEPT["reach on psm"])


@pytest.mark.slow
@pytest.mark.parametrize("task", list_tasks())
def test_each_task_gives_what_it_gave(task: str) -> None:
    check(surface.environment(task), KEPT["environments"][task])


@pytest.mark.slow
def test_crossplay_says_what_it_said() -> None:
    check(surface.of_teams(), KEPT["crossplay"])


def test_a_change_is_shown_in_lines_that_a_person_reads() -> None:
    kept = {"names": {"sm.f": "(a: int = 1)", "sm.g": "()"}, "ids": ["Reach-v0"], "numbers": {"first": 1.0}}
    found = {"names": {"sm.f": "(a: int = 2)"}, "ids": ["Reach-v0", "New-v0"], "numbers": {"first": 1.01}}
    with pytest.raises(pytest.fail.Exception) as error:
        check(found, kept)
    said = str(error.value).splitlines()
    assert {
        "- names: sm.f: (a: int = 1)",
        "+ names: sm.f: (a: int = 2)",
        "- names: sm.g: ()",
        "+ ids: New-v0",
        "- numbers: first: 1.0",
        "+ numbers: first: 1.01",
    } == {line for line in said if line[:2] in ("- ", "+ ")}
    assert "python -m tests.helpers.surface" in str(error.value)
    check({"numbers": {"first": 1.0005}}, {"numbers": {"first": 1.0}})
    assert surface.fingerprint([1.0, 2.0]) != surface.fingerprint([2.0, 1.0])
