"""A whole run with driver and cameras as they are: whole_run.py PROBLEM SEED MOST_PROPOSALS [CONTACT [CHECKPOINT]].

CONTACT: the executor's `driver.contact`; with `height` the robot is a CB3, which knows no tool contact and no `trajectory_until_node`.
The demonstration is one of the same cell on another day: as its cameras saw it, with another light and other noise.

Prints its result as a line of JSON, and where it is not complete the logs on standard error.
Everything happens in real time: a disk takes some 10 s, of which the driver takes 3 s to accept two descents.
"""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import signal
import sys
import tempfile
import time

from processes import REPOSITORY, Process, free_domain

# Read by rmw_fastrtps when the first participant is made.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(REPOSITORY / "config/fastdds.xml"))

from cell_operator import Operator
from sctn_msgs.msg import StepConfirmation, StepResult

REALISTIC = REPOSITORY / "config/hardware/realistic.yaml"
PERTURBATION = REPOSITORY / "config/perturbations/realsense.yaml"
CHECKPOINTS = REPOSITORY / "config/checkpoints"
# How old joint states and heightmaps may be [s]. Processes here wait for a processor, as those of a robot's computer do not: a pause of the
# simulation is no driver that is lost, and one of the fusion no dead camera.
STATUS_MAX_AGE_S, OBSERVATION_MAX_AGE_S = 1.0, 8.0
# What ends a run.
BROKEN_OFF = (StepResult.FAULT, StepResult.STOPPED, StepResult.REFUSED)


def parameters(node: str, **values: object) -> list[object]:
    """The arguments of a node of the realistic cell."""
    arguments: list[object] = ["--ros-args", "--params-file", REPOSITORY / f"config/{node}.yaml", "--params-file", REALISTIC]
    if node == "suction_executor":
        values = {"driver__status_max_age_s": STATUS_MAX_AGE_S, "observation_max_age_s": OBSERVATION_MAX_AGE_S, **values}
    for name, value in values.items():
        arguments += ["-p", f"{name.replace('__', '.')}:={value}"]
    return arguments


def approve_all(operator: Operator, most_proposals: int) -> dict[str, object]:
    """Approves every proposal until the run is complete or broken off, and says what came of it."""
    outcomes: list[int] = []
    reason, seen, complete = "", 0, False
    while len(outcomes) < most_proposals and not complete and not reason:
        goal = operator.newest("goal") if operator.count("goal") > seen else operator.next("goal", seen)
        seen = operator.count("goal")
        wanted = (goal.step, goal.attempt)
        operator.next("pick_place", accept=lambda made, wanted=wanted: (made.step, made.attempt) == wanted)
        # Another view may have replaced it meanwhile.
        operator.until(operator.executor_is_ready, "executor that is ready", 60.0)
        proposal = operator.newest("pick_place")
        rewards = operator.count("reward")
        result = operator.approve(proposal)
        if result.outcome == StepResult.REFUSED and "superseded" in result.reason:
            seen -= 1
            continue
        outcomes.append(result.outcome)
        if result.outcome in BROKEN_OFF:
            reason = result.reason
            continue
        reward = operator.next("reward", rewards)
        complete = reward.complete
        if not complete:
            operator.confirm(proposal.id, StepConfirmation.ADVANCE if reward.delta > 0 else StepConfirmation.RETRY)
    total = operator.newest("reward").total if operator.count("reward") else 0.0
    return {"complete": complete, "total_reward": total, "outcomes": outcomes, "broken_off": reason}


def main() -> None:
    # What was started is ended then too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    problem, seed, most_proposals = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    contact = sys.argv[4] if len(sys.argv) > 4 else "until_action"
    robot = {"hardware__software_major": 3} if contact == "height" else {}
    # A robot that senses no contact is sure to touch what it is to grip only where it goes a little further.
    sign = {"driver__contact": contact} | ({"contact__press_m": 0.003} if contact == "height" else {})
    checkpoint = CHECKPOINTS / f"{sys.argv[5] if len(sys.argv) > 5 else 'any_start'}.safetensors"
    domain = free_domain()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        logs = pathlib.Path(folder)
        started: list[Process] = []

        def start(name: str, *line: object) -> Process:
            started.append(Process(name, [str(argument) for argument in line], domain, logs))
            stack.callback(started[-1].end)
            return started[-1]

        demos = start(
            "sctn", "demos", "--problem", problem, "--episodes", 1, "--seed", seed, "--perturb", PERTURBATION, "--out", logs / "demos",
        )  # fmt: skip
        if demos.wait(120.0):
            sys.exit(demos.log())
        (demonstration,) = [file.parent for file in (logs / "demos").rglob("metadata.yaml")]
        operator = stack.enter_context(Operator(domain, topics=("goal", "pick_place", "step_result", "reward")))
        start("sim_workcell", *parameters("sim_workcell", problem=problem, seed=seed, **robot))
        start("camera_fusion", *parameters("camera_fusion"))
        start("goal_oracle", *parameters("goal_oracle", demonstration=demonstration))
        start("gctn_policy", *parameters("gctn_policy", checkpoint=checkpoint))
        start("suction_executor", *parameters("suction_executor", **sign))
        operator.listeners = 3
        begin = time.monotonic()
        try:
            result = approve_all(operator, most_proposals)
        except TimeoutError as error:
            result = {"complete": False, "broken_off": str(error)}
        if not result["complete"]:
            print(*(f"--- {process.name}\n{process.log()}" for process in started), sep="\n", file=sys.stderr)
    print(json.dumps({"problem": problem, "seed": seed, "took_s": round(time.monotonic() - begin, 1), **result}), flush=True)


if __name__ == "__main__":
    main()
