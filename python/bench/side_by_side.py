"""Compares the speed of this package with that of python-can, cantools and asammdf, in one run: `cargo xtask bench python`.

Prints a table for docs/benchmarks.md. Times are the process's processor seconds, of all its threads, which say the same whatever else the machine
does, and seconds of the wall's clock, which users wait: the best of a few runs each, in turns, after one that nobody counts. python-can, cantools
and asammdf have one thread, cantap as many as it takes.
"""

import argparse
import os
import pathlib
import tempfile
import time

import can
import cantools
from asammdf import MDF

import cantap

CAR = pathlib.Path(__file__).parents[2] / "host/virtual/src/car/car.dbc"


def beside(theirs, ours, runs):
    """The shortest processor time and the shortest time in seconds, and the result, of each, in turns."""
    times, results = ([], []), [None, None]
    for _ in range(runs + 1):
        for which, work in enumerate((theirs, ours)):
            results[which] = None
            begin = time.process_time(), time.perf_counter()
            results[which] = work()
            times[which].append((time.process_time() - begin[0], time.perf_counter() - begin[1]))
    return [
        (*(min(column) for column in zip(*of_one[1:])), result) for of_one, result in zip(times, results)
    ]


def make(folder, frames):
    """Five seconds of the virtual car, repeated, as BLF and as MF4."""
    with cantap.open("virtual:car") as device:
        device.open_channel(1)
        device.open_channel(2)
        recording = device.batch(seconds=5).to_pyarrow().to_pylist()
    heard = [record for record in recording if record["event"] == "frame" and not record["remote"]]
    text = folder / "drive.log"
    with text.open("w") as out:
        for at in range(frames):
            record = heard[at % len(heard)]
            identifier = f"{record['id']:08X}" if record["extended"] else f"{record['id']:03X}"
            out.write(f"({1.7e9 + at * 1e-4:.6f}) can0 {identifier}#{record['data'].hex().upper()}\n")
    table = cantap.read(text)
    cantap.write(table, folder / "drive.blf")
    cantap.write(table, folder / "drive.mf4")


def read_with_python_can(path):
    with can.BLFReader(path) as reader:
        return sum(1 for _ in reader)


def decode_with_cantools(path):
    database = cantools.database.load_file(CAR)
    columns = {}
    with can.BLFReader(path) as reader:
        for message in reader:
            try:
                decoded = database.decode_message(message.arbitration_id, message.data, decode_choices=False)
            except (KeyError, cantools.database.DecodeError):
                continue
            for name, value in decoded.items():
                columns.setdefault((message.arbitration_id, name), []).append((message.timestamp, value))
    return sum(map(len, columns.values()))


def decode_with_asammdf(path):
    with MDF(path) as file, file.extract_bus_logging({"CAN": [(str(CAR), 0)]}) as extracted:
        return sum(len(group.channels) - 1 for group in extracted.groups)


def values_with_asammdf(path):
    """The same, and of each channel the physical values, as `cantap.decode` has them: before, they are the frames' raw numbers."""
    with MDF(path) as file, file.extract_bus_logging({"CAN": [(str(CAR), 0)]}) as extracted:
        return sum(
            len(extracted.get(group=at, index=index).samples)
            for at, group in enumerate(extracted.groups)
            for index in range(1, len(group.channels))
        )


def sorted_by_asammdf(path):
    """A file whose frames are in a group of their own, as most loggers write them."""
    with MDF(path) as file:
        return file.save(path.with_stem("sorted"), overwrite=True)


def recv_loop(messages):
    """Messages per second of this thread through `can.Bus.recv`, when they are already waiting."""
    with can.Bus(
        interface="cantap", channel="virtual:pace=fast,load=100,channels=1", bitrate=1_000_000, listen_only=True
    ) as bus:
        while bus.recv(1) is None:
            pass
        time.sleep(3)
        begin = time.thread_time()
        for _ in range(messages):
            if bus.recv(1) is None:
                raise RuntimeError("there were fewer messages")
        return messages / (time.thread_time() - begin)


class Constant(can.BusABC):
    """The least that an interface of python-can can do: the same message each time, without a device."""

    def _recv_internal(self, timeout):
        return can.Message(1.7e9, 0x123, False, False, False, 0, 8, bytearray(8), False, True), True

    def send(self, msg, timeout=None):
        raise NotImplementedError


def constant_loop(messages):
    """Messages per second through python-can's own `recv`, made of constants: what it takes without any interface."""
    with Constant(channel=None) as bus:
        begin = time.thread_time()
        for _ in range(messages):
            if bus.recv(1) is None:
                raise RuntimeError("there were fewer messages")
        return messages / (time.thread_time() - begin)


def message_alone(messages):
    """Messages per second of python-can's constructor, kept as by a program that receives them one after the other."""
    begin = time.thread_time()
    for _ in range(messages):
        message = can.Message(1.7e9, 0x123, False, False, False, 0, 8, bytearray(8), False, True)
    del message
    return messages / (time.thread_time() - begin)


def virtual_loop(messages):
    """Messages per second through `can.Bus.recv` on python-can's own virtual interface."""
    with can.Bus(interface="virtual", channel="a") as sender, can.Bus(interface="virtual", channel="a") as bus:
        message = can.Message(arbitration_id=0x123, data=bytes(8), is_extended_id=False)
        for _ in range(messages):
            sender.send(message)
        begin = time.thread_time()
        for _ in range(messages):
            bus.recv(1)
        return messages / (time.thread_time() - begin)


def most(loops):
    """The best of several runs of each, in turns."""
    rates = [[loop(100_000) for loop in loops] for _ in range(5)]
    return [max(of_one) for of_one in zip(*rates)]


def capture(seconds):
    """Records per second in tables, from a device that is faster than any bus."""
    with cantap.open("virtual:pace=fast,load=100", 1_000_000) as device:
        begin, records = time.perf_counter(), 0
        while (passed := time.perf_counter() - begin) < seconds:
            records += len(device.batch(seconds=0.2))
        lost = sum(counts["lost"] for counts in device.losses.values()) + sum(device._records.lost)
        return records / passed, lost


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    frames, runs = arguments.frames, arguments.runs
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        make(folder, frames)
        blf, mf4 = folder / "drive.blf", folder / "drive.mf4"
        of_group = sorted_by_asammdf(mf4)

        def row(what, theirs, by_theirs, by_ours, runs):
            """Reads the database in each run, as the others do."""
            (its_cpu, its_wall, counted), (cpu, wall, made) = beside(by_theirs, by_ours, runs)
            print(
                f"| {what} | {theirs} | {its_cpu:.3f} | {cpu:.4f} | {its_cpu / cpu:.1f} × "
                f"| {its_wall:.3f} | {wall:.4f} | {its_wall / wall:.1f} × |",
                flush=True,
            )
            return counted, made

        print(f"{frames} frames, {os.cpu_count()} cores\n")
        print("| what | beside | its processor s | cantap's | | its s | cantap's | |")
        print("|---|---|---|---|---|---|---|---|")
        counted, table = row(
            "read BLF", "python-can", lambda: read_with_python_can(blf), lambda: cantap.read(blf), runs
        )
        if counted != len(table) or counted != frames:
            raise RuntimeError("not the same frames")
        both = "python-can + cantools"
        values, decoded = row(
            "BLF to a column per signal", both, lambda: decode_with_cantools(blf), lambda: cantap.decode(blf, CAR), runs
        )
        if decoded.report.values != values:
            raise RuntimeError(f"{decoded.report.values} values here, {values} there")
        row("BLF to a row per value", both, lambda: decode_with_cantools(blf), lambda: cantap.read(blf, db=CAR), 1)
        for file, words in ((mf4, "MF4"), (of_group, "MF4 as asammdf sorts it")):
            its = "asammdf `extract_bus_logging`"
            more = 3 * runs

            def ours(file=file):
                return cantap.decode(file, CAR)

            channels, decoded = row(
                f"{words} to a column per signal", its, lambda file=file: decode_with_asammdf(file), ours, more
            )
            columns = sum(len([name for name in table.column_names[3:] if not name.endswith(".text")]) for table in decoded.values())
            if columns != channels:
                raise RuntimeError(f"{columns} signals here, {channels} there")
            its_values, decoded = row(
                f"{words} to physical values", f"{its} and `get`", lambda file=file: values_with_asammdf(file), ours, more
            )
            if its_values != decoded.report.values or its_values != values:
                raise RuntimeError(f"{decoded.report.values} values here, {its_values} there")
    loops = {
        "`can.Bus.recv`, cantap": recv_loop,
        "`can.Bus.recv` as python-can has it, of a message made of constants": constant_loop,
        "`can.Bus.recv`, python-can's virtual interface": virtual_loop,
        "python-can's `Message` alone": message_alone,
    }
    rates = dict(zip(loops, most(loops.values())))
    print("\n| messages per second of a thread | | cantap's, of this |\n|---|---|---|")
    for what, rate in rates.items():
        print(f"| {what} | {rate:,.0f} | {rates['`can.Bus.recv`, cantap'] / rate:.2f} × |")
    rate, lost = capture(3)
    print(f"\n`device.batch`: {rate:,.0f} records per second by the clock, {lost} lost and counted")


if __name__ == "__main__":
    main()
