"""cantools' decoded values, as JSON lines, for tests/signals_agree_with_cantools.rs.

    cantools_peer.py decode FILE...    what each signal of each database is, and $PAYLOADS random payloads, or 100, per message
    cantools_peer.py files DIR         fetch cantools' source from PyPI and print its test files
    cantools_peer.py others DIR        as files, the databases of canmatrix and opendbc
    cantools_peer.py dbf DIR DBC…      writes each, as canmatrix reads it, as DBF and as DBC, and prints both names

Values are printed as text: integers of any size, floats with every digit.
"""

import contextlib
import json
import os
import pathlib
import random
import re
import subprocess
import sys
import tarfile
from importlib.metadata import version

PAYLOADS = int(os.environ.get("PAYLOADS", "100"))
TRUNCATED_EVERY = 10


def text(value):
    return str(value) if isinstance(value, int) else repr(float(value))


def decode(message, node, data, texts):
    """Message.decode, which gives up on a multiplexer value that the database does not list, does the
    same walk; this one keeps what is present in any case. `texts` gets those of value tables."""
    from cantools.database.namedsignalvalue import NamedSignalValue
    from cantools.database.utils import decode_data

    layout = (data, message.length, node["signals"], node["formats"])
    decoded = decode_data(*layout, False, True, True, True)
    named = decode_data(*layout, True, True, True, True)
    texts.update({name: str(value) for name, value in named.items() if isinstance(value, NamedSignalValue)})
    for switch, children in node["multiplexers"].items():
        child = children.get(decoded.get(switch))
        if child is not None:
            decoded.update(decode(message, child, data, texts))
    return decoded


def contained(message, random_bytes):
    """A container's bytes, made by hand so that headers of no known PDU, PDUs that come twice or are cut, and padding are among them."""
    data = b""
    for _ in range(random_bytes.randrange(5)):
        inner = random_bytes.choice(message.contained_messages)
        header_id, length = inner.header_id, inner.length
        if random_bytes.random() < 0.2:
            header_id, length = random_bytes.randrange(1, 1 << 24), random_bytes.randrange(9)
        elif random_bytes.random() < 0.2:
            length = random_bytes.randrange(inner.length + 1)
        data += header_id.to_bytes(3, "big") + bytes([length]) + random_bytes.randbytes(length)
    if random_bytes.random() < 0.2:
        data = data[: random_bytes.randrange(len(data) + 1)]
    return data[: message.length]


def decode_container(message, data, texts):
    """The signals of each PDU under `PDU.signal`, of one that comes again those of the last."""
    values = {}
    for inner, bytes_of_it in message.unpack_container(data, allow_truncated=True):
        if isinstance(inner, int):
            continue
        of_it = {}
        decoded = decode(inner, inner._codecs, bytes_of_it, of_it)
        for known, new in ((values, decoded), (texts, of_it)):
            for name in [name for name in known if name.startswith(f"{inner.name}.")]:
                del known[name]
            known.update({f"{inner.name}.{name}": value for name, value in new.items()})
    return values


def signal_layout(signal):
    kind = "float" if signal.is_float else "signed" if signal.is_signed else "unsigned"
    return {
        "start": signal.start,
        "length": signal.length,
        "little": signal.byte_order == "little_endian",
        "kind": kind,
        "scale": repr(float(signal.scale)),
        "offset": repr(float(signal.offset)),
        "unit": signal.unit or "",
        "switch": signal.multiplexer_signal if signal.multiplexer_ids else None,
        "ids": sorted(signal.multiplexer_ids or []),
        "texts": {str(int(raw)): str(choice) for raw, choice in (signal.choices or {}).items()},
    }


def with_switches(message, node, data, random_bytes):
    """The payload with multiplexers at values that the database lists: random ones rarely meet those of long multiplexers."""
    number = int.from_bytes(data, "little")
    for switch, children in node["multiplexers"].items():
        signal = message.get_signal_by_name(switch)
        value = random_bytes.choice(list(children))
        positions = range(signal.start, signal.start + signal.length)
        if signal.byte_order == "big_endian":
            first = signal.start // 8 * 8 + 7 - signal.start % 8
            positions = [at // 8 * 8 + 7 - at % 8 for at in range(first + signal.length - 1, first - 1, -1)]
        for place, bit in enumerate(positions):
            number = number & ~(1 << bit) | (value >> place & 1) << bit
        data = (number & (1 << 8 * len(data)) - 1).to_bytes(len(data), "little")
        data = with_switches(message, children[value], data, random_bytes)
        number = int.from_bytes(data, "little")
    return data


IDENTIFIER = re.compile(r'^((?:BO_|VAL_|SIG_VALTYPE_|SG_MUL_VAL_|BO_TX_BU_|SIG_GROUP_|(?:CM_|BA_ +"\w+") +(?:BO_|SG_)) +)(\d+)', re.M)


def with_flags(text):
    """A DBC file with the flag on each identifier that needs 29 bits, which cantools refuses without."""
    flag = lambda id: id | 1 << 31 if 0x7FF < id < 0x20000000 else id
    return IDENTIFIER.sub(lambda found: found[1] + str(flag(int(found[2]))), text)


def load(path):
    import cantools

    kind = pathlib.Path(path).suffix.lower()[1:]
    if kind != "dbc":
        return cantools.database.load_file(path, database_format=kind, strict=False)
    content = pathlib.Path(path).read_bytes()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
    try:
        return cantools.database.load_string(text, database_format="dbc", strict=False)
    except cantools.database.UnsupportedDatabaseFormatError as error:
        if "is more than 11 bits" not in str(error):
            raise
        return cantools.database.load_string(with_flags(text), database_format="dbc", strict=False)


def decode_file(path):
    try:
        database = load(path)
    except Exception as error:  # the reason why cantools refuses a file is its answer
        print(json.dumps({"file": path, "refused": str(error).splitlines()[0]}))
        return
    print(json.dumps({"file": path, "messages": len(database.messages)}))
    random_bytes = random.Random(618)
    for message in database.messages:
        head = {"message": message.name, "id": message.frame_id, "extended": message.is_extended_frame}
        if not message.is_container:
            layouts = [[signal.name, signal_layout(signal)] for signal in message.signals]
            print(json.dumps({**head, "length": message.length, "layouts": layouts}))
        for number in range(PAYLOADS):
            length = message.length
            if number % TRUNCATED_EVERY == 0 and length:
                length = random_bytes.randrange(length)
            data = random_bytes.randbytes(length)
            if message.is_container:
                data = contained(message, random_bytes)
            elif number % 2:
                data = with_switches(message, message._codecs, data, random_bytes)
            answer = {**head, "data": data.hex()}
            try:
                texts = {}
                if message.is_container:
                    values = decode_container(message, data, texts)
                else:
                    values = decode(message, message._codecs, data, texts)
                answer["texts"] = texts
                answer["signals"] = {name: text(value) for name, value in values.items()}
            except Exception as error:
                answer["failed"] = f"{type(error).__name__}: {error}"
            print(json.dumps(answer))


# Nothing is installed of these: only their files are wanted.
OTHERS = {"canmatrix": "1.2", "opendbc": "0.3.1"}


def source(directory, name, number):
    """The folder of a release's source."""
    release = f"{name}-{number}"
    if not (directory / release).is_dir():
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:"]
        subprocess.run([*command, f"{name}=={number}", "--dest", directory], check=True)
        with contextlib.closing(tarfile.open(directory / f"{release}.tar.gz")) as archive:
            archive.extractall(directory, filter="data")
    return directory / release


def fetch_others(directory):
    for name, number in OTHERS.items():
        for path in sorted(source(pathlib.Path(directory), name, number).rglob("*")):
            if path.suffix.lower() in (".dbc", ".kcd", ".sym", ".arxml"):
                print(path)


def fetch(directory):
    files = source(pathlib.Path(directory), "cantools", version("cantools")) / "tests" / "files"
    for kind in ("dbc", "kcd", "sym", "arxml"):
        print("\n".join(sorted(str(path) for path in (files / kind).iterdir() if path.suffix.lower() == f".{kind}")))


def as_dbf(directory, names):
    """What canmatrix makes of DBC files: each as DBF and as DBC."""
    canmatrix = source(pathlib.Path(directory), "canmatrix", OTHERS["canmatrix"]) / "src"
    sys.path.insert(0, str(canmatrix))
    import canmatrix.formats

    for number, name in enumerate(names):
        try:
            matrix = canmatrix.formats.loadp_flat(name)
            paths = [pathlib.Path(directory) / f"as-dbf-{number}.{suffix}" for suffix in ("dbf", "dbc")]
            for path in paths:
                canmatrix.formats.dumpp({"": matrix}, str(path))
            print(*paths, sep="\t")
        except Exception as error:  # Not every file is one for canmatrix.
            print(f"{name}: {error}", file=sys.stderr)


if __name__ == "__main__":
    if sys.argv[1] == "dbf":
        as_dbf(sys.argv[2], sys.argv[3:])
    elif sys.argv[1] == "files":
        fetch(sys.argv[2])
    elif sys.argv[1] == "others":
        fetch_others(sys.argv[2])
    else:
        for name in sys.argv[2:]:
            decode_file(name)
