"""Cost of a drawing of the viewer: one environment with its policy, and a client that takes all that is sent.

measure_page("reach", "bimanual_psm", 20.0).ms_per_drawing
"""

from __future__ import annotations

# Only light imports up here: the client's process imports this module too.
import json
import multiprocessing
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from threading import Event, Timer
from typing import Any

from surgical_marl.machine import used

WARM = 3.0
"""Before that: a client first gets all meshes, and a policy's first action takes longer, s."""


@dataclass(frozen=True)
class Page:
    """The cost of the viewer's page, without the browser that shows it."""

    ms_per_drawing: float
    """Milliseconds of a core of the process that steps, draws and sends."""
    drawings_per_s: float
    """`surgical-marl view` wants 30; the clock on the wall tells, so other programs matter."""
    kilobytes_per_drawing: float
    """Size of the messages that the server sends."""
    grown_mb: float
    """Memory that the process took on meanwhile, MB."""
    mover: str
    """Movers of the arms."""


def measure_page(task: str, scene: str, seconds: float) -> Page:
    """Run the viewer for so many seconds after a warm-up, as `surgical-marl view` does, on this process's clock.

    Raises:
        ValueError: viser is not installed, or task and scene do not fit together.
    """
    from surgical_marl.runs.settings import Settings
    from surgical_marl.view.browser.viewer import Viewer

    viewer = Viewer(Settings(task=task, scene=scene), port=0)
    marks: list[tuple[float, float, int, int, float]] = []
    end = Event()
    mover = ", ".join(dict.fromkeys(viewer.session.movers.who.values()))
    with _client(viewer.address) as taken:

        def mark() -> None:
            marks.append((time.process_time(), time.monotonic(), viewer.drawn, taken.value, used()))
            if len(marks) == 2:
                end.set()

        timers = [Timer(WARM, mark), Timer(WARM + seconds, mark)]
        for timer in timers:
            timer.start()
        viewer.run(end)
    spent, lasted, drawn, sent, grown = (after - before for before, after in zip(*marks, strict=True))
    return Page(1e3 * spent / drawn, drawn / lasted, sent / 1024 / drawn, grown / 2**20, mover)


def run(task: str, scene: str, seconds: float, as_json: bool) -> str:
    """Run `surgical-marl bench view`; return its sentence, or JSON."""
    found = measure_page(task, scene, seconds)
    if as_json:
        return json.dumps(asdict(found))
    return (
        f"{task} on {scene}, moved by {found.mover}: {found.ms_per_drawing:.1f} ms of one core a drawing, "
        f"{found.drawings_per_s:.1f} drawings/s of {found.kilobytes_per_drawing:.1f} KB, "
        f"{found.grown_mb:+.1f} MB of memory in {seconds:.0f} s"
    )


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """Let another process open the page meanwhile; yield how many bytes it has taken."""
    context = multiprocessing.get_context("spawn")
    joined, taken = context.Event(), context.Value("Q", lock=False)
    client = context.Process(target=_watch, args=(address, joined, taken), daemon=True)
    client.start()
    try:
        if not joined.wait(60):
            raise RuntimeError("no client could open the page within 60 s")
        yield taken
    finally:
        client.terminate()
        client.join()


def _watch(address: str, joined: Event, taken: Any) -> None:
    """Receive the messages of a page's server, as a browser that draws nothing."""
    from importlib.metadata import version

    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    protocol = Subprotocol(f"viser-v{version('viser')}")
    with connect(address.replace("http", "ws").rstrip("/"), subprotocols=[protocol], max_size=None) as socket:
        joined.set()
        try:
            for message in socket:
                taken.value += len(message)
        except ConnectionClosed:  # the measurement is over
            pass
