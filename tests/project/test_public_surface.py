"""Names, signatures, commands, keys and numbers that others build on change only when somebody means it."""

from __future__ import annotations

import difflib
import json
import subprocess
import sys
from importlib.util import find_spec
from typing import Any

import pytest

from surgical_marl.plugins.tasks import list_tasks
from tests.helpers import surface
from tests.helpers.processes import answer

KEPT: dict[str, Any] = json.loads(surface.FILE.read_text())
named = pytest.mark.skipif(not find_spec("pettingzoo.env_registry"), reason="PettingZoo has ids since 1.27")
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


@named
def test_the_public_surface_is_what_it_was() -> None:
    found = answer(surface.quick)  # in a new process: other tests register tasks in this one
    check(found, {name: KEPT[name] for name in found})


def test_a_seed_leads_to_the_numbers_that_it_led_to() -> None:
    check(surface.environment("reach", "psm"), KEPT["reach on psm"])


def test_an_evaluation_has_the_keys_that_it_had() -> None:
    check(surface.evaluation("reach", "psm"), KEPT["json of eval, reach on psm"])


@pytest.mark.slow
@pytest.mark.parametrize("task", list_tasks())
def test_each_task_gives_what_it_gave(task: str) -> None:
    check(surface.environment(task), KEPT["environments"][task])
    check(surface.evaluation(task), KEPT["json of eval"][task])


@pytest.mark.slow
def test_crossplay_says_what_it_said() -> None:
    check(surface.of_teams(), KEPT["crossplay"])


VERSIONED = """
import gymnasium, pettingzoo
import surgical_marl as sm
from surgical_marl.tasks.reach import Task

class Waiting(Task):
    pass

sm.register_task("waiting", Waiting, version=2)
from surgical_marl import waiting_v0, waiting_v2

assert "waiting_v2" in dir(sm) and "waiting_v0" not in dir(sm)
assert waiting_v2.parallel_env and gymnasium.spec("surgical_marl/Waiting-v2")
assert pettingzoo.spec("parallel", "surgical_marl/waiting-v2") and pettingzoo.spec("aec", "surgical_marl/waiting-v2")
for make in (
    waiting_v0.parallel_env,
    waiting_v0.env,
    sm.waiting_v1.raw_env,
    lambda **options: pettingzoo.make("parallel", "surgical_marl/waiting-v1", **options),
    lambda **options: gymnasium.make("surgical_marl/Waiting-v0", **options),
):
    try:
        make(scene="psm")
    except Exception as error:
        print(error)
for version in (-1, 1.0, True):
    try:
        sm.register_task("waiting", Waiting, version=version)
    except ValueError as error:
        print(error)
"""


@named
def test_a_task_of_a_higher_version_says_so_to_those_who_ask_for_an_older_one() -> None:
    done = subprocess.run([sys.executable, "-c", VERSIONED], cwd=surface.ROOT, capture_output=True, text=True)
    said = done.stdout.splitlines()
    assert len(said) == 8, done.stderr
    assert [line.split(":")[0] for line in said[:3]] == [f"waiting_v{v} is out of date" for v in (0, 0, 1)]
    assert all("waiting_v2" in line for line in said[:3])
    assert "v2" in said[3] and "surgical_marl/Waiting-v2" in said[4]
    assert [line.rsplit(" ", 1)[1] for line in said[5:]] == ["-1", "1.0", "True"]
