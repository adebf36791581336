"""What the viewer knows and does, without a browser."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surgical_marl.cli import viewing
from surgical_marl.cli.main import _parser, main
from surgical_marl.content import find
from surgical_marl.robots.rotation import turned
from surgical_marl.runs.settings import Settings
from surgical_marl.view.browser.nodes import Paths
from surgical_marl.view.browser.panel import status
from surgical_marl.view.browser.server import open_server
from surgical_marl.view.hand import Hand
from surgical_marl.view.history import History, summary
from surgical_marl.view.moment import Near, Observer
from surgical_marl.view.session import MOST, Pace, Session
from surgical_marl.view.take import read_take, replay

SETTINGS = Settings(task="reach", scene="bimanual_psm", seed=3, max_steps=60)


@pytest.fixture
def session() -> Iterator[Session]:
    made = Session(SETTINGS, "oracle")
    yield made
    made.close()


def test_the_shortest_line_is_as_long_as_the_engine_says(session: Session) -> None:
    for _ in range(12):
        session.step()
        (near,) = session.moment().nearest
        assert near is not None
        told = [float(session.infos[agent]["min_distance"][0]) for agent in session.env.agents]
        assert near.distance == pytest.approx(min(told), abs=1e-5)
        assert np.linalg.norm(near.ends[1] - near.ends[0]) == pytest.approx(abs(near.distance), abs=1e-9)


def test_tool_tips_are_where_forward_kinematics_has_them(session: Session) -> None:
    session.step()
    for number, (agent, mount) in enumerate(session.env.scene.mounts.items()):
        q = session.env.qpos[0, session.env.scene.qpos_index(agent)].astype(float)
        tip = mount.rotation @ mount.arm.forward_kinematics(q)[:3, 3] + mount.position
        np.testing.assert_allclose(session.moment().tips[0, number], tip, atol=1e-9)


def test_contacts_have_the_force_that_the_engine_says(session: Session) -> None:
    forces = np.zeros((1, len(session.env.scene.pairs)), np.float32)
    forces[0, 5] = 2.5
    ((push,),) = Observer(session.env.scene).look(session.env, forces).pushes
    assert push.force == 2.5
    assert np.linalg.norm(push.direction) == pytest.approx(1.0)


def test_contacts_point_from_one_shape_into_the_other_also_where_they_overlap(session: Session) -> None:
    observer, forces = Observer(session.env.scene), np.zeros((1, len(session.env.scene.pairs)), np.float32)
    forces[0, 5] = 2.5
    for ends in ([[0.0, 0, 0], [0.001, 0, 0]], [[0.001, 0, 0], [0.0, 0, 0]]):  # a gap, and an overlap, of 1 mm
        line = Near(0.001 if ends[1][0] else -0.001, np.array(ends))
        observer._line = lambda *_, line=line: line  # type: ignore[method-assign,misc]
        ((push,),) = observer.look(session.env, forces).pushes
        np.testing.assert_allclose(push.direction, [1.0, 0.0, 0.0])
        np.testing.assert_allclose(push.place, [0.0005, 0.0, 0.0])


def test_fingers_press_on_what_they_hold_from_both_sides() -> None:
    session = Session(Settings(task="needle_pick", scene="psm_needle", seed=0), "oracle")
    assert session.moment().grips == [[]]
    for _ in range(400):
        session.step()
        if session.moment().held.any():
            break
    (one, other) = session.moment().grips[0]
    assert one.push.direction @ other.push.direction < -0.7
    assert {grip.push.force for grip in (one, other)} == set(session.env.grip_forces[0, 0].astype(float))
    needle, tip = session.moment().objects[0, 0], session.moment().tips[0, 0]
    for grip in (one, other):
        assert grip.arm == 0 and grip.push.force > 1.0
        assert np.linalg.norm(grip.push.place - tip) < 0.008
        assert np.linalg.norm(grip.push.place - needle) < 0.02
    session.close()


def test_a_path_passes_through_its_targets() -> None:
    session = Session(Settings(task="follow_path", scene="psm", seed=1, engine="mjx"), "zero")
    paths = Paths(session.env).read(session.env)
    assert paths is not None
    np.testing.assert_allclose(paths[:, 0], session.moment().marks, atol=1e-6)  # at the start, its first point
    assert Paths(session.env).read(session.env) is not paths
    session.close()


def test_a_person_moves_a_tool_tip_and_leaves_the_other_arm_to_its_policy(session: Session) -> None:
    person, other = session.env.agents
    session.set_mover(person, "you")
    hand = session.movers.hands[person]
    before = session.moment().tips[0, 0].copy()
    hand.nudge([0.004, 0.0, 0.010])
    for _ in range(40):
        session.step()
    np.testing.assert_allclose(session.moment().tips[0, 0] - before, [0.004, 0.0, 0.010], atol=5e-4)
    assert session.infos[other]["tip_error"][0] < 0.002


def test_a_person_turns_the_tool_and_opens_the_jaw(session: Session) -> None:
    agent = session.env.agents[0]
    session.set_mover(agent, "you")
    hand = session.movers.hands[agent]
    wanted = turned(np.array([0.0, 0.0, 15.0])) @ hand.tip()[:3, :3]
    hand.reach(hand.tip()[:3, 3], wanted)
    np.testing.assert_allclose(hand.tip()[:3, :3], wanted, atol=1e-3)
    jaw = session.env.scene.qpos_index(agent)[np.flatnonzero(hand.jaw)]
    closed = session.env.qpos[0, jaw].copy()
    hand.jaw_open = True
    for _ in range(15):
        session.step()
    assert (session.env.qpos[0, jaw] > closed + 0.3).all()


def test_a_wish_out_of_reach_stays_within_the_joints_limits(session: Session) -> None:
    agent = session.env.agents[0]
    session.set_mover(agent, "you")
    hand = session.movers.hands[agent]
    hand.reach([3.0, 3.0, 3.0])
    lower, upper = hand.limits
    assert ((hand.q >= lower) & (hand.q <= upper)).all()
    hand.set_joint(0, 100.0)
    assert hand.q[0] == upper[0]


def test_a_new_episode_forgets_what_was_wanted(session: Session) -> None:
    agent = session.env.agents[0]
    session.set_mover(agent, "you")
    session.movers.hands[agent].set_joint(0, 1.0)
    for _ in range(SETTINGS.max_steps or 0):
        session.step()
    np.testing.assert_allclose(session.movers.hands[agent].q, session.env.scene.mounts[agent].arm.home, atol=1e-6)


def test_who_moves_an_arm_stays_if_the_other_can_not(session: Session) -> None:
    agent, other = session.env.agents
    session.set_mover(agent, "frozen")
    with pytest.raises(ValueError, match="'no_such'"):
        session.set_mover(agent, "no_such")
    with pytest.raises(ValueError, match="reach-psm is of scene 'psm'"):
        session.set_mover(agent, "reach-psm")
    with pytest.raises(ValueError, match="unknown agent 'psm_7'"):
        session.set_mover("psm_7", "frozen")
    assert session.movers.who == {agent: "frozen", other: "oracle"}


def test_the_menu_has_what_fits(session: Session) -> None:
    assert {"you", "oracle", "zero", "frozen", "reach-bimanual_psm"} <= set(session.choices)
    assert "reach-psm" not in session.choices


def test_nobody_moves_velocities_by_hand() -> None:
    env: Any = SimpleNamespace(control="velocity")
    with pytest.raises(ValueError, match="control must be cartesian or position, not 'velocity'"):
        Hand(env, "psm_0")


def test_a_reset_plays_the_same_again(session: Session) -> None:
    def tips() -> np.ndarray:
        for _ in range(5):
            session.step()
        return session.trails()[0]

    first = tips()
    assert first.shape == (6, 1, 2, 3)
    session.reset()
    np.testing.assert_array_equal(tips(), first)
    session.reset(4)
    assert session.seed == 4 and (tips()[-1] != first[-1]).any()


def test_too_many_environments_are_refused() -> None:
    with pytest.raises(ValueError, match="1 to 4 environments, not 5"):
        Session(SETTINGS, "zero", num_envs=5)


def test_a_take_leads_to_the_same_numbers(tmp_path: Path) -> None:
    session = Session(SETTINGS, "oracle", num_envs=2, record=tmp_path / "takes")
    agent = session.env.agents[1]
    for step in range(70):  # beyond the end of an episode
        if step == 5:
            session.set_mover(agent, "you")
            session.movers.hands[agent].nudge([0, 0, 0.01])
        session.step()
    session.reset()
    session.step()
    session.close()
    first, second = sorted((tmp_path / "takes").iterdir())
    about, arrays = read_take(first)
    assert about["movers"][-1] == [5, agent, "you"]
    assert arrays["qpos"].shape[:2] == (70, 2) and arrays["ended"].any()
    assert replay(first)[:3] == (70, None, 0.0)
    assert replay(second).steps == 1

    spoilt = {**arrays, f"actions/{agent}": arrays[f"actions/{agent}"].copy()}
    spoilt[f"actions/{agent}"][33] *= -1
    np.savez(tmp_path / "spoilt.npz", about=json.dumps(about), **spoilt)
    found = replay(tmp_path / "spoilt.npz")
    assert found.differs_at == 33 and found.largest > 0


@pytest.mark.slow
def test_a_take_of_a_needle_in_tissue_leads_to_the_same_numbers(tmp_path: Path) -> None:
    session = Session(Settings(task="needle_drive", scene="psm_suture", seed=1), "oracle", record=tmp_path)
    entered = False
    for _ in range(150):
        session.step()
        entered |= bool(session.infos["psm_0"]["stage_entered"][0])
    session.close()
    assert entered and replay(tmp_path / "take-0001.npz").differs_at is None


def test_a_take_keeps_a_scene_of_the_users_own(tmp_path: Path) -> None:
    """The program is that of the test above: the scene has the name and the content of one that ships."""
    own, takes = tmp_path / "bimanual_psm.yaml", tmp_path / "takes"
    shutil.copy(find("scenes", "bimanual_psm"), own)
    settings = dataclasses.replace(SETTINGS, scene=str(own))
    session = Session(settings, "zero", num_envs=2, record=takes)
    session.step()
    session.close()
    own.write_text(find("scenes", "psm").read_text())
    moved = takes.rename(tmp_path / "moved")
    assert read_take(moved / "take-0001.npz")[0]["environment"]["scene"] == "content/bimanual_psm.yaml"
    assert replay(moved / "take-0001.npz")[:3] == (1, None, 0.0)
    with pytest.raises(ValueError, match=r"bimanual_psm.yaml differs from .*: name another folder"):
        Session(settings, "zero", num_envs=2, record=moved)


def test_a_file_that_is_no_take_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no")
    np.savez(tmp_path / "other.npz", qpos=np.zeros(3))
    np.savez(tmp_path / "old.npz", qpos=np.zeros(3), about='{"layout": 0, "environment": {}, "engine": "fused", '
             '"device": "cpu", "num_envs": 1, "versions": {}}')  # fmt: skip
    options = json.dumps({"task": "reach", "scene": "psm"})
    rest = '"engine": "fused", "device": "cpu", "num_envs": 1, "versions": {}}'
    np.savez(tmp_path / "part.npz", qpos=np.zeros(3), about=f'{{"layout": 1, "environment": {options}, {rest}')
    np.savez(tmp_path / "new.npz", qpos=np.zeros(3), about=f'{{"layout": 1, "environment": {{"x": 1}}, {rest}')
    refused = {"text": "not a take", "other": "not a take", "old": "layout 0", "part": "lacks actions/psm_0",
               "new": "does not know"}  # fmt: skip
    for name, sentence in refused.items():
        with pytest.raises(ValueError, match=sentence):
            replay(tmp_path / f"{name}.npz")


def test_time_runs_at_its_speed() -> None:
    pace = Pace(0.02)
    assert pace.due(10.0) == 0
    assert sum(pace.due(10.0 + k / 30) for k in range(1, 31)) in (49, 50)
    pace.speed = 0.1
    assert sum(pace.due(11.0 + k / 30) for k in range(1, 31)) in (4, 5, 6)
    pace.paused = True
    assert pace.due(20.0) == 0
    pace.step_once()
    assert [pace.due(20.1), pace.due(20.2)] == [1, 0]
    pace.paused, pace.speed = False, 1.0
    assert pace.due(99.0) == MOST


def test_history_keeps_the_last_steps_in_order() -> None:
    history = History(["a"], dt=0.5, seconds=2.0)
    for value in range(6):
        info = {"tip_error": np.array([value / 1000]), "min_distance": np.array([np.inf]), "success": np.array([True])}
        history.add({"a": info}, {"a": np.array([-value])})
    np.testing.assert_array_equal(history.time, [-1.5, -1.0, -0.5, 0.0])
    np.testing.assert_allclose(history.error("a")[1], [2, 3, 4, 5])
    np.testing.assert_array_equal(history.read("a", "reward"), [-2, -3, -4, -5])
    assert np.isnan(history.read("a", "min_distance")).all()
    assert "success" not in history.names("a")


def test_a_summary_says_error_stages_and_faults() -> None:
    info = {"tip_error": [0.00123], "stage_grasped": [1], "stage_lifted": [0], "collision": [True], "success": [False]}
    assert summary(info) == ["1.23 mm", "stages grasped", "collision"]
    assert summary({"contact_overflow": [2.0, 0.0]}) == ["2 contacts left out"]
    assert summary({"contact_overflow": [2.0, 0.0]}, 1) == []


def test_names_are_escaped(session: Session) -> None:
    session.step()
    session.env.scene = dataclasses.replace(session.env.scene, name="<img src=x onerror=alert(1)>")
    assert "<img" not in status(session)
    assert "&lt;img" in status(session)


def test_without_viser_a_sentence_says_what_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(VIEW) == 2
    assert (
        capsys.readouterr().err
        == "surgical-marl: the viewer needs the package viser: pip install 'surgical-marl[view]'\n"
    )
    with pytest.raises(ValueError, match="pip install"):
        open_server(0)


VIEW = ["view", "reach", "--scene", "psm"]
PLAY = ["play", "reach", "--scene", "psm", "--out", "f.gif"]


@pytest.mark.parametrize(
    "argv, words",
    [
        (["view"], ["TASK"]),
        (["view", "reech", "--scene", "psm"], ["'reech'", "did you mean 'reach'"]),
        (["view", "reach"], ["--scene", "bimanual_psm"]),
        (["view", "reach", "--scene", "psmm"], ["'psmm'", "did you mean 'psm'"]),
        ([*VIEW, "--policy", "nobody"], ["'nobody'", "oracle"]),
        ([*VIEW, "--policy", "."], ["config.yaml"]),
        ([*VIEW, "--policy", "reach-star"], ["'star'", "`surgical-marl view reach --scene star --policy reach-star`"]),
        ([*VIEW, "--policy", "track-psm"], ["'track'", "`surgical-marl view track --scene psm --policy track-psm`"]),
        ([*VIEW, "--num-envs", "5"], ["--num-envs", "from 1 to 4"]),
        ([*VIEW, "--port", "70000"], ["--port", "'70000'"]),
        (["replay", "none.npz"], ["none.npz"]),
        (["replay", "pyproject.toml"], ["pyproject.toml", "not a take"]),
        (["play", "reach", "--scene", "psm"], ["--out"]),
        (["play", "reach", "--scene", "psm", "--out", "film.avi"], [".mp4, .gif or .webp"]),
        ([*PLAY, "--size", "9"], ["640x480", "'9'"]),
        ([*PLAY, "--size", "9x99"], ["16 to 4096", "9x99"]),
        ([*PLAY, "--grid", "4"], ["4x4", "'4'"]),
        ([*PLAY, "--grid", "9x1"], ["1 to 8", "9x1"]),
        ([*PLAY, "--grid", "4x8", "--size", "4096x4096"], ["32768x16384", "8192 pixels"]),
        ([*PLAY, "--policy", "oracle", "--control", "torque"], ["oracle", "position, not 'torque'"]),
        ([*PLAY, "--camera", "0,0,-1"], ["distance", "'0,0,-1'"]),
        ([*PLAY, "--slow", "0"], ["0.1 to 100", "not 0"]),
        ([*PLAY, "--slow", "much"], ["'much'"]),
        ([*PLAY, "--camera", "side"], ["'side'", "overview"]),
    ],
)
def test_bad_input(argv: list[str], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 2
    out, err = capsys.readouterr()
    progress = "surgical-marl: compil", "surgical-marl: preparing"  # said where that takes a while
    said = [line for line in err.splitlines() if not line.startswith(progress)]
    assert not out and len(said) == 1
    for word in words:
        assert word in said[0]


@pytest.mark.parametrize("command", ["view", "play"])
def test_a_run_before_its_first_checkpoint_is_bad_input(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(find("policies", "reach-psm") / "config.yaml", tmp_path)
    out = ["--out", str(tmp_path / "film.gif")] if command == "play" else []
    assert main([command, "reach", "--policy", str(tmp_path), *out]) == 2
    assert f"{tmp_path} has no checkpoint.pt yet" in capsys.readouterr().err


def test_a_policy_brings_its_scene() -> None:
    arguments = _parser().parse_args(["play", "reach", "--policy", "reach-star", "--out", "film.gif"])
    settings, who = viewing.settings_of(arguments)
    assert (settings.task, settings.scene, who) == ("reach", "star", "reach-star")
