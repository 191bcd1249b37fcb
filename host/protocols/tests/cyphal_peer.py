"""Transfers of Cyphal with random contents, by the Python package pycyphal, for uavcan_agrees_with_peers.rs.

cyphal_peer.py DEFINITIONS FOLDER SEED ROUNDS    compiles the data types of a file of definitions in a folder, and prints one JSON object per
                                                 transfer, ROUNDS for each of them, as dronecan_peer.py does
"""

import importlib
import json
import pathlib
import random
import sys

import numpy
import pycyphal
import pycyphal.dsdl
import pydsdl
from pycyphal.transport import Priority
from pycyphal.transport.can._identifier import MessageCANID, ServiceCANID
from pycyphal.transport.can._session._transfer_sender import serialize_transfer


def compile_types(definitions, folder):
    path = None
    for line in pathlib.Path(definitions).read_text().splitlines():
        if line.startswith("=== "):
            path = folder / "dsdl" / line[4:]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("")
        elif path is not None:
            with path.open("a") as out:
                out.write(line + "\n")
    roots = [folder / "dsdl" / name for name in ("uavcan", "reg")]
    pycyphal.dsdl.compile_all(roots, folder / "out")
    sys.path.insert(0, str(folder / "out"))
    importlib.invalidate_caches()
    for root in roots:
        yield from pydsdl.read_namespace(root, [roots[0]])


def some(kind):
    if isinstance(kind, pydsdl.BooleanType):
        return random.random() < 0.5
    if isinstance(kind, pydsdl.FloatType):
        return random.choice([0.0, 1.5, -2.25, float("nan"), random.uniform(-60000, 60000), random.uniform(-1, 1)])
    low, high = (int(limit) for limit in kind.inclusive_value_range)
    return random.choice([low, high, random.randint(low, high)])


def make(kind):
    """A random value for a type's field."""
    if isinstance(kind, pydsdl.CompositeType):
        return fill(kind)
    if not isinstance(kind, pydsdl.ArrayType):
        return some(kind)
    count = kind.capacity
    if isinstance(kind, pydsdl.VariableLengthArrayType):
        count = random.choice([0, min(count, 300), random.randint(0, min(count, 300))])
    return [make(kind.element_type) for _ in range(count)]


def fill(kind):
    fields = kind.fields_except_padding
    if isinstance(kind.inner_type if isinstance(kind, pydsdl.DelimitedType) else kind, pydsdl.UnionType):
        fields = [random.choice(fields)]
    arguments = {field.name: make(field.data_type) for field in fields}
    cls = pycyphal.dsdl.get_class(kind)
    made = cls()
    for name, value in arguments.items():
        pycyphal.dsdl.set_attribute(made, name, value)
    return made


def one(name, kind, value):
    if isinstance(kind, pydsdl.FloatType):
        exact = {16: numpy.float16, 32: numpy.float32, 64: numpy.float64}[kind.bit_length](value)
        yield [name, "float", repr(float(exact))]
    else:
        value = int(value)
        yield [name, "int", value & ((1 << kind.bit_length) - 1) if value >= 0 else value]


def values(made, kind, prefix):
    for field in kind.fields_except_padding:
        value, path, of = pycyphal.dsdl.get_attribute(made, field.name), prefix + field.name, field.data_type
        if value is None:
            continue
        if isinstance(of, pydsdl.CompositeType):
            yield from values(value, of, path + ".")
        elif not isinstance(of, pydsdl.ArrayType):
            yield from one(path, of, value)
        elif isinstance(of.element_type, pydsdl.CompositeType):
            for at, item in enumerate(value):
                yield from values(item, of.element_type, f"{path}[{at}].")
        elif isinstance(of.element_type, pydsdl.BooleanType):
            yield [path, "bits", [at for at, item in enumerate(value) if item]]
        elif isinstance(of.element_type, pydsdl.UnsignedIntegerType) and of.element_type.bit_length == 8:
            yield [path, "bytes", bytes(bytearray(value)).hex().upper()]
        else:
            for at, item in enumerate(value):
                yield from one(f"{path}[{at}]", of.element_type, item)


def frames(identifier, transfer, payload, fd):
    payload = [memoryview(part) for part in payload]
    sent = serialize_transfer(identifier, transfer, payload, 63 if fd else 7)
    return [[f"{frame.identifier:08X}", bytes(frame.compile().data).hex().upper()] for frame in sent]


def main():
    types = list(compile_types(sys.argv[1], pathlib.Path(sys.argv[2])))
    random.seed(int(sys.argv[3]))
    for number, kind in enumerate(sorted(types, key=str)):
        for _ in range(int(sys.argv[4])):
            fd, transfer, priority, sent, seen = random.random() < 0.5, random.randrange(32), Priority(random.randrange(8)), [], []
            port = kind.fixed_port_id
            if isinstance(kind, pydsdl.ServiceType):
                for of, prefix, ask in ((kind.request_type, "request.", True), (kind.response_type, "", False)):
                    made = fill(of)
                    identifier = ServiceCANID(
                        priority=priority,
                        source_node_id=123 if ask else 42,
                        destination_node_id=42 if ask else 123,
                        service_id=number if port is None else port,
                        request_not_response=ask,
                    )
                    sent += frames(identifier.compile([]), transfer, pycyphal.dsdl.serialize(made), fd)
                    seen += values(made, of, prefix)
            else:
                made = fill(kind)
                port = number if port is None else port
                identifier = MessageCANID(priority=priority, source_node_id=random.randrange(128), subject_id=port)
                sent += frames(identifier.compile([]), transfer, pycyphal.dsdl.serialize(made), fd)
                seen += values(made, kind, "")
            print(json.dumps({"title": str(kind), "fd": fd, "port": port, "frames": sent, "values": seen}))


if __name__ == "__main__":
    main()
