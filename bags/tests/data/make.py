"""Makes the bags of this folder with rosbags: what another program writes, for ../bags.rs to read.

python bags/tests/data/make.py
"""

import pathlib
import shutil

import numpy
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

HERE = pathlib.Path(__file__).parent
STORE = get_typestore(Stores.ROS2_JAZZY)
STRING = STORE.types["std_msgs/msg/String"]
IMAGE = STORE.types["sensor_msgs/msg/Image"]
HEADER = STORE.types["std_msgs/msg/Header"]
TIME = STORE.types["builtin_interfaces/msg/Time"]


def make(name, mode=None, plugin=StoragePlugin.MCAP):
    folder = HERE / name
    shutil.rmtree(folder, ignore_errors=True)
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if mode:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        texts = writer.add_connection("/chatter", STRING.__msgtype__, typestore=STORE)
        images = writer.add_connection("/image", IMAGE.__msgtype__, typestore=STORE)
        for index in range(5):
            text = STORE.serialize_cdr(STRING(f"text {index}"), STRING.__msgtype__)
            writer.write(texts, 1_000_000_000 + index, text)
        header = HEADER(TIME(1, 5), "camera")
        image = IMAGE(header, 2, 3, "mono8", 0, 3, numpy.arange(6, dtype=numpy.uint8))
        writer.write(images, 1_000_000_005, STORE.serialize_cdr(image, IMAGE.__msgtype__))


make("rosbags_plain")
make("rosbags_zstd", CompressionMode.STORAGE)
make("rosbags_sqlite", plugin=StoragePlugin.SQLITE3)
make("rosbags_sqlite_file", CompressionMode.FILE, StoragePlugin.SQLITE3)
make("rosbags_sqlite_message", CompressionMode.MESSAGE, StoragePlugin.SQLITE3)
