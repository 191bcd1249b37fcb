"""Transfers of DroneCAN with random contents, by the Python package dronecan, for uavcan_agrees_with_peers.rs.

dronecan_peer.py SEED ROUNDS    prints one JSON object per transfer, ROUNDS for each data type: its frames ("frames"), its type ("title"),
                                whether it is of CAN FD ("fd"), and [name, kind, value] of each of its values ("values"); of a service, two
                                transfers in one object
"""

import json
import random
import sys

import dronecan
from dronecan import transport
from dronecan.dsdl import ArrayType, CompoundType, PrimitiveType


def some(kind):
    if kind.kind == PrimitiveType.KIND_BOOLEAN:
        return random.random() < 0.5
    if kind.kind == PrimitiveType.KIND_FLOAT:
        return random.choice([0.0, 1.5, -2.25, float("nan"), random.uniform(-60000, 60000), random.uniform(-1, 1)])
    low, high = kind.value_range
    return random.choice([low, high, random.randint(low, high)])


def fill_array(array):
    kind = array._type
    if kind.mode == ArrayType.MODE_STATIC:
        for at in range(kind.max_size):
            if isinstance(kind.value_type, CompoundType):
                fill(array[at])
            else:
                array[at] = some(kind.value_type)
        return
    for _ in range(random.choice([0, kind.max_size, random.randint(0, kind.max_size)])):
        if isinstance(kind.value_type, CompoundType):
            item = array.new_item()
            fill(item)
            array.append(item)
        else:
            array.append(some(kind.value_type))


def fill(compound):
    fields = transport.get_fields(compound)
    names = list(fields)
    if transport.is_union(compound):
        names = [random.choice(names)]
        transport.switch_union_field(compound, names[0])
    for name in names:
        value = fields[name]
        if isinstance(value, transport.VoidValue):
            continue
        if isinstance(value, transport.CompoundValue):
            fill(value)
        elif isinstance(value, transport.ArrayValue):
            fill_array(value)
        else:
            value.value = some(value._type)


def one(name, kind, value):
    if kind.kind == PrimitiveType.KIND_FLOAT:
        yield [name, "float", repr(value)]
    else:
        yield [name, "int", int(value)]


def values(compound, prefix):
    fields = transport.get_fields(compound)
    names = list(fields)
    if transport.is_union(compound):
        names = [transport.get_active_union_field(compound)]
    for name in names:
        value = fields[name]
        path = prefix + name
        if isinstance(value, transport.VoidValue):
            continue
        if isinstance(value, transport.CompoundValue):
            yield from values(value, path + ".")
        elif not isinstance(value, transport.ArrayValue):
            yield from one(path, value._type, value.value)
        else:
            kind = value._type.value_type
            items = list(value)
            if isinstance(kind, CompoundType):
                for at, item in enumerate(items):
                    yield from values(item, f"{path}[{at}].")
            elif kind.kind == PrimitiveType.KIND_BOOLEAN:
                yield [path, "bits", [at for at, item in enumerate(items) if item]]
            elif kind.kind == PrimitiveType.KIND_UNSIGNED_INT and kind.bitlen == 8:
                yield [path, "bytes", bytes(items).hex().upper()]
            else:
                for at, item in enumerate(items):
                    yield from one(f"{path}[{at}]", kind, item)


def frames(transfer):
    return [[f"{frame.message_id:08X}", bytes(frame.bytes).hex().upper()] for frame in transfer.to_frames()]


def make(payload, **nodes):
    """A transfer whose frames have lengths that CAN FD has, which its own padding does not always give."""
    sent = transport.Transfer(payload=payload, **nodes)
    if all(transport.datalength_roundup(len(frame.bytes)) == len(frame.bytes) for frame in sent.to_frames()):
        return sent
    return None


def main():
    random.seed(int(sys.argv[1]))
    for (number, kind), data_type in sorted(dronecan.DATATYPES.items(), key=lambda item: item[1].full_name):
        service = kind == CompoundType.KIND_SERVICE
        for _ in range(int(sys.argv[2])):
            parts = [("request", "request."), ("response", "")] if service else [(None, "")]
            payloads = [data_type(_mode=mode) if service else data_type() for mode, _ in parts]
            for payload in payloads:
                fill(payload)
            number, priority, node = random.randrange(32), random.randrange(32), random.randint(1, 127)
            for fd in [True, False] if random.random() < 0.25 else [False]:
                made = []
                for (mode, _), payload in zip(parts, payloads):
                    nodes = {"source_node_id": node}
                    if service:
                        ask = mode == "request"
                        nodes = {"source_node_id": 127 if ask else 10, "dest_node_id": 10 if ask else 127}
                        nodes |= {"service_not_message": True, "request_not_response": ask}
                    made.append(make(payload, transfer_id=number, transfer_priority=priority, canfd=fd, **nodes))
                if all(made):
                    break
            seen = [value for (_, prefix), payload in zip(parts, payloads) for value in values(payload, prefix)]
            sent = [frame for transfer in made for frame in frames(transfer)]
            print(json.dumps({"title": data_type.full_name, "fd": fd, "frames": sent, "values": seen}))


if __name__ == "__main__":
    main()
