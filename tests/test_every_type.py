"""Every message type of this repository there and back: rosbags writes it, we read and record it, two readers of others read that."""

from __future__ import annotations

import operator as functions
import pathlib
import random
import signal
import string

import numpy as np
import pytest
from bag_contents import KINDS, same, writer_of
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from processes import REPOSITORY
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

COPIES = 3
INTEGERS = {f"{sign}int{bits}": np.dtype(f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)}
# Whichever sign a reader gives them.
INTEGERS |= {"byte": np.dtype("int8"), "octet": np.dtype("int8"), "char": np.dtype("int8")}


def all_types() -> tuple[object, list[str]]:
    """A type store of rosbags with every message type of this repository, and their names."""
    store = get_typestore(Stores.ROS2_JAZZY)
    names: list[str] = []
    for path in sorted([*REPOSITORY.glob("msgs/msg/*.msg"), *REPOSITORY.glob("msgs/vendor/*/msg/*.msg")]):
        package = "sctn_msgs" if path.parent.parent.name == "msgs" else path.parent.parent.name
        # Of the middleware's own types rosbags has another hash (its `char` is none of rosidl's); nobody records them.
        if package == "rmw_dds_common":
            continue
        name = f"{package}/msg/{path.stem}"
        names.append(name)
        if name not in store.types:
            store.register(get_types_from_msg(path.read_text(), name))
    return store, names


STORE, TYPES = all_types()


def number(name: str, chance: random.Random) -> object:
    """Any value of a primitive type that is no text."""
    if name == "bool":
        return chance.random() < 0.5
    if name.startswith("float"):
        value = chance.uniform(-1e6, 1e6)
        return float(np.float32(value)) if name == "float32" else value
    return int.from_bytes(chance.randbytes(8), "little") % (int(np.iinfo(INTEGERS[name]).max) + 1)


def value(description: tuple, chance: random.Random) -> object:
    """Any value of a field."""
    kind, argument = description
    if kind == Nodetype.NAME:
        return message(argument, chance)
    if kind == Nodetype.BASE:
        if argument[0] == "string":
            letters = string.ascii_letters + "äöü "
            return "".join(chance.choices(letters, k=chance.randrange(argument[1] or 12)))
        return number(argument[0], chance)
    element, limit = argument
    count = limit if kind == Nodetype.ARRAY else chance.randrange(min(limit or 5, 5) + 1)
    values = [value(element, chance) for _ in range(count)]
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        return np.array(values, dtype=INTEGERS.get(element[1][0], element[1][0]))
    return values


def message(name: str, chance: random.Random) -> object:
    """Any message of a type."""
    return STORE.types[name](**{field: value(kind, chance) for field, kind in STORE.get_msgdef(name).fields})


def topic_of(name: str) -> str:
    return f"/every/{name.replace('/msg/', '/')}"


@pytest.fixture(scope="module")
def messages() -> list[tuple[str, bytes]]:
    """Type and CDR of a few messages of every type."""
    chance = random.Random(7)
    return [(name, bytes(STORE.serialize_cdr(message(name, chance), name))) for _ in range(COPIES) for name in TYPES]


def write(bag: pathlib.Path, kind: str, messages: list[tuple[str, bytes]]) -> pathlib.Path:
    """A bag of rosbags, a message a millisecond."""
    with writer_of(bag, kind) as writer:
        connections = {name: writer.add_connection(topic_of(name), name, typestore=STORE) for name in TYPES}
        for index, (name, raw) in enumerate(messages):
            writer.write(connections[name], 10**9 + 10**6 * index, raw)
    return bag


def by_rosbags(bag: pathlib.Path) -> list[tuple[str, bytes, object]]:
    """Topic, CDR and message, with the definitions that are in the bag alone."""
    with AnyReader([bag]) as reader:
        return [(c.topic, bytes(raw), reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]


def by_mcap(bag: pathlib.Path) -> list[tuple[str, bytes, object]]:
    """The same by mcap-ros2-support."""
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(c.topic, m.data, decoded) for _, c, m, decoded in reader.iter_decoded_messages()]


def padded(raw: bytes) -> bytes:
    """As DDS carries it: in whole words. What follows a message is none of it."""
    return raw + bytes(-len(raw) % 4)


def check(bag: pathlib.Path, messages: list[tuple[str, bytes]]) -> None:
    """Two readers of others find in a bag of ours what was written, decoded and not."""
    key = functions.itemgetter(0, 1)
    expected = sorted((topic_of(name), padded(raw)) for name, raw in messages)
    first, second = (
        sorted(((topic, padded(raw), read) for topic, raw, read in found), key=key) for found in (by_rosbags(bag), by_mcap(bag))
    )
    assert [found[:2] for found in first] == expected
    assert [found[:2] for found in second] == expected
    for (topic, raw, theirs), (_, _, others) in zip(first, second, strict=True):
        assert same(others, theirs), topic
        name = next(name for name in TYPES if topic_of(name) == topic)
        assert same(others, STORE.deserialize_cdr(raw, name)), topic


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_every_type_is_played_and_recorded_with_our_own_definitions(
    start, tmp_path: pathlib.Path, messages: list[tuple[str, bytes]], compression: str
) -> None:
    bag = write(tmp_path / "bag", "mcap", messages)
    copy = tmp_path / "copy"
    recorder = start("sctn", "bag", "record", "--regex", "^/every/", "--out", copy, "--compression", compression)
    play = start("sctn", "bag", "play", bag, "--wait", 60)
    assert play.wait(120.0) == 0, play.log()
    recorder.signal(signal.SIGINT)
    assert recorder.wait(30.0) == 0, recorder.log()
    assert "definition" not in recorder.errors(), recorder.errors()
    check(copy, messages)
    assert start("sctn", "bag", "verify", copy).wait(60.0) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_every_type_of_every_kind_of_bag_of_rosbags_is_read(
    start, tmp_path: pathlib.Path, messages: list[tuple[str, bytes]], kind: str
) -> None:
    bag = write(tmp_path / "bag", kind, messages)
    for compression in ("zstd", "none"):
        copy = tmp_path / compression
        recover = start("sctn", "bag", "recover", bag, "--out", copy, "--compression", compression)
        assert recover.wait(60.0) == 0, recover.log()
        check(copy, messages)
