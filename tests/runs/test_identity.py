"""Networks act in the run that they were trained in, and a run has a folder of its own."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from surgical_marl.cli.main import main
from surgical_marl.content import find
from surgical_marl.learning import train
from surgical_marl.policies.actor import load_actor
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.weights import write_weights
from surgical_marl.runs.checkpoint import read_checkpoint, write_checkpoint
from surgical_marl.runs.folder import CONFIG, check_own, find_run
from surgical_marl.runs.identity import identity
from tests.helpers.fake_env import FakeEnv
from tests.helpers.run_folders import make_run
from tests.helpers.runs import COUNTS, SIZES, SMALL, fake_env


@pytest.mark.parametrize(
    "setting, value",
    [("task", "track"), ("scene", "ecm"), ("algo", "ippo"), ("seed", 7), ("control", "torque"), ("messages", 2)],
)
def test_a_checkpoint_of_another_run_is_no_policy_of_this_one(
    setting: str, value: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "make_env", fake_env)
    run = train.train(replace(SMALL, iterations=1, max_steps=9, train_max_steps=5), out=tmp_path / "run")
    env: Any = FakeEnv(COUNTS, SIZES)
    load_policy(run, env)
    checkpoint = read_checkpoint(run)
    write_checkpoint(run, {**checkpoint, "of": {**checkpoint["of"], setting: value}})
    for read in (lambda: load_policy(run, env), lambda: train.train(replace(SMALL, max_steps=9), out=run, resume=run)):
        with pytest.raises(ValueError, match=rf"checkpoint.pt is of {setting} {value!r}, and not of|train_max_steps"):
            read()
    write_checkpoint(run, {name: value for name, value in checkpoint.items() if name != "of"})
    load_policy(run, env)  # of an older version


def test_weights_of_another_run_are_no_policy_of_this_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "make_env", fake_env)
    env: Any = FakeEnv(COUNTS, SIZES)
    settings = replace(SMALL, iterations=1, max_steps=9, train_max_steps=5)
    run, policy = train.train(settings, out=tmp_path / "run"), tmp_path / "policy"
    actor, _ = load_actor(run, env)
    policy.mkdir()
    shutil.copyfile(run / CONFIG, policy / CONFIG)
    for own in (None, settings):
        write_weights(policy, actor, None if own is None else identity(own.in_training()))
        load_policy(policy, env)
    write_weights(policy, actor, identity(replace(settings, control="torque").in_training()))
    with pytest.raises(ValueError, match="safetensors is of control 'torque', and not of 'position' as the run"):
        load_policy(policy, env)


def test_a_checkpoint_of_an_older_version_knows_the_path_of_its_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "make_env", fake_env)
    scene = tmp_path / "mine.yaml"
    scene.write_text(find("scenes", "psm").read_text())
    run = train.train(replace(SMALL, scene=str(scene), iterations=1), out=tmp_path / "run")
    checkpoint = read_checkpoint(run)
    for told, good in (("mine.yaml", True), ("/elsewhere/mine.yaml", True), ("/elsewhere/yours.yaml", False)):
        write_checkpoint(run, {**checkpoint, "of": {"task": "reach", "scene": told, "algo": "mappo"}})
        if good:
            read_checkpoint(run)
        else:
            with pytest.raises(ValueError, match="is of scene 'yours', and not of 'mine'"):
                read_checkpoint(run)


def test_a_policy_by_its_name_goes_before_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_run(tmp_path / "reach-psm")
    monkeypatch.chdir(tmp_path)
    assert find_run("reach-psm") == find("policies", "reach-psm")
    assert find_run("./reach-psm").resolve() == tmp_path / "reach-psm"


@pytest.mark.parametrize(
    "names, good",
    [
        ([], True),
        (["train.lock", ".config.yaml.7.tmp"], True),
        (["thesis.tex"], False),
        (["config.yaml.old"], False),
        ([".git"], False),
        (["content"], False),
    ],
)
def test_a_new_run_does_not_mix_with_other_files(
    names: list[str], good: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train, "make_env", fake_env)
    out = tmp_path / "out"
    out.mkdir()
    for name in names:
        (out / name).write_text("mine")
    if good:
        assert train.train(replace(SMALL, iterations=1), out=out) == out
        return
    for flags in (["--out", str(out)], ["--resume", str(out)]):
        assert main(["train", "reach", "--scene", "psm", *flags]) == 2
        assert f"{out} is not empty, it holds {names[0]}: name a new or an empty folder" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == names and (out / names[0]).read_text() == "mine"


def test_a_folder_of_takes_takes_more(tmp_path: Path) -> None:
    check_own(tmp_path / "missing", "take-*.npz")
    (tmp_path / "take-0001.npz").write_bytes(b"")
    check_own(tmp_path, "take-*.npz", "content")
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(ValueError, match=r"is not empty, it holds notes.txt"):
        check_own(tmp_path, "take-*.npz", "content")
