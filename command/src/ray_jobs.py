"""Carries out jobs as tasks of Ray: `sctn sweep --engine ray` starts it with its jobs as JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys

# No statistics of use leave the host.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

try:
    import ray
except ImportError:
    sys.exit(f"--engine ray: {sys.executable} has no package ray (python3 -m pip install ray), expected one that has; --python names it")

# How often a command is started anew after its worker was lost.
RETRIES = 10


def carry_out(command: list[str]) -> int:
    """Runs a command to its end, and returns its exit code. The kernel kills it when this worker dies: the one that goes on is alone."""
    return subprocess.run(["setpriv", "--pdeathsig", "KILL", *command], check=False).returncode


def main() -> int:
    """Carries out a command with each of its parts as last argument, and waits for all; returns 1 if one has failed."""
    jobs = json.loads(sys.argv[1])
    ray.init()
    task = ray.remote(carry_out).options(num_cpus=jobs["cores"], num_gpus=jobs["gpus"], max_retries=RETRIES)
    names = {task.remote([*jobs["command"], part]): name for name, part in jobs["parts"].items()}
    failed = 0
    while names:
        (done,), _ = ray.wait(list(names))
        name = names.pop(done)
        try:
            code = ray.get(done)
            outcome = "done" if code == 0 else f"exit code {code}"
        except ray.exceptions.RayError as error:
            code, outcome = 1, str(error)
        print(f"{name}: {outcome}", file=sys.stderr)
        failed |= code != 0
    return int(failed)


sys.exit(main())
