"""Makes cdr.txt: every message type of this crate, filled by counting, as CDR bytes of an implementation that is not ours.

Run in an environment with rosbags and, for the standard types, rclpy with their packages:

    python msgs/tests/golden/make.py > msgs/tests/golden/cdr.txt

Each line: type name, CDR in hexadecimal. The rule of filling is that of `Filler` in ../cdr.rs. Where rclpy knows the
type, its reading of the bytes is compared as well.
"""

import importlib
import pathlib
import sys

import numpy
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MSGS = pathlib.Path(__file__).parents[2]
PARTS = {"msg": [""], "srv": ["_Request", "_Response"], "action": ["_Goal", "_Result", "_Feedback"]}
MASK = (1 << 64) - 1
GOLDEN_RATIO = 0x9E3779B97F4A7C15


def definitions():
    """Yields package, kind, name and text of every structure."""
    packages = [("sctn_msgs", MSGS)]
    packages += [(path.name, path) for path in sorted((MSGS / "vendor").iterdir()) if path.is_dir()]
    for package, folder in packages:
        for kind, parts in PARTS.items():
            for path in sorted((folder / kind).glob(f"*.{kind}")):
                texts, current = [], []
                for line in path.read_text().splitlines():
                    if line.strip() == "---":
                        texts.append("\n".join(current))
                        current = []
                    else:
                        current.append(line)
                texts.append("\n".join(current))
                for part, text in zip(parts, texts, strict=True):
                    yield package, kind, path.stem + part, text


class TooLong(Exception):
    """A bounded sequence takes less."""


class Filler:
    def __init__(self, store, most):
        self.store, self.most, self.counter = store, most, 0

    def count(self):
        self.counter += 1
        return self.counter

    def primitive(self, name):
        count = self.count()
        if name == "bool":
            return count % 2 == 0
        if name == "char":
            name = "uint8"
        if name == "string":
            return f"s{count}"
        if name in ("float32", "float64"):
            return count * 0.5
        if name in ("byte", "octet"):
            name = "int8"  # The same bits: rosbags takes bytes for signed.
        bits = int(name.removeprefix("u").removeprefix("int"))
        value = (count * GOLDEN_RATIO & MASK) >> (64 - bits)
        if not name.startswith("u") and value >> (bits - 1):
            value -= 1 << bits
        return value

    def element(self, node, argument):
        return self.primitive(argument[0]) if node == Nodetype.BASE else self.message(argument)

    def field(self, node, argument):
        if node in (Nodetype.BASE, Nodetype.NAME):
            return self.element(node, argument)
        (element, inner), size = argument
        is_bytes = element == Nodetype.BASE and inner[0] in ("uint8", "byte", "octet", "char")
        if node == Nodetype.SEQUENCE:
            bound, size = size, self.count() % (self.most + 1)
            if bound and size > bound:
                raise TooLong
            if is_bytes:
                return numpy.array([(self.counter + index) % 256 for index in range(size)], dtype=numpy.uint8)
        values = [self.element(element, inner) for _ in range(size)]
        if element == Nodetype.BASE and inner[0] not in ("string",):
            dtype = "uint8" if inner[0] in ("byte", "octet", "char") else inner[0]
            return numpy.array(values, dtype=dtype)
        return values

    def message(self, name):
        fields = self.store.fielddefs[name][1]
        values = {field: self.field(*kind) for field, kind in fields}
        return self.store.types[name](**values)


def check_with_rclpy(package, kind, name, bytes_, store):
    """Whether rclpy reads the same numbers from these bytes; packages and types that are not installed are skipped."""
    try:
        module = importlib.import_module(f"{package}.{kind}")
        from rclpy.serialization import deserialize_message, serialize_message
    except ImportError:
        return False
    parts = name.split("_")
    if not hasattr(module, parts[0]):
        return False
    kind_class = getattr(module, parts[0])
    for part in parts[1:]:
        kind_class = getattr(kind_class, part)
    again = serialize_message(deserialize_message(bytes_, kind_class))
    full = f"{package}/msg/{name}"
    # rclpy leaves padding as it was in memory: compare what is read back.
    same = bytes(store.serialize_cdr(store.deserialize_cdr(again, full), full))
    # It does not keep the byte of an empty structure.
    empty = "structure_needs_at_least_one_member" in store.types[full].__dataclass_fields__
    assert same == bytes_ or (empty and len(same) == len(bytes_)), f"rclpy reads {full} otherwise"
    return True


def main():
    store = get_typestore(Stores.EMPTY)
    types = {}
    structures = list(definitions())
    for package, _, name, text in structures:
        if not any(line.split("#")[0].strip() for line in text.splitlines()):
            text = "uint8 structure_needs_at_least_one_member"
        types.update(get_types_from_msg(text, f"{package}/msg/{name}"))
    store.register(types)
    checked = 0
    for package, kind, name, _ in structures:
        full = f"{package}/msg/{name}"
        try:
            message = Filler(store, 3).message(full)
        except TooLong:
            message = Filler(store, 1).message(full)
        bytes_ = bytes(store.serialize_cdr(message, full))
        checked += check_with_rclpy(package, kind, name, bytes_, store)
        print(f"{package}/{kind}/{name}", bytes_.hex())
    print(f"{len(structures)} types, {checked} of them compared with rclpy", file=sys.stderr)


main()
