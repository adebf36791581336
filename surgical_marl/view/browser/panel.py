"""The menus and buttons of the page."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.content import list_scenes
from surgical_marl.plugins.task_file import label
from surgical_marl.plugins.tasks import TASKS, list_tasks
from surgical_marl.untrusted.markup import as_html
from surgical_marl.untrusted.values import one_line
from surgical_marl.view.browser.nodes import PARTS, Nodes
from surgical_marl.view.history import summary
from surgical_marl.view.session import Pace, Session
from surgical_marl.view.take import MOST_ENVS

if TYPE_CHECKING:
    from viser import CommandEvent, GuiEvent, GuiInputHandle, GuiTabHandle, ViserServer

_WHOLE = "font-size:0.8em;padding:0 1em 0.8em;overflow-wrap:anywhere"
_CELL = "padding:1px 8px 1px 0;vertical-align:top"


GO, STEP, RESET = "Pause / go on", "One step", "Reset"
LONGEST = 3600.0
"""An episode at most, s."""
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


@dataclass(frozen=True)
class Choice:
    """The view that the menus choose."""

    task: str
    scene: str
    difficulty: str
    num_envs: int
    max_steps: int
    """Control steps of an episode."""


class Panel:
    """The part of the page with the menus of the view and the controls of time.

    Args:
        server: of viser.
        session: what is looked at.
        pace: how time passes.
        ask: lets the thread that steps do something.
    """

    def __init__(
        self, server: ViserServer, session: Session, pace: Pace, ask: Callable[[Callable[[], None]], None]
    ) -> None:
        self._gui, self._session, self._pace, self._ask = server.gui, session, pace, ask
        self._told = session.seed
        """The seed that the page was last told."""
        self._make_time()
        self._status = self._gui.add_html(status(session))

    def sync(self) -> None:
        """Show how things are."""
        self._status.content = status(self._session, self._pace.paused)
        if self._told != self._session.seed:  # and not whenever it is another one: somebody may just have typed it
            self._told = self._session.seed
            self._seed.value = self._told

    def add_parts(self, folder: GuiTabHandle, nodes: Nodes) -> None:
        """Add a box for each part of the scene that can be hidden."""

        def box(part: str) -> None:
            handle = self._gui.add_checkbox(part, initial_value=True)
            handle.on_update(self._then(lambda: nodes.show(part, bool(handle.value))))

        with folder:
            for part in PARTS:
                box(part)

    def _make_time(self) -> None:
        gui, pace = self._gui, self._pace
        buttons = gui.add_button_group("time", (GO, STEP, RESET), hint="keys: space, N, R")
        speed = gui.add_dropdown("speed", SPEEDS, initial_value=f"{pace.speed:g}")
        self._seed: Any = gui.add_number("seed", self._told, min=0, max=2**31 - 1, step=1)

        def turn() -> None:
            pace.paused = not pace.paused

        def single() -> None:
            pace.paused = True
            pace.step_once()

        def begin() -> None:
            self._session.reset(int(self._seed.value))

        acts = {GO: turn, STEP: single, RESET: begin}
        keys: Any = ("space", "N", "R")
        for (name, act), key in zip(acts.items(), keys, strict=True):
            gui.add_command(name, hotkey=key).on_trigger(self._then(act))
        buttons.on_click(self._then(lambda: acts[buttons.value]()))
        speed.on_update(self._then(lambda: setattr(pace, "speed", float(speed.value))))
        self._seed.on_update(self._then(begin))

    def add_menus(self, folder: GuiTabHandle, choose: Callable[[Choice], None]) -> None:
        """Add the menus of task, scene, difficulty and length; `choose` is called with a new choice."""
        with folder:
            chosen, menus = self._make_menus()
        for menu in menus:
            menu.on_update(self._then(lambda: choose(chosen())))

    def _make_menus(self) -> tuple[Callable[[], Choice], list[GuiInputHandle[Any]]]:
        """Return a function that reads the choice from the menus, and the menus."""
        env, gui = self._session.env, self._gui
        scene = self._session.settings.scene
        scenes = list(dict.fromkeys([*list_scenes(), scene]))
        levels = list(TASKS.load(env.task_name).levels)
        tasks = list(dict.fromkeys([*list_tasks(), env.task_name]))
        task = gui.add_dropdown("task", tasks, initial_value=env.task_name)
        place = gui.add_dropdown("scene", scenes, initial_value=scene)
        level = gui.add_dropdown("difficulty", levels, initial_value=self._session.settings.difficulty)
        count = gui.add_dropdown(
            "environments", list(map(str, range(1, MOST_ENVS + 1))), initial_value=str(env.num_envs)
        )
        length = gui.add_number(
            "seconds an episode", round(env.max_steps * env.control_dt, 3), min=env.control_dt, max=LONGEST, step=1.0
        )

        def chosen() -> Choice:
            steps = max(1, round(float(length.value) / env.control_dt))
            return Choice(task.value, place.value, level.value, int(count.value), steps)

        return chosen, [task, place, level, count, length]

    def _then(self, act: Callable[[], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
        """Return a callback of viser that lets the stepping thread act, when it was a person who caused it."""

        async def callback(event: GuiEvent[Any] | CommandEvent) -> None:
            if event.client is not None:
                self._ask(act)

        return callback


def status(session: Session, paused: bool = False) -> str:
    """Return the status of the first environment as HTML: its time, and errors, stages and contacts of all agents."""
    env = session.env
    names = [as_html(one_line(name)) for name in (label(env.task_name), env.scene.name, session.settings.difficulty)]
    step, dt = int(np.asarray(env.steps)[0]), env.control_dt
    time = f"{step * dt:.2f} of {env.max_steps * dt:.0f} s, seed {session.seed}{', paused' if paused else ''}"
    rows = "".join(_row(agent, session.infos[agent]) for agent in env.agents if agent in session.infos)
    head = f"<b>{names[0]}</b> on <b>{names[1]}</b>, {names[2]}"
    return f'<div style="{_WHOLE}">{head}<br/>{time}<table>{rows}</table></div>'


def _row(agent: str, info: Mapping[str, Any]) -> str:
    cells = [agent, ", ".join(summary(info)) or "-"]
    return "<tr>" + "".join(f'<td style="{_CELL}">{as_html(cell)}</td>' for cell in cells) + "</tr>"
