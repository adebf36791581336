"""What stands in the pages: files to save, commands to type and Python to run, in the order of a page."""

from __future__ import annotations

import argparse
import ast
import builtins
import re
import shlex
from collections.abc import Iterator
from typing import NamedTuple

from surgical_marl.cli import main as cli
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.scenes.placing import scenes_for
from tests.helpers import ROOT

PATTERNS = ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "arms/*/README.md", "policies/**/README.md")
PAGES = sorted({path for pattern in PATTERNS for path in ROOT.glob(pattern)})

PROGRAMS = ("surgical-marl", "python", "python3", "make", "pip", "pytest", "torchrun")
"""A piece of inline code that begins with one of them is a command."""
STANDS_FOR = {"SCENE": "psm", "TASK": "reach", "LEVEL": "hard", "POLICY": "oracle", "RUN": "runs/run", "SEED": "0",
              "NAME": "reach-psm", "N": "2", "K": "4", "W": "0.1", "HOST": "localhost", "WAY": "si"}  # fmt: skip
"""What words in capitals stand for in a command."""
FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
SAVE = re.compile(r"save this as `([^`]+)`[^`]*(?:`[^`]+`[^`]*)*\Z", re.IGNORECASE)
INLINE = re.compile(r"`([^`]+)`")


class Piece(NamedTuple):
    """A piece of a page. kind: "sh", "python", the language of another block, "file" or "inline"."""

    kind: str
    text: str
    name: str = ""
    """The file to save it as."""


def pieces(text: str) -> Iterator[Piece]:
    """Yield the blocks of a page, each after the inline commands before it."""
    begin = 0
    for block in FENCE.finditer(text):
        before = text[begin : block.start()]
        yield from _inline(before)
        indent, kind, code = block.groups()
        code = re.sub(f"^{indent}", "", code, flags=re.MULTILINE)
        paragraph = before.rpartition("```")[2].strip().rpartition("\n\n")[2]
        saved = SAVE.search(paragraph)
        if saved:
            yield Piece("file", code, saved[1])
        yield Piece({"bash": "sh"}.get(kind, kind), code)
        begin = block.end()
    yield from _inline(text[begin:])


def _inline(text: str) -> Iterator[Piece]:
    for code in INLINE.findall(text):
        if code.split()[0] in PROGRAMS:
            yield Piece("inline", " ".join(code.split()))


def commands(block: str) -> Iterator[tuple[list[str], str]]:
    """Yield the words of each command of a shell block, and the comment behind it."""
    for line in block.replace("\\\n", " ").splitlines():
        if words := shlex.split(line, comments=True):
            yield words, line.partition(" #")[2].strip()


def free_names(code: str) -> set[str]:
    """Return the names that a program reads and neither defines nor gets from Python."""
    nodes = list(ast.walk(ast.parse(code)))
    used = {node.id for node in nodes if isinstance(node, ast.Name)}
    made = {node.id for node in nodes if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load)}
    made |= {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    made |= {node.arg for node in nodes if isinstance(node, ast.arg)}
    imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    made |= {(alias.asname or alias.name).partition(".")[0] for node in imports for alias in node.names}
    return used - made - set(dir(builtins))


def stand_in(word: str, words: list[str]) -> str:
    """Return a word of a command with what its capitals and angle brackets stand for."""
    if word == "SCENE" and "--task" in words and words[words.index("--task") + 1] in TASKS.names():
        return scenes_for(words[words.index("--task") + 1])[0]
    word = re.sub(r"<(\w+)>", r"\1", word).removeprefix("/")  # nothing is written outside of the working folder
    return re.sub(r"(?<![a-zA-Z_])[A-Z]{1,6}(?![a-zA-Z_=])", lambda match: STANDS_FOR.get(match[0], match[0]), word)


def is_name_only(words: list[str]) -> bool:
    """Return whether inline code is a command's name, which a page may say without what it should work on."""
    name = " ".join(words).replace("python -m surgical_marl ", "surgical-marl ")
    return len(words) == 1 or name.removeprefix("surgical-marl ") in COMMANDS


def names_of_commands(parser: argparse.ArgumentParser, before: str = "") -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield before + name
                yield from names_of_commands(inner, f"{before}{name} ")


COMMANDS = set(names_of_commands(cli._parser()))
