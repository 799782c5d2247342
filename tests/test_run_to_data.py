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
import pyarrow as pa
import pyarrow.parquet
import pytest
from bag_contents import same
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from processes import REPOSITORY
from rosbags.highlevel import AnyReader


@pytest.fixture(scope="module")
def run(start_for_module, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The folder of a recorded run of placing."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    launch = start_for_module("sctn", "launch", "--problem", "placing", "--seed", 10005, "--record", folder)
    assert launch.wait(400.0) == 0, launch.log()
    return folder


def test_training_takes_recorded_runs(start, run: pathlib.Path, tmp_path: pathlib.Path) -> None:
    recipe = (REPOSITORY / "config/recipes/placing.yaml").read_text()
    for short in ("steps: 2", "warm_up_steps: 1", "snapshots: 1", "episodes: 0"):
        key = short.split(":")[0]
        recipe, count = re.subn(rf"\b{key}: \d+", short, recipe)
        assert count == 1, key
    (tmp_path / "recipe.yaml").write_text(recipe)
    # The folder of the launch, and the bag itself.
    train = start("sctn", "train", "--recipe", tmp_path / "recipe.yaml", "--demos", run, run / "run", "--out", tmp_path / "out", "--json")
    assert train.wait(400.0) == 0, train.log()
    assert pathlib.Path(json.loads(train.output().splitlines()[-1])["policy"]).is_file()
    assert "2 demonstrations" in train.errors()


def test_an_exported_run_is_what_the_bag_says(start, run: pathlib.Path, tmp_path: pathlib.Path) -> None:
    out = tmp_path / "data"
    export = start("sctn", "bag", "export", run / "run", run / "demonstration", "--out", out, "--json")
    assert export.wait(60.0) == 0, export.log()
    info = json.loads((out / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    episodes = pyarrow.parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert info["total_episodes"] == len(episodes) == 2
    assert info["total_frames"] == sum(episode["length"] for episode in episodes)
    assert all(episode["tasks"] == ["placing"] for episode in episodes)
    lengths = [episode["length"] for episode in episodes]
    spans = [(episode["dataset_from_index"], episode["dataset_to_index"]) for episode in episodes]
    assert spans == [(0, lengths[0]), (lengths[0], sum(lengths))]
    tasks = pyarrow.parquet.read_table(out / "meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "__index_level_0__": "placing"}]
    # What makes the text the index of the table that pandas reads.
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]

    with AnyReader([run / "run"]) as reader:
        chosen = [connection for connection in reader.connections if connection.topic in ("/pick_place", "/heightmap")]
        messages = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages(chosen)]
    proposals = [message for topic, message in messages if topic == "/pick_place"]
    heightmaps = {(m.header.stamp.sec, m.header.stamp.nanosec): m for topic, m in messages if topic == "/heightmap"}

    places = [(episode["data/chunk_index"], episode["data/file_index"]) for episode in episodes]
    path, second = (info["data_path"].format(chunk_index=chunk, file_index=file) for chunk, file in places)
    # The columns are those of the features that LeRobot's loader (datasets) would write itself, or it would not see pictures.
    schema = pyarrow.parquet.read_schema(out / path)
    arrow = {
        "image": pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
        "float32": pa.float32(),
        "int64": pa.int64(),
        "bool": pa.bool_(),
    }
    for name, feature in info["features"].items():
        expected = arrow[feature["dtype"]]
        nested = {"image": 0}.get(feature["dtype"], 0 if feature["shape"] == [1] else len(feature["shape"]))
        for _ in range(nested):
            expected = pa.list_(expected)
        assert schema.field(name) == pa.field(name, expected), name
    declared = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
    assert set(declared) == set(info["features"])
    assert declared["observation.images.workspace"] == {"_type": "Image"}
    assert declared["observation.goal_height_m"] == {"shape": [320, 160], "dtype": "float32", "_type": "Array2D"}
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
        assert np.array_equal(np.array(row["observation.height_m"], dtype=np.float32), heights)
        # A step's goal is what the next step begins with.
        if index + 1 < len(table):
            assert row["observation.images.goal"]["bytes"] == table[index + 1]["observation.images.workspace"]["bytes"]
            assert row["observation.goal_height_m"] == table[index + 1]["observation.height_m"]
    folder = out / "steps/episode_000000"
    assert table[-1]["observation.images.goal"]["bytes"] == (folder / "last_observation.png").read_bytes()
    last_heights = np.array(table[-1]["observation.goal_height_m"], dtype=np.float32)
    assert np.array_equal(last_heights, np.load(folder / "last_height_m.npy"))
    rows = table + pyarrow.parquet.read_table(out / second).to_pylist()
    assert [row["index"] for row in rows] == list(range(sum(lengths)))
    stats = json.loads((out / "meta/stats.json").read_text())
    assert set(stats) == set(info["features"])
    actions = np.array([row["action"] for row in rows])
    for name, of in (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)):
        assert np.allclose(stats["action"][name], of(actions, axis=0), atol=1e-5), name
    assert stats["action"]["count"] == [len(rows)]
    assert np.shape(stats["observation.images.workspace"]["mean"]) == (3, 1, 1)
    heights = np.array([row["observation.height_m"] for row in rows])
    assert np.allclose(stats["observation.height_m"]["mean"], [[heights.mean()]], atol=1e-5)


def test_the_bag_of_a_run_shows_its_last_heightmap_steps_and_rewards(start, run: pathlib.Path) -> None:
    info = start("sctn", "bag", "info", run / "run")
    assert info.wait(60.0) == 0, info.log()
    lines = info.output().splitlines()
    (steps,) = [line for line in lines if line.startswith("steps: ")]
    assert "placed" in steps
    assert "reward: 1.000, complete" in lines
    (decisions,) = [line for line in lines if line.startswith("operator: ")]
    assert "9 advance" in decisions
    with AnyReader([run / "run"]) as reader:
        chosen = [connection for connection in reader.connections if connection.topic in ("/reward", "/heightmap")]
        stamps: dict[str, int] = {}
        for connection, _, raw in reader.messages(chosen):
            stamp = reader.deserialize(raw, connection.msgtype).header.stamp
            stamps[connection.topic] = stamp.sec * 10**9 + stamp.nanosec
    assert stamps["/heightmap"] >= stamps["/reward"], "what the last step has made of the workspace is seen"


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


def test_the_page_of_the_sample_bag_reads_it() -> None:
    (script,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "bags/sample/README.md").read_text(), re.DOTALL)
    assert len(script.splitlines()) <= 10
    done = subprocess.run([sys.executable, "-c", script], cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("placed") == 9, done.stdout
