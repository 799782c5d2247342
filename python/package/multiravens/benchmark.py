"""Steps per second of an environment, as a command: ``python -m multiravens.benchmark --problem stacking``."""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

from multiravens.vector import MultiRavensVectorEnv


def steps_per_second(problem: str, threads: int, seconds: float, envs: int = 8) -> dict[str, float]:
    """Steps of the demonstrator in a second of ``envs`` episodes on ``threads`` threads, resets counted in the time."""
    environment = MultiRavensVectorEnv(problem, envs, threads=threads, goal="none")
    _, info = environment.reset(seed=0)
    action = np.zeros((envs, 6))
    steps = 0
    start, processor = time.perf_counter(), time.process_time()
    while time.perf_counter() - start < seconds:
        if "demonstrator_action" in info:
            action = info["demonstrator_action"]
        resets = environment._done
        _, _, _, _, info = environment.step(action)
        steps += int(np.count_nonzero(~resets))
    elapsed, processor = time.perf_counter() - start, time.process_time() - processor
    return {"threads": threads, "steps_per_second": steps / elapsed, "cpu_seconds_per_step": processor / steps}


def main() -> None:
    """Prints the steps per second on 1 and on 2 threads."""
    parser = argparse.ArgumentParser(prog="python -m multiravens.benchmark", description=__doc__)
    parser.add_argument("--problem", default="stacking")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each number of threads")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--json", action="store_true", help="print a JSON object")
    arguments = parser.parse_args()
    rows = [steps_per_second(arguments.problem, threads, arguments.seconds, arguments.envs) for threads in arguments.threads]
    if arguments.json:
        print(json.dumps({"problem": arguments.problem, "rows": rows}))
        return
    for row in rows:
        print(
            f"{arguments.problem}, {row['threads']} threads: {row['steps_per_second']:.1f} steps a second, "
            f"{1e3 * row['cpu_seconds_per_step']:.0f} ms of processor time a step"
        )


if __name__ == "__main__":
    main()
