"""What the README shows works as it stands."""

from __future__ import annotations

import os
import pathlib
import re
import subprocess
import sys
import time

from processes import REPOSITORY, environment


def test_the_operator_script_of_the_readme_carries_a_run_through(start, domain: int, tmp_path: pathlib.Path) -> None:
    (script,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    log = tmp_path / "script.log"
    profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]}
    with log.open("wb") as output:
        person = subprocess.Popen(
            [sys.executable, "-u", "-c", script], env={**environment(domain), **profile}, stdout=output, stderr=output
        )
        try:
            launch = start("sctn", "launch", "--problem", "placing", "--seed", 10004, "--operator", "none", "--processes")
            assert launch.wait(300.0) == 0, f"{launch.log()}\n{log.read_text()}"
            # The script may hear of the last reward a little later.
            deadline = time.monotonic() + 30.0
            while not log.read_text().endswith("reward 1.00\n") and time.monotonic() < deadline:
                time.sleep(0.1)
        finally:
            person.kill()
            person.wait()
    assert log.read_text().splitlines()[-1] == "reward 1.00"
