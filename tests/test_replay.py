"""What was recorded of cameras and operator, played into the nodes, gives what the nodes made of it, bit for bit."""

from __future__ import annotations

import json
import pathlib
import re
import signal
import time
from collections.abc import Callable, Iterable

from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from processes import REPOSITORY, free_domain

# What goes in, and what has to come out.
PLAYED = ("/tf_static", "/clock", "/step_confirmation", "/step_result")
CAMERAS = "/(color|depth)/"
COMPARED = ("/heightmap", "/goal", "/pick_place")


def test_a_recorded_run_gives_the_same_heightmaps_goals_and_proposals_again(start, tmp_path: pathlib.Path) -> None:
    checkpoint = REPOSITORY / "config/checkpoints/placing.safetensors"
    launch = start(
        "sctn", "launch", "--problem", "placing", "--seed", 10003, "--operator", "auto", "--processes",
        "--checkpoint", checkpoint, "--record", tmp_path / "run", "--record-images", "--json",
    )  # fmt: skip
    assert launch.wait(400.0) == 0, launch.log()
    outcome = json.loads(launch.output().splitlines()[-1])
    recorded = messages(pathlib.Path(outcome["bag"]))

    # Another domain: nobody of the run is left there.
    domain = free_domain()
    config = REPOSITORY / "config"
    parameters = {
        "camera_fusion": [],
        "goal_oracle": ["-p", f"demonstration:={tmp_path / 'run/demonstration'}"],
        "gctn_policy": ["-p", f"checkpoint:={checkpoint}"],
    }
    nodes = []
    for node, own in parameters.items():
        common = ["--ros-args", "--params-file", config / f"{node}.yaml", "-p", "use_sim_time:=true"]
        nodes.append(start(node, *common, *own, domain=domain))
    replay = tmp_path / "replay"
    record = start("sctn", "bag", "record", *COMPARED, "--out", replay, domain=domain)
    # Every node listens: others subscribe to the same topics.
    wait_until(lambda: all(re.search(r"\bactive\b", node.errors()) for node in nodes), "active nodes")
    unfinished = replay.with_name("replay.partial")
    wait_until(lambda: flushed(unfinished)["/goal"], "goal")
    play = start(
        "sctn", "bag", "play", outcome["bag"], "--topics", *PLAYED, "--regex", CAMERAS, "--wait", 30, "--json",
        domain=domain,
    )  # fmt: skip
    assert play.wait(240.0) == 0, play.log()
    assert json.loads(play.output().splitlines()[-1])["unsent"] == 0
    # The last of them may still be on their way.
    wait_until(lambda: all(len(found) >= len(recorded[topic]) for topic, found in flushed(unfinished).items()), "last messages")
    record.signal(signal.SIGTERM)
    assert record.wait(60.0) == 0, record.log()

    replayed = messages(replay)
    assert len(recorded["/pick_place"]) == outcome["steps"]
    for topic in COMPARED:
        assert recorded[topic], f"no message on {topic}"
        # The recorded run was over with the last reward; what its nodes would still have said of it comes now.
        assert len(replayed[topic]) - len(recorded[topic]) in (0, 1), topic
        assert replayed[topic][: len(recorded[topic])] == recorded[topic], f"{topic} differs"


def distinct(messages: Iterable[tuple[str, bytes]]) -> dict[str, list[bytes]]:
    """The serialised messages of each compared topic, in order, without repetitions."""
    found: dict[str, list[bytes]] = {topic: [] for topic in COMPARED}
    for topic, data in messages:
        known = found.get(topic)
        if known is not None and data not in known[-1:]:
            known.append(data)
    return found


def messages(bag: pathlib.Path) -> dict[str, list[bytes]]:
    """Those of a bag."""
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        return distinct((channel.topic, message.data) for _, channel, message in make_reader(stream).iter_messages())


def flushed(bag: pathlib.Path) -> dict[str, list[bytes]]:
    """Those of an unfinished bag, as far as they are on the disk."""
    names: dict[int, str] = {}
    found: list[tuple[str, bytes]] = []
    for file in bag.glob("*.mcap"):
        with file.open("rb") as stream:
            try:
                for record in StreamReader(stream).records:
                    if isinstance(record, Channel):
                        names[record.id] = record.topic
                    elif isinstance(record, Message):
                        found.append((names[record.channel_id], record.data))
            except Exception:  # The open chunk at its end.
                pass
    return distinct(found)


def wait_until(condition: Callable[[], object], what: str, timeout_s: float = 120.0) -> None:
    """Asks again and again."""
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"no {what} within {timeout_s} s"
        time.sleep(0.2)
