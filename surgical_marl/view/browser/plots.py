"""Live plots of one environment: error, distance, forces, thread and tissue, grips on objects, terms of the reward."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.view.browser.nodes import colour
from surgical_marl.view.history import REWARD, History

if TYPE_CHECKING:
    from viser import GuiTabHandle, GuiUplotHandle, ViserServer

_TERMS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2", "#17becf", "#bcbd22", "#7f7f7f", "#ff7f0e")
_HEIGHT = 150


class Curve(NamedTuple):
    """A line of a plot."""

    label: str
    colour: str
    values: np.ndarray
    shaded: bool = False
    """True if the area below it is filled instead."""


def curves(history: History) -> dict[str, list[Curve]]:
    """Return the lines of each plot, by the plot's title; [T] each. A plot without a number is left out."""
    agents = history.agents
    own = [_css(colour(index)) for index in range(len(agents))]
    plots = {
        "error, mm": [Curve(agent, own[i], history.error(agent)[1]) for i, agent in enumerate(agents)],
        "distance of arms, mm": [
            Curve(agent, own[i], 1000 * history.read(agent, "min_distance")) for i, agent in enumerate(agents)
        ],
        "contact force, N": [
            Curve(agent, own[i], history.read(agent, "contact_force")) for i, agent in enumerate(agents)
        ],
        **{name.replace("_", " "): [Curve(name, _TERMS[0], history.read(agents[0], name))] for name in history.reports},
        **_grips(history, own),
        "reward": [Curve(agent, own[i], history.read(agent, "reward")) for i, agent in enumerate(agents)],
    }
    for agent in agents:
        terms = sorted(name for name in history.names(agent) if name.startswith(REWARD))
        plots[f"terms of the reward of {agent}"] = [
            Curve(term.removeprefix(REWARD), _TERMS[k % len(_TERMS)], history.read(agent, term))
            for k, term in enumerate(terms)
        ]
    return {title: lines for title, lines in plots.items() if any(np.isfinite(line.values).any() for line in lines)}


def _grips(history: History, colours: Sequence[str]) -> dict[str, list[Curve]]:
    """Return two plots for each free object: how hard each arm's fingers press on it, and how far it has slid.

    The area below the force is filled while the arm holds the object.
    """
    plots: dict[str, list[Curve]] = {}
    for name in history.objects:
        force, slip = plots.setdefault(f"grip on {name}, N", []), plots.setdefault(f"slip of {name}, mm", [])
        for agent, own in zip(history.agents, colours, strict=True):
            if f"{name}_force" in history.names(agent):
                pressed = history.read(agent, f"{name}_force")
                held = np.where(history.read(agent, f"{name}_holding") > 0, pressed, 0.0)
                force += [Curve(agent, own, pressed), Curve(f"{agent} holds", own, held, shaded=True)]
                slip.append(Curve(agent, own, 1000 * history.read(agent, f"{name}_slip")))
    return plots


class Plots:
    """The plots of a session on the page. They appear with the first numbers."""

    def __init__(self, server: ViserServer, folder: GuiTabHandle) -> None:
        self._gui, self._folder = server.gui, folder
        self._handles: dict[str, GuiUplotHandle] = {}
        with folder:
            self._empty = server.gui.add_markdown("Plots appear with the first steps.")

    def draw(self, history: History) -> None:
        """Show the last steps."""
        time = history.time
        if len(time) < 2:
            return
        self._empty.visible = False
        for title, lines in curves(history).items():
            data = (time, *(np.nan_to_num(line.values, nan=0.0) for line in lines))
            if title in self._handles:
                self._handles[title].data = data
            else:
                self._handles[title] = self._make(title, data, lines)

    def _make(self, title: str, data: tuple[np.ndarray, ...], lines: Sequence[Curve]) -> GuiUplotHandle:
        series: Any = ({"label": "s"}, *map(_series, lines))
        with self._folder:
            return self._gui.add_uplot(
                data, series, title=title, scales={"x": {"time": False}}, height=_HEIGHT, legend={"show": True}
            )


def _series(line: Curve) -> Any:
    """Return how uPlot draws a line."""
    if line.shaded:
        return {"label": line.label, "stroke": line.colour, "fill": f"{line.colour}40", "width": 0}
    return {"label": line.label, "stroke": line.colour, "width": 1.5}


def _css(rgb: np.ndarray) -> str:
    return "#" + "".join(f"{int(part):02x}" for part in rgb)
