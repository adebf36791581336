"""Every command of every page is run to its end, in a fresh copy of this project, as small as its options allow.

The commands of a page run in its order in one folder, so that a report finds the run of the training above it. What a
reader is supposed to have, such as `runs/mine`, is made first. What can't run here is skipped, with the word why.
`test_pages.py` checks the same commands with all of their options as they stand, up to where their work begins.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.runs.fault import write_fault
from surgical_marl.runs.settings import Settings
from tests.helpers.least import all_set_up, command_alone, least, serves, stamps_of_make
from tests.helpers.pages import PAGES, ROOT, commands, free_names, is_name_only, pieces, stand_in

LONGEST = 1800
"""Seconds that a command may take, with caches that are empty."""
BESIDE = {
    ".git",
    ".venv",
    ".mypy_cache",
    ".pytest_cache",
    ".ruff_cache",
    ".hypothesis",
    "runs",
    "build",
    "dist",
    "site",
}
"""What may lie in the folder of this project and is no part of it."""
INSTALL = ("pip", "npm", "apt", "apt-get", "conda")
LACKING = {
    r"No module named '(?!surgical_marl|tests)(\w+)": "{} is not installed",
    r"(DISPLAY) environment variable is missing": "needs a {}",
}
"""What a program that fails says where this machine lacks something, and the word for it."""


@pytest.fixture
def clone() -> Iterator[Path]:
    """A copy of the project, so that no command writes into this one."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clone"
        shutil.copytree(ROOT, path, ignore=lambda at, _: BESIDE if Path(at) == ROOT else {"__pycache__"})
        if shutil.which("git"):  # a reader's copy is a repository, which `make mutants` asks for its files
            subprocess.run(["git", "init", "--quiet", path], check=True)
        yield path


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """What trains a run on a scene, once."""

    @cache
    def train(scene: str) -> Path:
        folder = tmp_path_factory.mktemp("trained") / scene
        words = least(shlex.split(f"surgical-marl train reach --scene {scene}"))
        run([*words, "iterations=1", "--out", str(folder)], ROOT, ROOT)
        return folder

    return train


def test_the_commands_that_newcomers_type_first_run(
    clone: Path, trained: Callable[[str], Path], subtests: pytest.Subtests
) -> None:
    run_all(commands_of(ROOT / "README.md", clone, ["sh"]), clone, trained, subtests)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_the_commands_of_a_page_run(
    page: Path, clone: Path, trained: Callable[[str], Path], subtests: pytest.Subtests
) -> None:
    run_all(commands_of(page, clone), clone, trained, subtests)


def run_all(found: list[list[str]], folder: Path, trained: Callable[[str], Path], subtests: pytest.Subtests) -> None:
    for words in found:
        with subtests.test(shlex.join(words)):
            if word := lacking(words):
                pytest.skip(word)
            lay_out(words, found, folder, trained)
            began = time.monotonic()
            (visit if serves(words) else run)(least(words), folder, folder)
            print(f"{time.monotonic() - began:.0f} s  {shlex.join(words)}")


@pytest.mark.parametrize(
    ("command", "added"),
    [
        ("surgical-marl eval reach-psm --episodes 1000", "--episodes 8"),
        ("surgical-marl bench view --scene psm", "--seconds 1"),
        ("surgical-marl view reach --scene psm", "--port 0"),
        ("python -m docs.studies.grasping --arms 1", "--seconds 1 --grasps 1 --objects needle_sh"),
        ("python policies/train_all.py --evaluate", "--seeds 1 --jobs 1 --only reach-psm"),
        ("python docs/examples/random_agents.py", ""),
        ("pytest tests/cli/test_cli.py -k list", "--collect-only --quiet"),
        ("SEED=3 make gallery", "ARGS='--only psm'"),
        ("make coverage", "ARGS='--collect-only --quiet'"),
        ("make docs", ""),
    ],
)
def test_a_command_is_made_small_by_its_own_options(command: str, added: str) -> None:
    assert least(shlex.split(command)) == [*shlex.split(command), *shlex.split(added)]


def test_a_training_is_made_small_and_imitates_only_if_it_did() -> None:
    reach, pick = (least(["surgical-marl", "train", *task]) for task in (["reach", "--scene", "psm"], ["needle_pick"]))
    assert {"iterations=2", "num_envs=4", "steps_per_iteration=2"} <= {*reach}
    assert (reach[-1], pick[-1]) == ("max_steps=8", "imitation.steps=1")
    several = "torchrun --nproc-per-node 4{} -m surgical_marl train reach --scene psm"
    found = least(shlex.split(several.format("")))
    assert found == [*shlex.split(several.format(" --nnodes 1 --nproc-per-node 2")), *reach[5:]]


@pytest.mark.parametrize(
    ("command", "word"),
    [
        ("pip install onnxruntime", "network"),
        ("make lock", "make lock" if not (Path(sys.prefix) / ".ready-for-supply").exists() else "servers"),
        ("python -m docs.studies.stability", None),
    ],
)
def test_what_cannot_run_here_is_said(command: str, word: str | None) -> None:
    found = lacking(shlex.split(command))
    assert found is None if word is None else word in str(found)


def commands_of(page: Path, folder: Path, kinds: Sequence[str] = ("sh", "inline")) -> list[list[str]]:
    """Return the words of each command of a page, after everything that the page has its reader save."""
    found, classes = [], []
    for kind, text, name in pieces(page.read_text(encoding="utf-8")):
        if kind == "file":
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")
        elif kind == "python":
            classes.append(text)
            if "surgical_marl" not in text and not free_names(
                text
            ):  # it makes files that commands read, such as meshes
                subprocess.run([sys.executable, "-c", text], cwd=folder, check=True)
        elif kind == "toml":
            install(tomllib.loads(text)["project"]["entry-points"], classes, folder)
        elif kind in kinds:
            found += [words for words, _ in commands(text) if not (kind == "inline" and is_name_only(words))]
    return [list(words) for words in dict.fromkeys(tuple(stand_in(word, words) for word in words) for words in found)]


def install(groups: dict[str, dict[str, str]], classes: list[str], folder: Path) -> None:
    """Write the classes of a page as the package that its pyproject.toml describes, where Python finds packages."""
    named = [where for names in groups.values() for where in names.values()]
    about = folder / "of_a_page-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: of-a-page\nVersion: 1\n")
    with (about / "entry_points.txt").open("w") as file:
        for group, names in groups.items():
            print(f"[{group}]", *(f"{name} = {where}" for name, where in names.items()), sep="\n", file=file)
    for module, _, wanted in (where.partition(":") for where in named):
        package, _, name = module.partition(".")
        (folder / package).mkdir(exist_ok=True)
        (folder / package / "__init__.py").touch()
        if wanted:
            (text,) = [text for text in classes if f"class {wanted}" in text]
            (folder / package / f"{name}.py").write_text(text)


def lacking(words: list[str]) -> str | None:
    """Return what a command needs and is not here."""
    words = command_alone(words)
    if words[0] in INSTALL:
        return "installs packages from the network"
    if "cuda" in words and not torch.cuda.is_available():
        return "needs a GPU"
    if words[0] == "make":
        rules = re.findall(rf"^{words[1]}:.*$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        needed = {name: stamp for name, stamp in stamps_of_make().items() if f"$({name})" in " ".join(rules)}
        if not all((Path(sys.prefix) / stamp).exists() for stamp in needed.values()):
            return f"needs the packages that `make {words[1]}` installs"
        if "SUPPLY_READY" in needed:
            return "asks servers of packages"
    return None


def lay_out(words: list[str], all_words: list[list[str]], folder: Path, trained: Callable[[str], Path]) -> None:
    """Make the files and run folders that a command reads and no command of the page has written."""
    for flag, word in pairwise(["", *words]):
        name = word.partition("=")[2] if flag == "--partner" else word
        path = folder / name
        if flag == "--resume":  # each goes on with a run as the reader has it
            shutil.rmtree(path, ignore_errors=True)
        if flag in ("--out", "--figure"):
            path.parent.mkdir(parents=True, exist_ok=True)
        elif ("--out", word) in pairwise(words) or path.exists():
            continue
        elif name.startswith("runs/"):
            told = [pairwise(other) for other in all_words if word in other]
            scenes = [scene for pairs in told for flag, scene in pairs if flag == "--scene"]
            copy_run(trained(*scenes[:1] or ["bimanual_psm"]), path)
        elif path.suffix == ".yaml" and flag != "--csv":
            shutil.copy(folder / "scenes" / "psm.yaml", path)
        elif flag == "--against":
            older = [one for one in words if one not in (flag, word)]
            path.write_text(run([*least(older), "--json"], folder, folder))
        elif path.suffix == ".npz":
            make_fault(path)


def copy_run(source: Path, path: Path) -> None:
    """Copy a run, with the next seed."""
    shutil.copytree(source, path)
    text = (path / "config.yaml").read_text(encoding="utf-8")
    seed = len(list(path.parent.iterdir()))
    (path / "config.yaml").write_text(re.sub("^seed: .*", f"seed: {seed}", text, flags=re.MULTILINE), encoding="utf-8")


def make_fault(path: Path) -> None:
    """Write a fault as a training does, of an arm whose speed is not a number."""
    env = BatchedEnv("reach", "psm", num_envs=1, device="cpu")
    env.reset(seed=0)
    start = {name: np.array(part) for name, part in env.carry().items()}
    start[".physics.qvel"][0, 0] = np.nan
    still = {agent: np.zeros((1, 1, *space.shape), np.float32) for agent, space in env.action_spaces.items()}
    write_fault(path, env, Settings("reach", "psm"), start, still, seed=0, index=0, place="state physics.qvel[0]")
    env.close()


def started(words: list[str], folder: Path, source: Path) -> subprocess.Popen[str]:
    """Start a command in a folder, with the package and the environment of these tests."""
    program = command_alone(words)
    given = dict(word.split("=", 1) for word in words[: len(words) - len(program)])
    paths = {"PYTHONPATH": str(source), "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    if program[0] == "make":
        program[1:1] = all_set_up()
    if program[0] == ".":
        program = ["sh", "-c", shlex.join(program).replace(".venv", sys.prefix)]
    return subprocess.Popen(
        program, cwd=folder, env={**os.environ, **paths, **given}, text=True, start_new_session=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def run(words: list[str], folder: Path, source: Path) -> str:
    """Run a command to its end, and return what it printed; skip if it says that this machine lacks something."""
    process = started(words, folder, source)
    try:
        out, err = process.communicate(timeout=LONGEST)
    finally:
        end(process)
    refused = re.search(r"leave (--[a-z-]+)", err) if process.returncode == 2 else None
    if refused and refused[1] in words:  # an amount that does not go with the command's other options
        at = words.index(refused[1])
        return run([*words[:at], *words[at + 2 :]], folder, source)
    if process.returncode:
        for said, word in LACKING.items():
            if found := re.search(said, out + err):
                pytest.skip(word.format(found[1]))
        said = f"{shlex.join(words)} ended with {process.returncode}:\n{out[-2000:]}\n{err[-4000:]}"
        pytest.fail(said, pytrace=False)
    return out


def visit(words: list[str], folder: Path, source: Path) -> None:
    """Start a command that shows a page, look at the page, and interrupt the command, which ends well."""
    if not importlib.util.find_spec("viser"):
        pytest.skip("viser is not installed")
    process = started(words, folder, source)
    try:
        assert process.stdout and process.stderr
        address = process.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:"), process.stderr.read()
        with urllib.request.urlopen(address, timeout=60) as answer:
            assert answer.status == 200 and b"<html" in answer.read().lower()
        time.sleep(1)  # so that something can be recorded
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
        assert process.returncode == 0, err
    finally:
        end(process)


def end(process: subprocess.Popen[str]) -> None:
    """End what is left of a command, if anything is."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
