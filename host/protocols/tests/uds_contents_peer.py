"""What py-uds finds in random messages of UDS, for uds_contents_agree_with_py_uds.rs.

uds_contents_peer.py SEED COUNT    prints one JSON object per message: its bytes ("data"), and name and value of each
                                   of its parts ("parts"), numbers or bytes in hexadecimal
"""

import json
import random
import sys
import warnings

from uds.translator import BASE_TRANSLATOR, BASE_TRANSLATOR_2013

ALGORITHM = 16


def some(low=0, high=5):
    return bytes(random.randrange(256) for _ in range(random.randint(low, high)))


def exactly(count):
    return some(count, count)


def sized(low=0):
    data = some(low)
    return len(data).to_bytes(2, "big") + data


def memory():
    address, size = random.randint(1, 8), random.randint(1, 8)
    return bytes([size << 4 | address]), exactly(address), exactly(size)


def authentication(task):
    configured = exactly(1)
    return {
        0: b"",
        1: configured + sized(1) + sized(),
        2: configured + sized(1) + sized(1),
        3: sized(1) + sized(),
        5: configured + exactly(ALGORITHM),
        6: exactly(ALGORITHM) + sized(1) + sized() + sized(),
        7: exactly(ALGORITHM) + sized(1) + sized(1) + sized(),
        8: b"",
    }[task]


def authenticated(task):
    result = bytes([random.choice([0, 1, 2, 3, 4, 0x10, 0x11, 0x12, 0x13])])
    return result + {
        1: sized(1) + sized(),
        2: sized(1) + sized(1) + sized(1) + sized(),
        3: sized(),
        5: exactly(ALGORITHM) + sized(1) + sized(),
        6: exactly(ALGORITHM) + sized(),
        7: exactly(ALGORITHM) + sized(1) + sized(),
    }.get(task, b"")


def file_request(mode):
    name = bytes(random.choice(b"abc/._xyz") for _ in range(random.randint(1, 20)))
    size = random.randint(1, 6)
    message = len(name).to_bytes(2, "big") + name
    if mode in (1, 3, 4, 6):
        message += exactly(1)
    if mode in (1, 3, 6):
        message += bytes([size]) + exactly(2 * size)
    return message


def file_response(mode):
    if mode == 2:
        return b""
    block, size = random.randint(1, 4), random.randint(1, 6)
    message = bytes([block]) + exactly(block) + (b"\0" if mode == 5 else exactly(1))
    if mode in (4, 5):
        message += size.to_bytes(2, "big") + exactly(size if mode == 5 else 2 * size)
    return message + (exactly(8) if mode == 6 else b"")


def event_record(event):
    return {
        1: exactly(1) + b"\x19\x02\xff",
        3: exactly(2) + b"\x22\xf1\x90",
        7: exactly(2) + bytes([random.randint(1, 4)]) + exactly(7) + b"\x22\xf1\x90",
    }.get(event, b"")


def scaling():
    message = b""
    for _ in range(random.randint(1, 4)):
        kind = random.choice([0, 1, 2, 3, 4, 6, 7, 8, 9, 10])
        message += bytes([kind << 4 | random.randint(1, 4)])
        if kind == 2:
            message += exactly(message[-1] & 15)
        elif kind == 9:
            formula = random.randrange(10)
            constants = [2, 2, 3, 2, 2, 3, 1, 1, 1, 2][formula]
            # It fails where an exponent or a mantissa is negative.
            message += bytes([formula]) + bytes(random.randrange(0x78) & ~8 for _ in range(2 * constants))
        elif kind == 10:
            message += bytes([random.randrange(0x3F)])
    return message


def messages():
    lengths, address, size = memory()
    # It expects more than there is in a task of 4.
    task, mode, event = random.choice([0, 1, 2, 3, 5, 6, 7, 8]), random.randint(1, 6), random.choice([0, 1, 3, 5, 6, 7])
    window, stored = bytes([random.randint(2, 8)]), random.choice([0, 0x40])
    did, data = exactly(2), some(1)
    signature = random.randrange(4)
    secured = bytes([0, random.choice([0, 0x40])]) + exactly(1) + bytes([0, signature]) + exactly(2)
    yield b"\x11\x04"
    yield b"\x51\x04" + exactly(1)
    yield b"\x23" + lengths + address + size
    yield b"\x24" + did
    yield b"\x64" + did + scaling()
    yield b"\x28\x04" + bytes([random.randrange(256)]) + exactly(2)
    yield b"\x28\x01" + bytes([random.randrange(256)])
    yield b"\x29" + bytes([task]) + authentication(task)
    yield b"\x69" + bytes([task]) + authenticated(task)
    yield b"\x2a" + bytes([random.randint(1, 4)]) + some(1, 1)
    yield b"\x2c\x01" + exactly(2) + exactly(4)
    yield b"\x2c\x02" + exactly(2) + lengths + address + size
    yield b"\x2c\x03" + exactly(2)
    yield b"\x6c" + bytes([random.randint(1, 3)]) + exactly(2)
    yield b"\x2f" + did + b"\x03" + some(1)
    yield b"\x6f" + did + bytes([random.randrange(4)]) + some(1)
    yield b"\x34" + exactly(1) + lengths + address + size
    yield b"\x74" + b"\x40" + exactly(4)
    yield b"\x36" + some(2, 9)
    yield b"\x76" + some(2, 9)
    yield b"\x38" + bytes([mode]) + file_request(mode)
    yield b"\x78" + bytes([mode]) + file_response(mode)
    yield b"\x3d" + lengths + address + len(data).to_bytes(len(size), "big") + data
    yield b"\x7d" + lengths + address + size
    yield b"\x84" + secured + b"\x22" + some(2) + exactly(signature)
    yield b"\xc4" + secured + b"\x62" + some(2) + exactly(signature)
    yield b"\x86" + bytes([event | stored]) + window + event_record(event)
    yield b"\xc6" + bytes([event | stored]) + exactly(1) + window + event_record(event)
    yield b"\x86\x02\x02" + bytes([random.randint(1, 3)]) + b"\x22\xf1\x90"
    yield b"\x87\x01" + bytes([random.choice([1, 2, 3, 4, 5, 0x10, 0x11, 0x12, 0x13, 0x20])])
    yield b"\x87\x02" + exactly(3)


def parts(records):
    for record in records:
        value, children = record["raw_value"], record.get("children") or ()
        several = isinstance(value, (list, tuple))
        yield [record["name"], bytes(value).hex().upper() if several and all(one < 256 for one in value) else value]
        for child in children if several and children and isinstance(children[0], (list, tuple)) else [children]:
            yield from parts(child)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    random.seed(int(sys.argv[1]))
    for _ in range(int(sys.argv[2])):
        for message in messages():
            # The timer was left out of the later edition.
            old = message[:1] in b"\x86\xc6" and message[1] & 0x3F == 2
            translator = BASE_TRANSLATOR_2013 if old else BASE_TRANSLATOR
            records = translator.services_mapping[message[0]].decode(message)
            print(json.dumps({"data": message.hex().upper(), "parts": list(parts(records))}))
