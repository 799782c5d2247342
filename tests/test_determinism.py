"""Two runs of one seed are the same, bit for bit, also on a busy machine."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import subprocess
import sys
from collections.abc import Iterator

from mcap.reader import make_reader

# What a run decides. Joint states, clock and images stream at their own pace and are not compared message by message.
COMPARED = ("/heightmap", "/goal", "/pick_place", "/step_result", "/reward")


def test_two_runs_of_one_seed_are_bit_identical_under_load(start, tmp_path: pathlib.Path) -> None:
    quiet = run(start, tmp_path / "quiet")
    with busy_machine():
        loaded = run(start, tmp_path / "loaded")
    for topic in COMPARED:
        assert quiet[topic], f"no message on {topic}"
        assert quiet[topic] == loaded[topic], f"{topic} differs"


def run(start, directory: pathlib.Path) -> dict[str, list[bytes]]:
    """One recorded run: the serialised messages of each compared topic, in order."""
    launch = start(
        "sctn", "launch", "--problem", "placing", "--seed", 10001, "--operator", "auto", "--processes",
        "--record", directory, "--json",
    )  # fmt: skip
    assert launch.wait(400.0) == 0, launch.log()
    outcome = json.loads(launch.output().splitlines()[-1])
    assert outcome["completed"] is True, outcome
    messages: dict[str, list[bytes]] = {topic: [] for topic in COMPARED}
    (file,) = pathlib.Path(outcome["bag"]).glob("*.mcap")
    with file.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            known = messages.get(channel.topic)
            # While nothing moves a node may repeat what it said.
            if known is not None and message.data not in known[-1:]:
                known.append(message.data)
    # The run is over with the last reward; the oracle's word that nothing is left may come too late for the bag.
    messages["/goal"] = messages["/goal"][: outcome["steps"]]
    assert len(messages["/goal"]) == len(messages["/pick_place"]) == outcome["steps"]
    return messages


@contextlib.contextmanager
def busy_machine() -> Iterator[None]:
    """Two processes for every core that only compute."""
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()
