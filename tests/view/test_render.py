"""Pictures and videos: they show what geometry says they must."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import imageio.v3 as imageio
import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.policies.policy import zero_policy
from surgical_marl.view import record, video
from surgical_marl.view.render import Renderer, View
from tests.helpers.fake_env import FakeEnv

SIZE = 120
FRONT = View(lookat=(0, 0, 0), distance=1.0, azimuth=90, elevation=0, fovy=40)
BALL = "<geom size='.1' rgba='1 0 0 1'/>"
Image = NDArray[np.uint8]


def draw(world: str, above: str = "", **options: object) -> Image:
    xml = f"<mujoco>{above}<worldbody>{world}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Renderer(model, SIZE, SIZE).render(data, **{"camera": FRONT, **options})  # type: ignore[arg-type]


def is_red(image: Image) -> NDArray[np.bool_]:
    return image[..., 0] > 1.5 * image[..., 2].astype(float)


def pixel_radius(radius: float, distance: float) -> float:
    return SIZE / 2 * np.tan(np.arcsin(radius / distance)) / np.tan(np.deg2rad(FRONT.fovy / 2))


def test_a_ball_covers_the_pixels_that_geometry_predicts() -> None:
    red = is_red(draw(BALL))
    rows, columns = np.argwhere(red).T
    assert red.sum() == pytest.approx(np.pi * pixel_radius(0.1, 1.0) ** 2, rel=0.05)
    assert rows.mean() == pytest.approx(SIZE / 2 - 0.5, abs=0.5)
    assert columns.mean() == pytest.approx(SIZE / 2 - 0.5, abs=0.5)


@pytest.mark.parametrize(
    "position, row, column",
    [("0.2 0 0", 0, 1), ("-0.2 0 0", 0, -1), ("0 0 0.2", -1, 0), ("0 0 -0.2", 1, 0)],
)
def test_right_is_right_and_up_is_up(position: str, row: int, column: int) -> None:
    middle = np.argwhere(is_red(draw(BALL.replace("<geom", f"<geom pos='{position}'")))).mean(axis=0)
    assert np.sign(np.round(middle - SIZE / 2, -1)).tolist() == [row, column]


def test_the_side_towards_the_lamp_is_brighter() -> None:
    image = draw(BALL).astype(float).sum(axis=2)
    rows, columns = np.argwhere(is_red(draw(BALL))).T - SIZE // 2
    bright = image[rows + SIZE // 2, columns + SIZE // 2]
    assert bright[rows < -5].mean() > 1.2 * bright[rows > 5].mean()
    assert bright[columns < -5].mean() > 1.05 * bright[columns > 5].mean()


def test_a_block_throws_a_shadow_on_the_floor() -> None:
    floor = "<geom type='plane' size='0 0 1' pos='0 0 -.2' rgba='.8 .8 .8 1'/>"
    block = "<geom type='box' size='.05 .05 .01' pos='.1 .1 .1' rgba='.8 .8 .8 1'/>"
    statistic = "<statistic center='0 0 0' extent='1'/>"
    above = View(lookat=(0, 0, -0.2), distance=1.0, elevation=-89.99, fovy=60)
    plain, shaded = (
        draw(floor + geom, above=statistic, camera=above).astype(float).sum(axis=2) for geom in ("", block)
    )
    rows, columns = np.argwhere(shaded < 0.85 * plain).T
    # From the lamp through the middle of the block, down to the floor.
    lamp = Renderer(mujoco.MjModel.from_xml_string(f"<mujoco>{statistic}</mujoco>")).lamp(above.pose()[1])
    middle = np.array([0.1, 0.1, 0.1])
    x, y, _ = lamp + (middle - lamp) * (lamp[2] + 0.2) / (lamp[2] - middle[2])
    scale = SIZE / 2 / np.tan(np.deg2rad(30))
    assert columns.mean() == pytest.approx(SIZE / 2 + scale * x, abs=2)
    assert rows.mean() == pytest.approx(SIZE / 2 - scale * y, abs=2)


def test_collision_geoms_are_not_drawn() -> None:
    assert not is_red(draw(BALL.replace("<geom", "<geom group='3'"))).any()


def test_a_named_camera_and_a_free_view_at_its_place_agree() -> None:
    camera = "<camera name='front' pos='0 -1 0' xyaxes='1 0 0 0 0 1' fovy='40'/>"
    np.testing.assert_array_equal(draw(BALL + camera, camera="front"), draw(BALL + camera))
    np.testing.assert_array_equal(draw(BALL + camera, camera=None), draw(BALL + camera))


def test_extra_spheres_hide_what_is_behind_them_and_hide_behind_what_is_before() -> None:
    centre = (SIZE // 2, SIZE // 2)
    blue = (0.0, 0.0, 1.0, 1.0)
    before = draw(BALL, spheres=[((0, -0.5, 0), 0.02, blue)])[centre].astype(int)
    assert before[2] > 2 * before[0]
    behind = draw(BALL, spheres=[((0, 0.5, 0), 0.02, blue)])
    np.testing.assert_array_equal(behind, draw(BALL))
    glass = draw(BALL, spheres=[((0, -0.5, 0), 0.02, (*blue[:3], 0.5))])[centre].astype(int)
    assert before[0] < glass[0] < draw(BALL)[centre][0] and before[2] > glass[2]


def test_the_nearer_of_two_extra_spheres_is_seen() -> None:
    near, far = ((0, -0.5, 0), 0.05, (0, 0, 1, 1)), ((0, 0.5, 0), 0.05, (1, 0, 0, 1))
    world = "<geom size='.01' pos='0 0 9'/>"
    one, other = draw(world, spheres=[near, far]), draw(world, spheres=[far, near])
    np.testing.assert_array_equal(one, other)
    middle = one[SIZE // 2, SIZE // 2].astype(int)
    assert middle[2] > 2 * middle[0]


def test_bad_cameras_and_sizes_are_named() -> None:
    with pytest.raises(ValueError, match="unknown camera 'fornt', did you mean 'front'"):
        draw(BALL + "<camera name='front'/>", camera="fornt")
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(ValueError, match="0 x 10 pixels"):
        Renderer(model, 0, 10)


def frames(count: int) -> Iterator[Image]:
    return (np.full((32, 48, 3), 10 * i, np.uint8) for i in range(count))


# Reading an mp4 back, imageio forks, which JAX reports if another test has started it.
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
def test_a_film_shows_what_pictures_of_each_step_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads draw it, and keep the order. A control step is half of a picture's time."""
    monkeypatch.setattr(record, "cores", lambda: 3)
    env = BatchedEnv("track", "ecm", num_envs=2, max_steps=5)
    still = zero_policy(env)
    film = list(record.frames(env, still, episodes=2, seed=4))
    picture = record.ScenePicture(env)
    env.autoreset = False
    observations, *_ = env.reset(4)
    one_by_one = []
    for step in range(1, 11):
        observations = env.step(still(observations)).observations
        if step % 2 == 0 or step % 5 == 0:  # the last step of an episode is always there
            one_by_one.append(picture.draw())
        if step == 5:
            observations, *_ = env.reset()
    np.testing.assert_array_equal(film, one_by_one)
    assert all((first != second).any() for first, second in pairwise(film))  # the goal moves


def test_threads_that_draw_parse_no_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python 3.11 fails now and then when two threads parse code, and NumPy parses the text of a layout as code."""
    env = BatchedEnv("track", "ecm", num_envs=1)
    env.reset(0)
    picture, parsed, parse = record.ScenePicture(env), [], ast.literal_eval
    with monkeypatch.context() as patch:
        patch.setattr(ast, "literal_eval", lambda text: parsed.append(text) or parse(text))
        picture.draw()
    assert not parsed


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_a_video_holds_its_frames(tmp_path: Path, suffix: str) -> None:
    path = video.write_video(tmp_path / f"film{suffix}", frames(12), fps=25)
    assert path.suffix == suffix
    assert np.stack(list(imageio.imiter(path))).shape == (12, 32, 48, 3)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
def test_a_small_video_holds_as_many_frames(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (8, 64, 64, 3)).astype(np.uint8)
    usual, small = (
        video.write_video(tmp_path / f"{size}.mp4", iter(noise), 25, small=size == "small")
        for size in ("usual", "small")
    )
    assert len(list(imageio.imiter(small))) == 8
    assert small.stat().st_size < usual.stat().st_size


def test_without_ffmpeg_a_video_is_a_gif(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "ffmpeg_runs", lambda: False)
    assert video.write_video(tmp_path / "film.mp4", frames(2), fps=25) == tmp_path / "film.gif"


def test_a_video_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def failing() -> Iterator[Image]:
        yield from frames(2)
        raise RuntimeError("the policy broke")

    with pytest.raises(RuntimeError, match="the policy broke"):
        video.write_video(tmp_path / "film.mp4", failing(), fps=25)
    with pytest.raises(ValueError, match="no frames"):
        video.write_video(tmp_path / "film.mp4", [], fps=25)
    with pytest.raises(ValueError, match="0 frames a second"):
        video.write_video(tmp_path / "film.mp4", frames(2), fps=0)
    assert not list(tmp_path.iterdir())


class Picture:
    """Counts the pictures that are drawn."""

    def pose(self) -> int:
        return 0


@pytest.mark.parametrize(("max_steps", "seconds"), [(10, 0.4), (600, 24.0), (9000, record.LONGEST)])
def test_a_video_is_of_two_episodes_but_not_of_a_long_trial(max_steps: int, seconds: float) -> None:
    env: Any = FakeEnv({"psm": 1}, {"psm": 3}, 1, max_steps=max_steps)
    env.control_dt, picture = 0.02, cast(Any, Picture())
    still = {agent: torch.zeros((1, 3)) for agent in env.agents}
    poses = list(record._poses(env, lambda _: still, picture, 2, 0))
    assert len(poses) == round(seconds * record.FPS)


def test_a_video_is_made_with_a_bar_and_one_thread_of_torch(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    env: Any = FakeEnv({"psm": 1}, {"psm": 3}, 1, max_steps=10)
    env.control_dt = 0.02
    threads: list[int] = []

    def frames(*_: Any) -> Iterator[np.ndarray]:
        for _ in range(10):
            threads.append(torch.get_num_threads())
            yield np.zeros((48, 64, 3), np.uint8)

    monkeypatch.setattr(record, "frames", frames)
    usual = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        path = record.record(env, lambda _: {}, tmp_path / "video.gif")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(usual)
    assert path.is_file() and set(threads) == {1}
    assert capsys.readouterr().err.splitlines()[-1].startswith("filming: 10 of 10 frames")
