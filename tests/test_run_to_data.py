"""From an operator's run to data: training takes it as it is, and `sctn bag export` gives it to people outside ROS."""

from __future__ import annotations

import json
import operator
import pathlib
import re
import struct
import subprocess
import sys

import numpy as np
import pyarrow.parquet
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from processes import REPOSITORY


@pytest.fixture(scope="module")
def run(start_for_module, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The folder of a recorded run of placing."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    launch = start_for_module("sctn", "launch", "--problem", "placing", "--seed", 10005, "--record", folder)
    assert launch.wait(200.0) == 0, launch.log()
    return folder


def test_training_takes_recorded_runs(start, run: pathlib.Path, tmp_path: pathlib.Path) -> None:
    recipe = (REPOSITORY / "config/recipes/placing.yaml").read_text()
    for short in ("steps: 2", "warm_up_steps: 1", "snapshots: 1", "episodes: 0"):
        key = short.split(":")[0]
        recipe, count = re.subn(rf"\b{key}: \d+", short, recipe)
        assert count == 1, key
    (tmp_path / "recipe.yaml").write_text(recipe)
    # The folder of the launch, and the bag itself.
    train = start(
        "sctn", "train", "--recipe", tmp_path / "recipe.yaml", "--demos", run, run / "run", "--out", tmp_path / "out", "--json"
    )
    assert train.wait(200.0) == 0, train.log()
    assert pathlib.Path(json.loads(train.output().splitlines()[-1])["policy"]).is_file()
    assert "2 demonstrations" in train.errors()


def test_an_exported_run_is_what_the_bag_says(start, run: pathlib.Path, tmp_path: pathlib.Path) -> None:
    out = tmp_path / "data"
    export = start("sctn", "bag", "export", run / "run", run / "demonstration", "--out", out, "--json")
    assert export.wait(60.0) == 0, export.log()
    info = json.loads((out / "meta/info.json").read_text())
    episodes = [json.loads(line) for line in (out / "meta/episodes.jsonl").read_text().splitlines()]
    assert info["total_episodes"] == len(episodes) == 2
    assert info["total_frames"] == sum(episode["length"] for episode in episodes)
    assert all(episode["tasks"] == ["placing"] for episode in episodes)

    with AnyReader([run / "run"]) as reader:
        chosen = [connection for connection in reader.connections if connection.topic in ("/pick_place", "/heightmap")]
        messages = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages(chosen)]
    proposals = [message for topic, message in messages if topic == "/pick_place"]
    heightmaps = {(m.header.stamp.sec, m.header.stamp.nanosec): m for topic, m in messages if topic == "/heightmap"}

    path = info["data_path"].format(episode_chunk=0, episode_index=0)
    table = pyarrow.parquet.read_table(out / path).to_pylist()
    assert set(table[0]) == set(info["features"])
    assert 6 <= len(table) == episodes[0]["length"]
    # Attempts that failed are left out; the rest is in the order of the run.
    actions = [[p.pick.x, p.pick.y, p.pick.theta, p.place.x, p.place.y, p.place.theta] for p in proposals]
    kept = [int(np.abs(np.array(actions) - row["action"]).max(axis=1).argmin()) for row in table]
    assert np.allclose([actions[index] for index in kept], [row["action"] for row in table], atol=1e-6)
    assert kept == sorted(kept)
    assert [row["frame_index"] for row in table] == list(range(len(table)))
    assert [row["next.done"] for row in table] == [False] * (len(table) - 1) + [True]
    for index, row in enumerate(table):
        stamp = proposals[kept[index]].header.stamp
        seen = heightmaps[stamp.sec, stamp.nanosec]
        picture = row["observation.images.workspace"]["bytes"]
        assert picture.startswith(b"\x89PNG")
        assert struct.unpack(">II", picture[16:24]) == (seen.cols, seen.rows)
        step = out / f"steps/episode_000000/step_{index:03}"
        assert step.with_name(step.name + "_observation.png").read_bytes() == picture
        heights = np.load(step.with_name(step.name + "_height_m.npy"))
        assert np.array_equal(heights.ravel(), seen.height_m)
    stats = json.loads((out / "meta/episodes_stats.jsonl").read_text().splitlines()[0])["stats"]
    assert np.allclose(stats["action"]["mean"], np.mean([row["action"] for row in table], axis=0))
    assert set(stats) == set(info["features"])


def test_two_readers_of_others_read_every_message_of_a_recorded_run(run: pathlib.Path) -> None:
    (file,) = (run / "run").glob("*.mcap")
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        by_mcap = [(c.topic, m.log_time, m.data, decoded) for _, c, m, decoded in reader.iter_decoded_messages()]
    with AnyReader([run / "run"]) as reader:
        by_rosbags = [(c.topic, time, bytes(raw), reader.deserialize(raw, c.msgtype)) for c, time, raw in reader.messages()]
    assert len(by_mcap) == len(by_rosbags) > 1000
    key = operator.itemgetter(0, 1, 2)
    for ours, theirs in zip(sorted(by_mcap, key=key), sorted(by_rosbags, key=key), strict=True):
        assert ours[:3] == theirs[:3]
        assert same(ours[3], theirs[3]), ours[0]


def same(ours: object, theirs: object) -> bool:
    """Whether a message decoded by mcap-ros2-support says what the same message does by rosbags."""
    if fields := getattr(ours, "__slots__", None):
        return all(same(getattr(ours, name), getattr(theirs, name)) for name in fields if not name.startswith("_"))
    if isinstance(ours, (list, tuple)):
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    if isinstance(ours, (bytes, bytearray, memoryview)):
        return bytes(ours) == bytes(theirs)
    return ours == theirs


def test_the_page_of_the_sample_bag_reads_it() -> None:
    (script,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "bags/sample/README.md").read_text(), re.DOTALL)
    assert len(script.splitlines()) <= 10
    done = subprocess.run([sys.executable, "-c", script], cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("placed") == 9, done.stdout
