"""Makes standard_definitions.txt with rosbags: the fields of ROS 2 Jazzy's own message types, and their RIHS01 hashes.

python bags/src/standard_definitions.py
"""

import pathlib

from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
# As bags separate the definitions of types that depend on each other.
SEPARATOR = "=" * 80 + "\n"


def definition(name: str) -> str:
    """The fields of one type alone."""
    text, _ = STORE.generate_msgdef(name, ros_version=2)
    return text.split(SEPARATOR)[0].rstrip("\n") + "\n"


types = sorted(name for name in STORE.fielddefs if "/msg/" in name)
blocks = [f"MSG: {name} {STORE.hash_rihs01(name)}\n{definition(name)}" for name in types]
pathlib.Path(__file__).with_suffix(".txt").write_text(SEPARATOR.join(blocks))
