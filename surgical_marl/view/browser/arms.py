"""The menus of each arm's mover, and a person's controls: sliders, a handle at the tool tip, keys."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.robots.rotation import matrix_of, quaternion
from surgical_marl.view.hand import Hand
from surgical_marl.view.movers import YOU
from surgical_marl.view.session import Session

if TYPE_CHECKING:
    from viser import (
        CommandEvent,
        GuiButtonGroupHandle,
        GuiEvent,
        GuiFolderHandle,
        GuiInputHandle,
        GuiTabHandle,
        TransformControlsEvent,
        ViserServer,
    )

Ask = Callable[[Callable[[], None]], None]
"""Function that puts a call into the queue of the thread that steps."""

STEP = 0.002
"""Distance by which a key moves the tool tip, m."""
KEYS = {
    "arrowleft": (-STEP, 0, 0), "arrowright": (STEP, 0, 0), "arrowup": (0, STEP, 0), "arrowdown": (0, -STEP, 0),
    "pageup": (0, 0, STEP), "pagedown": (0, 0, -STEP),
}  # fmt: skip
JAW_KEY = "J"
ALL = "all arms"
"""On the button that lets a run move them all."""
_DIGITS = 4
"""Digits of a joint's position, rad or m, in a slider."""
_QUIET = 0.5
"""Time in s after somebody used a control, in which the page does not move it."""


class Arms:
    """The part of the page that says who moves each arm."""

    def __init__(
        self, server: ViserServer, folder: GuiTabHandle, session: Session, ask: Ask, offset: np.ndarray
    ) -> None:
        self._server, self._session, self._ask, self._offset = server, session, ask, offset
        self._menus: dict[str, Any] = {}
        self._folders: dict[str, GuiFolderHandle] = {}
        self._controls: dict[str, Controls] = {}
        self._told = dict(session.movers.who)
        """Movers of the arms as the menus show them."""
        with folder:
            for agent in session.env.agents:
                self._folders[agent] = server.gui.add_folder(agent)
                with self._folders[agent]:
                    self._menus[agent] = self._menu(agent)
            self._add_run()
        self._keys()

    def sync(self, refused: bool = False) -> None:
        """Show the movers of the arms, and the joint positions that a person wants, as the session has them.

        What was just chosen in a menu stays there until the session has heard of it, unless it was refused.
        """
        movers = self._session.movers
        for agent, menu in self._menus.items():
            if len(menu.options) != len(self._session.choices):
                menu.options = tuple(self._session.choices)
            if self._told[agent] != movers.who[agent] or (refused and menu.value != movers.who[agent]):
                self._told[agent] = menu.value = movers.who[agent]
            if agent in self._controls and movers.who[agent] != YOU:
                self._controls.pop(agent).remove()
            elif agent in movers.hands and agent not in self._controls:
                number = self._session.env.agents.index(agent)
                hand, folder = movers.hands[agent], self._folders[agent]
                self._controls[agent] = Controls(self._server, folder, hand, self._ask, number, self._offset)
        for controls in self._controls.values():
            controls.sync()

    def _menu(self, agent: str) -> Any:
        options = self._session.choices
        menu = self._server.gui.add_dropdown("moved by", options, initial_value=self._session.movers.who[agent])
        _let(menu, self._ask, lambda who: self._session.set_mover(agent, str(who)))
        return menu

    def _add_run(self) -> None:
        """Add a field for a policy that no menu has, as one that was just trained, and a button for each arm."""
        gui, agents = self._server.gui, self._session.env.agents
        name = gui.add_text("run folder", "", hint="of a training for this task and scene, as in runs/reach-psm")
        arms = gui.add_button_group("moves", agents if len(agents) == 1 else (*agents, ALL))

        @arms.on_click
        async def _(event: GuiEvent[GuiButtonGroupHandle]) -> None:
            if event.client is not None:
                run, chosen = str(name.value).strip(), str(arms.value)
                self._ask(lambda: self._let_run(run, agents if chosen == ALL else [chosen]))

    def _let_run(self, run: str, agents: Sequence[str]) -> None:
        """Let a run move arms; ValueError if it can't, and then nobody else does."""
        if not run:
            raise ValueError("type the folder of a run into the field above first, such as runs/reach-psm")
        for agent in agents:
            self._session.set_mover(agent, str(Path(run).expanduser()))

    def _keys(self) -> None:
        """Let keys move the first arm that a person moves."""
        gui = self._server.gui

        def bind(key: Any, label: str, act: Callable[[Hand], None]) -> None:
            @gui.add_command(label, hotkey=key).on_trigger
            async def _(_: CommandEvent) -> None:
                self._ask(lambda: self._with_first(act))

        def nudge(step: tuple[float, float, float]) -> Callable[[Hand], None]:
            return lambda hand: hand.nudge(step)

        for key, step in KEYS.items():
            bind(key, f"tool tip by {1000 * STEP:.0f} mm: {key.removeprefix('arrow')}", nudge(step))
        bind(JAW_KEY, "open or close the jaw", _turn_jaw)

    def _with_first(self, act: Callable[[Hand], None]) -> None:
        hand = next(iter(self._session.movers.hands.values()), None)
        if hand is None:
            raise ValueError(f"no arm is moved by {YOU!r}: choose it in the menu of an arm first")
        act(hand)


class Controls:
    """Controls by which a person moves one arm."""

    def __init__(
        self, server: ViserServer, folder: GuiFolderHandle, hand: Hand, ask: Ask, number: int, offset: np.ndarray
    ) -> None:
        self._hand, self._ask, self._offset = hand, ask, offset
        self._used = 0.0
        lower, upper = hand.limits
        with folder:
            self._sliders = {
                index: self._slider(server, index, name, float(lower[index]), float(upper[index]))
                for index, name in enumerate(hand.joints)
                if not hand.jaw[index]
            }
            self._jaw = self._jaw_box(server) if hand.jaw.any() else None
        self._handle = server.scene.add_transform_controls(f"/handle/{number}", scale=0.06, depth_test=False)

        @self._handle.on_update
        async def _(event: TransformControlsEvent) -> None:
            position, turn = np.array(event.target.position), matrix_of(np.array(event.target.wxyz))
            self._use(lambda: self._hand.reach(position - self._offset, turn))

        self.sync()

    def sync(self) -> None:
        """Move all controls to the wanted joint positions, unless somebody is using them."""
        if self._jaw is not None and self._jaw.value != self._hand.jaw_open:
            self._jaw.value = self._hand.jaw_open
        if time.monotonic() - self._used < _QUIET:
            return
        for index, slider in self._sliders.items():
            if abs(slider.value - self._hand.q[index]) > slider.step:
                slider.value = round(float(self._hand.q[index]), _DIGITS)
        pose = self._hand.tip()
        self._handle.position, self._handle.wxyz = pose[:3, 3] + self._offset, quaternion(pose[:3, :3])

    def remove(self) -> None:
        """Take the controls off the page."""
        for control in (*self._sliders.values(), self._jaw, self._handle):
            if control is not None:
                control.remove()

    def _use(self, act: Callable[[], None]) -> None:
        self._used = time.monotonic()
        self._ask(act)

    def _slider(self, server: ViserServer, index: int, name: str, lower: float, upper: float) -> Any:
        value = round(float(np.clip(self._hand.q[index], lower, upper)), _DIGITS)
        step = 10.0**-_DIGITS
        slider = server.gui.add_slider(name, min=lower, max=upper, step=step, initial_value=value)
        _let(slider, self._use, lambda wanted: self._hand.set_joint(index, float(wanted)))
        return slider

    def _jaw_box(self, server: ViserServer) -> Any:
        box = server.gui.add_checkbox("jaw open", initial_value=self._hand.jaw_open, hint=f"key {JAW_KEY}")
        _let(box, self._ask, lambda wanted: setattr(self._hand, "jaw_open", bool(wanted)))
        return box


def _let(control: GuiInputHandle[Any], ask: Ask, act: Callable[[Any], None]) -> None:
    """Let a control, whenever a person uses it, ask to act on the value that it then has."""

    @control.on_update
    async def _(event: GuiEvent[Any]) -> None:
        if event.client is not None:
            value = control.value
            ask(lambda: act(value))


def _turn_jaw(hand: Hand) -> None:
    hand.jaw_open = not hand.jaw_open
