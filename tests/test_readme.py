"""What README and guide show works as it stands."""

from __future__ import annotations

import json
import os
import pathlib
import re
import subprocess
import sys
import time

from processes import REPOSITORY, environment

# Disks of placing.
STEPS = 9


def test_the_operator_script_of_the_guide_carries_a_run_through(start, domain: int, tmp_path: pathlib.Path) -> None:
    (script,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "docs/guide/operate.md").read_text(), re.DOTALL)
    log = tmp_path / "script.log"
    profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]}
    with log.open("wb") as output:
        person = subprocess.Popen(
            [sys.executable, "-u", "-c", script], env={**environment(domain), **profile}, stdout=output, stderr=output
        )
        try:
            launch = start("sctn", "launch", "--problem", "placing", "--seed", 10004, "--operator", "none", "--processes", "--json")
            assert launch.wait(300.0) == 0, f"{launch.log()}\n{log.read_text()}"
            # The script may hear of the last result a little later.
            deadline = time.monotonic() + 30.0
            while log.read_text().count("placed\n") < STEPS and time.monotonic() < deadline:
                time.sleep(0.1)
        finally:
            person.kill()
            person.wait()
    assert log.read_text().splitlines()[-1] == "placed", log.read_text()
    assert json.loads(launch.output().splitlines()[-1])["completed"] is True
