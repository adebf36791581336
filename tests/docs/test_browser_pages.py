"""Reports and the site in a real browser, on a desk and on a phone: no errors, nothing from elsewhere, and they fit."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from surgical_marl.report.page import render
from surgical_marl.report.run import read_run
from tests.helpers.chromium import NEEDS_CHROMIUM, listen
from tests.helpers.pages import ROOT
from tests.helpers.run_folders import evaluate, make_run

pytestmark = NEEDS_CHROMIUM
DESK, PHONE = {"width": 1280, "height": 900}, {"width": 390, "height": 844}
TOO_WIDE = """() => document.documentElement.scrollWidth - document.documentElement.clientWidth"""

CUT = """() => [...document.querySelectorAll('table')].filter(table => table.offsetParent)
    .filter(table => table.querySelector('td')?.getBoundingClientRect().right > innerWidth)
    .map(table => table.caption.textContent)"""
"""Tables whose first value is not in view."""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, list[str]]]:
    """Build the site, and serve it; yield its address, and all of its pages."""
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        pages = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.html"))
        yield f"http://127.0.0.1:{server.server_port}/", pages
        server.shutdown()


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_a_report_loads_and_fits(browser: Any, tmp_path: Path, size: dict[str, int]) -> None:
    runs = [evaluate(make_run(tmp_path / f"s{seed}", seed=seed)) for seed in (0, 1)]
    runs.append(evaluate(make_run(tmp_path / "other", num_envs=128)))
    report = tmp_path / "report.html"
    report.write_text(render([read_run(run) for run in runs]), encoding="utf-8")
    page = browser.new_page(viewport=size)
    complaints = listen(page, (report.as_uri(),))
    page.goto(report.as_uri())
    assert page.locator("svg").count() > 10 and page.locator("svg").first.is_visible()
    assert page.evaluate(TOO_WIDE) <= 0 and page.evaluate(CUT) == []
    assert not complaints
    page.close()


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_the_pages_of_the_site_load_and_fit(browser: Any, site: tuple[str, list[str]], size: dict[str, int]) -> None:
    address, pages = site
    assert len(pages) > 40
    found = {}
    page = browser.new_page(viewport=size)
    complaints = listen(page, (address,))
    for name in pages:
        page.goto(address + name)
        found[name] = [*complaints, *([f"{wide} px too wide"] if (wide := page.evaluate(TOO_WIDE)) > 0 else [])]
        complaints.clear()
    assert not {name: what for name, what in found.items() if what}
    page.close()
