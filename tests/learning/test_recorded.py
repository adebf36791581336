"""Exported data sets as demonstrations: the observations and actions that they were made of, and what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from surgical_marl.cli.main import main
from surgical_marl.data.export import export
from surgical_marl.data.reading import read_set
from surgical_marl.data.recording import Recording, played
from surgical_marl.data.request import Request
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.env import Env
from surgical_marl.learning.recorded import Recorded, check_recorded
from surgical_marl.policies.layout import Layout
from surgical_marl.policies.policy import load_policy
from surgical_marl.runs.settings import ImitationSettings, NetworkSettings, Settings, make_env
from tests.helpers import ROOT

SETTINGS = Settings(
    task="reach", scene="psm", seed=3, max_steps=100, device="cpu", num_envs=64, iterations=2, steps_per_iteration=4,
    network=NetworkSettings(hidden=(8,)),
)  # fmt: skip
ARM, COUNT = "psm_0", 2


@pytest.fixture(scope="module")
def env() -> Iterator[BatchedEnv]:
    made = make_env(SETTINGS, COUNT, "numpy")
    yield made
    made.close()


@pytest.fixture(scope="module")
def recordings(env: BatchedEnv) -> list[Recording]:
    return list(islice(played(env, load_policy("oracle", env), SETTINGS.seed), COUNT))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("sets") / "joint")


def exported(out: Path, form: str = "joint", rate: int = 50, name: str = "lerobot") -> Path:
    return export(Request(name, settings=SETTINGS, episodes=COUNT, rate=rate, actions=form), out)


def of(folder: Path, **more: object) -> Settings:
    return replace(SETTINGS, imitation=ImitationSettings(data=str(folder), steps=5, **more))  # type: ignore[arg-type]


@pytest.mark.parametrize("form, rate, name", [("joint", 50, "lerobot"), ("env", 50, "lerobot"),
                                              ("relative", 50, "lerobot-2.1"), ("joint", 25, "lerobot")])  # fmt: skip
def test_pairs_are_what_was_seen_and_done(
    env: BatchedEnv, recordings: list[Recording], tmp_path: Path, form: str, rate: int, name: str
) -> None:
    found = Recorded(of(exported(tmp_path / "set", form, rate, name)), Layout(env), env, "cpu")
    rows = [own.every(50 // rate) for own in recordings]
    seen = np.concatenate([own.seen[f"observations/{ARM}"][:-1] for own in rows])
    done = np.concatenate([own.done[f"actions/{ARM}"] for own in rows])
    shown = found.shown["psm"][:, 0].numpy()
    places = [int(np.flatnonzero((seen == row).all(1))[0]) for row in shown]
    assert len(shown) <= len(seen) - (rate == 50) and np.all(np.diff(places) > 0)
    left = np.setdiff1d(np.arange(len(seen)), places)
    assert np.abs(done[left, :6]).max(initial=0.0) < 1e-2  # it waited there
    moves = np.abs(done[places, :6]).max(1) > 0.1
    assert moves.sum() > 20
    off = np.abs(found.actions.numpy()[moves] - done[np.array(places)[moves]])
    # a target that leads its joint as far as it may moves less than it was told
    assert off[:, 6].max() == 0 and np.quantile(off, 0.9) < (1e-3 if rate == 50 else 0.1)


def test_a_run_imitates_a_data_set(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = ["num_envs=64", "iterations=1", "steps_per_iteration=4", "max_steps=100", "network.hidden=[8]"]
    command = ["train", "reach", "--scene", "psm", "--device", "cpu", *settings, f"imitation.data={folder}"]
    assert main([*command, "imitation.steps=20", "imitation.rounds=1", "--out", str(tmp_path / "run")]) == 2
    assert "imitation.rounds must be 0 with imitation.data, not 1" in capsys.readouterr().err
    from surgical_marl.learning.train import make_training
    from surgical_marl.runs.settings import load_config

    trainer = make_training(load_config("reach", "psm", [*settings, "device=cpu", f"imitation.data={folder}",
                                                         "imitation.steps=20", "imitation.weight=0.1"]))  # fmt: skip
    before = trainer.algorithm.imitation
    assert before is not None and trainer._demonstrations is None  # the oracle plays nothing
    assert trainer.imitate() and not trainer.imitating
    trainer.iterate()


def edited(folder: Path, out: Path, name: str, **change: object) -> Path:
    shutil.copytree(folder, out)
    about = json.loads((out / name).read_text())
    (out / name).write_text(json.dumps({**about, **change}))
    return out


def test_what_is_no_whole_set_of_this_task_is_refused(env: BatchedEnv, folder: Path, tmp_path: Path) -> None:
    def refused(words: str, settings: Settings) -> None:
        with pytest.raises(ValueError, match=words):
            Recorded(settings, Layout(env), env, "cpu")

    about = json.loads((folder / "export.json").read_text())["environment"]
    refused(r"no data set that was exported in the format lerobot: it lacks export.json", of(tmp_path))
    other = edited(folder, tmp_path / "a", "export.json", environment={**about, "scene": "ecm"})
    refused(r"imitation.data \S+ is of scene 'ecm', not 'psm'", of(other))
    refused(
        "is not whole: it has 200 of 300 rows", of(edited(folder, tmp_path / "b", "meta/info.json", total_frames=300))
    )
    refused("at rate 7: ", of(edited(folder, tmp_path / "c", "export.json", rate=7)))
    refused(
        r"has the actions psm_0/yaw, .* are psm_0/x",
        of(edited(folder, tmp_path / "d", "export.json", actions="cartesian")),
    )
    broken = edited(folder, tmp_path / "e", "export.json")
    next((broken / "data").rglob("*.parquet")).write_bytes(b"PAR1")
    refused("is damaged, or was not exported by this program", of(broken))
    with pytest.raises(ValueError, match="control_frame 'base' and no messages"):
        check_recorded(replace(of(folder), control="cartesian", control_frame="camera"))


def test_the_set_that_ships_is_of_this_version() -> None:
    """Its command is in `demonstrations/README.md`: export it anew where this fails."""
    table = read_set(ROOT / "demonstrations/needle_pick", ("action", "observation.environment_state", "next.success"))
    made = Env(**{**table.about["environment"], "goals": "training"})
    assert table.columns["observation.environment_state"].shape[1:] == made.state_space.shape
    arm = made.scene.mounts[ARM].arm
    assert table.names == tuple(f"{ARM}/{joint.name}" for joint in arm.actuated)
    assert ((table.columns["action"] >= arm.lower - 1e-5) & (table.columns["action"] <= arm.upper + 1e-5)).all()
    assert table.columns["next.success"].sum() >= table.about["episodes"] == 50
