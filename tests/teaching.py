"""Teaches a task by clicks and has it repeated from other starts, in a browser, as a person would.

`.venv/bin/python tests/teaching.py --starts 10`, with the programs built, says how often the shipped policy repeats it.

The task is one that no module programs: three coloured blocks onto three marked places of config/scenes/marked_places.yaml, whose
own goals are others.
"""

from __future__ import annotations

import argparse
import math
import os
import pathlib
import re
import tempfile
from dataclasses import dataclass
from typing import Any

import numpy as np

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")

from browser import Person, address_of, chromium
from cell_operator import Operator, nanoseconds
from playwright.sync_api import expect
from processes import REPOSITORY, Process, free_domain
from sctn_msgs.msg import Heightmap, PickPlace, StepResult
from sctn_msgs.srv import ResetCell

SCENE = "config/scenes/marked_places.yaml"
NAME = "blocks_on_marks"
# The shipped policy that follows a demonstration from another start.
CHECKPOINT = REPOSITORY / "config/checkpoints/any_start.safetensors"
# Which block is to lie on which mark, in the order in which it is shown: colour, and place in the world frame [m].
TASK = [("blue", (0.37, 0.2)), ("red", (0.5, 0.2)), ("green", (0.63, 0.2))]
COLORS = {"red": (255, 87, 89), "green": (89, 161, 79), "blue": (78, 121, 167)}
# A block of 50 mm lies on its mark of 100 mm where its middle is not further from that of the mark [m].
NEAR_M = 0.025
# How far beside its middle a block is clicked, along each axis [m].
BESIDE_M = 0.01
# Proposals for a step that are looked at before a person gives up.
MOST_PROPOSALS = 5


@dataclass
class Repetition:
    """How a repetition went."""

    done: bool = False
    steps: int = 0
    rejected: int = 0
    tried_again: int = 0

    @property
    def needed_nobody(self) -> bool:
        """Every first proposal was right, and did what it should."""
        return self.done and self.rejected == self.tried_again == 0


def middle(heightmap: Heightmap, color: str) -> tuple[float, float]:
    """Where a person sees the block of this colour: the middle of its cells, in the world frame [m]."""
    shape = (heightmap.rows, heightmap.cols)
    rgb = np.frombuffer(bytes(heightmap.rgb), np.uint8).reshape(*shape, 3).astype(float)
    height_m = np.array(heightmap.height_m).reshape(shape)
    # The hue alone: shadows change the rest.
    hue = rgb / np.linalg.norm(rgb, axis=2, keepdims=True).clip(1.0)
    names = list(COLORS)
    wanted = np.array([np.array(COLORS[name]) / np.linalg.norm(COLORS[name]) for name in names])
    apart = np.linalg.norm(hue[:, :, None] - wanted, axis=3)
    seen = (height_m > 0.015) & (apart.argmin(axis=2) == names.index(color)) & (apart.min(axis=2) < 0.2)
    rows, cols = np.nonzero(seen)
    assert len(rows) > 50, f"the {color} block is not in view"
    to_m = heightmap.pixel_size_m
    return float(heightmap.origin.x + to_m * (cols.mean() + 0.5)), float(heightmap.origin.y + to_m * (rows.mean() + 0.5))


def seen_since(operator: Operator, stamp: Any) -> Heightmap:
    """What the table looks like, not before a time."""
    return operator.next("heightmap", accept=lambda seen: nanoseconds(seen.header.stamp) >= nanoseconds(stamp))


def leads_to(proposal: PickPlace, block: tuple[float, float]) -> tuple[float, float]:
    """Where the middle of a block would come to lie."""
    turn = proposal.place.theta - proposal.pick.theta
    x, y = block[0] - proposal.pick.x, block[1] - proposal.pick.y
    return (
        proposal.place.x + math.cos(turn) * x - math.sin(turn) * y,
        proposal.place.y + math.sin(turn) * x + math.cos(turn) * y,
    )


def shows(person: Person, proposal: PickPlace) -> None:
    """Waits until the page shows a proposal."""
    person.sees(f"Pick at x {1000 * proposal.pick.x:.0f} mm, y {1000 * proposal.pick.y:.0f} mm.")


def reset(operator: Operator, seed: int) -> None:
    """The blocks lie elsewhere, as this seed has them; returns when that is in view."""
    client = operator.node.create_client(ResetCell, "sim_workcell/reset")
    operator.until(client.service_is_ready, "sim_workcell", 30.0)
    answer = client.call_async(ResetCell.Request(request_id=f"start {seed} {operator.count('heightmap')}", seed=seed))
    operator.until(answer.done, "answer of sim_workcell", 30.0)
    response = answer.result()
    assert response.success, response.message
    seen_since(operator, response.stamp)
    operator.node.destroy_client(client)


def on_page(person: Person, x_m: float, y_m: float) -> tuple[float, float]:
    """Where a place of the world frame is on the picture of the table, in pixels of the page."""
    table = person.page.get_by_role("img", name="The table now, from above")
    table.evaluate("table => table.scrollIntoView({ block: 'center' })")
    box = table.bounding_box()
    # The robot looks up: x up, y to the left.
    return box["x"] + (0.5 - y_m) * box["width"], box["y"] + (0.75 - x_m) / 0.5 * box["height"]


def click(person: Person, x_m: float, y_m: float) -> None:
    """A click on the table at a place of the world frame."""
    person.page.mouse.click(*on_page(person, x_m, y_m))


def drag(person: Person, begin_m: tuple[float, float], end_m: tuple[float, float]) -> None:
    """Drags something on the table from one place of the world frame to another."""
    person.page.mouse.move(*on_page(person, *begin_m))
    person.page.mouse.down()
    person.page.mouse.move(*on_page(person, *end_m), steps=4)
    person.page.mouse.up()


def show_by_keyboard(person: Person, operator: Operator, shown: int) -> None:
    """Shows a step of the task, counted from 0, without a mouse."""
    color, mark = TASK[shown]
    keyboard = person.page.keyboard
    person.page.get_by_label("Pick x").focus()
    numbers = (*middle(operator.newest("heightmap"), color), *mark)
    for number_m in numbers:
        keyboard.type(str(round(1000 * number_m)))
        keyboard.press("Tab")
    keyboard.type("0")
    results = operator.count("step_result")
    keyboard.press("Enter")
    # What comes next has the focus.
    for name in ("Carry it out", "As it should be: keep this step"):
        expect(person.button(name)).to_be_focused()
        keyboard.press("Enter")
    after = seen_since(operator, operator.next("step_result", results).header.stamp)
    assert math.dist(middle(after, color), mark) < NEAR_M


def choose(person: Person, operator: Operator, shown: int) -> None:
    """Clicks pick and place of a step of the task, counted from 0."""
    color, mark = TASK[shown]
    person.sees(f"Lesson, {shown} {'step' if shown == 1 else 'steps'} so far. Click what to pick")
    block = middle(operator.newest("heightmap"), color)
    # Wherever the block is clicked, its middle is picked.
    click(person, block[0] + BESIDE_M, block[1] - BESIDE_M)
    person.sees("Now click where to place it.")
    picked = [0.001 * float(person.page.get_by_label(f"Pick {axis}").input_value()) for axis in "xy"]
    assert math.dist(picked, block) < 0.6 * BESIDE_M, (picked, block)
    click(person, *mark)


def carry_out_and_keep(person: Person, operator: Operator, shown: int) -> None:
    """Has the step that was chosen carried out, and keeps it."""
    color, mark = TASK[shown]
    results = operator.count("step_result")
    person.button("Show the motion").click()
    carry_out(person)
    after = seen_since(operator, operator.next("step_result", results).header.stamp)
    assert math.dist(middle(after, color), mark) < NEAR_M
    person.button("As it should be: keep this step").click()


def show(person: Person, operator: Operator, shown: int) -> None:
    """Shows a step of the task, counted from 0, by clicks."""
    choose(person, operator, shown)
    carry_out_and_keep(person, operator, shown)


def carry_out(person: Person) -> None:
    """Looks at the planned motion, and has it carried out."""
    expect(person.page.get_by_text(re.compile(r"The planned motion takes \d"))).to_be_visible()
    carry_out = "Carry it out"
    person.presses(carry_out, lambda wait_ms: expect(person.button(carry_out)).to_be_hidden(timeout=wait_ms))


def save(person: Person, name: str) -> None:
    """Saves the lesson."""
    person.page.get_by_label("Name of the task").fill(name)
    person.button("Save").click()
    person.sees(f"Saved as {name}.")


def repeat(person: Person, operator: Operator, name: str = NAME) -> Repetition:
    """Has the task repeated, approves what leads to it, and says whether each step succeeded."""
    went = Repetition()
    goals = operator.count("goal")
    said = operator.count("pick_place")
    person.button(f"Repeat {name}").click()
    operator.next("goal", goals, lambda goal: goal.problem == name)
    looked_at: set[int] = set()
    proposals = 0

    def next_proposal() -> PickPlace:
        """Another proposal than those that were looked at, once the page shows it."""
        found = operator.next("pick_place", said, lambda proposal: proposal.problem == name and proposal.id not in looked_at)
        shows(person, found)
        return found

    # Until then the page may say what it said before.
    proposal = next_proposal()
    while True:
        person.reads(re.compile("proposes|succeed|All steps|broke"))
        headline = person.headline()
        if "All steps" in headline:
            went.done = True
            return went
        step = int(re.search(r"Step (\d)", headline).group(1))
        color, mark = TASK[step - 1]
        if "proposes" in headline:
            proposal = next_proposal()
            looked_at.add(proposal.id)
            proposals += 1
            block = middle(seen_since(operator, proposal.header.stamp), color)
            picks = math.dist((proposal.pick.x, proposal.pick.y), block) < 0.03
            if picks and math.dist(leads_to(proposal, block), mark) < NEAR_M:
                decision = "Approve"
            elif proposals >= MOST_PROPOSALS:
                return went
            else:
                decision = "Reject"
                went.rejected += 1
        else:
            result = operator.next(
                "step_result", accept=lambda result: result.proposal_id == proposal.id and result.outcome != StepResult.REFUSED
            )
            after = seen_since(operator, result.header.stamp)
            if math.dist(middle(after, color), mark) < NEAR_M:
                decision = "It succeeded: next step"
                went.steps += 1
                proposals = 0
            elif proposals >= MOST_PROPOSALS:
                return went
            else:
                decision = "It failed: try again"
                went.tried_again += 1
        person.presses(decision, lambda wait_ms, headline=headline: person.reads_otherwise(headline, wait_ms))


def correct_first_step(person: Person, operator: Operator, name: str = NAME) -> None:
    """Has the task repeated, and drags pick and place of the first proposal to where they belong before it is carried out."""
    color, mark = TASK[0]
    goals, said = operator.count("goal"), operator.count("pick_place")
    person.button(f"Repeat {name}").click()
    operator.next("goal", goals, lambda goal: goal.problem == name)
    proposal = operator.next("pick_place", said, lambda proposal: proposal.problem == name)
    shows(person, proposal)
    # The policy says how likely its proposal is to succeed.
    expect(person.page.get_by_text(re.compile(r"It expects the step to succeed with \d+ %\."))).to_be_visible()
    person.can("Approve")
    person.button("Correct…").click()
    drag(person, (proposal.pick.x, proposal.pick.y), middle(operator.newest("heightmap"), color))
    drag(person, (proposal.place.x, proposal.place.y), mark)
    said = operator.count("pick_place")
    person.button("Propose this").click()
    corrected = operator.next("pick_place", said, lambda proposal: proposal.author == person.name)
    assert (corrected.checkpoint, corrected.step) == ("", 1)
    person.can("Approve")
    results = operator.count("step_result")
    person.button("Approve").click()
    after = seen_since(operator, operator.next("step_result", results).header.stamp)
    assert math.dist(middle(after, color), mark) < NEAR_M
    person.can("It succeeded")
    person.button("It succeeded").click()
    person.reads("Step 2 of 3")


def main() -> None:
    """Teaches once, repeats from several starts, prints how it went."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=10, help="from how many starts the task is repeated")
    parser.add_argument("--first-seed", type=int, default=10001, help="seed of the first start")
    parser.add_argument("--checkpoint", type=pathlib.Path, default=CHECKPOINT, help="of the policy")
    asked = parser.parse_args()
    domain = free_domain()
    with tempfile.TemporaryDirectory() as scratch, chromium() as browser, Operator(domain) as operator:
        logs = pathlib.Path(scratch)
        arguments = ["launch", "--problem", str(REPOSITORY / SCENE), "--seed", "10000", "--operator", "web"]
        arguments += ["--library", str(logs / "library")]
        arguments += ["--checkpoint", str(asked.checkpoint)]
        launch = Process("sctn", arguments, domain, logs)
        try:
            person = Person(browser, address_of(launch, lambda found, what, limit: operator.until(found, what, limit)), "Ada")
            person.takes_control()
            operator.next("heightmap")
            operator.until(operator.executor_is_ready, "executor that has checked its driver", 60.0)
            person.button("Teach a new task").click()
            for shown in range(len(TASK)):
                show(person, operator, shown)
            save(person, NAME)
            person.button("End the lesson").click()
            all_went = []
            for seed in range(asked.first_seed, asked.first_seed + asked.starts):
                reset(operator, seed)
                went = repeat(person, operator)
                all_went.append(went)
                words = "repeated" if went.done else f"not repeated: {went.steps} of {len(TASK)} steps"
                print(f"start {seed}: {words}, {went.rejected} proposals rejected, {went.tried_again} motions tried again", flush=True)
        finally:
            launch.end()
    done = sum(went.done for went in all_went)
    alone = sum(went.needed_nobody for went in all_went)
    print(f"repeated from {done} of {len(all_went)} other starts; in {alone} every first proposal was right")


if __name__ == "__main__":
    main()
