"""Measures the operator's page: `.venv/bin/python tests/console_latency.py`, with the programs built.

How long from the publication of a heightmap to its pixels on the page, and from a click to the publication of its step_confirmation
and to its arrival at another node. A run of stacking, everything on this machine.
"""

from __future__ import annotations

import os
import pathlib
import statistics
import tempfile

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"

from browser import Person, address_of, chromium
from cell_operator import EVENT, LATCHED, Operator
from processes import Process, free_domain
from sctn_msgs.msg import Heightmap, StepConfirmation
from test_operator_console import until

STEPS = 5

# Times of clicks and of drawn pictures, in ms since 1970.
WATCH = """() => {
  window.clicks = []; window.drawn = [];
  document.addEventListener("click", () => clicks.push(performance.timeOrigin + performance.now()), true);
  new MutationObserver(() => requestAnimationFrame(() => setTimeout(() => drawn.push(performance.timeOrigin + performance.now()))))
    .observe(document.getElementById("boards"), { attributes: true, attributeFilter: ["data-drawn"] });
}"""


def words(name: str, values_ms: list[float]) -> str:
    """Median and longest."""
    return f"{name}: median {statistics.median(values_ms):.1f} ms, longest {max(values_ms):.1f} ms, of {len(values_ms)}"


def main() -> None:
    """Approves some steps and measures."""
    domain = free_domain()
    with tempfile.TemporaryDirectory() as scratch, chromium() as browser, Operator(domain) as operator:
        arguments = ["launch", "--problem", "stacking", "--seed", "10000", "--operator", "web"]
        launch = Process("sctn", arguments, domain, pathlib.Path(scratch))
        # When a heightmap and a confirmation were published, and when that arrived [ms since 1970], whenever this program looks.
        heard: dict[str, list[float]] = {"heightmap": [], "published": [], "confirmation": []}
        node = operator.node
        node.create_subscription(
            Heightmap, "heightmap", lambda _, about: heard["heightmap"].append(about["source_timestamp"] / 1e6), LATCHED
        )

        def on_confirmation(_: StepConfirmation, about: dict) -> None:
            heard["published"].append(about["source_timestamp"] / 1e6)
            heard["confirmation"].append(about["received_timestamp"] / 1e6)

        node.create_subscription(StepConfirmation, "step_confirmation", on_confirmation, EVENT)
        pixels_ms, published_ms, clicks_ms = [], [], []
        try:
            ada = Person(browser, address_of(launch, until), "Ada")
            ada.takes_control()
            operator.until(operator.executor_is_ready, "executor that has checked its driver", 60.0)
            ada.page.evaluate(WATCH)
            for _ in range(STEPS):
                for name in ("Approve", "It succeeded"):
                    ada.can(name)
                    operator.spin(0.5)
                    ada.can(name)
                    said, seen = len(heard["confirmation"]), len(heard["heightmap"])
                    drawn = ada.page.evaluate("drawn.length")
                    ada.button(name).click()
                    operator.until(lambda said=said: len(heard["confirmation"]) > said, "step_confirmation", 10.0)
                    clicked_ms = ada.page.evaluate("clicks.at(-1)")
                    published_ms.append(heard["published"][said] - clicked_ms)
                    clicks_ms.append(heard["confirmation"][said] - clicked_ms)
                    if name == "Approve":
                        operator.until(lambda seen=seen: len(heard["heightmap"]) > seen, "heightmap", 60.0)
                        operator.until(lambda drawn=drawn: ada.page.evaluate("drawn.length") > drawn, "picture of it", 10.0)
                        pixels_ms.append(ada.page.evaluate("drawn")[drawn] - heard["heightmap"][seen])
                if "All steps" in ada.headline():
                    break
        finally:
            launch.end()
    print(words("heightmap to pixels", pixels_ms))
    print(words("click to published step_confirmation", published_ms))
    print(words("click to step_confirmation at another node", clicks_ms))


if __name__ == "__main__":
    main()
