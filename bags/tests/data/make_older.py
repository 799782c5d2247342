"""Makes older_run with rosbags: a recorded run in the definitions of older_definitions/, from before fields were added at the end of
Goal, PickPlace and StepResult. Both stay as they are for ever, for ../older.rs to read.

python bags/tests/data/make_older.py
"""

import pathlib
import shutil

import numpy
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

HERE = pathlib.Path(__file__).parent
STORE = get_typestore(Stores.ROS2_JAZZY)
for path in sorted((HERE / "older_definitions").glob("*.msg")):
    STORE.register(get_types_from_msg(path.read_text(), f"sctn_msgs/msg/{path.stem}"))


def ours(name):
    return STORE.types[f"sctn_msgs/msg/{name}"]


TIME = STORE.types["builtin_interfaces/msg/Time"]
DURATION = STORE.types["builtin_interfaces/msg/Duration"]
HEADER = STORE.types["std_msgs/msg/Header"]
POSE = STORE.types["geometry_msgs/msg/Pose2D"]
POINT = STORE.types["geometry_msgs/msg/Point"]
SETTINGS = ours("PrimitiveSettings")(0.24, 0.2, 1.5, 0.8, 0.35, 4.0)
APPROVE, ADVANCE, PLACED = 1, 3, 1


def header(second):
    return HEADER(TIME(second, 0), "world")


def heightmap(second):
    heights = numpy.full(12, 0.01 * second, dtype=numpy.float32)
    colors = numpy.zeros(36, dtype=numpy.uint8)
    origin = POINT(0.25, -0.5, 0.0)
    return ours("Heightmap")(header(second), 4, 3, 0.003125, origin, -0.002, 0.28, colors, heights, 3, 1.0)


def goal(step, stamp):
    name = "placing/7"
    return ours("Goal")(header(stamp), "placing", name, step, 2, 0, False, "placing", SETTINGS, heightmap(9 + step))


def proposal(identifier, step, stamp):
    pick, place = POSE(0.3, 0.01 * identifier, 0.0), POSE(0.4, 0.1, 1.0)
    return ours("PickPlace")(header(stamp), identifier, "placing", step, 0, pick, place, 0.75, 0.5, SETTINGS, "placing")


def said(identifier, decision):
    return ours("StepConfirmation")(header(0), identifier, decision, "somebody")


def result(identifier, stamp):
    return ours("StepResult")(header(stamp), identifier, PLACED, "done" * identifier, DURATION(2, 0))


def reward(stamp, total):
    return ours("Reward")(header(stamp), 0.5, total, total == 1.0)


MESSAGES = [
    ("heightmap", heightmap(1)),
    ("goal", goal(1, 0)),
    ("pick_place", proposal(1, 1, 1)),
    ("step_confirmation", said(1, APPROVE)),
    ("step_result", result(1, 4)),
    ("heightmap", heightmap(4)),
    ("reward", reward(4, 0.5)),
    ("step_confirmation", said(1, ADVANCE)),
    ("goal", goal(2, 4)),
    ("pick_place", proposal(2, 2, 4)),
    ("step_confirmation", said(2, APPROVE)),
    ("step_result", result(2, 8)),
    ("heightmap", heightmap(8)),
    ("reward", reward(8, 1.0)),
    ("step_confirmation", said(2, ADVANCE)),
]

folder = HERE / "older_run"
shutil.rmtree(folder, ignore_errors=True)
with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    topics = {}
    for index, (topic, message) in enumerate(MESSAGES):
        name = message.__msgtype__
        if topic not in topics:
            topics[topic] = writer.add_connection(f"/{topic}", name, typestore=STORE)
        writer.write(topics[topic], 1_000_000_000 + index, STORE.serialize_cdr(message, name))
