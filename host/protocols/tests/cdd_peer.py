"""What cantools reads in random data of the identifiers of its example CDDs.

cdd_peer.py DIR SEED ROUNDS: for each file the line `file PATH`, then for each instance and its data a line, a JSON object. DIR keeps the source of cantools.

cantools knows the places of values, but not their signs, codings, gaps and alternatives: instances with such are left out.
"""

import contextlib
import json
import pathlib
import random
import subprocess
import sys
import tarfile
from importlib.metadata import version
from xml.etree import ElementTree

import cantools


def source(directory):
    release = f"cantools-{version('cantools')}"
    if not (directory / release).is_dir():
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:"]
        subprocess.run([*command, f"cantools=={version('cantools')}", "--dest", directory], check=True)
        with contextlib.closing(tarfile.open(directory / f"{release}.tar.gz")) as archive:
            archive.extractall(directory, filter="data")
    return directory / release


def comparable(document):
    """The names of instances of which cantools reads all that there is."""
    by_id = {node.get("id"): node for node in document.iter() if node.get("id")}
    kinds = {}
    for kind in document.find("ECUDOC/DATATYPES"):
        value, comp = kind.find("CVALUETYPE"), kind.find("COMP")
        plain = value is not None and (value.get("enc"), value.get("qty")) == ("uns", "atom")
        # cantools takes no divisor.
        kinds[kind.get("id")] = plain and (comp is None or comp.get("div") is None)
    names = []
    for instance in document.iter("DIAGINST"):
        inner = list(instance.iter())
        odd = any(node.tag in ("GAPDATAOBJ", "UNION", "DIDDATAREF", "STRUCT") for node in inner)
        objects = [node for node in inner if node.tag == "DATAOBJ"]
        services = [node for node in instance.findall("SERVICE") if node.findtext("QUAL") == "Read"]
        protocols = [by_id[by_id[node.get("tmplref")].get("tmplref")] for node in services]
        # ReadDataByLocalIdentifier and ReadDataByIdentifier.
        is_read = any(node.find("REQ/CONSTCOMP").get("v") in ("33", "34") for node in protocols)
        if is_read and objects and not odd and all(kinds.get(node.get("dtref")) for node in objects):
            names.append(instance.findtext("QUAL"))
    return [name for name in names if names.count(name) == 1]


def main(directory, seed, rounds):
    random.seed(seed)
    for path in sorted((source(pathlib.Path(directory)) / "tests" / "files" / "cdd").glob("*example*.cdd")):
        try:
            database = cantools.database.load_file(path)
        except Exception:  # One is there to be refused.
            continue
        print(f"file {path}")
        names = comparable(ElementTree.parse(path))
        for did in database.dids:
            values = [data.name for data in did.datas]
            if did.name not in names or len(set(values)) < len(values):
                continue
            for _ in range(rounds):
                data = random.randbytes(did.length)
                raw = did.decode(data, decode_choices=False)
                shown = {name: str(value) for name, value in did.decode(data).items()}
                line = {"name": did.name, "data": data.hex(), "values": raw, "shown": shown}
                print(json.dumps({**line, "units": {data.name: data.unit or "" for data in did.datas}}))


main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
