"""How long a heightmap takes to reach rclpy: `python tests/heightmap_latency.py --count 300` prints it as JSON.

The time is from camera_fusion's publication, which DDS stamps, to the callback. `--without-profile` measures Fast DDS as it comes,
without config/fastdds.xml.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import statistics
import sys
import tempfile
import time

REPOSITORY = pathlib.Path(__file__).resolve().parent.parent


def measure(count: int) -> dict[str, float]:
    """Latencies [s] of that many heightmaps, and how many of those that the fusion has sent did not come.

    Images are best effort: a set that does not arrive whole makes no heightmap, and is sent again.
    """
    from cameras import Cameras
    from cell_operator import EVENT, LATCHED, Operator
    from diagnostic_msgs.msg import DiagnosticArray
    from processes import Process, free_domain
    from sctn_msgs.msg import Heightmap

    domain = free_domain()
    with tempfile.TemporaryDirectory() as logs:
        fusion = Process("camera_fusion", [], domain, pathlib.Path(logs))
        try:
            with Operator(domain) as operator:
                ages: list[float] = []
                sent: list[int] = []

                def arrived(_: Heightmap, info: dict[str, int]) -> None:
                    ages.append((time.time_ns() - info["source_timestamp"]) * 1e-9)

                def diagnosed(message: DiagnosticArray) -> None:
                    values = [value for status in message.status for value in status.values if value.key == "/heightmap"]
                    sent.extend(int(value.value.split("messages=")[1].split()[0]) for value in values)

                operator.node.create_subscription(Heightmap, "heightmap", arrived, LATCHED)
                operator.node.create_subscription(DiagnosticArray, "/diagnostics", diagnosed, EVENT)
                cameras = Cameras(operator)
                cameras.wait_for_fusion()
                cameras.publish_extrinsics()

                def until_there_are(heightmaps: int, limit_s: float) -> None:
                    deadline = time.monotonic() + limit_s
                    while len(ages) < heightmaps and time.monotonic() < deadline:
                        cameras.publish()
                        # Not before the last one has come, which the next would replace.
                        before, end = len(ages), time.monotonic() + 2.0
                        while len(ages) == before and time.monotonic() < end:
                            operator.spin(0.002)

                def counts() -> tuple[int, int]:
                    """How many were sent and have come, when nothing is on its way."""
                    operator.spin(1.0)
                    reports = len(sent)
                    operator.until(lambda: len(sent) > reports + 1, "diagnostics", 60.0)
                    return sent[-1], len(ages)

                # The ends meet, and everything runs for the second time.
                until_there_are(5, 60.0)
                sent_before, came_before = counts()
                until_there_are(came_before + count, 60.0 + count)
                latencies = sorted(ages[came_before:])
                sent_after, came_after = counts()
        finally:
            fusion.end()
    figures = {
        "sent": sent_after - sent_before,
        "count": len(latencies),
        "lost": (sent_after - sent_before) - (came_after - came_before),
    }
    if latencies:
        figures["median_s"] = statistics.median(latencies)
        figures["p99_s"] = latencies[min(len(latencies) - 1, round(0.99 * len(latencies)))]
        figures["max_s"] = latencies[-1]
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--without-profile", action="store_true")
    arguments = parser.parse_args()
    # Read when the first participant is made.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"
    os.environ.pop("FASTRTPS_DEFAULT_PROFILES_FILE", None)
    if not arguments.without_profile:
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(REPOSITORY / "config/fastdds.xml")
    sys.path.insert(0, str(REPOSITORY / "tests"))
    print(json.dumps(measure(arguments.count)))


if __name__ == "__main__":
    main()
