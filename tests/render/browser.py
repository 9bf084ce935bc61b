"""Open pages in headless Chromium, record console messages and requests, and take screenshots."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SWITCHES = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL without a graphics card
)
DESKTOP = {"viewport": {"width": 1280, "height": 800}}
PHONE = {"viewport": {"width": 390, "height": 844}, "device_scale_factor": 2, "has_touch": True, "is_mobile": True}


def chromium() -> str:
    """Return the path of Chromium, on the path or in MESHMATCH_CHROMIUM; skip the test without it."""
    found = os.environ.get("MESHMATCH_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("no Chromium here: apt-get install chromium, or set MESHMATCH_CHROMIUM")
    return found


@dataclass(eq=False)
class Opened:
    """An open page, with its console messages and errors (``said``) and requested URLs (``requests``)."""

    page: Any
    said: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def state(self) -> dict[str, Any]:
        return dict(self.page.evaluate("meshmatch.state()"))

    def place(self, side: str, vertex: int) -> dict[str, Any]:
        """Return x, y of a vertex on the screen, and whether it is visible."""
        return dict(self.page.evaluate("([s, v]) => meshmatch.project(s, v)", [side, vertex]))

    def settled(self) -> dict[str, Any]:
        """Return the state after two more frames."""
        self.page.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(() => r())))")
        return self.state()

    def picture(self, path: Path) -> Path:
        self.settled()
        self.page.screenshot(path=path)
        return path


@contextmanager
def browser() -> Iterator[Any]:
    """Launch Chromium with a new profile."""
    program = chromium()
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser (extra dev)")
    with playwright.sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=program, args=list(SWITCHES))
        yield running
        running.close()


@contextmanager
def opened(running: Any, path: Path, **options: Any) -> Iterator[Opened]:
    """Open a file and wait until it is drawn; at exit, assert no console messages and no other requests."""
    context = running.new_context(**(DESKTOP | options))
    page = context.new_page()
    seen = Opened(page)
    page.on("console", lambda message: seen.said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: seen.said.append(f"error: {error}"))
    page.on("request", lambda request: seen.requests.append(request.url))
    page.goto(path.resolve().as_uri())
    page.wait_for_selector("html[data-ready]", timeout=60_000)
    yield seen
    assert seen.said == []
    assert seen.requests == [path.resolve().as_uri()]
    context.close()


def unnamed_controls(view: Opened) -> list[str]:
    """Return the controls of a page without an accessible name for screen readers."""
    said = "e => e.ariaLabel || e.innerText || [...(e.labels ?? [])].map(l => l.innerText).join() || ''"
    used = view.page.locator("button, input, select, summary, [role=application]").all()
    return [element.evaluate("e => e.outerHTML") for element in used if not element.evaluate(said).strip()]
