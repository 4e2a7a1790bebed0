"""A real browser for the pages: Debian's Chromium, driven by Playwright, with a record of its complaints."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from axe_playwright_python.sync_playwright import Axe
from hypothesis import settings
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from tests.needs import chromium, need
from tests.waiting import END_S

SCREENS = Path("build/screens")
# No sandbox, because tests may run as root in a container; the 3-D view is drawn without a graphics card.
ARGUMENTS = ["--no-sandbox", "--enable-unsafe-swiftshader", "--disable-gpu-vsync"]
DESK, PHONE = {"width": 1280, "height": 860}, {"width": 360, "height": 740}
# In the place of the script that draws the 3-D view, in software here.
WITHOUT_VIEW = "export class Renderer { buffers = new Map(); draw() {} }"
HARMLESS = ("GL Driver Message", "Multiple readback operations")  # messages of the software renderer


@contextmanager
def browsing() -> Iterator[Browser]:
    """Start the browser; if there is none the test is skipped, or fails if CI requires it (`tests.needs`)."""
    need("browser")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium(), args=ARGUMENTS)
        yield browser
        browser.close()


def colours(drawn: bytes) -> int:
    """Count the colours of a picture: an empty canvas has one."""
    pixels = np.asarray(Image.open(io.BytesIO(drawn)).convert("RGB"))
    return len(np.unique(pixels.reshape(-1, 3), axis=0))


def axe(page: Page, without: str | None = None) -> list[str]:
    """Return what axe-core finds on a page, but in the elements of a selector: rule, and the elements that break it."""
    found = Axe().run(page, context=None if without is None else {"exclude": [[without]]}).response["violations"]
    return [f"{one['id']}: {[node['html'][:120] for node in one['nodes']]}" for one in found]


class Watched:
    """A page with a record of the browser's complaints and of every address requested."""

    def __init__(
        self, browser: Browser, url: str, *, phone: bool = False, dark: bool = False, view: bool = True
    ) -> None:
        """Open a page.

        Args:
            browser: The browser.
            url: The service.
            phone: Whether the window is that of a phone.
            dark: Whether the system's colours are dark.
            view: Whether 3-D views are drawn.
        """
        self.url = url
        self.context = browser.new_context(
            viewport=PHONE if phone else DESK, color_scheme="dark" if dark else "light", has_touch=phone
        )
        self.context.set_default_timeout(1000 * END_S)
        self.page: Page = self.context.new_page()
        if not view:
            script = "text/javascript"
            self.page.route("**/webgl.js", lambda asked: asked.fulfill(content_type=script, body=WITHOUT_VIEW))
        self.complaints: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda said: self._heard(said.type, said.text))
        self.page.on("pageerror", lambda error: self.complaints.append(f"{error.name}: {error.message}"))
        self.page.on("request", lambda request: self.asked.append(request.url))

    def _heard(self, kind: str, text: str) -> None:
        if kind in ("error", "warning") and not any(word in text for word in HARMLESS):
            self.complaints.append(text)

    def open(self, path: str) -> None:
        self.page.goto(self.url + path)

    def shoot(self, name: str) -> None:
        """Save a screenshot of the whole page for people to look at, with `--hypothesis-profile=nightly` only."""
        if settings.get_current_profile_name() == "nightly":
            SCREENS.mkdir(parents=True, exist_ok=True)
            self.page.evaluate("scrollTo(0, 0)")
            self.page.screenshot(path=SCREENS / f"{name}.png", full_page=True)

    def foreign(self) -> list[str]:
        """List the requested addresses that are not this server's; an embedded picture has none."""
        return [url for url in self.asked if not url.startswith((f"{self.url}/", "data:", f"blob:{self.url}/"))]

    def too_wide(self) -> int:
        """Return by how many pixels the page is wider than the window."""
        wide: int = self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        return wide


@contextmanager
def visiting(browser: Browser, url: str, **how: bool) -> Iterator[Watched]:
    """Open a tab, and assert at the end that the browser has complained of nothing and requested no other server."""
    tab = Watched(browser, url, **how)
    yield tab
    tab.context.close()
    assert tab.complaints == []
    assert tab.foreign() == []
