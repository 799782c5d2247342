"""Draws the operator's page for docs/pictures: `.venv/bin/python tests/console_pictures.py docs/pictures`, with the programs built.

A run of stacking at its second step, a lesson, and a policy that has learned from it, each 1440 and 390 pixels wide.
"""

from __future__ import annotations

import pathlib
import sys
import tempfile

from browser import PATIENCE_MS, Person, address_of, chromium
from playwright.sync_api import Page, expect
from processes import Process, free_domain
from test_operator_console import until

SIZES = {"wide": (1440, 1000), "narrow": (390, 844)}


def picture(page: Page, folder: pathlib.Path, name: str) -> None:
    """The whole page at each size."""
    for size, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(300)
        # All of it in view: what sticks to an edge of the window hides nothing.
        page.set_viewport_size({"width": width, "height": page.evaluate("document.documentElement.scrollHeight")})
        page.wait_for_timeout(300)
        page.screenshot(path=folder / f"console_{name}_{size}.png")
        wider = page.evaluate("document.documentElement.scrollWidth > innerWidth")
        assert not wider, f"{name}: the page is wider than {width} pixels"


def main() -> None:
    """Launches, drives the page, draws."""
    folder = pathlib.Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as scratch, chromium() as browser:
        logs = pathlib.Path(scratch)
        arguments = ["launch", "--problem", "stacking", "--seed", "10000", "--operator", "web", "--library", str(logs / "library")]
        launch = Process("sctn", arguments, free_domain(), logs)
        try:
            ada = Person(browser, address_of(launch, until), "Ada")
            ada.takes_control()
            for button in ("Approve", "It succeeded"):
                ada.can(button)
                ada.button(button).click()
            ada.reads("Step 2 of 6: the policy proposes")
            ada.can("Approve")
            picture(ada.page, folder, "run")
            ada.page.get_by_label("Difference").check()
            ada.button("Correct…").click()
            picture(ada.page, folder, "correct")
            ada.button("Keep the policy's").click()
            ada.page.get_by_label("Colour").check()
            ada.button("Teach a new task").click()
            ada.reads("Teaching a new task")
            ada.page.set_viewport_size({"width": 1440, "height": 1000})
            table = ada.page.get_by_role("img", name="The table now, from above")
            table.scroll_into_view_if_needed()
            board = table.bounding_box()
            for right, down in ((0.257, 0.31), (0.19, 0.68)):
                ada.page.mouse.click(board["x"] + right * board["width"], board["y"] + down * board["height"])
            ada.button("Show the motion").click()
            ada.can("Carry it out")
            ada.page.wait_for_timeout(2000)
            picture(ada.page, folder, "teach")
            ada.button("Carry it out").click()
            ada.button("As it should be: keep this step").click()
            for name in ("one_block", "one_block_again"):
                ada.page.get_by_label("Name of the task").fill(name)
                ada.button("Save").click()
                ada.sees(f"Saved as {name}.")
            ada.button("End the lesson").click()
            for name, use in (("one_block", "learn from"), ("one_block_again", "hold out")):
                ada.page.get_by_role("combobox", name=name, exact=True).select_option(use)
            ada.page.get_by_label("Name of the policy").fill("taught")
            ada.page.get_by_role("spinbutton", name="Steps").fill("40")
            ada.button("Train").click()
            expect(ada.page.get_by_text("taught is trained.")).to_be_visible(timeout=5 * PATIENCE_MS)
            for board in ("as shown", "by taught", "by the policy of now"):
                expect(ada.page.get_by_role("img", name=f"one_block_again, step 1, {board}")).to_be_visible()
            picture(ada.page, folder, "train")
        finally:
            launch.end()


if __name__ == "__main__":
    main()
