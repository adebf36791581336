"""The viewer in a real browser."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surgical_marl.content import find
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.runs.settings import Settings
from surgical_marl.view.browser.nodes import PARTS
from surgical_marl.view.browser.viewer import Viewer
from surgical_marl.view.take import read_take, replay
from tests.helpers.chromium import NEEDS_CHROMIUM, listen

pytestmark = NEEDS_CHROMIUM
PATIENCE = 180.0
LATE = "Tried to update non-existent component"


class Running:
    """A viewer that runs in a thread, as the command does, and what pages of it complained about."""

    def __init__(self, browser: Any, settings: Settings, who: str, record: Path | None = None) -> None:
        self.viewer = Viewer(settings, who, port=0, record=record)
        self._complaints: list[list[str]] = []
        self._pages: list[Any] = []
        self._browser, self._end = browser, threading.Event()
        self._thread = threading.Thread(target=self.viewer.run, args=(self._end,), daemon=True)
        self._thread.start()

    def open(self) -> Any:
        page = self._browser.new_page(viewport={"width": 1000, "height": 900})
        self._pages.append(page)
        self._complaints.append(listen(page, (self.viewer.address,)))
        page.set_default_timeout(1000 * PATIENCE)
        page.goto(self.viewer.address)
        page.get_by_role("tab", name="Scene").wait_for()
        page.wait_for_timeout(1500)  # a choice is lost while the page is still being made
        return page

    @property
    def complaints(self) -> list[str]:
        """All but those of viser's page, which first removes and then updates what it got at once, when it is slow."""
        return [each for own in self._complaints for each in own if not each.startswith(LATE)]

    def close(self) -> None:
        """End the viewer, and close pages that a failed test has left open: they would slow the next one."""
        for page in self._pages:
            page.close()
        self._end.set()
        self._thread.join()


@pytest.fixture
def running(browser: Any, tmp_path: Path) -> Iterator[Running]:
    settings = Settings(task="reach", scene="bimanual_psm", seed=3, max_steps=100_000)
    made = Running(browser, settings, "oracle", tmp_path)
    yield made
    made.close()


def comes(true: Callable[[], Any], page: Any = None) -> None:
    """Wait until something is true."""
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end, "it never came true"
        if page is None:
            time.sleep(0.1)
        else:
            page.wait_for_timeout(100)


def let_run(page: Any, run: Path, arm: str) -> None:
    """Name a run in the menu, and let it move an arm."""
    # the label of a field of text names no element
    page.get_by_text("run folder", exact=True).locator("xpath=../../..//input").fill(str(run))
    page.wait_for_timeout(500)  # the page sends what is typed a little later
    page.get_by_role("button", name=arm, exact=True).click()


def choose(page: Any, label: str, option: str, number: int = 0) -> None:
    page.locator("input:visible").and_(page.get_by_label(label, exact=True)).nth(number).click()
    page.get_by_role("option", name=option, exact=True).click()


def to_scene(page: Any) -> Any:
    """Open the tab Scene; what is chosen there makes the page anew, which then shows its first tab."""
    page.wait_for_timeout(1500)
    page.get_by_role("tab", name="Scene").click()
    return page


def test_the_controls_do_what_they_say(running: Running) -> None:
    viewer, page = running.viewer, running.open()
    page.get_by_role("button", name="Pause / go on").click()
    comes(lambda: viewer.pace.paused, page)
    steps = viewer.session.steps
    page.get_by_role("button", name="One step").click()
    comes(lambda: viewer.session.steps == steps + 1, page)
    page.wait_for_timeout(500)
    assert viewer.session.steps == steps + 1
    page.get_by_role("button", name="Reset", exact=True).click()
    comes(lambda: viewer.session.steps == 0, page)
    page.keyboard.press("n")
    comes(lambda: viewer.session.steps == 1, page)
    choose(page, "speed", "0.25")
    comes(lambda: viewer.pace.speed == 0.25, page)
    page.get_by_label("seed", exact=True).fill("11")
    page.keyboard.press("Enter")
    comes(lambda: viewer.session.seed == 11, page)
    choose(page, "moved by", "frozen", 1)
    comes(lambda: viewer.session.movers.who == {"psm_0": "oracle", "psm_1": "frozen"}, page)
    page.get_by_role("tab", name="Show").click()
    page.get_by_label("targets", exact=True).click()
    comes(lambda: not viewer._nodes._marks.visible, page)
    page.get_by_role("tab", name="Plots").click()
    page.get_by_text("error, mm").wait_for()
    page.get_by_role("tab", name="Scene").click()
    choose(page, "environments", "2")
    comes(lambda: viewer.session.env.num_envs == 2, page)
    assert viewer.session.movers.who["psm_1"] == "frozen"
    assert not running.complaints
    page.close()


def test_what_is_looked_at_is_chosen_from_menus(running: Running) -> None:
    viewer, page = running.viewer, running.open()
    page.get_by_role("tab", name="Show").click()
    for part in PARTS:
        page.get_by_label(part, exact=True).click()
        comes(lambda part=part: not any(handle.visible for handle in viewer._nodes._parts[part]), page)
    choose(to_scene(page), "difficulty", "hard")
    comes(lambda: viewer.session.settings.difficulty == "hard", page)
    to_scene(page).get_by_label("seconds an episode", exact=True).fill("3")
    page.keyboard.press("Enter")
    comes(lambda: viewer.session.env.max_steps == 150, page)
    choose(to_scene(page), "scene", "ecm")
    comes(lambda: viewer.session.env.agents == ["ecm_0"], page)
    page.get_by_role("tab", name="Pictures").click()
    page.get_by_text("endoscope of ecm_0").first.wait_for()
    page.locator("img:visible").first.wait_for()
    choose(to_scene(page), "task", "track")
    comes(lambda: viewer.session.env.task_name == "track", page)
    assert not running.complaints


def test_sliders_and_keys_move_an_arm(running: Running) -> None:
    viewer, page = running.viewer, running.open()
    choose(page, "moved by", "you", 0)
    comes(lambda: "psm_0" in viewer.session.movers.hands, page)
    hand = viewer.session.movers.hands["psm_0"]
    roll = hand.joints.index("roll")
    slider, before = page.get_by_role("slider").nth(roll), hand.q[roll]

    def turned() -> bool:
        slider.press("ArrowRight")  # one that comes before the page listens is lost
        return bool(hand.q[roll] > before)

    comes(turned, page)
    page.get_by_label("jaw open", exact=True).click()
    comes(lambda: hand.jaw_open, page)
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("j")
    comes(lambda: not hand.jaw_open, page)
    page.keyboard.press("Space")
    comes(lambda: viewer.pace.paused, page)
    page.keyboard.press("r")
    comes(lambda: viewer.session.steps == 0, page)
    assert not running.complaints


def test_a_closed_tab_ends_nothing_and_a_second_one_works(running: Running) -> None:
    first, second = running.open(), running.open()
    first.close()
    steps = running.viewer.session.steps
    comes(lambda: running.viewer.session.steps > steps, second)
    second.get_by_role("button", name="Pause / go on").click()
    comes(lambda: running.viewer.pace.paused, second)
    second.close()
    running.viewer.pace.paused = False
    third = running.open()
    steps = running.viewer.session.steps
    comes(lambda: running.viewer.session.steps > steps, third)
    assert not running.complaints
    third.close()


def test_a_person_and_a_policy_bring_two_arms_to_their_targets(running: Running, tmp_path: Path) -> None:
    viewer, page = running.viewer, running.open()
    choose(page, "moved by", "you", 0)
    comes(lambda: "psm_0" in viewer.session.movers.hands, page)
    keys = (("ArrowRight", "ArrowLeft"), ("ArrowUp", "ArrowDown"), ("PageUp", "PageDown"))

    def error() -> np.ndarray:
        return viewer.session.moment().marks[0, 0] - viewer.session.movers.hands["psm_0"].tip()[:3, 3]

    page.evaluate("document.activeElement.blur()")  # a menu that has the focus keeps the keys
    for _ in range(200):
        axis = int(np.argmax(np.abs(error())))
        if abs(error()[axis]) < 0.0011:
            break
        page.keyboard.press(keys[axis][int(error()[axis] < 0)])
        page.wait_for_timeout(250)  # a key that comes before the page listens is lost, and pressed again
    infos = lambda agent: float(viewer.session.infos[agent]["tip_error"][0])  # noqa: E731
    comes(lambda: infos("psm_0") < 0.003 and infos("psm_1") < 0.002, page)
    page.close()
    running.close()
    found = replay(tmp_path / "take-0001.npz")
    assert found.steps > 100 and found.differs_at is None


def test_a_handle_is_dragged_with_the_mouse(running: Running) -> None:
    viewer, page = running.viewer, running.open()
    hand = take_over(viewer, page)
    pose = hand.tip()
    axis = pose[:3, 0]
    drag(viewer, page, axis, 0.020)
    comes(lambda: abs((hand.tip()[:3, 3] - pose[:3, 3]) @ axis - 0.020) < 0.002, page)
    tip = lambda: viewer.session.moment().tips[0, 0]  # noqa: E731
    comes(lambda: np.linalg.norm(tip() - hand.tip()[:3, 3]) < 0.001, page)
    assert not running.complaints
    page.close()


def test_a_run_and_a_person_with_a_mouse_bring_two_arms_to_their_targets(browser: Any, tmp_path: Path) -> None:
    run = shutil.copytree(find("policies", "reach-bimanual_psm"), tmp_path / "run")
    running = Running(
        browser, Settings(task="reach", scene="bimanual_psm", seed=3, max_steps=100_000), "zero", tmp_path
    )
    viewer, page = running.viewer, running.open()
    page.get_by_role("button", name="Pause / go on").click()  # until both are at their arms
    comes(lambda: viewer.pace.paused, page)
    let_run(page, tmp_path / "no such run", "psm_1")
    page.get_by_text("Not possible").wait_for()
    let_run(page, run, "psm_1")
    comes(lambda: viewer.session.movers.who["psm_1"] == str(run), page)
    hand = take_over(viewer, page)
    page.get_by_role("button", name="Reset", exact=True).click()
    comes(lambda: viewer.session.steps == 0, page)
    page.get_by_role("button", name="Pause / go on").click()
    error = lambda agent: float(viewer.session.infos[agent]["tip_error"][0])  # noqa: E731
    for number in range(30):
        wanted = viewer.session.moment().marks[0, 0] - hand.tip()[:3, 3]
        if np.linalg.norm(wanted) < 0.0015:
            break
        axis = hand.tip()[:3, number % 3]
        if abs(wanted @ axis) > 0.0005:
            drag(viewer, page, axis, float(wanted @ axis))
    comes(lambda: error("psm_0") < 0.002 and error("psm_1") < 0.002, page)
    page.close()
    running.close()
    take = max(tmp_path.glob("take-*.npz"))
    about, arrays = read_take(take)
    assert {(agent, who) for _, agent, who in about["movers"]} == {("psm_0", "you"), ("psm_1", str(run))}
    assert np.abs(np.diff(arrays["actions/psm_0"], axis=0)).max() > 0  # a person moved it
    found = replay(take)
    assert found.steps > 50 and found.differs_at is None


def take_over(viewer: Viewer, page: Any) -> Any:
    """Choose "you" for the first arm, and return its hand when its handle is drawn."""
    choose(page, "moved by", "you", 0)
    comes(lambda: "psm_0" in viewer.session.movers.hands, page)
    comes(viewer.server.get_clients, page)
    page.wait_for_timeout(5000)
    return viewer.session.movers.hands["psm_0"]


def drag(viewer: Viewer, page: Any, axis: np.ndarray, way: float) -> None:
    """Drag the arrow of the first arm's handle along an axis, [3], by a way in m."""
    place = viewer.session.movers.hands["psm_0"].tip()[:3, 3]
    start, end = (pixel(viewer, place + far * axis) for far in (0.045, 0.045 + way))
    page.mouse.move(*start)
    page.wait_for_timeout(700)  # a handle is grabbed where the mouse was seen above it
    page.mouse.down()
    for share in np.linspace(0, 1, 6):
        page.mouse.move(*(start + share * (end - start)))
        page.wait_for_timeout(200)
    page.mouse.up()
    page.wait_for_timeout(1000)  # until the handle is where the tool is sent


def test_hostile_names_stay_text(browser: Any, tmp_path: Path) -> None:
    """Of a scene's file, of an arm and its agent, and of a run that nobody finds."""
    name = "<img src=x onerror=window.hit=1>"
    scene, arm = tmp_path / f"{name}.yaml", shutil.copytree(find("arms", "psm"), tmp_path / f"{name} psm")
    text = find("scenes", "psm").read_text().replace("psm_0:", f"{arm.name}_0:")
    scene.write_text(text.replace("arm: psm", f"arm: '{arm.name}'"))
    running = Running(browser, Settings(task="reach", scene=str(scene)), "zero")
    page = running.open()
    page.get_by_text(name).first.wait_for()
    assert running.viewer.session.env.agents == [f"{arm.name}_0"]
    running.viewer.ask(lambda: running.viewer.session.set_mover(f"{arm.name}_0", name))
    page.get_by_text(f"unknown run or policy '{name}'").first.wait_for()
    page.get_by_role("tab", name="Plots").click()
    page.get_by_text(f"terms of the reward of {arm.name}_0").first.wait_for()
    page.locator(".u-legend").get_by_text(f"{arm.name}_0").first.wait_for()
    page.wait_for_timeout(1000)
    assert page.evaluate("window.hit") is None
    assert not running.complaints
    page.close()
    running.close()


def pixel(viewer: Viewer, point: np.ndarray) -> np.ndarray:
    """Where the page of the only tab shows a point, by its camera: x to the right, y down, z forward."""
    (client,) = viewer.server.get_clients().values()
    camera = client.camera
    x, y, z = matrix_of(np.array(camera.wxyz)).T @ (point - camera.position)
    half = camera.image_height / 2
    scale = half / np.tan(camera.fov / 2)
    return np.array([camera.image_width / 2 + scale * x / z, half + scale * y / z])
