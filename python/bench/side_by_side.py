"""Compares the speed of this package with that of python-can, cantools and asammdf, in one run: `cargo xtask bench python`.

Prints a table for docs/benchmarks.md. Times are the process's processor seconds, which say the same whatever else the machine does: the best of
a few runs each, in turns, after one that nobody counts.
"""

import argparse
import pathlib
import tempfile
import time

import can
import cantools
from asammdf import MDF

import cantap

CAR = pathlib.Path(__file__).parents[2] / "host/virtual/src/car/car.dbc"


def beside(theirs, ours, runs):
    """The shortest processor time in seconds and the result of each, run in turn."""
    times, results = ([], []), [None, None]
    for _ in range(runs + 1):
        for which, work in enumerate((theirs, ours)):
            results[which] = None
            begin = time.process_time()
            results[which] = work()
            times[which].append(time.process_time() - begin)
    return (min(times[0][1:]), results[0]), (min(times[1][1:]), results[1])


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
        return sum(len(group.channels) for group in extracted.groups)


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


def most(loop):
    """The best of several runs."""
    return max(loop(100_000) for _ in range(3))


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
        database = cantap.load_database(CAR)
        rows = []

        def row(what, theirs, theirs_s, ours_s):
            rows.append((what, theirs, theirs_s, ours_s))
            print(f"| {what} | {theirs} | {theirs_s:.3f} | {ours_s:.4f} | {theirs_s / ours_s:.0f} × |", flush=True)

        print(f"{frames} frames\n\n| what | beside | its processor s | ours | |\n|---|---|---|---|---|")
        (theirs, counted), (ours, table) = beside(
            lambda: read_with_python_can(blf), lambda: cantap.read(blf), runs
        )
        if counted != len(table) or counted != frames:
            raise RuntimeError("not the same frames")
        row("read BLF", "python-can", theirs, ours)
        (theirs, values), (ours, decoded) = beside(
            lambda: decode_with_cantools(blf), lambda: cantap.decode(blf, database), runs
        )
        if decoded.report.values != values:
            raise RuntimeError(f"{decoded.report.values} values here, {values} there")
        row("BLF to a column per signal", "python-can + cantools", theirs, ours)
        (_, _), (ours, _) = beside(lambda: None, lambda: cantap.read(blf, db=database), runs)
        row("BLF to a row per value", "python-can + cantools", theirs, ours)
        (theirs, _), (ours, _) = beside(
            lambda: decode_with_asammdf(mf4), lambda: cantap.decode(mf4, database), runs
        )
        row("MF4 to a column per signal", "asammdf extract_bus_logging", theirs, ours)
    print("\n| messages per second | |\n|---|---|")
    print(f"| `can.Bus.recv`, cantap | {most(recv_loop):,.0f} |")
    print(f"| `can.Bus.recv`, python-can's virtual interface | {most(virtual_loop):,.0f} |")
    print(f"| python-can's `Message` alone | {most(message_alone):,.0f} |")
    rate, lost = capture(3)
    print(f"| `device.batch` (records; {lost} lost, counted) | {rate:,.0f} |")


if __name__ == "__main__":
    main()
