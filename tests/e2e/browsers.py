"""A real browser for the pages: Debian's Chromium, driven by Playwright, that writes down what it was not to see."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

SCREENS = Path("build/screens")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or "/usr/bin/chromium"
# No sandbox, for tests may run as root in a container; the 3-D view is drawn without a graphics card.
ARGUMENTS = ["--no-sandbox", "--enable-unsafe-swiftshader", "--disable-gpu-vsync"]
DESK, PHONE = {"width": 1280, "height": 860}, {"width": 360, "height": 740}
HARMLESS = ("GL Driver Message", "Multiple readback operations")  # a word of the software that draws here


@contextmanager
def browsing() -> Iterator[Browser]:
    """Start the browser; where there is none, fail and say how to get it."""
    if not Path(CHROMIUM).exists():
        pytest.fail("The pages need a real browser to be tested: install it with `apt-get install chromium`.")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


class Watched:
    """A page that remembers what a browser complained of, and every address that it asked."""

    def __init__(self, browser: Browser, url: str, *, phone: bool = False, dark: bool = False) -> None:
        self.url = url
        self.context = browser.new_context(
            viewport=PHONE if phone else DESK, color_scheme="dark" if dark else "light", has_touch=phone
        )
        self.context.set_default_timeout(30_000)
        self.page: Page = self.context.new_page()
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

    def shoot(self, name: str) -> bytes:
        """Save what is seen, the whole page."""
        SCREENS.mkdir(parents=True, exist_ok=True)
        self.page.evaluate("scrollTo(0, 0)")
        return self.page.screenshot(path=SCREENS / f"{name}.png", full_page=True)

    def foreign(self) -> list[str]:
        """List the addresses asked that are not this server's; a picture written out in place has none."""
        return [url for url in self.asked if not url.startswith((f"{self.url}/", "data:", f"blob:{self.url}/"))]

    def too_wide(self) -> int:
        """Measure by how many pixels the page is wider than the window."""
        wide: int = self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        return wide
