"""Headless Chromium, by Playwright: open a page from disk, act, look, listen."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import playwright.sync_api

__all__ = ["FLAGS", "Browser", "Page", "browser", "find_chromium"]

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--disable-dev-shm-usage"]
PATIENCE_MS = 30_000


def find_chromium() -> str:
    """The browser's executable; without one the test is skipped, or fails where it has to be there."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        found = shutil.which(name)
        if found:
            return found
    text = "no Chromium is installed (Debian: apt-get install chromium)"
    if os.environ.get("ROADGEO_REQUIRE_CHROMIUM") == "1":
        pytest.fail(text)
    pytest.skip(text)


class Page:
    """A page in the browser, and what it said and asked for since it was opened."""

    def __init__(self, page: "playwright.sync_api.Page") -> None:
        self._page = page
        self._protocol = page.context.new_cdp_session(page)
        self._said: list[str] = []
        self._asked: list[str] = []
        page.on("console", lambda message: self._said.append(message.text))
        page.on("pageerror", lambda error: self._said.append(str(error)))
        page.on("request", lambda request: self._asked.append(request.url))

    def run(self, expression: str) -> Any:
        """Evaluate JavaScript and return its value, once a promise is kept."""
        return self._page.evaluate(expression)

    def settle(self) -> None:
        """Wait until pictures are decoded and what was asked for has been drawn."""
        self.run("Promise.all([...document.images].map((image) => image.decode())).then(() => 1)")
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width, height of an element in the window."""
        found = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
        return tuple(self.run(f"(({{x, y, width, height}}) => [x, y, width, height])({found})"))

    def middle(self, selector: str) -> tuple[float, float]:
        """Middle of an element in the window."""
        left, top, width, height = self.box(selector)
        return left + width / 2, top + height / 2

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send one mouse event: mousePressed, mouseMoved, mouseReleased, mouseWheel."""
        self._protocol.send("Input.dispatchMouseEvent", {"type": kind, "x": x, "y": y, **more})

    def drag(self, x: float, y: float, dx: float, dy: float) -> None:
        """Press, move in two steps, release; no movement is a click."""
        mouse = self._page.mouse
        mouse.move(x, y)
        mouse.down()
        if dx or dy:
            mouse.move(x + dx, y + dy, steps=2)
        mouse.up()
        self.settle()

    def click_through(self, x: float, y: float) -> None:
        """Click a link and wait for the page that it leads to."""
        self._said.clear()
        with self._page.expect_navigation():
            self._page.mouse.click(x, y)

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """Send one touch event: touchStart, touchMove, touchEnd."""
        fingers = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        self._protocol.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

    def press(self, key: str, _: str = "") -> None:
        """Press and release a key on what has the focus."""
        self._page.keyboard.press(key)
        self.settle()

    def picture(self, path: Path) -> None:
        """Save what the window shows as PNG."""
        self._page.screenshot(path=path)

    def complaints(self) -> list[str]:
        """What the console and failed scripts said since the page was opened."""
        return self._said

    def requests(self) -> list[str]:
        """Addresses asked for, other than data in the page itself."""
        return [url for url in self._asked if not url.startswith("data:")]


class Browser:
    """A running Chromium."""

    def __init__(self, running: "playwright.sync_api.Browser") -> None:
        self._running = running

    @contextmanager
    def open(self, path: Path, width: int, height: int, *, phone: bool = False, dark: bool = False) -> Iterator[Page]:
        """Open a file, with no network, on a screen of the given size."""
        context = self._running.new_context(
            viewport={"width": width, "height": height},
            device_scale_factor=2 if phone else 1,
            is_mobile=phone,
            has_touch=phone,
            color_scheme="dark" if dark else "light",
            reduced_motion="reduce",
            offline=True,
        )
        context.set_default_timeout(PATIENCE_MS)
        tab = context.new_page()
        page = Page(tab)
        tab.goto(path.as_uri())
        page.settle()
        yield page
        context.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One Chromium for the tests of a module."""
    from playwright.sync_api import sync_playwright

    executable = find_chromium()
    with (
        sync_playwright() as started,
        started.chromium.launch(executable_path=executable, args=FLAGS) as running,
    ):
        yield Browser(running)
