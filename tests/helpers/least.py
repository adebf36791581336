"""A command made small: the same command, with the least of everything that it has options for.

What these options are is asked of the command's own parser, so that a new command needs no word here.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import runpy
import shlex
import subprocess
import sys
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Any

import pytest

from surgical_marl.cli import main as cli
from surgical_marl.cli.flags import given
from surgical_marl.plugins.tasks import scene_of
from surgical_marl.runs.settings import Settings, load_config

from .pages import ROOT

AMOUNTS = {
    "--num-envs": "4", "--episodes": "8", "--steps": "2000", "--seconds": "1", "--minutes": "0.1", "--turn": "1",
    "--trials": "1", "--confirm": "1", "--seeds": "1", "--jobs": "1", "--grasps": "1", "--sample": "1",
    "--size": "160x120", "--nnodes": "1", "--nproc-per-node": "2",
}  # fmt: skip
"""The least that an option which says how much is given."""
GOALS = {"--success": "0", "--collisions": "1", "--port": "0"}
"""What is met at once: by any policy, and by any machine."""
ONE_OF = {"SCENE": "psm", "POLICY": "reach-psm", "NAME": "psm", "LOADER": "yaml"}
"""`--only` this one, by what the option calls its values. Where they are choices, all of them are short."""
SETTINGS = (
    "iterations=2", "num_envs=4", "steps_per_iteration=2", "oracle_episodes=16", "imitation.batch_size=8",
    "ppo.epochs=1", "ppo.mini_batches=1",
)  # fmt: skip
"""What takes `key=value` is given these."""


class Found(Exception):
    """A program got as far as to read its options."""


def least(words: list[str]) -> list[str]:
    """Return a command with the least that it can do."""
    if before := words[: len(words) - len(command_alone(words))]:
        return [*before, *least(command_alone(words))]
    program, rest = Path(words[0]).name, words[1:]
    if program == "pytest" or (program == "coverage" and "pytest" in rest):  # they run anyway: here they are only found
        return [*words, "--collect-only", "--quiet"]
    if program == "make":
        return [*words[:2], *_with_arguments(words[2:], least(taker)[len(taker) :] if (taker := _taker(words)) else [])]
    if program == "torchrun":
        from torch.distributed.run import get_args_parser

        own = list(takewhile(lambda word: word != "-m", rest))
        return [program, *own, *_added(get_args_parser(), own), "-m", *least(["python", *rest[len(own) :]])[2:]]
    if rest[:2] == ["-m", "surgical_marl"]:
        program, rest = "surgical-marl", rest[2:]
    parser = _surgical_marl(rest) if program == "surgical-marl" else _python(rest) if "python" in program else None
    return [
        *words,
        *(_added(parser, words) if parser else []),
        *(_shortened(rest) if program == "surgical-marl" else []),
    ]


def command_alone(words: list[str]) -> list[str]:
    """Return the words of a command without the variables of the environment before it."""
    return list(dropwhile(re.compile("[A-Z_]+=").match, words))


def serves(words: list[str]) -> bool:
    """Return whether a command shows a page until it is interrupted."""
    return words[0] == "surgical-marl" and "--port" in _surgical_marl(words[1:])._option_string_actions


def _added(parser: argparse.ArgumentParser, words: list[str]) -> list[str]:
    options = parser._option_string_actions
    added: list[str] = []
    for name, value in (AMOUNTS | GOALS).items():
        if name in options and not (name in AMOUNTS and options[name].default == 1):
            added += [name, value]
    for name, option in options.items():  # of names that nobody gave, the first
        if isinstance(option.default, list) and len(option.default) > 1 and name not in (*words, *added, "--only"):
            added += [name, str(option.default[0])]
    only = options.get("--only")
    if only and not only.choices:
        added += ["--only", ONE_OF[str(only.metavar)]]
    if "[key=value" in parser.format_usage():
        added += SETTINGS if "--limit" not in options else SETTINGS[1:]  # or else it learns until it is good
    return added


def _shortened(words: list[str]) -> list[str]:
    """Return the settings of a training that imitates for one step, or whose episodes have eight if no oracle acts."""
    arguments = cli._parse(words)
    if arguments.name not in cli._TAKE_SETTINGS or not arguments.task:
        return []
    flags = [f"{name}={value}" for name, value in given(arguments, Settings).items()]
    try:
        scene = arguments.scene or scene_of(arguments.task)
        settings = load_config(arguments.task, scene, [*flags, *arguments.overrides])
    except ValueError:  # a task or an algorithm that the page adds, and nobody has here
        return []
    if settings.imitation.steps:
        return ["imitation.steps=1"]
    return [] if settings.imitation.weight or settings.oracle_states.rate else ["max_steps=8"]


def _surgical_marl(words: list[str]) -> argparse.ArgumentParser:
    """Return the parser of a command of `surgical-marl`, such as that of `bench sim`."""
    parser: Any = cli._parser()
    for word in words:
        inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
        if not inner:
            break
        parser = inner[0].choices[word]
    return parser


def _python(words: list[str]) -> argparse.ArgumentParser | None:
    """Return the parser of a Python program of this project; None if it has none, or is another's."""
    while words[0] == "-X":
        words = words[2:]
    if words[0] == "-m" and words[1].partition(".")[0] in ("surgical_marl", "docs", "tests"):
        spec = importlib.util.find_spec(words[1])
        assert spec and spec.origin, words[1]
        file = Path(spec.origin)
    else:
        file = ROOT / words[0]
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    if "parser" not in text or "def main(" not in text:
        return None
    found: list[argparse.ArgumentParser] = []

    def stop(parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        found.append(parser)
        raise Found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_known_args", stop)
        patch.setattr(sys, "argv", [str(file)])
        with pytest.raises(Found):
            runpy.run_path(str(file), run_name="read")["main"]()
    return found[0]


def _taker(words: list[str]) -> list[str]:
    """Return the command of a target's recipe that takes ARGS, without the folder of its program; [] if none does."""
    lines = subprocess.run(
        ["make", *all_set_up(), "--dry-run", words[1], *_with_arguments(words[2:], ["HERE"])],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.splitlines()  # fmt: skip
    takers = [shlex.split(line) for line in lines if line.endswith(" HERE")]
    return [Path(takers[0][0]).name, *takers[0][1:-1]] if takers else []


def _with_arguments(variables: list[str], added: list[str]) -> list[str]:
    """Return variables of `make` with more in ARGS."""
    given = next((value[5:] for value in variables if value.startswith("ARGS=")), "")
    others = [value for value in variables if not value.startswith("ARGS=")]
    return [*others, "ARGS=" + f"{given} {shlex.join(added)}".strip()] if added else variables


def all_set_up() -> list[str]:
    """Return options for `make`: what it would install first is there, in the environment of the tests."""
    stamps = [word for stamp in sorted(stamps_of_make().values()) for word in ("-o", f"{sys.prefix}/{stamp}")]
    return [f"VENV={sys.prefix}", *stamps]


def stamps_of_make() -> dict[str, str]:
    """Return the files that say that an environment is ready, by their variables in the Makefile."""
    lines = (ROOT / "Makefile").read_text(encoding="utf-8").splitlines()
    parts = (line.partition(" := $(VENV)/") for line in lines)
    return {name: stamp for name, _, stamp in parts if name.endswith("READY")}
