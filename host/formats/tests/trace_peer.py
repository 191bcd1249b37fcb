"""Reads and writes trace files with python-can, for trace_files_agree_with_peers.rs.

dump FILE...             prints "file PATH", then one line for each message
write LINES FILE...      writes the messages of such lines into each file, format by suffix
asammdf LINES FILE...    writes its data frames with asammdf, as each name says: VERSION_COMPRESSION_GROUPS_LAYOUT.mf4, layout rows or columns

A line is: microseconds, channel from 1 (0 where the format has none), Rx or Tx, data, remote, error or fd,
identifier in hexadecimal, x if it is extended, length, bytes in hexadecimal; of CAN FD the flags: 1 for a switched
bit rate, 2 for an error passive sender.
"""

import sys
from pathlib import Path

import can


def channel_from_1(message, suffix):
    channel = message.channel
    if channel is None:
        return 0
    if isinstance(channel, str):
        return int("".join(filter(str.isdigit, channel)) or 0) + 1
    # The readers of PEAK's files and of MF4 pass on the bus number, the others count from 0.
    return channel if suffix in (".trc", ".mf4") else channel + 1


def line(message, suffix):
    micros = round(message.timestamp * 1_000_000)
    direction = "Rx" if message.is_rx else "Tx"
    if message.is_error_frame:
        return f"{micros} {channel_from_1(message, suffix)} {direction} error"
    kind = "fd" if message.is_fd else "remote" if message.is_remote_frame else "data"
    extended = "x" if message.is_extended_id else "-"
    data = bytes(message.data).hex().upper() or "-"
    flags = f" {message.bitrate_switch + 2 * message.error_state_indicator}" if message.is_fd else ""
    return (
        f"{micros} {channel_from_1(message, suffix)} {direction} {kind} {message.arbitration_id:X} {extended} "
        f"{message.dlc} {data}{flags}"
    )


def suffix_of(path):
    suffixes = [suffix.lower() for suffix in Path(path).suffixes]
    return next(suffix for suffix in reversed(suffixes) if suffix != ".gz")


def reader(path, suffix):
    # Vector's reader gives times from the start of the measurement by default.
    options = {"relative_timestamp": False} if suffix == ".asc" else {}
    return can.LogReader(path, **options)


def dump(paths):
    for path in paths:
        print("file", path)
        suffix = suffix_of(path)
        for message in reader(path, suffix):
            print(line(message, suffix))


def messages_of(lines):
    messages = []
    for text in Path(lines).read_text().splitlines():
        micros, channel, direction, kind, *rest = text.split()
        common = {"timestamp": int(micros) / 1_000_000, "is_rx": direction == "Rx", "channel": int(channel) - 1}
        if kind == "error":
            messages.append(can.Message(is_error_frame=True, **common))
            continue
        identifier, extended, dlc, data, *flags = rest
        flags = int(flags[0]) if flags else 0
        messages.append(
            can.Message(
                arbitration_id=int(identifier, 16),
                is_extended_id=extended == "x",
                is_remote_frame=kind == "remote",
                is_fd=kind == "fd",
                bitrate_switch=bool(flags & 1),
                error_state_indicator=bool(flags & 2),
                dlc=int(dlc),
                data=None if kind == "remote" or data == "-" else bytes.fromhex(data),
                check=True,
                **common,
            )
        )
    return messages


def write(lines, paths):
    messages = messages_of(lines)
    for path in paths:
        # Only the candump log and printed output name interfaces; MF4 counts from 1.
        named = suffix_of(path) in (".log", ".txt")
        first = 1 if suffix_of(path) == ".mf4" else 0
        # a0.mf4 is plain, a1.mf4 deflated, a2.mf4 transposed and deflated.
        options = {"compression_level": int(Path(path).stem[-1])} if first else {}
        with can.Logger(path, **options) as logger:
            for message in messages:
                number = message.channel
                message.channel = f"can{number}" if named else number + first
                logger.on_message_received(message)
                message.channel = number


def by_asammdf(lines, paths):
    import datetime

    import asammdf
    import numpy
    from can.io.mf4 import STD_DTYPE, SourceInformation
    from can.util import len2dlc

    class Signal(asammdf.Signal):
        """asammdf 8.8 asks for these of what it writes in columns, and does not make them."""

        axes = conversions = units = None

    messages = [message for message in messages_of(lines) if not (message.is_error_frame or message.is_remote_frame)]
    records = numpy.zeros(len(messages), STD_DTYPE)
    for record, message in zip(records, messages):
        values = {"BusChannel": message.channel + 1, "ID": message.arbitration_id, "IDE": message.is_extended_id}
        values.update(DLC=len2dlc(message.dlc) if message.is_fd else message.dlc, DataLength=len(message.data))
        values.update(Dir=not message.is_rx, EDL=message.is_fd, BRS=message.bitrate_switch, ESI=message.error_state_indicator)
        for name, value in values.items():
            record[f"CAN_DataFrame.{name}"] = value
        record["CAN_DataFrame.DataBytes"][: len(message.data)] = list(message.data)
    start = datetime.datetime.fromtimestamp(int(messages[0].timestamp), datetime.timezone.utc)
    times = numpy.array([message.timestamp - start.timestamp() for message in messages])
    source = SourceInformation(source_type=2, bus_type=2)
    for path in paths:
        version, compression, groups, layout = Path(path).stem.split("_")
        mdf = asammdf.MDF(version=version)
        if layout == "columns":
            # No option of the class that makes new files turns them on, and blocks would be larger than these files.
            inner = getattr(mdf, "_mdf", mdf)
            inner._column_storage, inner._write_fragment_size = True, 4096
        mdf.header.start_time = start
        for group in range(int(groups)):
            # With two groups, one for each of two buses.
            chosen = records["CAN_DataFrame.BusChannel"] % int(groups) == group
            frames = Signal(name="CAN_DataFrame", samples=records[chosen], timestamps=times[chosen], source=source)
            beside = [Signal(name="Speed", samples=times[chosen], timestamps=times[chosen])] if layout == "columns" else []
            mdf.append([frames, *beside], acq_source=source)
        if layout == "rows":
            mdf.append([Signal(name="Speed", samples=times, timestamps=times)])
        mdf.save(path, compression=int(compression), overwrite=True)


if __name__ == "__main__":
    command, *arguments = sys.argv[1:]
    if command == "dump":
        dump(arguments)
    elif command == "asammdf":
        by_asammdf(arguments[0], arguments[1:])
    else:
        write(arguments[0], arguments[1:])
