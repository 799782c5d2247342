"""The operator's page in a real browser, its API with a program, and what is hostile to both."""

from __future__ import annotations

import concurrent.futures
import http.client
import importlib.util
import itertools
import json
import math
import os
import pathlib
import random
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import teaching
from browser import PATIENCE_MS, Person, address_of, chromium, launched, no_barrier
from cameras import LENSES, through_lens
from cell_operator import EVENT, Operator, nanoseconds
from playwright.sync_api import Browser, Locator, expect
from processes import REPOSITORY, Process
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rosbags.highlevel import AnyReader
from sctn_msgs.msg import OperatorPresence, StepConfirmation, StepResult

STEPS = 6
# A start of the blocks that is another one than that of the lesson.
START = 10001
# One more, for what policies are compared with.
HELD_BACK_START = 10002
# And one from which a step is corrected.
CORRECTED_START = 10003
# Gradient steps of the training in a test.
TRAINING_STEPS = 8


def console_client() -> Any:
    """The example client as a module."""
    path = REPOSITORY / "docs/examples/operator_console.py"
    specification = importlib.util.spec_from_file_location("operator_console_client", path)
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    return module


CLIENT = console_client()


def until(condition: Callable[[], Any], what: str, timeout_s: float) -> Any:
    """Waits for a condition that needs no node."""
    end = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < end, f"no {what} within {timeout_s} s"
        time.sleep(0.05)
    return found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One browser for all tests."""
    with chromium() as running:
        yield running


@pytest.fixture
def decided(operator: Operator) -> Callable[..., list[StepConfirmation]]:
    """What operators have decided, as the graph hears it, after a last look: `decided(2)` waits for two decisions at least."""
    heard: list[StepConfirmation] = []
    operator.node.create_subscription(StepConfirmation, "step_confirmation", heard.append, EVENT)

    def look(at_least: int = 0) -> list[StepConfirmation]:
        operator.until(lambda: len(heard) >= at_least, f"{at_least} decisions on the graph", 30.0)
        operator.spin(0.3)
        return heard

    return look


def launch_web(start: Callable[..., Process], seed: int, *arguments: object) -> tuple[Process, str]:
    """A run of stacking that waits for a person, and the address of the page."""
    launch = start("sctn", "launch", "--problem", "stacking", "--seed", seed, "--operator", "web", *arguments)
    return launch, address_of(launch, until)


def program(launch: Process, name: str) -> int:
    """Process id of a node that was launched as a process of its own."""
    for pid in launch.descendants():
        if pathlib.Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[0].endswith(f"/{name}".encode()):
            return pid
    raise AssertionError(f"{name} does not run")


def set_of_cell(operator: Operator, parameter: Parameter) -> None:
    """Sets a parameter of sim_workcell while it runs."""
    client = operator.node.create_client(SetParameters, "sim_workcell/set_parameters")
    operator.until(client.service_is_ready, "sim_workcell", 30.0)
    answer = client.call_async(SetParameters.Request(parameters=[parameter.to_parameter_msg()]))
    operator.until(answer.done, "answer of sim_workcell", 30.0)
    assert answer.result().results[0].successful


def slow_down(operator: Operator, factor: float) -> None:
    """Simulated seconds for each second: a person can stop a motion only where it takes time."""
    set_of_cell(operator, Parameter("real_time_factor", Parameter.Type.DOUBLE, factor))


def as_arguments(parameters: dict[str, object]) -> list[str]:
    """Parameters as `-p name:=value`."""
    return [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]


def console_process(start: Callable[..., Process], address_file: pathlib.Path, **more: object) -> tuple[Process, str]:
    """A console beside a graph that runs, and its address."""
    address_file.unlink(missing_ok=True)
    parameters = {"port": 0, "address_file": address_file, "use_sim_time": "true", **more}
    process = start("operator_console", "--ros-args", *as_arguments(parameters))
    until(address_file.exists, "address of the page", 30.0)
    return process, address_file.read_text().strip()


def test_a_person_rejects_once_and_then_approves_a_run_of_stacking_to_its_end_by_keyboard(
    browser: Browser, start, operator: Operator, decided, tmp_path: pathlib.Path
) -> None:
    launch, address = launch_web(start, 10000, "--record", tmp_path / "record")
    ada = Person(browser, address, "Ada")
    ada.reaches(ada.button("Take control"))
    ada.page.keyboard.press("Enter")
    ada.reads("Step 1 of 6: the policy proposes")
    expect(ada.page.get_by_role("listitem").filter(has_text="Step 1 (now)")).to_have_attribute("aria-current", "step")
    ada.can("Approve")
    # What is proposed is seen from everywhere before it is approved.
    expect(ada.page.get_by_text(re.compile("Made by gctn_policy with ten_problems"))).to_be_visible()
    expect(ada.page.get_by_text(re.compile(r"The planned motion takes \d"))).to_be_visible()
    expect(ada.page.get_by_text("100 % of the planned")).to_be_visible()
    expect(ada.page.get_by_text(re.compile(r"from above, the robot below, \d+ s old"))).to_be_visible()
    slider = ada.page.get_by_role("slider", name="Time")
    robot = ada.page.get_by_role("img", name="The robot in its cell")
    drawn = []
    ada.reaches(slider)
    for key in ("Home", "PageUp", "PageUp"):
        ada.page.keyboard.press(key)
        drawn.append(robot.evaluate("canvas => canvas.toDataURL()"))
    assert len(set(drawn)) == 3
    ada.page.keyboard.press("p")
    ada.reaches(ada.button("Pause"))
    ada.page.keyboard.press("Enter")
    cameras = ada.page.locator("summary").filter(has_text="Camera views")
    ada.reaches(cameras)
    ada.page.keyboard.press("Enter")
    views = [ada.page.get_by_role("img", name=f"What the {name} camera sees") for name in ("front", "left", "right")]

    def pixels(view: Locator, condition: str) -> int:
        """How many pixels of an image have such red, green and blue (d[i], d[i + 1], d[i + 2])."""
        count = "c => { const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0; "
        return view.evaluate(count + f"for (let i = 0; i < d.length; i += 4) n += {condition}; return n; }}")

    # The place is marked in its colour, and where the policy would place shines blue.
    marked, blue = "d[i] === 92 && d[i + 1] === 214 && d[i + 2] === 192", "d[i] < 70 && d[i + 2] > 160"
    for view in views:
        expect(view).to_be_visible()
        until(lambda view=view: pixels(view, marked) > 20, "mark on a camera's image", 20.0)
    unscored = [pixels(view, blue) for view in views]
    table = ada.page.get_by_role("img", name="The table now, from above")
    # As colours, as heights, as what differs from the goal, and as scores: each is another picture.
    ada.reaches(ada.page.get_by_label("Colour"))
    pictures = [table.evaluate("canvas => canvas.toDataURL()")]
    for mode in ("Height", "Difference", "Pick scores", "Place scores"):
        ada.page.keyboard.press("ArrowDown")
        expect(ada.page.get_by_role("radio", name=mode)).to_be_checked()
        if mode == "Difference":
            expect(ada.page.get_by_text(re.compile(r"\([0-9.]+ % of it differs from the goal\)"))).to_be_visible()
        until(lambda: table.evaluate("canvas => canvas.toDataURL()") not in pictures, mode, 20.0)
        pictures.append(table.evaluate("canvas => canvas.toDataURL()"))
    for view, before in zip(views, unscored, strict=True):
        until(lambda view=view, before=before: pixels(view, blue) > before + 10, "scores on a camera's image", 20.0)
    ada.page.keyboard.press("ArrowDown")
    expect(ada.page.get_by_label("Colour")).to_be_checked()
    ada.reaches(cameras)
    ada.page.keyboard.press("Enter")
    ada.finds_no_barrier()
    ada.page.keyboard.press("r")
    ada.reads("Step 1 of 6, attempt 2")
    keys = 0
    question = re.compile("proposes|succeed|All steps")
    done = 0
    while done < STEPS:
        ada.reads(question)
        headline = ada.headline()
        if "proposes" in headline:
            ada.can("Approve")
            key = "a"
        else:
            # A person sees whether the step succeeded; the test asks the simulator.
            proposed = operator.next("pick_place", accept=lambda proposal: proposal.step == done + 1)
            proposed = next(one for one in reversed(operator.received["pick_place"]) if one.step == proposed.step)
            seen = nanoseconds(proposed.header.stamp)
            reward = operator.next("reward", accept=lambda reward: nanoseconds(reward.header.stamp) > seen, timeout_s=30.0)
            done += reward.delta > 0
            key = "n" if reward.delta > 0 else "t"
            ada.can("It succeeded")
        keys += 1
        ada.page.keyboard.press(key)
        expect(ada.page.get_by_role("heading", level=2).first).not_to_have_text(headline)
        assert keys < 40, ada.headline()
    ada.reads("All steps are done")
    # Each step is shown with what was before and after it.
    for step in range(1, STEPS + 1):
        for when in ("Before", "After"):
            expect(ada.page.get_by_role("img", name=f"{when} step {step}").first).to_be_attached()
    ada.close()
    assert launch.wait(60.0) == 0, launch.log()
    assert "completed" in launch.output()
    # Each decision was heard on the graph, by name.
    said = decided(1)
    assert said[0].decision == StepConfirmation.REJECT
    assert {one.operator_name for one in said} == {"Ada"}
    # And stands in the log and in the bag, with its time, beside the checkpoint of each proposal.
    assert "`Ada`: decision" in launch.errors()
    with AnyReader([tmp_path / "record/run"]) as reader:
        chosen = [connection for connection in reader.connections if connection.topic in ("/step_confirmation", "/pick_place")]
        recorded = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages(chosen)]
    names = [(one.operator_name, nanoseconds(one.header.stamp) > 0) for topic, one in recorded if topic == "/step_confirmation"]
    assert names == [("Ada", True)] * len(said)
    assert {one.checkpoint for topic, one in recorded if topic == "/pick_place"} == {"ten_problems"}


def test_a_console_joins_a_graph_that_runs_and_another_one_after_it(start) -> None:
    start("sctn", "launch", "--problem", "stacking", "--seed", 10008, "--operator", "none")
    for name in ("Ada", "Bob"):
        joined = start("sctn", "console", "--use-sim-time", "--port", 0)
        console = CLIENT.Console(address_of(joined, until), name)
        console.take_control()

        def present(console: Any = console) -> dict[str, Any] | None:
            """The proposal that can be approved: the one before it may come first."""
            state = console.wait("proposed")
            return state["proposal"] if "approve" not in state["refused"] else None

        proposed = until(present, "proposal that can be approved", 30.0)
        console.decide("reject", proposed)
        until(lambda console=console, seen=proposed: console.wait("proposed")["proposal"]["id"] != seen["id"], "another proposal", 60.0)
        joined.end()
        assert joined.exit_code == 0


def test_a_motion_is_stopped_and_the_run_goes_on_and_a_second_browser_takes_over(
    browser: Browser, start, operator: Operator, decided, tmp_path: pathlib.Path
) -> None:
    library = tmp_path / "library"
    launch, address = launch_web(start, 10002, "--processes", "--library", library)
    ada, bob = Person(browser, address, "Ada"), Person(browser, address, "Bob", width=390, height=844)
    ada.takes_control()
    expect(bob.page.get_by_text("You watch. Ada decides")).to_be_visible()
    ada.reads("proposes")
    ada.can("Approve")
    bob.cannot("Approve")
    expect(bob.page.get_by_text("Ada decides. You are watching.")).to_be_visible()

    # A camera's images stop, as does the node that fuses them: nothing can be approved until it is back.
    fusion = program(launch, "camera_fusion")
    os.kill(fusion, signal.SIGSTOP)
    ada.cannot("Approve")
    expect(ada.page.get_by_role("status").filter(has_text="camera_fusion is stale")).to_be_visible()
    assert is_greyed(ada)
    os.kill(fusion, signal.SIGCONT)
    ada.can("Approve")
    assert not is_greyed(ada)

    # Stopped in mid-motion, by button.
    slow_down(operator, 1.0)
    ada.button("Approve").click()
    ada.reads("the arm moves")
    results = operator.count("step_result")
    ada.button("Stop").click()
    ada.reads("stopped")
    assert operator.next("step_result", results).outcome == StepResult.STOPPED
    slow_down(operator, 0.0)
    ada.button("Arm home").click()
    # The way home is shown, and nothing moves before it is approved.
    ada.sees("Nothing moves before you approve it.")
    ada.can("Go home this way")
    expect(ada.page.get_by_text(re.compile(r"The planned motion takes \d"))).to_be_visible()
    approved = len(decided())
    ada.finds_no_barrier()
    ada.button("Leave the arm where it is").click()
    expect(ada.button("Go home this way")).to_be_hidden()
    ada.button("Arm home").click()
    assert len(decided()) == approved
    ada.can("Go home this way")
    ada.page.keyboard.press("g")
    expect(ada.page.get_by_text("The arm is at home.")).to_be_visible()
    ada.button("Continue").click()
    ada.reads("proposes")

    # Another one takes over; the first can no longer approve.
    bob.takes_control(over="Ada")
    expect(ada.page.get_by_text("Bob decides. You are watching.")).to_be_visible()
    ada.cannot("Approve")
    approvals = len(decided())
    ada.page.keyboard.press("a")
    # The link is lost and regained; who decides stays.
    bob.page.reload()
    expect(bob.page.get_by_text("You decide", exact=True)).to_be_visible()
    bob.can("Approve")

    # Another place than the policy's, by hand: a proposal that is approved as every other.
    bob.finds_no_barrier()
    bob.button("Correct…").click()
    bob.finds_no_barrier()
    place_x = bob.page.get_by_label("Place x")
    place_x.fill(str(round(1000 * operator.newest("pick_place").place.x) + 10))
    proposals = operator.count("pick_place")
    bob.button("Propose this").click()
    corrected = operator.next("pick_place", proposals)
    assert (corrected.author, corrected.checkpoint) == ("Bob", "")
    assert round(1000 * corrected.place.x) == int(place_x.input_value())
    # The same by dragging: the place, the hand that shows the turn, the pick.
    bob.button("Correct…").click()
    place = (corrected.place.x, corrected.place.y)
    moved = (place[0] + 0.02, place[1] - 0.03)
    teaching.drag(bob, place, moved)
    turn = corrected.place.theta - corrected.pick.theta
    hand_m = 14 * operator.newest("heightmap").pixel_size_m
    teaching.drag(
        bob,
        (moved[0] + hand_m * math.cos(turn), moved[1] + hand_m * math.sin(turn)),
        (moved[0] + 0.06 * math.cos(turn + 0.5), moved[1] + 0.06 * math.sin(turn + 0.5)),
    )
    proposals = operator.count("pick_place")
    bob.button("Propose this").click()
    dragged = operator.next("pick_place", proposals)
    assert math.dist((dragged.place.x, dragged.place.y), moved) < 0.005
    assert abs((dragged.place.theta - dragged.pick.theta - turn - 0.5 + math.pi) % (2 * math.pi) - math.pi) < 0.1
    bob.button("Correct…").click()
    teaching.drag(bob, (dragged.pick.x, dragged.pick.y), (dragged.pick.x + 0.01, dragged.pick.y))
    proposals = operator.count("pick_place")
    bob.button("Propose this").click()
    corrected = operator.next("pick_place", proposals)
    assert abs(corrected.pick.x - dragged.pick.x - 0.01) < 0.005
    bob.can("Approve")
    bob.button("Approve").click()
    bob.reads("did it succeed")
    said = decided(approvals + 1)[approvals:]
    assert [(one.proposal_id, one.decision, one.operator_name) for one in said] == [(corrected.id, StepConfirmation.APPROVE, "Bob")]
    # Confirmed, it is kept as something to learn from.
    bob.can("It succeeded")
    bob.button("It succeeded").click()
    kept = library / f".corrections/stacking-1-{corrected.id:016x}/metadata.yaml"
    until(kept.exists, "correction on disk", 20.0)
    ada.close()
    bob.close()


def test_a_run_is_corrected_stopped_continued_and_handed_over_by_keyboard_alone(
    browser: Browser, start, operator: Operator, decided
) -> None:
    _, address = launch_web(start, 10022)
    # What somebody sees first has no barrier either.
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(address)
        expect(page.get_by_role("heading", name="Who are you?")).to_be_visible()
        no_barrier(page)
    ada = Person(browser, address, "Ada")
    bob = Person(browser, address, "Bob", width=390, height=844)
    keyboard = ada.page.keyboard
    ada.reaches(ada.button("Take control"))
    keyboard.press("Enter")
    ada.can("Approve")
    # Corrected: what is typed is proposed, and the next key decides on it.
    proposals = operator.count("pick_place")
    keyboard.press("e")
    place_x = ada.page.get_by_label("Place x")
    ada.reaches(place_x)
    typed = round(1000 * operator.next("pick_place").place.x) + 10
    keyboard.type(str(typed))
    keyboard.press("Enter")
    corrected = operator.next("pick_place", proposals, lambda proposal: proposal.author == "Ada")
    assert round(1000 * corrected.place.x) == typed
    expect(ada.button("Approve")).to_be_focused()
    ada.can("Approve")
    # Stopped in mid-motion, with the part held.
    expect(ada.button("Put the part down")).to_be_hidden()
    slow_down(operator, 1.0)
    results = operator.count("step_result")
    keyboard.press("a")
    ada.reads("the arm moves")
    ada.sees("holds something")
    keyboard.press("s")
    ada.reads("stopped")
    assert operator.next("step_result", results).outcome == StepResult.STOPPED
    slow_down(operator, 0.0)
    said = [(one.proposal_id, one.decision) for one in decided(2)]
    assert said[0] == (corrected.id, StepConfirmation.APPROVE)
    assert said[1][1] == StepConfirmation.STOP
    keyboard.press("h")
    ada.can("Go home this way")
    # It would carry the part home: it is put down instead, where it was picked, and nothing moves before that is approved.
    keyboard.press("d")
    ada.can("Put it down this way")
    ada.finds_no_barrier()
    assert len(decided()) == len(said)
    keyboard.press("g")
    ada.sees("what was held is put down where it was picked")
    expect(ada.button("Put the part down")).to_be_hidden()
    keyboard.press("c")
    ada.reads("proposes")
    ada.can("Approve")
    # Control is handed over: the first can no longer approve, the other can.
    ada.reaches(ada.button("Hand over to Bob"))
    keyboard.press("Enter")
    ada.sees("You watch. Bob decides")
    expect(bob.page.get_by_text("You decide", exact=True)).to_be_visible()
    ada.cannot("Approve")
    keyboard.press("a")
    # Whoever holds a phone sees what is decided, and the stop, without scrolling.
    for name in ("Approve", "Stop"):
        expect(bob.button(name)).to_be_in_viewport(ratio=1.0)
    bob.finds_no_barrier()
    bob.can("Approve")
    decisions = len(decided())
    bob.reaches(bob.button("Approve"))
    bob.page.keyboard.press("Enter")
    bob.reads("did it succeed")
    assert [(one.operator_name, one.decision) for one in decided(decisions + 1)[decisions:]] == [("Bob", StepConfirmation.APPROVE)]
    ada.close()
    bob.close()


def is_greyed(person: Person) -> bool:
    """Whether the picture of the table is shown without its colours, as what may not be what is there."""
    table = person.page.get_by_role("img", name="The table now, from above")
    return "grayscale(1)" in table.evaluate("table => getComputedStyle(table).filter")


def test_what_was_proposed_before_the_table_changed_cannot_be_approved_and_the_page_says_so(
    browser: Browser, start, operator: Operator, decided, tmp_path: pathlib.Path
) -> None:
    launch = start("sctn", "launch", "--problem", "stacking", "--seed", 10018, "--operator", "none", "--processes")
    # That the policy is stopped is not what the page is to object to.
    _, address = console_process(start, tmp_path / "address", nodes="[camera_fusion, goal_oracle, suction_executor]")
    ada = Person(browser, address, "Ada")
    ada.takes_control()
    ada.can("Approve")
    proposal = operator.next("pick_place")
    policy = program(launch, "gctn_policy")
    os.kill(policy, signal.SIGSTOP)
    # The simulator puts the blocks elsewhere.
    teaching.reset(operator, 10019)
    ada.cannot("Approve")
    expect(ada.page.get_by_role("status").filter(has_text="The proposal is stale: the table has changed about (")).to_be_visible()
    expect(ada.page.get_by_role("status").filter(has_text="Wait for the new proposal.")).to_be_visible()
    assert is_greyed(ada)
    ada.page.keyboard.press("a")
    # Nor does the console take it from a program of the same operator.
    session = ada.page.evaluate("sessionStorage.getItem('session')")
    program_of_ada = CLIENT.Console(address, "a program")
    program_of_ada._headers["X-Session"] = session
    with pytest.raises(CLIENT.Refused, match="the table has changed"):
        program_of_ada.decide("approve", {"id": str(proposal.id)})
    assert decided() == []
    # What the policy proposes on the table of now is approved.
    os.kill(policy, signal.SIGCONT)
    renewed = operator.next("pick_place", accept=lambda newer: newer.id != proposal.id)
    ada.can("Approve")
    assert not is_greyed(ada)
    ada.button("Approve").click()
    ada.reads("did it succeed")
    assert [(one.proposal_id, one.decision) for one in decided(1)] == [(renewed.id, StepConfirmation.APPROVE)]
    ada.close()


def test_the_page_shows_modes_and_the_age_of_every_stream_and_nothing_is_approved_on_what_is_stale(
    browser: Browser, start, operator: Operator, decided
) -> None:
    launch, address = launch_web(start, 10004, "--processes")
    ada = Person(browser, address, "Ada")
    ada.takes_control()
    ada.can("Approve")
    robot = ada.page.get_by_role("region", name="Robot and streams")

    def says(**rows: str) -> None:
        for term, value in rows.items():
            said = robot.get_by_role("term").filter(has_text=re.compile(f"^{term.replace('_', ' ')}$")).locator("+ dd")
            expect(said).to_have_text(value)

    says(Robot_mode="running", Safety="normal", Program="running", Speed="100 % of the planned", Suction="off", Gripper="empty")
    for fault, mode, safety in [
        ("protective_stop", "running", "protective stop"),
        ("emergency_stop", "power off", "robot emergency stop"),
        ("program_stopped", "running", "normal"),
    ]:
        set_of_cell(operator, Parameter("hardware.fault", Parameter.Type.STRING, fault))
        says(Robot_mode=mode, Safety=safety, Program="not running")
        ada.cannot("Approve")
        expect(ada.page.get_by_role("status").filter(has_text="The robot is not ready: ")).to_be_visible()
        set_of_cell(operator, Parameter("hardware.fault", Parameter.Type.STRING, "none"))
        says(Robot_mode="running", Safety="normal", Program="running")
        ada.can("Approve")
    set_of_cell(operator, Parameter("hardware.speed_scaling", Parameter.Type.DOUBLE, 0.4))
    says(Speed="40 % of the planned")

    def age(stream: str) -> Locator:
        return robot.get_by_role("row").filter(has=ada.page.get_by_role("rowheader", name=stream, exact=True)).get_by_role("cell")

    images = [f"{side}/{image}" for side in ("front", "left", "right") for image in ("color/image_raw", "depth/image_rect_raw")]
    stale_with = {
        "goal_oracle": ["goal_oracle"],
        "gctn_policy": ["gctn_policy"],
        "suction_executor": ["suction_executor"],
        "camera_fusion": ["camera_fusion", *images],
        "sim_workcell": ["joint_states", *images],
    }
    for streams in stale_with.values():
        for stream in streams:
            expect(age(stream)).to_have_text(re.compile(r"^\d+\.\d s$"))
    for node, streams in stale_with.items():
        process = program(launch, node)
        os.kill(process, signal.SIGSTOP)
        for stream in streams:
            expect(age(stream)).to_have_text(re.compile(r"^\d+\.\d s, stale$"))
        ada.cannot("Approve")
        assert is_greyed(ada)
        ada.page.keyboard.press("a")
        os.kill(process, signal.SIGCONT)
        for stream in streams:
            expect(age(stream)).to_have_text(re.compile(r"^\d+\.\d s$"))
        ada.can("Approve")
        assert not is_greyed(ada)
    assert decided() == []
    ada.close()


def test_a_page_whose_console_is_gone_says_so_and_decides_again_once_it_is_back(
    browser: Browser, start, operator: Operator, tmp_path: pathlib.Path
) -> None:
    start("sctn", "launch", "--problem", "stacking", "--seed", 10020, "--operator", "none")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    same = {"port": port, "token": "the-same-after-a-restart"}
    console, address = console_process(start, tmp_path / "address", **same)
    ada = Person(browser, address, "Ada")
    ada.takes_control()
    ada.can("Approve")
    console.signal(signal.SIGKILL)
    expect(ada.page.get_by_role("status").filter(has_text="Link lost: connecting again")).to_be_visible()
    ada.cannot("Approve")
    expect(ada.page.get_by_role("status").filter(has_text="what you see is old")).to_be_visible()
    # That nobody answered is all that the browser has to say.
    console_process(start, tmp_path / "address", **same)
    expect(ada.page.get_by_role("status").filter(has_text="Connected")).to_be_visible()
    assert all("ERR_CONNECTION_REFUSED" in error for error in ada.errors), ada.errors
    ada.errors.clear()
    # Who decided before the console went does so no longer, until they say so.
    ada.cannot("Approve")
    ada.takes_control()
    ada.can("Approve")
    results = operator.count("step_result")
    ada.button("Approve").click()
    ada.reads("did it succeed")
    assert operator.next("step_result", results).outcome != StepResult.REFUSED
    ada.close()


def test_a_motion_stops_when_the_deciding_page_is_closed_and_the_run_goes_on_when_somebody_is_back(
    browser: Browser, start, operator: Operator
) -> None:
    _, address = launch_web(start, 10010, "--require-presence")
    ada = Person(browser, address, "Ada")
    ada.takes_control()
    ada.reads("proposes")
    ada.can("Approve")
    # Five times a second everybody hears that she is there.
    heard: list[tuple[OperatorPresence, float]] = []

    def hear(said: OperatorPresence, about: dict[str, int]) -> None:
        """Keeps a message with the time at which it was published [s]."""
        heard.append((said, about["source_timestamp"] / 1e9))

    operator.node.create_subscription(OperatorPresence, "operator_presence", hear, EVENT)
    operator.until(lambda: len(heard) > 12, "operator_presence", 20.0)
    periods_s = sorted(after - before for (_, before), (_, after) in itertools.pairwise(heard))
    assert 0.15 < periods_s[len(periods_s) // 2] < 0.3, periods_s
    assert {(said.operator_name, said.is_present) for said, _ in heard} == {("Ada", True)}
    slow_down(operator, 0.5)
    results = operator.count("step_result")
    ada.button("Approve").click()
    ada.reads("the arm moves")
    ada.close()
    stopped = operator.next("step_result", results)
    assert stopped.outcome == StepResult.STOPPED, stopped
    slow_down(operator, 0.0)
    bob = Person(browser, address, "Bob")
    bob.reads("stopped")
    bob.takes_control(over="Ada")
    bob.button("Arm home").click()
    bob.button("Go home this way").click()
    expect(bob.page.get_by_text("The arm is at home.")).to_be_visible()
    bob.button("Continue").click()
    bob.reads("proposes")
    bob.can("Approve")
    bob.button("Approve").click()
    bob.reads("did it succeed")
    bob.close()


def renderers(browser: Browser) -> set[int]:
    """Process ids of a browser's pages."""
    session = browser.new_browser_cdp_session()
    found = {one["id"] for one in session.send("SystemInfo.getProcessInfo")["processInfo"] if one["type"] == "renderer"}
    session.detach()
    return found


def sleeps(_: Person, processes: set[int]) -> None:
    """The page's processes stand still, as on a machine that goes to sleep."""
    for process in processes:
        os.kill(process, signal.SIGSTOP)


def is_hidden(person: Person, _: set[int]) -> None:
    """The page says that another tab is in front of it."""
    hide = "Object.defineProperty(document, 'visibilityState', { value: 'hidden' })"
    person.page.evaluate(f"{hide}; document.dispatchEvent(new Event('visibilitychange'))")


def loses_its_link(person: Person, _: set[int]) -> None:
    """The browser's network is gone."""
    person.context.set_offline(True)


@pytest.mark.parametrize("way", [sleeps, is_hidden, loses_its_link])
def test_a_motion_stops_when_the_deciding_page_is_there_no_more(browser: Browser, start, operator: Operator, way) -> None:
    _, address = launch_web(start, 10024, "--require-presence")
    # Her pages have processes of their own.
    hers = launched(browser.browser_type)
    ada = Person(hers, address, "Ada")
    bob = Person(browser, address, "Bob")
    ada.takes_control()
    ada.can("Approve")
    slow_down(operator, 0.5)
    results = operator.count("step_result")
    ada.button("Approve").click()
    bob.reads("the arm moves")
    gone_s = time.monotonic()
    processes = renderers(hers)
    way(ada, processes)
    try:
        stopped = operator.next("step_result", results)
    finally:
        for process in processes:
            os.kill(process, signal.SIGCONT)
    assert stopped.outcome == StepResult.STOPPED, stopped
    # A second without a sign, and what the arm needs to come to rest.
    assert time.monotonic() - gone_s < 3.0
    bob.reads("stopped")
    hers.close()
    bob.close()


def lesson_settings(person: Person) -> dict[str, Any]:
    """Presets and ranges of heights and speeds, as the page was given them."""
    ask = "fetch('/api/v1/lesson/settings', { headers: { Authorization: `Bearer ${sessionStorage.getItem('token')}` } })"
    return person.page.evaluate(f"{ask}.then(answer => answer.json())")


def test_a_task_that_no_module_programs_is_taught_by_clicks_and_the_shipped_policy_repeats_it_from_another_start(
    browser: Browser, start, operator: Operator, tmp_path: pathlib.Path
) -> None:
    arguments = ["--problem", REPOSITORY / teaching.SCENE, "--seed", 10000, "--checkpoint", teaching.CHECKPOINT]
    launch = start("sctn", "launch", *arguments, "--operator", "web", "--library", tmp_path / "library")
    ada = Person(browser, address_of(launch, until), "Ada")
    ada.takes_control()
    operator.next("heightmap")
    operator.until(operator.executor_is_ready, "executor that has checked its driver", 60.0)
    ada.button("Teach a new task").click()
    ada.reads("Teaching a new task")
    # What is not as it should be is no step, and is tried again.
    teaching.choose(ada, operator, 0)
    results = operator.count("step_result")
    ada.button("Show the motion").click()
    teaching.carry_out(ada)
    teaching.seen_since(operator, operator.next("step_result", results).header.stamp)
    ada.button("Not as it should be: try again").click()
    ada.sees("Lesson, 0 steps so far. Click what to pick")
    ada.button("End the lesson").click()
    teaching.reset(operator, 10000)
    ada.button("Teach a new task").click()
    ada.finds_no_barrier()
    teaching.show(ada, operator, 0)
    # The step is taken back, and shown once more.
    results = operator.count("step_result")
    ada.button("Take the last step back").click()
    teaching.carry_out(ada)
    teaching.seen_since(operator, operator.next("step_result", results).header.stamp)
    ada.button("As it should be: keep this step").click()
    # What is changed does not move.
    teaching.choose(ada, operator, 0)
    ada.button("Show the motion").click()
    ada.can("Carry it out")
    ada.button("Change it").click()
    ada.sees("Click what to pick, then where to place it, and drag the hand")
    # A preset sets all heights and speeds; a slider changes one, within its range.
    ada.page.get_by_role("combobox", name="Motion").select_option("low and slow, for soft objects and chains")
    ada.page.get_by_text("Heights and speeds").click()
    carry = ada.page.get_by_role("slider", name="Speed while it carries")
    carry.focus()
    ada.page.keyboard.press("Home")
    for _ in range(29):
        ada.page.keyboard.press("ArrowRight")
    ada.finds_no_barrier()
    teaching.carry_out_and_keep(ada, operator, 0)
    settings, offered = operator.newest("pick_place").settings, lesson_settings(ada)
    assert round(settings.carry_m_s, 3) == 0.3
    assert offered["ranges"]["carry_m_s"][0] == 0.01
    for name, value in offered["presets"]["gentle"].items():
        assert name == "carry_m_s" or abs(getattr(settings, name) - value) < 0.01, name
    ada.page.get_by_role("combobox", name="Motion").select_option("high and fast, for rigid objects")
    teaching.show_by_keyboard(ada, operator, 1)
    teaching.show(ada, operator, 2)
    ada.sees("Lesson, 3 steps so far.")
    teaching.save(ada, teaching.NAME)
    ada.button("End the lesson").click()

    # The same task from another start: for later, to compare policies with.
    teaching.reset(operator, HELD_BACK_START)
    ada.button("Teach a new task").click()
    for shown in range(len(teaching.TASK)):
        teaching.show(ada, operator, shown)
    teaching.save(ada, "held_back")
    ada.button("End the lesson").click()

    teaching.reset(operator, START)
    for picture in ("start", "end"):
        expect(ada.page.get_by_role("img", name=f"{teaching.NAME}, {picture}")).to_be_visible()
    expect(ada.page.get_by_text(re.compile(rf"{teaching.NAME}: 3 steps, \d"))).to_be_visible()
    went = teaching.repeat(ada, operator)
    assert went.done, went
    ada.sees("1 of 1 run completed with any_start")
    assert operator.newest("pick_place").checkpoint == "any_start"
    goal = operator.next("goal", accept=lambda goal: goal.complete)
    assert (goal.problem, goal.step_count) == (teaching.NAME, 3)

    # A step of a repetition from one more start is corrected by dragging, and kept.
    teaching.reset(operator, CORRECTED_START)
    teaching.correct_first_step(ada, operator)
    # Written beside its place first, as *.partial.
    kept = until(lambda: list((tmp_path / "library").glob(".corrections/*[!l]/metadata.yaml")), "correction on disk", 20.0)
    assert len(kept) == 1

    # A policy learns from the one task and the correction, is compared on the other task, and is used while the graph is at work.
    ada.page.get_by_role("combobox", name=f"1 correction of {teaching.NAME}").select_option("learn from")
    ada.page.get_by_role("combobox", name=teaching.NAME, exact=True).select_option("learn from")
    ada.page.get_by_role("combobox", name="held_back").select_option("hold out")
    # One that takes too long is cancelled.
    ada.page.get_by_label("Name of the policy").fill("long")
    ada.page.get_by_role("spinbutton", name="Steps").fill("100000")
    ada.button("Train").click()
    ada.sees("long is being trained: step 0 of 100000.")
    expect(ada.page.get_by_role("progressbar", name="Progress of the training")).to_be_visible()
    ada.button("Cancel the training").click()
    ada.sees("The training of long was cancelled.")
    ada.page.get_by_label("Name of the policy").fill("taught")
    ada.page.get_by_role("spinbutton", name="Steps").fill(str(TRAINING_STEPS))
    ada.button("Train").click()
    expect(ada.page.get_by_text("taught is trained.")).to_be_visible(timeout=5 * PATIENCE_MS)
    compared = ada.page.get_by_role("table", name="Median distance from 3 held-out steps")
    assert "training taught on 2 bags" in launch.errors()
    distances = r"pick [0-9.]+ mm, place [0-9.]+ mm, turn [0-9.]+°"
    expect(ada.page.get_by_text(re.compile(rf"Step {TRAINING_STEPS}: {distances} from the held-out steps"))).to_be_visible()
    for policy in ("as shown", "by taught", "by the policy of now"):
        expect(ada.page.get_by_role("img", name=f"held_back, step 3, {policy}")).to_be_visible()

    def errors(policy: str) -> list[float]:
        """Pick and place [mm] and turn [degrees] of a policy."""
        row = compared.get_by_role("row", name=re.compile(rf"{policy} [0-9.]+ mm [0-9.]+ mm [0-9.]+°"))
        return [float(number) for number in re.findall(r"[0-9.]+", row.inner_text().removeprefix(policy))]

    # Better or equal, to the pixel of a heightmap.
    new, now = errors("taught"), errors("policy of now")
    assert all(mine <= theirs + 3.125 for mine, theirs in zip(new[:2], now[:2], strict=True)), (new, now)
    ada.finds_no_barrier()
    ada.page.get_by_role("combobox", name="Checkpoint").select_option("taught")
    ada.button("Use this checkpoint").click()
    expect(ada.button("Go back to any_start")).to_be_visible()
    proposals = operator.count("pick_place")
    ada.button(f"Repeat {teaching.NAME}").click()
    operator.next("pick_place", proposals, lambda proposal: proposal.checkpoint == "taught")
    # And back with one click.
    ada.button("Go back to any_start").click()
    ada.sees("The policy uses any_start.")
    ada.can("Reject")
    proposals = operator.count("pick_place")
    ada.button("Reject").click()
    operator.next("pick_place", proposals, lambda proposal: proposal.checkpoint == "any_start")
    ada.close()


def test_a_program_approves_a_step_and_is_refused_what_is_stale(start, decided) -> None:
    _, address = launch_web(start, 10004)
    console = CLIENT.Console(address, "a program")
    with pytest.raises(CLIENT.Refused, match="Nobody decides"):
        console.decide("approve", {"id": "1"})
    console.take_control()
    first = console.wait("proposed")
    rows, cols, colors, heights_m = console.heightmap("present")
    assert (rows, cols, len(colors), len(heights_m)) == (320, 160, 3 * 320 * 160, 320 * 160)
    assert 0.01 < max(heights_m) < 0.3
    # The executor has planned it by then.
    until(lambda: "approve" not in console.state()["refused"], "proposal that can be approved", 30.0)
    first = console.state()
    assert (first["proposal"]["author"], first["proposal"]["checkpoint"]) == ("gctn_policy", "ten_problems")
    motion = json.loads(console._request("motion")[0])
    assert motion["proposal_id"] == first["proposal"]["id"] and len(motion["joint_names"]) == 6
    assert 0 < motion["suction_on_s"] < motion["suction_off_s"] < motion["times_s"][-1] == first["motion"]["duration_s"]
    # The policy is given another checkpoint while the graph is at work.
    with pytest.raises(CLIENT.Refused, match="no checkpoint"):
        console.post("checkpoints/use", name="none_of_these")
    console.post("checkpoints/use", name="any_start")
    until(lambda: console.state()["policy"], "other checkpoint", 30.0)
    console.decide("reject", first["proposal"])
    second = until(
        lambda: (state := console.state())["phase"] == "proposed" and state["proposal"]["id"] != first["proposal"]["id"] and state,
        "proposal",
        60.0,
    )
    with pytest.raises(CLIENT.Refused, match="is not the present one"):
        console.decide("approve", first["proposal"])
    assert second["proposal"]["checkpoint"] == "any_start"
    console.post("checkpoints/back")
    until(lambda: console.state()["policy"]["checkpoint"].endswith("ten_problems.safetensors"), "checkpoint from before", 30.0)
    until(lambda: "approve" not in console.state()["refused"], "fresh streams", 30.0)
    console.decide("approve", second["proposal"])
    # Replayed: nothing happens twice.
    with pytest.raises(CLIENT.Refused):
        console.decide("approve", second["proposal"])
    state = console.wait("awaiting_confirmation")
    assert state["steps"][-1]["proposal"]["id"] == second["proposal"]["id"]
    said = [one.decision for one in decided(2)]
    assert said == [StepConfirmation.REJECT, StepConfirmation.APPROVE]
    # The example, as a program of its own, takes over and goes on to the end.
    example = [sys.executable, REPOSITORY / "docs/examples/operator_console.py", address]
    done = subprocess.run(example, input="y\n" * 2 * STEPS, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("all steps are done\n")
    assert console.state()["phase"] == "complete"
    until(lambda: {one.operator_name for one in decided()} == {"a program", "operator_console.py"}, "decisions of both programs", 30.0)


def test_the_page_is_served_with_tls_and_another_address_needs_it(start, tmp_path: pathlib.Path) -> None:
    address_file = tmp_path / "address"
    tls = REPOSITORY / "tests/tls"
    parameters = {"port": 0, "address_file": address_file, "address": "0.0.0.0"}
    refused = start("operator_console", "--ros-args", *as_arguments(parameters))
    assert refused.wait(20.0) == 1
    assert "tls.certificate" in refused.errors()

    parameters |= {"tls.certificate": tls / "certificate.pem", "tls.key": tls / "key.pem", "token": "a-token-of-the-test"}
    start("operator_console", "--ros-args", *as_arguments(parameters))
    address = until(lambda: address_file.exists() and address_file.read_text(), "address of the page", 20.0)
    assert address_file.stat().st_mode & 0o077 == 0
    assert address.startswith("https://0.0.0.0:")
    port = int(re.search(r":(\d+)/", address).group(1))
    trusted = ssl.create_default_context(cafile=tls / "certificate.pem")

    def ask(url: str, token: str) -> int:
        request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"})
        try:
            with urllib.request.urlopen(request, timeout=10, context=trusted) as response:
                return response.status
        except urllib.error.HTTPError as error:
            return error.code

    url = f"https://localhost:{port}/api/v1/state"
    assert ask(url, "a-token-of-the-test") == 200
    assert ask(url, "another-token") == 401
    # The answer is no HTTP: a TLS alert.
    with pytest.raises(http.client.BadStatusLine):
        urllib.request.urlopen(url.replace("https", "http"), timeout=10)


def test_hostile_input_moves_nothing_and_the_page_works_on(start, decided) -> None:
    _, address = launch_web(start, 10006)
    console = CLIENT.Console(address, "Ada")
    console.take_control()
    console.wait("proposed")
    url = urllib.parse.urlsplit(address)
    generator = random.Random(7)
    token = url.fragment.removeprefix("token=")

    def send(data: bytes, ends: bool = True) -> bytes:
        with socket.create_connection((url.hostname, url.port), timeout=5) as connection:
            try:
                connection.sendall(data)
                # A server may leave a request unanswered whose client has ended.
                if ends:
                    connection.shutdown(socket.SHUT_WR)
                return connection.recv(65536)
            except OSError:
                # It was cut off.
                return b""

    host = f"Host: {url.netloc}\r\n".encode()
    for _ in range(200):
        garbage = generator.randbytes(generator.randrange(1, 400))
        kind = generator.randrange(3)
        if kind == 0:
            send(garbage)
        elif kind == 1:
            answer = send(b"POST /api/v1/decisions HTTP/1.1\r\n" + host + b"Content-Length: %d\r\n\r\n" % len(garbage) + garbage)
            assert not answer.startswith(b"HTTP/1.1 2"), answer
        else:
            upgrade = b"GET /api/v1/live HTTP/1.1\r\n" + host + b"Connection: Upgrade\r\nUpgrade: websocket\r\n"
            upgrade += b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
            assert b'"phase"' not in send(upgrade + garbage)
    # A message of 100 MB is refused before it is read.
    head = b"POST /api/v1/decisions HTTP/1.1\r\n" + host + b"Authorization: Bearer " + token.encode()
    answer = send(head + b"\r\nContent-Type: application/json\r\nContent-Length: 100000000\r\n\r\n" + bytes(1 << 20))
    assert b" 4" in answer[:13] or answer == b"", answer
    # A page of another site is refused, token and all, on the WebSocket too.
    for path, more in (("state", b""), ("live", b"Connection: Upgrade\r\nUpgrade: websocket\r\n")):
        foreign = f"GET /api/v1/{path} HTTP/1.1\r\n".encode() + host + b"Origin: http://evil.example\r\n" + more
        answer = send(foreign + b"Authorization: Bearer " + token.encode() + b"\r\n\r\n", ends=False)
        assert answer.startswith(b"HTTP/1.1 403"), answer
    with pytest.raises(CLIENT.Refused) as wrong:
        CLIENT.Console(address.replace(token, "0" * len(token)), "Eve")
    assert wrong.value.status == 401

    assert decided() == []
    assert json.dumps(console.state()).count(token) == 0
    proposal = console.wait("proposed")["proposal"]
    until(lambda: "approve" not in console.state()["refused"], "fresh streams", 30.0)

    # Eight tabs of one person approve at once: one approval is sent.
    def approve(_: int) -> bool:
        try:
            console.decide("approve", proposal)
        except CLIENT.Refused:
            return False
        return True

    with concurrent.futures.ThreadPoolExecutor(8) as tabs:
        assert sum(tabs.map(approve, range(8))) == 1
    console.wait("awaiting_confirmation")
    assert [one.decision for one in decided(1)] == [StepConfirmation.APPROVE]


@pytest.mark.parametrize("model", LENSES)
def test_the_page_draws_through_every_lens_as_it_is_documented(browser: Browser, model: str) -> None:
    source = (REPOSITORY / "console/page/cameras.js").read_text()
    through = re.search(r"^function throughLens.*?^}$", source, re.MULTILINE | re.DOTALL).group(0)
    points = [[0.1, 0.2], [-0.4, 0.3], [0.6, -0.5], [0.01, 0.0]]
    page = browser.new_page()
    shown = page.evaluate(
        f"([d, points]) => {{ {through}; return points.map(([x, y]) => throughLens('{model}', d, x, y)); }}", [LENSES[model], points]
    )
    page.close()
    expected = through_lens(model, *np.array(points).T)
    assert np.allclose(np.array(shown).T, expected, atol=1e-12)
