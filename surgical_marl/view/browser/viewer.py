"""Runs `surgical-marl view`: one thread steps and draws, and does what the page asks it to.

viser calls back in threads of its own. A callback changes nothing: it puts what is to be done into a queue.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.engines.compilation import told
from surgical_marl.plugins.task_file import label
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.runs.settings import Settings
from surgical_marl.view.browser.arms import Arms
from surgical_marl.view.browser.nodes import Nodes
from surgical_marl.view.browser.panel import Choice, Panel
from surgical_marl.view.browser.pictures import Pictures
from surgical_marl.view.browser.plots import Plots
from surgical_marl.view.browser.server import close_server, open_server
from surgical_marl.view.camera import best_view, task_places
from surgical_marl.view.session import Pace, Session

if TYPE_CHECKING:
    from viser import ClientHandle, InitialCameraConfig, ViserServer

FPS = 30.0
"""Times a second that the scene is drawn."""
STEPPING = 0.6 / FPS
"""Time for steps between two drawings, s."""
_ASPECT = 1.0
"""Width over height that the first view holds all in: a page of 1400 x 900 pixels has more beside its panel."""
_WALL = np.linspace((172, 182, 194), (206, 213, 220), 64).astype(np.uint8)[:, None]
"""A wall that is lighter below, as in films, [64, 1, 3]."""
_SLOWER = {"trails": 3, "pictures": 4, "text": 6, "plots": 8}
"""Every how many drawings these are drawn."""


class Viewer:
    """A session in a browser.

    Args:
        settings: of the environments.
        who: moves all arms at first, as in `Session`.
        num_envs: how many environments.
        port: of the page; 0 for any that is free.
        record: a folder for takes; None to keep none.

    Raises:
        ValueError: something is unknown, does not fit together, or the port is taken.
    """

    def __init__(
        self,
        settings: Settings,
        who: str | None = None,
        num_envs: int = 1,
        port: int = 8080,
        record: Path | None = None,
    ) -> None:
        self._record = record
        self._further = () if who is None else (who,)
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.server, self.address = open_server(port)
        try:
            self.session = Session(settings, who, num_envs, record, self._further)
            self.pace = Pace(self.session.env.control_dt)
            self._show()
            self.server.on_client_connect(self._stand_back)
        except BaseException:
            close_server(self.server)
            raise
        self.drawn = 0
        """Number of drawings of the scene."""

    def run(self, until: Event) -> None:
        """Step and draw until an event is set; then write the recording, and stop the server."""
        try:
            due = time.monotonic()
            while not until.is_set():
                self.turn(time.monotonic())
                due = max(due + 1 / FPS, time.monotonic())
                until.wait(due - time.monotonic())
        finally:
            self.session.close()
            close_server(self.server)

    def turn(self, now: float) -> None:
        """Handle requests of the page, do the steps that are due at a time in s, and draw."""
        while not self._asked.empty():
            self._do(self._asked.get())
        for _ in range(self.pace.due(now)):
            self.session.step()
            if time.monotonic() - now > STEPPING:
                self.pace.forgive()  # the page stays smooth, and simulated time falls behind
                break
        with self.server.atomic():
            self._nodes.draw()
            for name, every in _SLOWER.items():
                if self.drawn % every == 0:
                    self._slow[name]()
        self.drawn += 1

    def ask(self, act: Callable[[], None]) -> None:
        """Let the thread that steps do something soon."""
        self._asked.put(act)

    def choose(self, choice: Choice) -> None:
        """Look at something else. If that can't be done, everything stays as it is."""
        old = self.session
        if choice == _choice(old):
            return
        self._say("Preparing", f"{label(choice.task)} on {Path(choice.scene).stem}", 5)
        try:
            settings, who = _settings(choice, old)
            self._further = tuple(dict.fromkeys([*self._further, *old.choices]))  # with runs that a person named
            with told(lambda title, stage: self._say("Compiling", f"{title}: {stage}", 5)):
                self.session = Session(settings, who, choice.num_envs, self._record, self._further)
        except ValueError:
            self._show()  # with menus that say what is looked at
            raise
        old.close()
        self._show()

    def _stand_back(self, client: ClientHandle) -> None:
        """Let a page that is higher than wide, as a phone's is, show all that a wide one shows."""
        first, wider = self.server.initial_camera, _ASPECT / client.camera.aspect
        if wider > 1:
            look_at = np.asarray(first.look_at)
            client.camera.position = look_at + wider * (np.asarray(first.position) - look_at)
            client.camera.look_at = look_at  # which has moved with it

    def _do(self, act: Callable[[], None]) -> None:
        try:
            act()
        except ValueError as error:
            self._say("Not possible", str(error), 10, color="red")
            self._arms.sync(refused=True)

    def _say(self, title: str, text: str, seconds: float, **look: Any) -> None:
        for client in self.server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=seconds, **look)

    def _show(self) -> None:
        """Make the page anew for the session."""
        server, session = self.server, self.session
        server.scene.reset()
        server.gui.reset()
        _light(server)
        _aim(server.initial_camera, session)
        before, self.pace = self.pace, Pace(session.env.control_dt)
        self.pace.speed, self.pace.paused = before.speed, before.paused  # whoever chose them may look at something else
        self._nodes = Nodes(server, session)
        panel = Panel(server, session, self.pace, self.ask)
        group = server.gui.add_tab_group()
        tabs = {name: group.add_tab(name) for name in ("Arms", "Scene", "Plots", "Pictures", "Show")}
        self._arms = Arms(server, tabs["Arms"], session, self.ask, self._nodes.offsets[0])
        panel.add_menus(tabs["Scene"], self.choose)
        plots, pictures = Plots(server, tabs["Plots"]), Pictures(server, tabs["Pictures"], session)
        panel.add_parts(tabs["Show"], self._nodes)

        def text() -> None:
            panel.sync()
            self._arms.sync()

        self._slow: dict[str, Callable[[], None]] = {
            "trails": self._nodes.draw_trails,
            "pictures": pictures.draw,
            "text": text,
            "plots": lambda: plots.draw(session.history),
        }


def _choice(session: Session) -> Choice:
    settings, env = session.settings, session.env
    return Choice(settings.task, settings.scene, settings.difficulty, env.num_envs, env.max_steps)


def _settings(choice: Choice, old: Session) -> tuple[Settings, dict[str, str] | None]:
    """Return the settings of a choice, and who moves its arms.

    A task that was just chosen brings a scene of its own if it is not meant for the old one.
    """
    if (choice.task, choice.scene) == (old.settings.task, old.settings.scene):
        settings = replace(old.settings, difficulty=choice.difficulty, max_steps=choice.max_steps, seed=old.seed)
        return settings, old.movers.who
    task, scene = TASKS.load(choice.task), choice.scene
    if choice.task != old.settings.task and task.scenes and scene not in task.scenes:
        scene = task.default_scene or task.scenes[0]
    difficulty = choice.difficulty if choice.difficulty in task.levels else "default"
    return Settings(choice.task, scene, difficulty=difficulty, seed=old.seed), None


def _aim(camera: InitialCameraConfig, session: Session) -> None:
    """Let a camera look at all arms and at the work, from where the least is hidden."""
    env = session.env
    view = best_view(env.scene, task_places(env.task), _ASPECT, whole=True)
    view = replace(view, distance=view.distance * (1 + 0.7 * (env.num_envs - 1)))
    camera.look_at, (camera.position, _) = np.asarray(view.lookat), view.pose()
    camera.fov = float(np.deg2rad(view.fovy))


def _light(server: ViserServer) -> None:
    """Light the scene like a room, without files from elsewhere."""
    server.scene.set_up_direction("+z")
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(enabled=True, cast_shadow=True)
    server.scene.add_light_hemisphere("/room", sky_color=(235, 242, 255), ground_color=(150, 130, 120), intensity=0.8)
    server.scene.set_background_image(_WALL)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    server.gui.main_panel.dock_right()  # beside the arms, and not over them
