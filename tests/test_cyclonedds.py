"""A peer on another DDS, without ROS, operates the graph."""

from __future__ import annotations

import subprocess
import sys

from processes import REPOSITORY, environment

# What rmw_cyclonedds_cpp does for ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST.
LOOPBACK = """
<CycloneDDS><Domain>
  <General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""


def test_an_operator_on_cyclonedds_completes_placing(start, domain: int) -> None:
    launch = start("sctn", "launch", "--problem", "placing", "--seed", 10006, "--operator", "none", "--json")
    operator = subprocess.run(
        [sys.executable, REPOSITORY / "tests/cyclone_operator.py", "--domain", str(domain), "--timeout", "200"],
        env={**environment(domain), "CYCLONEDDS_URI": LOOPBACK},
        capture_output=True,
        text=True,
        timeout=230.0,
        check=False,
    )
    lines = operator.stdout.splitlines()
    assert operator.returncode == 0, f"{operator.stdout}\n{operator.stderr}\n{launch.log()}"
    assert launch.wait(60.0) == 0, launch.log()
    assert "reward 1.00" in lines
    # A goal of 0.7 MB arrived whole: 320 x 160 cells.
    assert "goal 1 of 9: 153600 bytes of colour, 51200 heights" in lines
    assert sum(line.startswith("result 1") for line in lines) == 9
