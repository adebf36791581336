"""Text of the page. Names may come from anybody's files: what goes into HTML is escaped here, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from surgical_marl.plugins.task_file import label
from surgical_marl.untrusted.markup import as_html
from surgical_marl.untrusted.values import one_line
from surgical_marl.view.history import summary
from surgical_marl.view.session import Session

_WHOLE = "font-size:0.8em;padding:0 1em 0.8em;overflow-wrap:anywhere"
_CELL = "padding:1px 8px 1px 0;vertical-align:top"


def status(session: Session, paused: bool = False) -> str:
    """Return what the first environment is at, as HTML: its time, and errors, stages and contacts of all agents."""
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
