"""A person at the operator's page, in a real browser: Debian's Chromium, driven by Playwright."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserType, Locator, Page, ViewportSize, expect, sync_playwright
from processes import Process

CHROMIUM = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)

# Two busy cores: a policy, a simulator and a browser beside each other.
PATIENCE_MS = 60_000
expect.set_options(timeout=PATIENCE_MS)


def launched(kind: BrowserType) -> Browser:
    """One more Chromium, with processes of its own."""
    # The sandbox needs rights that containers do not give.
    return kind.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])


@contextmanager
def chromium() -> Iterator[Browser]:
    """A running Chromium; the test is skipped where there is none, and fails there where CI is set."""
    if CHROMIUM is None:
        reason = "not checked: the operator's page, for want of Chromium (Debian: apt install chromium)"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    with sync_playwright() as playwright:
        browser = launched(playwright.chromium)
        try:
            yield browser
        finally:
            browser.close()


def address_of(launch: Process, until: Callable[[Callable[[], object], str, float], object]) -> str:
    """The address that `sctn launch --operator web` or `sctn console` has printed."""

    def printed() -> str | None:
        found = re.search(r"^operator console: (\S+)$", launch.output() + launch.errors(), re.MULTILINE)
        assert launch.exit_code is None, launch.log()
        return found and found.group(1)

    return until(printed, "address of the operator's page", 90.0)


# What sticks out on the right, where the page would have to be scrolled sideways.
OUTSIDE = """() => {
    const { scrollWidth, clientWidth } = document.documentElement;
    if (scrollWidth <= clientWidth) return [];
    const sticksOut = (one) => one.getBoundingClientRect().right > clientWidth;
    const found = [...document.querySelectorAll("body *")].filter(sticksOut);
    return [`the page by ${scrollWidth - clientWidth} px`, ...found.map((one) => one.outerHTML.slice(0, 120))];
}"""
# Of a telephone.
NARROW = ViewportSize(width=390, height=844)


def no_barrier(page: Page) -> None:
    """axe-core finds nothing serious: names, roles, contrast, focus. Nothing has to be scrolled sideways. On a telephone neither."""
    size = page.viewport_size
    assert size is not None
    for seen in (NARROW, size):
        page.set_viewport_size(seen)
        found = Axe().run(page).response["violations"]
        serious = [(one["id"], [node["html"] for node in one["nodes"]]) for one in found if one["impact"] in ("serious", "critical")]
        if serious:
            raise AssertionError(f"axe-core finds at {seen['width']} px: {serious}")
        outside = page.evaluate(OUTSIDE)
        assert not outside, f"at {seen['width']} px these stick out: {outside}"


class Person:
    """Somebody at the page. Everything is found by what a person reads, and can be done by keyboard alone."""

    def __init__(self, browser: Browser, address: str, name: str, width: int = 1440, height: int = 1000) -> None:
        self.name = name
        self.context = browser.new_context(viewport={"width": width, "height": height})
        self.page: Page = self.context.new_page()
        self.errors: list[str] = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda said: self.errors.append(f"{said.text} ({said.location['url']})") if said.type == "error" else None)
        self.page.goto(address)
        # The dialogue has the focus: a person types and presses Enter.
        expect(self.page.get_by_label("Name", exact=True)).to_be_focused()
        self.page.keyboard.type(name)
        self.page.keyboard.press("Enter")
        expect(self.page.get_by_role("status").filter(has_text="Connected")).to_be_visible()

    def button(self, name: str) -> Locator:
        """A button by its words."""
        return self.page.get_by_role("button", name=name)

    def reads(self, text: str | re.Pattern[str]) -> None:
        """Waits until the headline says this."""
        expect(self.page.get_by_role("heading", level=2).first).to_contain_text(text)

    def presses(self, name: str, is_done: Callable[[float], None]) -> None:
        """Presses a button until it is done, which `is_done` waits for so many ms.

        On a busy machine a stream may be stale for a moment: the page says so and does nothing, and a person presses again.
        """
        for tries in range(1, 4):
            self.can(name)
            self.button(name).click()
            try:
                return is_done(PATIENCE_MS / 4)
            except AssertionError:
                if tries == 3:
                    raise

    def reads_otherwise(self, text: str, timeout_ms: float = PATIENCE_MS) -> None:
        """Waits until the headline says something else."""
        expect(self.page.get_by_role("heading", level=2).first).not_to_have_text(text, timeout=timeout_ms)

    def sees(self, text: str) -> None:
        """Waits until these words are on the page."""
        expect(self.page.get_by_text(text)).to_be_visible()

    def reaches(self, what: Locator) -> None:
        """Goes to something by the Tab key alone."""
        for _ in range(100):
            if what.evaluate("element => element === document.activeElement"):
                return
            self.page.keyboard.press("Tab")
        raise AssertionError(f"the Tab key does not lead to {what}")

    def headline(self) -> str:
        """What the headline says now."""
        return self.page.get_by_role("heading", level=2).first.inner_text()

    def can(self, name: str) -> None:
        """Waits until a button can be pressed."""
        expect(self.button(name)).to_be_enabled()

    def cannot(self, name: str) -> None:
        """Waits until a button is there and cannot be pressed."""
        expect(self.button(name)).to_be_disabled()

    def takes_control(self, over: str | None = None) -> None:
        """Takes control, from somebody or where nobody decides."""
        self.button(f"Take control from {over}" if over else "Take control").click()
        expect(self.page.get_by_text("You decide", exact=True)).to_be_visible()

    def finds_no_barrier(self) -> None:
        """See `no_barrier`."""
        no_barrier(self.page)

    def close(self) -> None:
        """Leaves; nothing went wrong on the page."""
        assert self.errors == [], self.errors
        self.context.close()
