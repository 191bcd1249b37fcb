"""Reads MF4 files with asammdf, and writes them anew, for the tests of `mf4/tests/canedge.rs`.

FILE...    prints "file NAME" and the data frames as lines of a candump log, then writes NAME-0.mf4, NAME-1.mf4 and NAME-2.mf4
           beside it: plain, deflated, and with rows and columns of bytes exchanged before
"""

import sys
from pathlib import Path

from asammdf import MDF


def frames(mdf):
    start_us = mdf.header.abs_time // 1000
    for index, group in enumerate(mdf.groups):
        names = [channel.name for channel in group.channels]
        if "CAN_DataFrame" not in names or not group.channel_group.cycles_nr:
            continue

        def values(part):
            name = f"CAN_DataFrame.{part}"
            if name not in names:
                return None
            raw = part == "DataBytes"
            return mdf.get(group=index, index=names.index(name), raw=raw, ignore_invalidation_bits=True)

        parts = {part: values(part) for part in "BusChannel ID IDE DataLength DataBytes Dir EDL BRS ESI".split()}
        for at, time in enumerate(parts["ID"].timestamps):
            number = {
                part: int(signal.samples[at]) if signal is not None and part != "DataBytes" else 0
                for part, signal in parts.items()
            }
            data = bytes(parts["DataBytes"].samples[at])[: number["DataLength"]].hex().upper()
            # numpy's texts lose their zeros at the end.
            data = data.ljust(2 * number["DataLength"], "0")
            identifier = f"{number['ID']:08X}" if number["IDE"] else f"{number['ID']:03X}"
            flags = f"#{number['BRS'] + 2 * number['ESI']}" if number["EDL"] else ""
            micros = start_us + round(time * 1_000_000)
            direction = " T" if number["Dir"] else ""
            yield f"({micros // 1_000_000}.{micros % 1_000_000:06}) can{number['BusChannel'] - 1} {identifier}#{flags}{data}{direction}"


for name in sys.argv[1:]:
    path = Path(name)
    print("file", path.stem)
    mdf = MDF(path)
    for line in frames(mdf):
        print(line)
    for compression in range(3):
        mdf.save(path.with_name(f"{path.stem}-{compression}.mf4"), compression=compression, overwrite=True)
