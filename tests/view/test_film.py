"""Films of policies: what is in a frame, and how many there are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

from surgical_marl.cli.main import main
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.view.captions import GREEN, GROUND, Caption, Captions, colour_of, panel, written
from surgical_marl.view.film import Look, camera_of, film, pictures, wall
from surgical_marl.view.movers import Movers, first
from surgical_marl.view.render import View


def test_words_are_in_the_upper_left_corner_alone() -> None:
    plain = np.full((240, 320, 3), 200, np.uint8)
    changed = (written(plain, [Caption("1.00 s"), Caption("psm_0  0.05 mm")]) != plain).any(-1)
    assert changed[:120, :160].any()
    assert not changed[120:].any() and not changed[:, 200:].any()
    assert written(plain, []) is plain


def test_long_lines_are_wrapped_at_commas() -> None:
    plain = np.full((240, 320, 3), 200, np.uint8)
    words = Caption(", ".join(["psm_0  0.05 mm", *(f"stage_{number}" for number in range(12))]))
    changed = (written(plain, [words]) != plain).any(-1)
    rows, columns = np.flatnonzero(changed.any(1)), np.flatnonzero(changed.any(0))
    assert columns[-1] < 319 and columns[-1] > 200
    one = np.flatnonzero((written(plain, [Caption("psm_0")]) != plain).any((1, 2)))
    assert len(rows) > 1.4 * len(one)


def test_words_of_a_panel_have_their_colours() -> None:
    captions = [Caption("psm_0", colour_of(0)), Caption("psm_1", colour_of(1))]
    found = panel(captions, 120, 90, 300).astype(int)
    assert found.shape == (90, 120, 3) and (found[-1] == GROUND).all()
    for _, colour in captions:
        assert (np.abs(found - colour).max(-1) < 30).any()


def test_stages_stay_reached_until_an_episode_ends() -> None:
    task = SimpleNamespace(stages=("lifted", "placed"))
    steps, agents = np.array([7, 7]), ("psm_0", "psm_1")
    thread = SimpleNamespace(reports=("tension", "swept"))
    scene = SimpleNamespace(systems={"thread": thread, "other thread": thread})
    env: Any = SimpleNamespace(
        num_envs=2, agents=agents, steps=steps, control_dt=0.02, task_name="peg_transfer", task=task, scene=scene
    )
    captions = Captions(env)

    def texts(index: int, lifted: list[bool], success: bool = False, dropped: bool = False) -> list[str]:
        own = {"stage_lifted": np.array(lifted), "stage_placed": np.array([False, False])}
        own |= {"tension": np.array([0.5, 0.25])}
        own |= {"success": np.array([success] * 2), "drop": np.array([dropped] * 2)}
        return [text for text, _ in captions.read(dict.fromkeys(env.agents, own), index)]

    start = ["0.14 s  peg_transfer", "psm_0  ", "psm_1  ", "tension  0.50 N", "- lifted", "- placed", ""]
    assert texts(0, [False, False]) == start
    assert texts(0, [True, False])[4:] == ["+ lifted", "- placed", ""]
    assert texts(0, [False, False], success=True)[4:] == ["+ lifted", "- placed", "success"]
    assert texts(1, [False, False], dropped=True)[1:5] == ["psm_0  drop", "psm_1  drop", "tension  0.25 N", "- lifted"]
    captions.forget(np.array([True, False]))
    assert texts(0, [False, False]) == start


def test_no_line_of_a_panel_is_cut_off() -> None:
    lines = [Caption("psm_0")] * 11 + [Caption("success", GREEN)]
    found = panel(lines, 135, 135, 270).astype(int)
    green = np.flatnonzero((np.abs(found - GREEN).max(-1) < 60).any(1))
    assert len(green) > 3 and green[-1] < 134


def test_a_wall_has_its_pictures_row_by_row() -> None:
    tiles = [np.full((2, 3, 3), value, np.uint8) for value in range(6)]
    found = wall(tiles, columns=3)
    assert found.shape == (4, 9, 3)
    assert found[::2, ::3, 0].tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgical_marl.view.film.WIDTH", 120)
    monkeypatch.setattr("surgical_marl.view.film.HEIGHT", 90)


@pytest.mark.usefixtures("small")
def test_a_film_is_as_long_as_its_episode_and_slow_ones_are_longer(tmp_path: Path) -> None:
    env = BatchedEnv("reach", "psm", device="cpu", max_steps=4)
    movers = Movers(env, "oracle")
    frames = imageio.imread(film(env, movers, tmp_path / "film.gif", Look()))
    assert frames.shape == (2, 90, 120, 3)  # 25 a second, of 50 steps a second
    slow = film(env, movers, tmp_path / "slow.gif", Look(slow=4.0, camera=View(distance=0.5)))
    assert len(imageio.imread(slow)) == 4
    assert imageio.immeta(slow)["duration"] == 80  # ms: 4 steps of 20 ms take 320 ms
    assert (frames[0] != frames[1]).any()


def test_the_last_picture_of_a_film_is_of_the_last_step() -> None:
    short, long = (BatchedEnv("reach", "psm", device="cpu", max_steps=steps) for steps in (3, 8))
    look = Look(words=False, size=(120, 90))
    last = list(pictures(short, Movers(short, "oracle"), look))[-1]
    np.testing.assert_array_equal(last, next(pictures(long, Movers(long, "oracle"), replace(look, fps=50 / 3))))
    assert short.autoreset and long.autoreset


def test_a_film_of_a_task_with_stages_goes_on_for_a_little_after_success(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgical_marl.view.film.AFTER", 0.1)
    env = BatchedEnv("reach", "psm", device="cpu", max_steps=50)
    look = Look(size=(64, 48), fps=50.0)
    assert len(list(pictures(env, Movers(env, "oracle"), look))) == 50
    monkeypatch.setattr(type(env.task), "stages", ("there",))
    shots = list(pictures(env, Movers(env, "oracle"), look, episodes=2))
    assert 2 * 6 < len(shots) < 2 * 50


def test_a_film_that_becomes_a_gif_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("surgical_marl.view.video.ffmpeg_runs", lambda: False)
    asked = [
        "play",
        "reach",
        "--scene",
        "psm",
        "--policy",
        "zero",
        "--size",
        "160x60",
        "--out",
        str(tmp_path / "a.mp4"),
    ]
    assert main(asked) == 0
    found = capsys.readouterr()
    assert found.out == f"{tmp_path / 'a.gif'}\n" and len(imageio.imread(tmp_path / "a.gif")) > 10
    assert "written as a gif, because ffmpeg can't run here" in found.err


@pytest.mark.usefixtures("small")
def test_an_endoscope_is_beside_and_a_grid_has_every_environment(tmp_path: Path) -> None:
    env = BatchedEnv("reach", "ecm", device="cpu", max_steps=2)
    frames = imageio.imread(film(env, Movers(env, "zero"), tmp_path / "scope.gif", Look()), index=None)
    assert frames.shape[-3:-1] == (90, 120)
    large = film(env, Movers(env, "zero"), tmp_path / "large.webp", Look(size=(64, 32)))
    assert imageio.imread(large).shape == (32, 64, 3)
    many = BatchedEnv("reach", "psm", num_envs=8, device="cpu", max_steps=2)
    look = Look(grid=(1, 8))
    picture = imageio.imread(film(many, Movers(many, "zero"), tmp_path / "grid.gif", look), index=None)
    width, height = look.tile
    assert picture.shape[-3:-1] == (height, 8 * width)


def test_cameras_have_names_or_angles() -> None:
    env = BatchedEnv("reach", "psm", device="cpu")
    assert camera_of(None, env) is None
    assert camera_of("overview", env) == "overview"
    free = camera_of("90,-20,0.4", env)
    assert isinstance(free, View) and (free.azimuth, free.elevation, free.distance) == (90, -20, 0.4)
    for far in ("1,2,nan", "1,2,-5", "1,2,0", "1,inf,1", "1e300,2,1e300"):
        with pytest.raises(ValueError, match=f"distance from 0.001 to 100 m, not '{far}'"):
            camera_of(far, env)
    with pytest.raises(ValueError, match="unknown camera 'left'"):
        camera_of("left", env)


def test_the_policy_that_ships_comes_first() -> None:
    # environments of the engine mjx compile nothing before they are reset
    assert first(BatchedEnv("reach", "psm", engine="mjx")) == "reach-psm"
    assert first(BatchedEnv("peg_transfer", "bimanual_psm_pegs", engine="mjx")) == "peg_transfer-bimanual_psm_pegs"
    assert first(BatchedEnv("reach", "psm_needle", engine="mjx")) == "oracle"
