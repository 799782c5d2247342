"""`sctn bag record` and `play` beside rclpy: any type, found as it appears, played as it was."""

from __future__ import annotations

import itertools
import json
import os
import pathlib
import re
import resource
import signal
import subprocess

import yaml
from bag_contents import DEEP, STORE, contents, wait_for_recorder, wait_until_heard, writer_of
from cell_operator import EVENT, LATCHED, STREAM, Operator, nanoseconds
from processes import BINARIES, environment
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sctn_msgs.msg import StepResult
from sensor_msgs.msg import BatteryState
from std_msgs.msg import String


def end(recorder, code: int = 0) -> dict:
    """Ends a recorder as Ctrl+C does; its report."""
    recorder.signal(signal.SIGINT)
    assert recorder.wait(60.0) == code, recorder.log()
    return json.loads(recorder.output().splitlines()[-1])


def test_topics_of_any_type_are_recorded_as_they_appear_and_read_by_rosbags(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = tmp_path / "bag"
    recorder = start("sctn", "bag", "record", "--all", "--exclude", "hush", "--out", bag, "--json")
    operator.spin(1.0)
    node = operator.node
    latched = node.create_publisher(String, "/latched", LATCHED)
    # A type that is not among ours.
    batteries = node.create_publisher(BatteryState, "/cell/battery", DEEP)
    hush = node.create_publisher(String, "/hush", DEEP)
    latched.publish(String(data="before anybody listened"))
    wait_for_recorder(operator, latched, batteries)
    for index in range(200):
        batteries.publish(BatteryState(voltage=float(index), location=f"slot {index}", cell_voltage=[1.0, float(index)]))
        hush.publish(String(data="not for the bag"))
        operator.spin(0.002)
    wait_until_heard(latched, batteries)
    report = end(recorder)
    assert report["topics"]["/cell/battery"] == {"messages": 200, "lost_in_transport": 0, "lost_in_queue": 0}

    found = contents(bag, "/cell/battery")
    assert [battery.location for _, battery in found] == [f"slot {index}" for index in range(200)]
    assert [list(battery.cell_voltage) for _, battery in found] == [[1.0, float(index)] for index in range(200)]
    assert [text.data for _, text in contents(bag, "/latched")] == ["before anybody listened"]
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = {entry["topic_metadata"]["name"]: entry for entry in information["topics_with_message_count"]}
    assert "/hush" not in topics
    (qos,) = topics["/latched"]["topic_metadata"]["offered_qos_profiles"]
    assert (qos["reliability"], qos["durability"]) == ("reliable", "transient_local")
    battery_type = "sensor_msgs/msg/BatteryState"
    assert topics["/cell/battery"]["topic_metadata"]["type_description_hash"] == STORE.hash_rihs01(battery_type)
    assert start("sctn", "bag", "verify", bag).wait(60.0) == 0


def test_a_recording_is_split_and_played_as_one(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = tmp_path / "bag"
    recorder = start("sctn", "bag", "record", "/chatter", "--out", bag, "--split-duration", 1.0, "--compression", "none", "--json")
    chatter = operator.node.create_publisher(String, "/chatter", DEEP)
    wait_for_recorder(operator, chatter)
    for index in range(60):
        chatter.publish(String(data=str(index)))
        operator.spin(0.05)
    wait_until_heard(chatter)
    report = end(recorder)
    assert report["files"] >= 3
    assert len(list(bag.glob("*.mcap"))) == report["files"]
    assert [int(text.data) for _, text in contents(bag)] == list(range(60))

    heard: list[tuple[int, String]] = []
    hear = lambda text, info: heard.append((info["source_timestamp"], text))  # noqa: E731
    operator.node.create_subscription(String, "/elsewhere", hear, DEEP)
    play = start("sctn", "bag", "play", bag, "--remap", "/chatter:=/elsewhere", "--rate", 4, "--wait", 30, "--start", 1.0, "--json")
    operator.until(lambda: heard and heard[-1][1].data == "59", "last message", 60.0)
    assert play.wait(60.0) == 0, play.log()
    # From one second on, each message once and in order.
    with AnyReader([bag], default_typestore=STORE) as reader:
        times = [time_ns for _, time_ns, _ in reader.messages()]
    first = sum(time_ns < times[0] + 10**9 for time_ns in times)
    assert 0 < first < 25
    assert [int(text.data) for _, text in heard] == list(range(first, 60))
    # At four times the pace.
    assert heard[-1][0] - heard[0][0] < 0.6 * (times[-1] - times[first])


def test_a_recording_is_split_by_size_and_the_files_are_one_bag(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = tmp_path / "bag"
    recorder = start("sctn", "bag", "record", "/big", "--out", bag, "--split-size", 1, "--compression", "none", "--json")
    big = operator.node.create_publisher(String, "/big", DEEP)
    wait_for_recorder(operator, big)
    for index in range(40):
        big.publish(String(data=f"{index} " + "x" * 100_000))
        operator.spin(0.02)
    wait_until_heard(big)
    report = end(recorder)
    sizes = [file.stat().st_size for file in bag.glob("*.mcap")]
    assert len(sizes) == report["files"] >= 3
    # A file may be larger by the chunk that is open, here 1 MB.
    assert max(sizes) < 2_500_000
    assert [int(text.data.split()[0]) for _, text in contents(bag)] == list(range(40))


def test_what_the_transport_has_lost_is_counted(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = tmp_path / "bag"
    recorder = start("sctn", "bag", "record", "/big", "--out", bag, "--compression", "none", "--json")
    big = operator.node.create_publisher(String, "/big", STREAM)
    wait_for_recorder(operator, big)
    numbers = iter(range(1000))

    def say(count: int, seconds: float) -> None:
        for number in itertools.islice(numbers, count):
            big.publish(String(data=f"{number} " + "x" * 100_000))
            operator.spin(seconds)

    # Slow enough for a busy machine.
    say(5, 0.2)
    # 60 MB, best effort, for a process that reads nothing: more than any receive buffer holds.
    recorder.signal(signal.SIGSTOP)
    say(600, 0.001)
    recorder.signal(signal.SIGCONT)
    operator.spin(3.0)
    say(5, 0.2)
    operator.spin(1.0)
    report = end(recorder)
    recorded = [int(text.data.split()[0]) for _, text in contents(bag)]
    assert recorded[:5] == list(range(5)) and recorded[-5:] == list(range(605, 610))
    lost = 610 - len(recorded)
    assert 0 < lost
    assert report["topics"]["/big"] == {"messages": len(recorded), "lost_in_transport": lost, "lost_in_queue": 0}
    assert "/big" in recorder.errors() and f"{lost} messages lost in the transport" in recorder.errors()


def test_what_finds_no_room_in_the_queue_is_counted_and_a_step_result_always_finds_some(
    start, operator: Operator, tmp_path: pathlib.Path
) -> None:
    bag = tmp_path / "bag"
    recorder = start("sctn", "bag", "record", "/chatter", "/step_result", "--out", bag, "--queue", 0, "--json")
    chatter = operator.node.create_publisher(String, "/chatter", DEEP)
    results = operator.node.create_publisher(StepResult, "/step_result", EVENT)
    wait_for_recorder(operator, chatter, results)
    for index in range(5):
        chatter.publish(String(data=str(index)))
        results.publish(StepResult(proposal_id=index))
        operator.spin(0.05)
    wait_until_heard(chatter, results)
    report = end(recorder, code=3)
    assert report["topics"]["/chatter"] == {"messages": 0, "lost_in_transport": 0, "lost_in_queue": 5}
    assert report["topics"]["/step_result"] == {"messages": 5, "lost_in_transport": 0, "lost_in_queue": 0}
    assert "5 messages found no room on their way to the disk" in recorder.errors()
    assert [result.proposal_id for _, result in contents(bag)] == list(range(5))


def test_a_person_at_the_terminal_sees_rate_and_size(operator: Operator, domain: int, tmp_path: pathlib.Path) -> None:
    person, terminal = os.openpty()
    command = [BINARIES / "sctn", "bag", "record", "/chatter", "--out", tmp_path / "bag", "--duration", "6"]
    recorder = subprocess.Popen(command, env=environment(domain), stdin=terminal, stderr=terminal, stdout=subprocess.DEVNULL)
    os.close(terminal)
    try:
        chatter = operator.node.create_publisher(String, "/chatter", DEEP)
        wait_for_recorder(operator, chatter)
        while recorder.poll() is None:
            chatter.publish(String(data="x" * 10_000))
            operator.spin(0.02)
        assert recorder.returncode == 0
        shown = os.read(person, 1 << 16).decode()
    finally:
        recorder.kill()
        recorder.wait()
        os.close(person)
    lines = re.findall(r"(\d+) s, (\d+) messages, ([\d.]+) kB, ([\d.]+) MB/s, lost: 0 in the transport, 0 in the queue", shown)
    assert lines, shown
    assert int(lines[-1][1]) > 20
    assert float(lines[-1][3]) > 0.1


def test_topics_are_chosen_and_offered_as_they_were_recorded(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = tmp_path / "bag"
    recorder = start("sctn", "bag", "record", "--all", "--exclude", "^/rosout$", "--out", bag, "--json")
    profiles = {"/one/latched": LATCHED, "/one/events": DEEP, "/one/stream": STREAM, "/two/events": DEEP, "/one/hush": DEEP}
    publishers = {topic: operator.node.create_publisher(String, topic, qos) for topic, qos in profiles.items()}
    wait_for_recorder(operator, *publishers.values())
    for publisher in publishers.values():
        publisher.publish(String(data="here"))
    operator.spin(1.0)
    end(recorder)
    for publisher in publishers.values():
        operator.node.destroy_publisher(publisher)
    play = start("sctn", "bag", "play", bag, "--paused", "--regex", "^/one/", "--exclude", "hush$", "--topics", "/two/events")
    expected = {topic: profiles[topic] for topic in ("/one/latched", "/one/events", "/one/stream", "/two/events")}
    operator.until(lambda: all(operator.node.count_publishers(topic) for topic in expected), "player", 60.0)
    for topic, qos in expected.items():
        (offered,) = [info.qos_profile for info in operator.node.get_publishers_info_by_topic(topic)]
        assert (offered.reliability, offered.durability) == (qos.reliability, qos.durability), topic
    assert operator.node.count_publishers("/one/hush") == 0
    play.signal(signal.SIGINT)
    assert play.wait(60.0) == 0, play.log()


def test_the_clock_of_a_play_is_that_of_the_bag_at_its_rate(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = numbered_bag(tmp_path / "bag", count=60, hz=10)
    times: list[tuple[float, float]] = []
    hear = lambda clock, info: times.append((1e-9 * info["source_timestamp"], 1e-9 * nanoseconds(clock.clock)))  # noqa: E731
    operator.node.create_subscription(Clock, "/clock", hear, STREAM)
    play = start("sctn", "bag", "play", bag, "--clock", 40, "--rate", 2, "--start", 2, "--duration", 3, "--wait", 4)
    operator.until(lambda: play.exit_code is not None, "end of the play", 60.0)
    assert play.exit_code == 0, play.log()
    values = [value for _, value in times]
    assert len(values) > 20
    assert values == sorted(values)
    # The bag begins at second 1.
    assert 3.0 <= values[0] < 3.5
    assert 5.0 < values[-1] <= 6.1
    wall = times[-1][0] - times[0][0]
    assert 0.5 < (values[-1] - values[0]) / wall / 2 < 2.0


def test_a_bag_played_in_a_loop_ends_when_told(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = tmp_path / "bag"
    recorder = start("sctn", "bag", "record", "--regex", "^/chat", "--out", bag, "--json")
    chatter = operator.node.create_publisher(String, "/chatter", DEEP)
    wait_for_recorder(operator, chatter)
    for index in range(5):
        chatter.publish(String(data=str(index)))
        operator.spin(0.05)
    wait_until_heard(chatter)
    end(recorder)
    operator.node.destroy_publisher(chatter)
    heard: list[String] = []
    operator.node.create_subscription(String, "/chatter", heard.append, DEEP)
    clocks = operator.count("clock")
    play = start("sctn", "bag", "play", bag, "--loop", "--wait", 30, "--clock", 50)
    operator.until(lambda: len(heard) >= 12, "message of the third round", 60.0)
    assert [text.data for text in heard[:12]] == [str(index % 5) for index in range(12)]
    operator.until(lambda: operator.count("clock") > clocks, "clock", 60.0)
    play.signal(signal.SIGTERM)
    assert play.wait(60.0) == 0, play.log()


def test_a_full_disk_ends_the_recording_and_what_was_written_is_a_bag(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = tmp_path / "bag"
    # More room than any disk has.
    recorder = start("sctn", "bag", "record", "/chatter", "--out", bag, "--min-free", 10**12, "--json")
    chatter = operator.node.create_publisher(String, "/chatter", DEEP)
    wait_for_recorder(operator, chatter)
    chatter.publish(String(data="the last word"))
    operator.until(lambda: recorder.exit_code is not None, "end of the recording", 60.0)
    assert recorder.exit_code == 3, recorder.log()
    assert json.loads(recorder.output().splitlines()[-1])["end"] == "disk_full"
    assert "room" in recorder.errors()
    assert [text.data for _, text in contents(bag)] == ["the last word"]


def test_a_disk_without_room_ends_the_recording_and_what_fitted_is_recovered(
    start, operator: Operator, domain: int, tmp_path: pathlib.Path
) -> None:
    def no_more_than_three_megabytes() -> None:
        # Beyond the limit a write fails, as on a full disk.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))

    command = [BINARIES / "sctn", "bag", "record", "/big", "--out", tmp_path / "bag", "--compression", "none"]
    log = tmp_path / "record.log"
    with log.open("wb") as errors:
        recorder = subprocess.Popen(
            command, env=environment(domain), stdin=subprocess.DEVNULL, stderr=errors, preexec_fn=no_more_than_three_megabytes
        )
    try:
        big = operator.node.create_publisher(String, "/big", DEEP)
        wait_for_recorder(operator, big)
        for index in range(80):
            big.publish(String(data=f"{index} " + "x" * 100_000))
            operator.spin(0.05)
            if recorder.poll() is not None:
                break
        assert recorder.wait(60.0) == 1, log.read_text()
    finally:
        recorder.kill()
        recorder.wait()
    assert "disk is full" in log.read_text()
    assert "sctn bag recover" in log.read_text()
    recover = start("sctn", "bag", "recover", tmp_path / "bag.partial", "--out", tmp_path / "copy")
    assert recover.wait(60.0) == 3, recover.log()
    numbers = [int(text.data.split()[0]) for _, text in contents(tmp_path / "copy")]
    assert len(numbers) > 5
    assert numbers == list(range(len(numbers)))


def test_keys_pause_step_and_end_a_play(start, operator: Operator, domain: int, tmp_path: pathlib.Path) -> None:
    bag = numbered_bag(tmp_path / "bag", count=100, hz=10)
    heard: list[String] = []
    operator.node.create_subscription(String, "/chatter", heard.append, DEEP)
    keyboard, terminal = os.openpty()
    command = [BINARIES / "sctn", "bag", "play", bag, "--paused", "--wait", "30"]
    play = subprocess.Popen(command, env=environment(domain), stdin=terminal)
    try:
        operator.until(lambda: operator.node.count_publishers("/chatter"), "player", 60.0)
        operator.spin(2.0)
        assert heard == [], "it is paused"
        os.write(keyboard, b"nn")
        operator.until(lambda: len(heard) == 2, "two messages", 60.0)
        operator.spin(0.5)
        assert [text.data for text in heard] == ["0", "1"]
        os.write(keyboard, b" ")
        operator.until(lambda: len(heard) > 5, "message after the pause", 60.0)
        os.write(keyboard, b"q")
        assert play.wait(60.0) == 0
        operator.spin(0.5)
        assert [text.data for text in heard] == [str(index) for index in range(len(heard))]
        assert len(heard) < 100
    finally:
        play.kill()
        play.wait()
        os.close(keyboard)
        os.close(terminal)


def test_what_stood_on_latched_topics_is_played_first(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = tmp_path / "bag"
    recorder = start("sctn", "bag", "record", "/latched", "/chatter", "--out", bag, "--json")
    latched = operator.node.create_publisher(String, "/latched", LATCHED)
    chatter = operator.node.create_publisher(String, "/chatter", DEEP)
    wait_for_recorder(operator, latched, chatter)
    for index in range(20):
        if index < 2:
            latched.publish(String(data=f"state {index}"))
        chatter.publish(String(data=str(index)))
        operator.spin(0.1)
    wait_until_heard(latched, chatter)
    end(recorder)
    operator.node.destroy_publisher(latched)
    operator.node.destroy_publisher(chatter)
    # By the time when each was sent: topics have no order among each other.
    heard: list[tuple[int, str, str]] = []
    for topic, qos in (("/latched", LATCHED), ("/chatter", DEEP)):
        hear = lambda text, info, topic=topic: heard.append((info["source_timestamp"], topic, text.data))  # noqa: E731
        operator.node.create_subscription(String, topic, hear, qos)
    play = start("sctn", "bag", "play", bag, "--start", 1.0, "--wait", 30)
    operator.until(lambda: {"state 1", "19"} <= {text for *_, text in heard}, "first and last message", 60.0)
    assert play.wait(60.0) == 0, play.log()
    operator.spin(0.5)
    said = [(topic, text) for _, topic, text in sorted(heard)]
    assert said[0] == ("/latched", "state 1")
    assert [topic for topic, _ in said].count("/latched") == 1
    assert said[-1] == ("/chatter", "19")


def test_a_bag_of_another_recorder_is_played(start, operator: Operator, tmp_path: pathlib.Path) -> None:
    bag = numbered_bag(tmp_path / "bag", count=20, hz=50)
    heard: list[String] = []
    operator.node.create_subscription(String, "/chatter", heard.append, DEEP)
    play = start("sctn", "bag", "play", bag, "--wait", 30)
    operator.until(lambda: len(heard) == 20, "played message", 60.0)
    assert [int(text.data) for text in heard] == list(range(20))
    assert play.wait(60.0) == 0, play.log()


def numbered_bag(bag: pathlib.Path, count: int, hz: int) -> pathlib.Path:
    """An SQLite bag of numbers, by rosbags."""
    text = STORE.types["std_msgs/msg/String"]
    with writer_of(bag, "sqlite") as writer:
        chatter = writer.add_connection("/chatter", text.__msgtype__, typestore=STORE)
        for index in range(count):
            writer.write(chatter, 10**9 + index * 10**9 // hz, STORE.serialize_cdr(text(str(index)), text.__msgtype__))
    return bag
