"""cantools' decoded values, as JSON lines, for tests/signals_agree_with_cantools.rs.

    cantools_peer.py decode FILE...    100 random payloads per message of each database
    cantools_peer.py files DIR         fetch cantools' source from PyPI and print its test files

Values are printed as text: integers of any size, floats with every digit.
"""

import contextlib
import json
import pathlib
import random
import subprocess
import sys
import tarfile
from importlib.metadata import version

PAYLOADS = 100
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


def decode_file(path):
    import cantools

    try:
        database = cantools.database.load_file(path, database_format=pathlib.Path(path).suffix.lower()[1:], strict=False)
    except Exception as error:  # the reason why cantools refuses a file is its answer
        print(json.dumps({"file": path, "refused": str(error).splitlines()[0]}))
        return
    print(json.dumps({"file": path, "messages": len(database.messages)}))
    random_bytes = random.Random(618)
    for message in database.messages:
        for number in range(PAYLOADS):
            length = message.length
            if number % TRUNCATED_EVERY == 0 and length:
                length = random_bytes.randrange(length)
            data = random_bytes.randbytes(length)
            answer = {"message": message.name, "id": message.frame_id, "extended": message.is_extended_frame}
            answer["data"] = data.hex()
            try:
                texts = {}
                values = decode(message, message._codecs, data, texts)
                answer["texts"] = texts
                answer["signals"] = {name: text(value) for name, value in values.items()}
            except Exception as error:
                answer["failed"] = f"{type(error).__name__}: {error}"
            print(json.dumps(answer))


def fetch(directory):
    directory = pathlib.Path(directory)
    release = f"cantools-{version('cantools')}"
    if not (directory / release).is_dir():
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:"]
        subprocess.run([*command, f"cantools=={version('cantools')}", "--dest", directory], check=True)
        with contextlib.closing(tarfile.open(directory / f"{release}.tar.gz")) as archive:
            archive.extractall(directory, filter="data")
    for kind in ("dbc", "kcd", "sym", "arxml"):
        files = (directory / release / "tests" / "files" / kind).iterdir()
        print("\n".join(sorted(str(path) for path in files if path.suffix.lower() == f".{kind}")))


if __name__ == "__main__":
    if sys.argv[1] == "files":
        fetch(sys.argv[2])
    else:
        for name in sys.argv[2:]:
            decode_file(name)
