"""Every page as it stands: its commands are understood, its files are read, its Python runs, its links lead somewhere.

A command of `surgical-marl` goes through the real command line, up to the work: it stops where it would make an
environment, with its task, scene, policy and settings checked. `list`, `check` and `export scene` do all they do.
`make train` and `view`, which newcomers type first, run to their end.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
import urllib.request
from collections.abc import Callable
from contextlib import nullcontext, suppress
from itertools import dropwhile, pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

from surgical_marl.cli import main as cli
from surgical_marl.content import content_dir, list_scenes
from surgical_marl.envs.env import Env
from surgical_marl.learning.trainer import OWN
from surgical_marl.plugins.algorithms import ALGORITHMS
from surgical_marl.plugins.controls import CONTROLS
from surgical_marl.plugins.systems import SYSTEMS
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.runs.checkpoint import write_checkpoint
from surgical_marl.runs.folder import has_begun
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.placing import scenes_for
from surgical_marl.tasks.base.options import Options, make_options
from surgical_marl.view.browser import server
from tests.helpers.pages import PAGES, ROOT, commands, free_names, is_name_only, pieces, stand_in

QUICK = {("reach", "psm"), ("reach", "bimanual_psm")}
"""Environments that Python in pages really makes. Most other tests use them, too."""


class Ready(Exception):
    """A command is understood, and its work would begin."""


def check_env(task: str, scene: str, **options: Any) -> None:
    """Raise an error unless such an environment can be made; compute none of its tables."""
    found, chosen = TASKS.load(task), make_options(task, scene, options)
    assert chosen.difficulty in found.levels, chosen.difficulty
    assert chosen.start in found.starts, chosen.start
    assert not found.weights or set(chosen.reward) <= {"action_change", *found.weights}, chosen.reward
    if found.scenes and scene in list_scenes():
        assert held(scene) in [held(name) for name in scenes_for(task)], f"{task} is not meant for {scene}"


def held(scene: str) -> set[str]:
    return {placement.object.name for placement in load_scene(scene).objects.values()}


def no_env(task: str, scene: str, **options: Any) -> None:
    check_env(task, scene, **options)
    raise Ready


def quick_env(task: str, scene: str, **options: Any) -> Any:
    """Return an environment if it is quick to make and nobody has to compile one for it; else only check it."""
    chosen = {key: value for key, value in options.items() if value is not None}
    if (task, scene) in QUICK and set(chosen) <= {"goals"}:
        return Env(task, scene, **options)
    return no_env(task, scene, **options)


def no_work(*arguments: Any, **_: Any) -> None:
    for each in arguments:
        if isinstance(each, Options):
            check_env(**each.of_environment())
    raise Ready


@pytest.fixture
def page_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder. What a page registers ends with its test."""
    monkeypatch.chdir(tmp_path)
    for registry in (TASKS, ALGORITHMS, CONTROLS, SYSTEMS):
        monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_page(page: Path, page_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {"__name__": page.stem}
    for kind, text, name in pieces(page.read_text(encoding="utf-8")):
        if kind == "file":
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).write_text(text, encoding="utf-8")
        elif kind == "python":
            run_python(text, names)
        elif kind == "sh":
            for words, comment in commands(text):
                check_command(words)
                if "nothing wrong found" in comment:
                    assert capsys.readouterr().out.splitlines()[-1] == comment
        elif kind == "inline":
            check_command(shlex.split(text), is_mention=True)
        elif kind == "toml":
            install(tomllib.loads(text), names)
        elif kind == "yaml":
            yaml.safe_load(text)


def test_the_command_of_every_figure_is_understood(page_folder: Path) -> None:
    for run in yaml.safe_load((ROOT / "docs" / "figures.yaml").read_text(encoding="utf-8")):
        check_command(shlex.split(run["run"]))


LEAST = "iterations=1 num_envs=4 steps_per_iteration=2 max_steps=8 ppo.epochs=1 ppo.mini_batches=1"
"""The least of a training."""


def test_make_train_trains_and_evaluates(tmp_path: Path) -> None:
    set_up = [f"VENV={sys.prefix}", "-o", f"{sys.prefix}/.ready"]
    command = ["make", *set_up, "train", f"ARGS=--out {tmp_path / 'run'} {LEAST}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert has_begun(tmp_path / "run") and "median" in done.stdout


def test_view_serves_a_page_until_it_is_interrupted(page_folder: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed")
    command = [sys.executable, "-m", "surgical_marl", "view", "reach", "--scene", "bimanual_psm", "--port", "0"]
    with subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            assert process.stdout and process.stderr
            address = process.stdout.readline().strip()
            assert address.startswith("http://127.0.0.1:"), process.stderr.read()
            with urllib.request.urlopen(address, timeout=60) as answer:
                assert answer.status == 200 and b"<html" in answer.read().lower()
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
            assert process.returncode == 0, err
        finally:
            process.kill()


def install(settings: dict[str, Any], names: dict[str, Any]) -> None:
    """Register the page's classes as a package with this pyproject.toml would."""
    for registry in (TASKS, ALGORITHMS, CONTROLS, SYSTEMS):
        for name, where in settings["project"]["entry-points"].get(registry.group, {}).items():
            registry._registered[name] = names[where.partition(":")[2]]


def run_python(code: str, names: dict[str, Any]) -> None:
    """Run a program of a page, up to an environment that is not quick to make.

    A program that needs names which the page leaves to the reader is compiled only.
    """
    program = compile(code, "page", "exec")
    if free_names(code) - set(names):
        return
    lay_out(re.findall(r'"(runs/[^"]+)"', code))
    with pytest.MonkeyPatch.context() as patch, suppress(Ready):
        patch.setattr("surgical_marl.envs.batch.Env", quick_env)
        patch.setattr("surgical_marl.interfaces.jax_env.Env", no_env)
        exec(program, names)


def check_command(words: list[str], is_mention: bool = False) -> None:
    """Raise AssertionError unless a command can be typed as it stands, or is nothing but a command's name."""
    program, *rest = dropwhile(re.compile("[A-Z_]+=").match, words)  # without variables of the environment
    if not (is_mention and is_name_only([program, *rest])):
        assert program in CHECKS, f"no test knows the program {program!r}"
        CHECKS[program](rest)


BENCHES = (f"bench.{kind}.run" for kind in ("report", "learning", "solve", "face", "render", "page"))
WORK = ("cli.doctor.report", "data.export.open_take", "evaluation.export.export_policy", "report.command.report",
        "view.take.replay", *BENCHES)  # fmt: skip
"""Where the work of commands begins."""
BIND = server._bind
"""Takes a port for a page of the viewer; `view` serves before it makes an environment."""


def check_surgical_marl(argv: list[str]) -> None:
    argv = [stand_in(word, argv) for word in argv]
    lay_out(argv)
    with pytest.MonkeyPatch.context() as patch, suppress(Ready):
        for work in WORK:
            patch.setattr(f"surgical_marl.{work}", no_work)
        for module in ("envs.batch", "learning.demonstrations"):
            patch.setattr(f"surgical_marl.{module}.Env", no_env)
        patch.setattr("surgical_marl.view.browser.server._bind", lambda _: BIND(0))  # another test may serve on it now
        patch.setattr("surgical_marl.bench.command._no_caches", nullcontext)  # it would outlast the command
        assert cli.main(argv) == 0, argv
    shutil.rmtree("runs", ignore_errors=True)


def lay_out(argv: list[str]) -> None:
    """Write the files and run folders that a command reads."""
    for flag, word in pairwise(["", *argv]):
        path = Path(word.partition("=")[2] if flag == "--partner" else word)
        if flag in ("--out", "--figure"):
            path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() or flag == "--out" or ("--out", word) in pairwise(argv):
            continue
        if path.parts[:1] == ("runs",):
            make_run(Path(*path.parts[:2]), argv)
        elif path.suffix == ".yaml":
            shutil.copy(content_dir("scenes") / "psm.yaml", path)
        elif flag == "--against":
            shutil.copy(content_dir("policies") / "reach-bimanual_psm" / "evaluation.json", path)
        elif path.suffix == ".npz":
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()


def make_run(folder: Path, argv: list[str]) -> None:
    """Make a run folder out of a shipped policy, one of the scene that a command names."""
    scene = argv[argv.index("--scene") + 1] if "--scene" in argv else "bimanual_psm"
    shutil.copytree(content_dir("policies") / f"reach-{scene}", folder)
    (folder / "clip.mp4").rename(folder / "video.mp4")
    write_checkpoint(folder, {"iteration": 1, "groups": {}, "algorithm": {}, **dict.fromkeys(OWN)})


def check_python(argv: list[str]) -> None:
    while argv[0] == "-X":
        argv = argv[2:]
    if argv[0] == "-c":
        compile(argv[1], "command", "exec")
    elif argv[0] == "-m":
        check_module(argv[1], argv[2:])
    else:
        script = ROOT / argv[0]
        text = (script / "__main__.py" if script.is_dir() else script).read_text(encoding="utf-8")
        for flag in (word for word in argv[1:] if word.startswith("--")):
            assert f'"{flag}"' in text, f"{argv[0]} has no {flag}"


def check_module(module: str, argv: list[str]) -> None:
    if module == "surgical_marl":
        check_surgical_marl(argv)
        return
    assert importlib.util.find_spec(module), module
    if module.startswith(("surgical_marl.", "docs.")) and argv:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)
            with pytest.raises(Ready):
                importlib.import_module(module).main(argv)


def parse_and_stop(parser: argparse.ArgumentParser, argv: list[str]) -> None:
    _, unknown = parser.parse_known_args(argv)
    assert not unknown
    raise Ready


def check_torchrun(argv: list[str]) -> None:
    from torch.distributed.run import get_args_parser

    arguments = get_args_parser().parse_args([stand_in(word, argv) for word in argv])
    assert arguments.module and arguments.training_script == "surgical_marl"
    check_surgical_marl(arguments.training_script_args)


def check_make(argv: list[str]) -> None:
    target, *variables = argv
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), target
    for name, _, value in (variable.partition("=") for variable in variables):
        assert name == "ARGS" and target in ("train", "test", "mutants", "matrix")
        if target == "train":
            check_surgical_marl(["train", "reach", "--scene", "bimanual_psm", *shlex.split(value)])
        elif target in ("mutants", "matrix"):
            check_python([f".ci/{target}.py", *shlex.split(value)])
        else:
            check_pytest(shlex.split(value))


def check_pytest(argv: list[str]) -> None:
    named = [ROOT / word for word in argv if word.startswith("tests/")]
    files = [file for path in named for file in (path.rglob("*.py") if path.is_dir() else [path])]
    text = "".join(path.read_text(encoding="utf-8") for path in files)
    if "-k" in argv:
        wanted = set(re.findall(r"\w+", argv[argv.index("-k") + 1])) - {"or", "and", "not"}
        assert all(word in text for word in wanted), wanted
    if "-m" in argv:
        assert set(re.findall(r"\w+", argv[argv.index("-m") + 1])) <= {"slow", "or", "not"}


def check_pip(argv: list[str]) -> None:
    assert argv[0] == "install"
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for word in argv[1:]:
        if word.startswith(".["):
            assert set(word[2:-1].split(",")) <= set(extras), word
        assert not word.endswith(".txt") or (ROOT / word).is_file()


CHECKS: dict[str, Callable[[list[str]], None]] = {
    "surgical-marl": check_surgical_marl,
    "python": check_python,
    "python3": check_python,
    "make": check_make,
    "pip": check_pip,
    "pytest": check_pytest,
    "torchrun": check_torchrun,
    ".": lambda argv: None if argv == [".venv/bin/activate"] else pytest.fail(str(argv)),
}
