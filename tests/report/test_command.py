"""The command `report`: where it writes, what it refuses, and that its commands repeat a run."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from surgical_marl.cli.main import main
from surgical_marl.content import find, list_policies
from surgical_marl.report import command
from surgical_marl.report.page import train_command
from surgical_marl.report.run import read_run
from surgical_marl.runs.folder import CONFIG, read_settings
from surgical_marl.runs.settings import Settings, load_config
from tests.helpers.run_folders import evaluate, make_run


def test_a_report_goes_to_the_run_or_where_it_is_wanted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "a", rows=0)
    make_run(tmp_path / "b", seed=1, rows=0)
    assert main(["report", "a"]) == 0 and capsys.readouterr().out == f"{tmp_path}/a/report.html\n"
    assert main(["report", "a", "b"]) == 0 and (tmp_path / "report.html").is_file()
    assert main(["report", "a", "b", "--out", "both.html"]) == 0 and main(["report", "a", "--out", "both.html"]) == 0
    assert (tmp_path / "both.html").read_text().startswith("<!DOCTYPE html>")
    assert not list(tmp_path.glob(".*.tmp"))


@pytest.mark.parametrize(
    "argv, words",
    [
        ([], ["RUN"]),
        (["no_such_run"], ["unknown run or policy 'no_such_run'"]),
        (["file"], ["file is a file, not a run"]),
        (["."], [". is not a run folder", CONFIG]),
        (["cut"], ["has no scene", "cut short"]),
        (["broken"], ["cannot be read"]),
        (["run", "pick"], ["pick is of task 'needle_pick'", "run of 'reach'", "one task"]),
        (["run", "./run"], ["'./run' is named twice"]),
        (["run", "--out", "page.pdf"], ["page.pdf", ".html"]),
        (["run", "--out", "no/such/page.html"], ["no/such/page.html", "folder that exists"]),
        (["run", "--out", "mine.html"], ["mine.html exists and is not a report", "--out"]),
        (["run", "--out", "folder.html"], ["folder.html"]),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing_behind(
    argv: list[str],
    words: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "run")
    make_run(tmp_path / "pick", task="needle_pick", scene="psm_needle")
    for name, text in (("cut", "task: reach\n"), ("broken", "task: [")):
        (tmp_path / name).mkdir()
        (tmp_path / name / CONFIG).write_text(text)
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "mine.html").write_text("<p>my own page")
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    assert main(["report", *argv]) == 2
    out, err = capsys.readouterr()
    assert not out and err.startswith("surgical-marl: ") and err.count("\n") == 1
    assert not [word for word in words if word not in err], err
    assert sorted(tmp_path.rglob("*")) == before and (tmp_path / "mine.html").read_text() == "<p>my own page"


def test_only_what_has_a_policy_and_no_episodes_is_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []
    monkeypatch.setattr(command, "judge", asked.append)
    monkeypatch.setattr(command, "render", lambda runs: " ".join(note for run in runs for note in run.notes))
    new, done, bare = (make_run(tmp_path / name, rows=0) for name in ("new", "done", "bare"))
    evaluate(done)
    (bare / "checkpoint.pt").unlink()
    path = command.report([str(new), str(done), str(bare)], tmp_path / "all.html", evaluate=True)
    assert asked == [new] and "This run has no checkpoint.pt" in path.read_text()


@pytest.mark.parametrize("policy", list_policies())
def test_the_command_repeats_the_settings(policy: str) -> None:
    run, wanted = read_run(policy), read_settings(find("policies", policy))
    _, train, task, *rest = shlex.split(train_command(run))
    flags = dict(zip(rest[:4:2], rest[1:4:2], strict=True))
    assert train == "train" and flags.keys() == {"--scene", "--seed"}
    for device in ("cpu", "cuda"):
        found = load_config(task, flags["--scene"], [f"device={device}", f"seed={flags['--seed']}", *rest[4:]])
        # a term that the run did not know has no weight
        since = {name: 0.0 for name in found.reward.keys() - wanted.reward.keys()}
        assert found == replace(wanted, device=device, reward={**wanted.reward, **since})


def test_the_command_names_what_has_no_default_here(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", task="track", scene="psm", observe={"psm_0": ["qpos"]}, device="cpu", max_steps=7)
    text = (run / CONFIG).read_text()
    words = shlex.split(train_command(read_run(run)))
    assert {"observe.psm_0=[qpos]", "device=cpu", "max_steps=7"} <= {*words}
    (run / CONFIG).write_text(text.replace("task: track", "task: my task") + "unheard_of: 1.0e-05\n")
    words = shlex.split(train_command(read_run(run)))
    assert words[:3] == ["surgical-marl", "train", "my task"] and "unheard_of=1.0e-05" in words


def test_a_folder_that_is_called_like_a_policy_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "reach-psm", rows=0)
    assert "no iteration is done yet" in command.report_run(Path("reach-psm")).read_text()
    assert (tmp_path / "reach-psm" / "report.html").is_file()


def test_a_training_that_is_stopped_leaves_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(settings: Settings, *, out: Path, resume: Path | None) -> Path:
        make_run(out, rows=2)
        raise KeyboardInterrupt

    monkeypatch.setattr("surgical_marl.learning.train.train", stopped)
    assert main(["train", "reach", "--scene", "psm", "--out", str(tmp_path / "run")]) == 130
    assert "2 of 6 iterations are done" in (tmp_path / "run" / "report.html").read_text()
