"""A task in a file of one's own: named by its path everywhere, wrong in one sentence, and refused where targets are out
of reach."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.cli.main import main
from surgical_marl.envs.env import Env
from surgical_marl.envs.out_of_reach import out_of_reach
from surgical_marl.learning import train
from surgical_marl.plugins import task_file
from surgical_marl.plugins.tasks import TASKS, find_task, module_name
from surgical_marl.report.page import _about
from surgical_marl.runs.settings import Settings, config_text, load_config, make_env, read_config
from surgical_marl.scenes.load import load_scene
from tests.helpers.pages import ROOT, pieces

SOURCE = next(piece.text for piece in pieces((ROOT / "docs/your_own_task.md").read_text()) if piece.kind == "file")
"""The smallest task of the page."""
WORLD = """
class Table(Hover):
    \"\"\"Table: tips at points of the world.\"\"\"

    def __init__(self, scene, options):
        super().__init__(scene, options)
        places = [mount.position + self.tables["points"][:, i] @ mount.rotation.T
                  for i, mount in enumerate(scene.mounts.values())]
        self.tables["points"] = np.stack(places, 1)
"""

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Write a file into an empty folder, which is the working folder, of a machine on which no task file has run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(task_file, "cache_dir", lambda: tmp_path / "cache")
    monkeypatch.setattr(task_file, "_NAMED", set())
    monkeypatch.setattr(sys, "path", list(sys.path))

    def write(text: str = SOURCE, name: str = "hover.py") -> Path:
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def test_a_file_is_a_task_by_its_absolute_path(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write()
    assert find_task("hover.py") == str(path) and find_task("./hover.py:Hover") == f"{path}:Hover"
    assert find_task(Path("hover.py")) == str(path)
    settings = load_config("hover.py", "psm")
    assert settings.task == str(path) and task_file.label(settings.task) == "hover"
    assert module_name(f"{path}:Hover") == "Hover_v0"
    (path.parent / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    write(config_text(settings, {}), "config.yaml")
    found = read_config(path.parent / "config.yaml")
    assert found == settings and Env(found.task, "psm").title == "hover on psm"
    assert TASKS.load(found.task).summary().startswith("Hover: every tool tip")


@pytest.mark.parametrize(
    ("text", "task", "words"),
    [
        (None, "hover.py", "there is no task file .*hover.py"),
        ("x = (\n", "hover.py", r"hover.py, line 1: SyntaxError: '\(' was never closed"),
        ("x = '\0'\n", "hover.py", "hover.py: .*null bytes"),
        ("x = 1\nimport no_such_module\n", "hover.py", "hover.py, line 2: ModuleNotFoundError: No module named 'no_su"),
        ("def f():\n    raise KeyError('a')\n\nf()\n", "hover.py", "hover.py, line 2: KeyError: 'a'"),
        ("import sys\nsys.exit(3)\n", "hover.py", "hover.py, line 2: SystemExit: 3"),
        ("class Hover:\n    pass\n", "hover.py", "hover.py has no task: a task is a subclass of surgical_marl.Task"),
        (SOURCE + WORLD, "hover.py", "has the tasks Hover, Table: name one of them, as in hover.py:Hover"),
        (SOURCE, "hover.py:Hoover", "has no task 'Hoover': its tasks are Hover"),
        (SOURCE, "hover.yaml", "unknown task 'hover.yaml'"),
    ],
)
def test_whatever_is_wrong_with_a_file_is_one_sentence_on_every_command(
    text: str | None, task: str, words: str, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    if text is not None:
        write(text)
    with pytest.raises(ValueError, match=words) as caught:
        sm.parallel_env(task, scene="psm")
    said = " ".join(str(caught.value).split())
    scene = ["--scene", "bimanual_psm"]
    for command in (
        ["train", task, *scene, "--device", "cpu", "--out", "run"],
        ["eval", "zero", "--task", task, *scene],
        ["crossplay", "zero", "random", "--task", task, *scene],
        ["bench", "train", "--task", task, *scene, "--device", "cpu", "num_envs=1", "ppo.mini_batches=1"],
        ["play", task, *scene, "--policy", "zero", "--out", "film.mp4"],
    ):
        assert main(command) == 2, command
        assert capsys.readouterr().err.splitlines()[-1] == f"surgical-marl: {said}", command
    assert not Path("run").exists()


def test_a_file_that_has_changed_is_loaded_anew(write: Write) -> None:
    path = write(SOURCE + "\n\nsm.register_task('hover', Hover)\n")
    try:
        first = TASKS.load(find_task("hover.py"))
        assert TASKS.load(str(path)) is first is TASKS.load("hover")
        write(path.read_text().replace("0.02]", "0.05]"))
        other = TASKS.load(str(path))
        assert other is not first and TASKS.load("hover") is other
        high, low = (cls(load_scene("psm"), Settings(task=str(path))).tables["points"] for cls in (other, first))
        np.testing.assert_allclose(high - low, np.broadcast_to([0, 0, 0.03], high.shape))
    finally:
        TASKS._registered.pop("hover", None)


def test_a_file_imports_what_lies_beside_it(write: Write) -> None:
    write("HEIGHT = 0.03\n", "heights_of_a_test.py")
    write("from heights_of_a_test import HEIGHT\n" + SOURCE.replace("0.02]", "HEIGHT]"))
    assert Env("hover.py", "psm").task.tables["points"].shape == (256, 1, 3)


def test_a_file_that_only_a_run_names_does_not_run(write: Write) -> None:
    """A run folder is data: a stranger's may name a file that came with it."""
    path = write("from pathlib import Path\nPath('ran').touch()\n" + SOURCE)
    settings = Settings(task="hover.py", scene="psm", device="cpu")
    for use in (
        lambda: TASKS.load(settings.task),
        lambda: make_env(settings, 1),
        lambda: load_config(settings.task, "psm"),
        lambda: train.make_training(settings),
    ):
        with pytest.raises(ValueError, match=rf"{path} has not run on this machine.*surgical-marl check {path}"):
            use()
    assert _about(settings.task) == "" and not Path("ran").exists()
    assert main(["check", "hover.py", "--scene", "psm"]) == 0
    assert Path("ran").exists() and not main(["check", "hover.py"])
    task_file._NAMED.clear()  # as in another process
    assert TASKS.load(settings.task).__name__ == "Hover"


def reset_in_worker(made: bytes, folder: str) -> Any:
    os.chdir(folder)
    env = pickle.loads(made)
    return env.reset(seed=3)[0]


def table_in_worker(task: str, folder: str) -> Any:
    os.chdir(folder)
    return Env(task, "psm").task.tables["points"]


def test_a_worker_that_gets_its_name_loads_it_again(write: Write) -> None:
    write()
    env = Env("hover.py", "psm")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.apply(table_in_worker, (env.task_name, "/"))
    np.testing.assert_array_equal(found, env.task.tables["points"])


@pytest.mark.slow
def test_an_environment_goes_to_workers_that_are_spawned(write: Write) -> None:
    write()
    env = gymnasium.make("surgical_marl/Reach-v0", task="hover.py", scene="psm", device="cpu")
    again = gymnasium.make(env.spec)
    assert again.spec.kwargs["task"] == env.unwrapped.batch.task_name == str(Path("hover.py").resolve())
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.apply(reset_in_worker, (pickle.dumps(env.unwrapped), "/"))
    np.testing.assert_array_equal(found, again.reset(seed=3)[0])


@pytest.mark.parametrize("scene", ["psm", "bimanual_psm", "ecm"])
def test_targets_in_the_world_are_found_before_training(
    scene: str, write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    write(SOURCE + WORLD)
    assert main(["check", "hover.py:Hover", "--scene", scene]) == 0
    assert main(["check", "hover.py:Table", "--scene", scene]) == 1
    (finding,) = capsys.readouterr().out.splitlines()[1:]
    agent = load_scene(scene).agents[0]
    assert f"Table on {scene}: " in finding and f"of the targets of {agent} are out of its reach, such as [" in finding
    assert "as points of the world they would be within its reach" in finding
    assert main(["train", "hover.py:Table", "--scene", scene, "--device", "cpu", "--out", "run"]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"surgical-marl: {finding}" and not Path("run").exists()


def test_targets_that_are_too_far_or_no_numbers_are_found(write: Write) -> None:
    for wrong in ("2.0", "np.nan"):
        write(SOURCE.replace("[0, 0, 0.02]", f"[0, 0, {wrong}]"))
        finding = out_of_reach(Env("hover.py", "psm"))
        assert finding is not None and "100% of the targets" in finding and "workspace, is [" in finding
    rare = "        self.tables['points'][:4] += 2.0\n\n    def start"
    write(SOURCE.replace("\n    def start", rare))
    assert out_of_reach(Env("hover.py", "psm")) is None  # 4 of 256


@pytest.mark.parametrize(
    ("task", "scene"), [("reach", "psm"), ("reach", "bimanual_psm"), ("track", "psm"), ("match_image", "ecm")]
)
def test_no_shipped_task_has_targets_out_of_reach(task: str, scene: str) -> None:
    assert out_of_reach(Env(task, scene)) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "scene"),
    [(task, scene) for task in sm.list_tasks() for scene in TASKS.load(task).scenes or sm.list_scenes()],
)
def test_no_shipped_task_has_targets_out_of_reach_anywhere(task: str, scene: str) -> None:
    try:
        env = Env(task, scene)
    except ValueError as error:
        pytest.skip(str(error))
    assert out_of_reach(env) is None
