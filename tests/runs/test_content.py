"""Run folders that hold what they need: they are of the same scene from any working folder, moved or sent."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import trimesh
import yaml

from surgical_marl.cli.main import main
from surgical_marl.content import content_dir, find
from surgical_marl.evaluation.environment import common_settings
from surgical_marl.interfaces.gymnasium import SurgicalEnv
from surgical_marl.learning import train
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.team import check_same
from surgical_marl.report.groups import group
from surgical_marl.report.page import train_command
from surgical_marl.report.run import read_run
from surgical_marl.runs import content
from surgical_marl.runs import settings as settings_module
from surgical_marl.runs.checkpoint import read_checkpoint
from surgical_marl.runs.fault import made_in, write_fault
from surgical_marl.runs.folder import CHECKPOINT, CONFIG, read_settings
from surgical_marl.runs.settings import Settings
from surgical_marl.scenes.load import load_scene
from tests.helpers.fake_env import FakeEnv
from tests.helpers.run_folders import make_run
from tests.helpers.runs import COUNTS, SIZES, SMALL, fake_env

PLACE = {"position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.11]}


def make_scene(folder: Path, shift: float = 0.0) -> Path:
    """A scene of the user's own, with an arm that has a mesh, an object, and another arm by its name."""
    arm = folder / "parts" / "lab"
    shutil.copytree(content_dir("arms") / "psm", arm)
    (arm / "meshes").mkdir()
    trimesh.creation.box((0.01, 0.01, 0.01)).export(arm / "meshes" / "part.stl")
    urdf = (arm / "psm.urdf").read_text()
    end = urdf.index("</link>")
    mesh = '<visual><geometry><mesh filename="meshes/part.stl"/></geometry></visual>'
    (arm / "psm.urdf").write_text(urdf[:end] + mesh + urdf[end:])
    (folder / "things").mkdir()
    shutil.copy(find("objects", "pad"), folder / "things" / "table.yaml")
    scene: dict[str, Any] = {
        "description": "mine",
        "arms": {
            "psm_0": {"arm": "psm", **PLACE},
            "lab_0": {"arm": "parts/lab", **PLACE, "position": [0.3 + shift, 0.0, 0.15]},
        },
        "objects": {"table": {"object": "things/table.yaml", "position": [0.0, 0.0, -0.2]}},
    }
    (folder / "mine.yaml").write_text(json.dumps(scene))  # which is YAML, without aliases
    return folder / "mine.yaml"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on such a scene, named by a relative path, whose files are gone since."""
    folder = tmp_path_factory.mktemp("trained")
    make_scene(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "make_env", fake_env)
        patch.chdir(folder)
        out = train.train(replace(SMALL, scene="mine.yaml"), out=Path("run"))
    (folder / "mine.yaml").unlink()
    for name in ("parts", "things"):
        shutil.rmtree(folder / name)
    return folder / out


@pytest.fixture
def run(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same, sent to somebody."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(trained, tmp_path / "runs" / "first"))


@pytest.fixture
def reached(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Labels of the scenes that commands come to, which end there: nothing is compiled."""
    found: list[str] = []

    def stop(**options: Any) -> None:
        found.append(content.scene_label(options["scene"]))
        raise ValueError("far enough")

    monkeypatch.setattr("surgical_marl.envs.batch.BatchedEnv", stop)
    monkeypatch.setattr(train, "make_env", settings_module.make_env)
    return found


def test_a_copy_is_the_same_scene_and_stands_alone(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "project")
    copied = Path(content.copy_content(str(scene), tmp_path / "run"))
    assert copied == tmp_path / "run" / "content" / "mine.yaml"
    before, label = load_scene(scene), content.scene_label(str(scene))
    shutil.rmtree(tmp_path / "project")
    assert content.scene_label(str(copied)) == label
    after = load_scene(copied)
    assert after.name == "mine" and after.agents == before.agents and after.fingerprint == before.fingerprint
    files = {path.relative_to(copied.parent).as_posix() for path in copied.parent.rglob("*") if path.is_file()}
    lab = ("arm.yaml", "psm.urdf", "psm_cadiere_forceps.urdf", "meshes/part.stl")
    assert files == {"mine.yaml", "table/table.yaml", *(f"lab_0/lab/{name}" for name in lab)}, (
        "all that it is made of but what has a name, and nothing else"
    )
    copied.with_name("lab_0").joinpath("lab", "meshes", "part.stl").write_bytes(b"other")
    assert content.scene_label(str(copied)) != label


def test_a_scene_by_its_name_is_not_copied(tmp_path: Path) -> None:
    assert content.copy_content("psm", tmp_path) == "psm" == content.scene_label("psm")
    assert not list(tmp_path.iterdir())


def test_a_scene_without_parts_keeps_its_comments(tmp_path: Path) -> None:
    text = "# measured twice\n" + find("scenes", "psm").read_text()
    (tmp_path / "mine.yaml").write_text(text)
    assert Path(content.copy_content(str(tmp_path / "mine.yaml"), tmp_path / "run")).read_text() == text


COMMANDS: dict[str, Callable[[str], list[str]]] = {
    "eval": lambda run: ["eval", run],
    "crossplay": lambda run: ["crossplay", run],
    "play": lambda run: ["play", "reach", "--policy", run, "--out", "film.gif"],
    "view": lambda run: ["view", "reach", "--policy", run, "--port", "0"],
    "report": lambda run: ["report", run, "--evaluate", "--out", "new.html"],
    "export": lambda run: ["export", "policy", run, "--out", "policy"],
    "resume": lambda run: ["train", "--resume", run, "--iterations", "9"],
}
PLACES: dict[str, tuple[str, str]] = {
    "absolute": ("other", "{run}"),
    "relative": ("runs", "first"),
    "dot": ("runs", "./first"),
    "up": ("other", "../runs/first"),
    "home": ("other", "~/runs/first"),
    "inside": ("runs/first", "."),
    "moved": ("other", "../moved/first"),
}
"""Working folder, and how the run is named there."""


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_from_anywhere(
    command: str, run: Path, reached: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    label = content.scene_label(read_settings(run).scene)
    for folder in ("other", "other/content"):  # files of the same names, which are another scene
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.yaml").write_text(find("scenes", "psm").read_text())
    monkeypatch.setenv("HOME", str(tmp_path))
    for name, (folder, given) in PLACES.items():
        if name == "moved":
            run.parent.rename(tmp_path / "moved")
        monkeypatch.chdir(tmp_path / folder)
        assert main(COMMANDS[command](given.format(run=run))) == 2
        assert reached.pop() == label, name
        assert not reached


def test_the_environments_of_a_run_that_goes_on(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the copy, though the user's file has changed since; a new run on that is another one."""
    monkeypatch.setattr(train, "make_env", fake_env)
    scene = make_scene(tmp_path / "project", shift=0.1)
    last = replace(read_settings(run), iterations=6)
    assert train.train(last, out=run, resume=run) == run
    assert read_checkpoint(run)["iteration"] == 6
    with pytest.raises(ValueError, match=r"has scene 'mine \(content \w+\)', and cannot go on with 'mine \(content"):
        train.train(replace(SMALL, scene=str(scene), iterations=9), out=run, resume=run)
    assert main(["train", "reach", "--scene", str(scene), "--resume", str(run)]) == 2
    branch = train.train(replace(last, iterations=8), out=tmp_path / "branch", resume=run)
    assert read_settings(branch).scene == str(branch / "content" / "mine.yaml")
    other = train.train(replace(SMALL, scene=str(scene)), out=tmp_path / "other")
    with pytest.raises(ValueError, match="has scene"):
        common_settings([str(run), str(other)], {})
    assert len(group([read_run(str(run)), read_run(str(branch))])) > len(group([read_run(str(run))])) == 1
    assert len(group([read_run(str(run)), read_run(str(other))])) == 2, "they are not seeds of one training"
    shutil.copyfile(other / CHECKPOINT, run / CHECKPOINT)
    with pytest.raises(ValueError, match=r"checkpoint.pt is of scene 'mine \(content \w+\)', and not of 'mine \("):
        load_policy(run, FakeEnv(COUNTS, SIZES))  # type: ignore[arg-type]


def test_names_in_a_run_folder_are_relative(run: Path) -> None:
    assert yaml.safe_load((run / CONFIG).read_text())["scene"] == "content/mine.yaml"
    assert read_run(str(run)).scene == content.scene_label(read_settings(run).scene)
    assert f"--scene {run}/content/mine.yaml" in train_command(read_run(str(run)))


def test_a_run_without_a_copy_is_of_the_path_that_it_names(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "project")
    run = make_run(tmp_path / "run", scene=str(scene))
    assert read_settings(run).scene == str(scene)
    shutil.rmtree(tmp_path / "project")
    with pytest.raises(ValueError, match=r"unknown scene '.*', and no such file"):
        load_scene(read_settings(run).scene)


def test_runs_that_reach_out_of_their_folder(run: Path, tmp_path: Path) -> None:
    copied = run / "content" / "mine.yaml"
    whole = copied.read_text()
    outside = make_scene(tmp_path / "outside")
    copied.write_text(whole.replace("table/table.yaml", str(outside.parent / "things" / "table.yaml")))
    with pytest.raises(ValueError, match=r"its object .*table.yaml is not in .*content; copy it there"):
        read_settings(run)
    copied.unlink()
    copied.symlink_to(outside)
    with pytest.raises(ValueError, match=r"mine.yaml cannot be read: it is a link out of its folder"):
        read_settings(run)
    copied.unlink()
    with pytest.raises(ValueError, match=r"mine.yaml cannot be read: No such file"):
        read_settings(run)
    (run / CONFIG).write_text((run / CONFIG).read_text().replace("content/mine.yaml", "content/../../x.yaml"))
    (run.parent / "x.yaml").write_text(whole)
    with pytest.raises(ValueError, match="link out of its folder"):
        read_settings(run)


def test_content_that_is_too_large_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "MOST", 1000)
    with pytest.raises(ValueError, match=r"mine.yaml names arms and objects of 0 MB, .* at most 0.001 MB are copied"):
        train.train(replace(SMALL, scene=str(make_scene(tmp_path))), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_links_in_an_arms_folder_are_not_copied(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "project")
    meshes = tmp_path / "project" / "parts" / "lab" / "meshes"
    (meshes / "part.stl").rename(meshes / "real.stl")
    (meshes / "part.stl").symlink_to("real.stl")
    for _ in range(2):  # what was copied in vain is no copy
        with pytest.raises(ValueError, match=r"parts/lab cannot be copied, replace links in it by files: .*part.stl"):
            content.copy_content(str(scene), tmp_path / "run")


def test_a_folder_keeps_one_scene_of_a_name(tmp_path: Path) -> None:
    first, other = make_scene(tmp_path / "first"), make_scene(tmp_path / "other", shift=0.1)
    takes = tmp_path / "takes"
    assert content.copy_content(str(first), takes) == content.copy_content(str(first), takes)
    with pytest.raises(ValueError, match=r"differs from .*other/mine.yaml.* name another folder"):
        content.copy_content(str(other), takes)


def test_parts_of_a_scene_are_beside_it_and_not_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(tmp_path / "project")
    alone = tmp_path / "mine.yaml"
    shutil.copy(scene, alone)
    monkeypatch.chdir(tmp_path / "project")
    load_scene("mine.yaml")
    with pytest.raises(ValueError, match=r"line \d+: arms.lab_0: unknown arm 'parts/lab', and no such folder"):
        load_scene(alone)


def test_partners_are_compared_by_content(run: Path, tmp_path: Path) -> None:
    own = read_settings(run).scene
    shutil.copytree(run / "content", tmp_path / "copy")
    check_same(str(run), {"scene": own})
    check_same(str(run), {"scene": str(tmp_path / "copy" / "mine.yaml")})
    with pytest.raises(ValueError, match=r"is of scene 'mine \(content \w+\)', not 'mine \(content"):
        check_same(str(run), {"scene": str(make_scene(tmp_path / "project", shift=0.1))})


def test_a_fault_is_found_beside_a_run_that_was_moved(run: Path, tmp_path: Path) -> None:
    settings = read_settings(run)
    env: Any = FakeEnv(COUNTS, SIZES)
    env.engine = type("Engine", (), {"name": "mjx"})
    told = {"seed": 0, "index": 0, "place": "psm_0"}
    write_fault(run / "fault-1.npz", env, settings, {}, {}, **told)
    moved = run.rename(tmp_path / "moved")
    with np.load(moved / "fault-1.npz") as file:
        about = yaml.safe_load(str(file["about"]))
    assert about["environment"]["scene"] == "content/mine.yaml"
    again = made_in(about["environment"], moved / "fault-1.npz")
    assert again.scene == str(moved / "content" / "mine.yaml") and again.max_steps == settings.max_steps


def test_environments_are_made_again_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "mine.yaml").write_text(find("scenes", "psm").read_text())
    (tmp_path / "other" / "mine.yaml").write_text(find("scenes", "ecm").read_text())
    monkeypatch.chdir(tmp_path)
    env = gymnasium.make("surgical_marl/Reach-v0", scene="mine.yaml", engine="mjx", max_steps=3)
    kept, inner = pickle.dumps(env.spec), env.unwrapped
    assert isinstance(inner, SurgicalEnv)
    made = inner.batch.__getstate__()["made"]
    env.close()
    monkeypatch.chdir(tmp_path / "other")
    assert made["scene"] == pickle.loads(kept).kwargs["scene"] == str(tmp_path / "mine.yaml")
    assert load_scene(made["scene"]).agents == ("psm_0",)


@pytest.mark.parametrize("given", ["mine.yaml", "./mine.yaml", "../project/mine.yaml", "~/project/mine.yaml"])
def test_paths_are_absolute_once_they_are_given(given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(tmp_path / "project")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path / "project")
    assert Settings(scene=given).scene == str(scene)
    assert Settings(scene="psm").scene == "psm"
