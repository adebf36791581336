"""A real browser for tests: Debian's chromium without a window, driven by playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NEEDS_CHROMIUM = [
    pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")
]  # fmt: skip
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Yield a browser. Where there is one, a missing package is an error: what is left out is soon broken."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        yield chromium
        chromium.close()


def listen(page: Any, own: tuple[str, ...]) -> list[str]:
    """Return a list that gets what a page complains about, and what it asks of others than `own` addresses."""
    complaints: list[str] = []

    def ask(request: Any) -> None:
        if not request.url.startswith((*own, "data:", "blob:")):
            complaints.append(f"it asks for {request.url}")

    page.on("console", lambda message: message.type == "error" and complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", ask)
    return complaints
