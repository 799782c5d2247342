"""What was recorded of cameras and operator, played into the nodes, gives what the nodes made of it, bit for bit."""

from __future__ import annotations

import json
import pathlib
import signal
import time

from mcap.reader import make_reader
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
    for node, own in parameters.items():
        common = ["--ros-args", "--params-file", config / f"{node}.yaml", "-p", "use_sim_time:=true"]
        start(node, *common, *own, domain=domain)
    replay = tmp_path / "replay"
    record = start("sctn", "bag", "record", *COMPARED, "--out", replay, domain=domain)
    # The oracle hears everything once it has said its first goal; others subscribe to the same topics.
    wait_for_messages(bag=replay.with_name("replay.partial"), topic="/goal", count=1)
    play = start(
        "sctn", "bag", "play", outcome["bag"], "--topics", *PLAYED, "--regex", CAMERAS, "--wait", 30, "--json",
        domain=domain,
    )  # fmt: skip
    assert play.wait(120.0) == 0, play.log()
    assert json.loads(play.output().splitlines()[-1])["unsent"] == 0
    # The last proposal may still be on its way.
    wait_for_messages(bag=replay.with_name("replay.partial"), topic="/pick_place", count=outcome["steps"])
    record.signal(signal.SIGTERM)
    assert record.wait(30.0) == 0, record.log()

    replayed = messages(replay)
    assert len(recorded["/pick_place"]) == outcome["steps"]
    for topic in COMPARED:
        assert recorded[topic], f"no message on {topic}"
        # The recorded run was over with the last reward; what its nodes would still have said of it comes now.
        assert len(replayed[topic]) - len(recorded[topic]) in (0, 1), topic
        assert replayed[topic][: len(recorded[topic])] == recorded[topic], f"{topic} differs"


def messages(bag: pathlib.Path) -> dict[str, list[bytes]]:
    """The serialised messages of each compared topic, in order, without repetitions."""
    found: dict[str, list[bytes]] = {topic: [] for topic in COMPARED}
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            known = found.get(channel.topic)
            if known is not None and message.data not in known[-1:]:
                known.append(message.data)
    return found


def wait_for_messages(bag: pathlib.Path, topic: str, count: int, timeout_s: float = 60.0) -> None:
    """Until the unfinished bag holds that many messages of a topic, by what is flushed of it."""
    end = time.monotonic() + timeout_s
    found = 0
    while time.monotonic() < end:
        names: dict[int, str] = {}
        found = 0
        file = next(bag.glob("*.mcap"), None)
        if file is None:
            time.sleep(0.2)
            continue
        with file.open("rb") as stream:
            try:
                for record in StreamReader(stream).records:
                    if type(record).__name__ == "Channel":
                        names[record.id] = record.topic
                    elif type(record).__name__ == "Message":
                        found += names[record.channel_id] == topic
            except Exception:  # The open chunk at its end.
                pass
        if found >= count:
            return
        time.sleep(0.2)
    raise TimeoutError(f"{found} of {count} messages on {topic}")
