"""Large messages arrive: three cameras into the fusion, and its heightmaps in rclpy.

The figures are for a quiet machine: `sctn bench camera_stream` and `python tests/heightmap_latency.py`. Here a short run shows that
nothing is lost; SCTN_FIGURES=1 also holds the times.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import pytest
from cameras import NAMES
from cell_operator import Operator
from heightmap_latency import measure
from processes import BINARIES, REPOSITORY, environment, free_domain

pytestmark = pytest.mark.alone

STRICT = os.environ.get("SCTN_FIGURES") == "1"


def test_heightmaps_reach_rclpy_whole_and_soon() -> None:
    figures = measure(20)
    print(json.dumps(figures))
    assert figures["count"] >= 20
    assert figures["lost"] == 0
    if STRICT:
        assert figures["max_s"] < 0.05


@pytest.mark.parametrize(
    ("profile", "rates_hz"),
    # A machine that other work keeps busy sends 30 sets of 6.3 MB a second no more: there half of that counts, and 30 on a quiet one.
    [(True, [10, 10, 10]), (False, [10, 10, 10]), (True, [30, 30, 30] if STRICT else [30, 30, 15])],
    ids=["with the profile", "without it", "with the profile at 30 Hz"],
)
def test_cameras_on_fast_dds_lose_no_image(start, profile: bool, rates_hz: list[int]) -> None:
    """Three RGB-D cameras of rclpy, a process each, send images of 0.9 and 1.2 MB at one moment; Fast DDS sends them in bursts."""
    # A writer keeps five images: a busy machine has no time to ask for what its sockets lost. The best of three runs counts.
    for rate_hz in rates_hz:
        lost = lost_of_cameras(start, profile, rate_hz, seconds=4 if rate_hz < 30 else 2)
        if not lost:
            return
        print(f"at {rate_hz} Hz: {lost}")
    pytest.fail(f"at {rate_hz} Hz: {lost}")


def lost_of_cameras(start, profile: bool, rate_hz: int, seconds: int) -> dict[str, dict[str, int]]:
    """Counts of the topics of which the fusion has not every message."""
    sets = rate_hz * seconds + 1
    domain = free_domain()
    fusion = start("camera_fusion", domain=domain)
    own = {**environment(domain), "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    own.pop("FASTRTPS_DEFAULT_PROFILES_FILE", None)
    if profile:
        own["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(REPOSITORY / "config/fastdds.xml")
    # All begin at the same moment, when each has found the fusion.
    begin_s = int(time.time()) + 15
    program = [sys.executable, "tests/camera_process.py"]
    arguments = [str(value) for value in (begin_s, rate_hz, seconds)]
    cameras = [subprocess.Popen([*program, name, *arguments], cwd=REPOSITORY, env=own) for name in NAMES]
    topics = [f"/{name}/{stream}" for name in NAMES for stream in ("color/image_raw", "depth/image_rect_raw")]
    try:
        with Operator(domain) as operator:

            def counts() -> dict[str, dict[str, int]]:
                said = operator.diagnosed("camera_fusion: topics")
                words = {topic: said.get(topic, "").split() for topic in [*topics, "/heightmap"]}
                return {
                    topic: {k: int(v) for k, _, v in (word.partition("=") for word in all_) if v.isdigit()} for topic, all_ in words.items()
                }

            def all_have_come() -> bool:
                return all(count.get("messages", 0) >= sets for count in counts().values())

            # The last of the cameras sends until this time; what is lost by then is asked for again.
            end_s = begin_s + seconds + 20
            while time.time() < end_s and not all_have_come():
                operator.spin(0.5)
            found = counts()
        failed = [name for name, camera in zip(NAMES, cameras, strict=True) if camera.poll() not in (None, 0)]
        assert not failed, f"cameras {failed} were not ready in time"
    finally:
        for camera in cameras:
            camera.kill()
            camera.wait()
        fusion.end()
    return {topic: count for topic, count in found.items() if count.get("messages") != sets or count.get("dropped") != 0}


@pytest.mark.parametrize("frames", [1, 5], ids=["each set", "the median of five"])
def test_the_streams_of_three_cameras_become_heightmaps(frames: int) -> None:
    seconds = 60 if STRICT else 3
    # A busy machine may lose images, which are best effort, and the fusion goes on with the next: the best of three runs counts.
    for _ in range(3):
        run = subprocess.run(
            [BINARIES / "sctn", "bench", "camera_stream", "--seconds", str(seconds), "--frames", str(frames), "--json"],
            capture_output=True,
            text=True,
            cwd=REPOSITORY,
            timeout=180,
        )
        print(run.stdout, run.stderr)
        figures = json.loads(run.stdout.splitlines()[-1])["camera_stream"]
        if figures["heightmaps"] > figures["sets"] / 2:
            break
    assert figures["sets"] == 30 * seconds
    assert figures["frames"] == frames
    # Processor time grows where others want the caches and the other half of a core: then a gross excess alone is told.
    assert figures["fusion_cores"] <= (0.5 if STRICT else 1.0)
    assert figures["heightmaps"] > figures["sets"] / 2
    if STRICT:
        assert run.returncode == 0
        assert figures["images_lost"] == 0


@pytest.mark.skipif(not STRICT, reason="a time of the wall clock: for a quiet machine, with SCTN_FIGURES=1")
def test_a_proposal_comes_within_40_ms_of_the_last_still_frame_that_the_median_needs() -> None:
    command = [BINARIES / "sctn", "bench", "still_frames_to_proposal", "--json"]
    run = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, timeout=600)
    print(run.stdout, run.stderr)
    assert run.returncode == 0
    figure = json.loads(run.stdout.splitlines()[-1])["inner_loops"]["still_frames_to_proposal"]
    assert figure["median_s"] <= figure["limit_s"] == 0.04
