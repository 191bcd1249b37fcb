"""Compares the speed of this package with that of python-can, cantools and asammdf, in one run: `cargo xtask bench python`.

Prints a table for docs/benchmarks.md. Times are the process's processor seconds, of all its threads, which say the same whatever else the machine
does, and seconds of the wall's clock, which users wait: the best of a few runs each, in turns, after one that nobody counts. python-can, cantools
and asammdf have one thread, cantap as many as it takes.

Decoding is measured with a small database (the virtual car's, and its traffic) and with a large one (generated: 600 messages of 12 signals, all of them in
the trace), each with the database loaded anew in every run, as a script does it, and loaded once before, as a long-running program does it. The least of all
ratios is printed last.
"""

import argparse
import os
import pathlib
import random
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


def frames_of_car():
    """Five seconds of the virtual car: identifier, whether it is extended, data."""
    with cantap.open("virtual:car") as device:
        device.open_channel(1)
        device.open_channel(2)
        recording = device.batch(seconds=5).to_pyarrow().to_pylist()
    heard = [record for record in recording if record["event"] == "frame" and not record["remote"]]
    return [(record["id"], record["extended"], record["data"]) for record in heard]


def make_large(path, messages=600):
    """Writes a database of messages that have twelve signals each, in both byte orders, signed and not, one of them with texts; returns frames of them."""
    chance = random.Random(7)
    lines, texts, frames = ['VERSION ""', "BU_: ECU"], [], []
    for number in range(messages):
        extended = number % 3 == 0
        identifier = 0x18F00000 + number * 0x101 if extended else 0x100 + number
        lines.append(f"BO_ {identifier | (extended << 31)} Message{number}: 8 ECU")
        for at in range(8):
            # Two of four bits in each second byte, one of eight in the others.
            for half in range(2 if at % 2 else 1):
                length, start = (4, 8 * at + 4 * half) if at % 2 else (8, 8 * at)
                motorola, signed = chance.random() < 0.3, "-" if chance.random() < 0.3 else "+"
                start = start + length - 1 if motorola else start
                factor = chance.choice([1, 0.5, 0.01, 0.125])
                lines.append(
                    f' SG_ Signal{number}x{at}x{half} : {start}|{length}@{int(not motorola)}{signed} ({factor},{chance.choice([0, -40])}) [0|0] "u" ECU'
                )
        texts.append(f'VAL_ {identifier | (extended << 31)} Signal{number}x1x0 0 "off" 1 "on" 2 "fault" ;')
        frames += [(identifier, extended, chance.randbytes(8)) for _ in range(5)]
    path.write_text("\n".join([*lines, *texts, ""]))
    chance.shuffle(frames)
    return frames


def make(folder, name, heard, frames):
    """So many of these frames, repeated, as BLF and as MF4."""
    text = folder / f"{name}.log"
    with text.open("w") as out:
        for at in range(frames):
            number, extended, data = heard[at % len(heard)]
            identifier = f"{number:08X}" if extended else f"{number:03X}"
            out.write(f"({1.7e9 + at * 1e-4:.6f}) can0 {identifier}#{data.hex().upper()}\n")
    table = cantap.read(text)
    blf, mf4 = folder / f"{name}.blf", folder / f"{name}.mf4"
    cantap.write(table, blf)
    cantap.write(table, mf4)
    return blf, mf4


def read_with_python_can(path):
    with can.BLFReader(path) as reader:
        return sum(1 for _ in reader)


def decode_with_cantools(path, database):
    """`database` is a file, or one that is loaded."""
    if isinstance(database, pathlib.Path):
        database = cantools.database.load_file(database)
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


def decode_with_asammdf(path, database):
    with MDF(path) as file, file.extract_bus_logging({"CAN": [(database, 0)]}) as extracted:
        return sum(len(group.channels) - 1 for group in extracted.groups)


def values_with_asammdf(path, database):
    """The same, and of each channel the physical values, as `cantap.decode` has them: before, they are the frames' raw numbers."""
    with MDF(path) as file, file.extract_bus_logging({"CAN": [(database, 0)]}) as extracted:
        return sum(
            len(extracted.get(group=at, index=index).samples)
            for at, group in enumerate(extracted.groups)
            for index in range(1, len(group.channels))
        )


def by_asammdf(path, name, compression):
    """A file whose frames are in a group of their own, as most loggers write them; zipped if there is a compression (2: transposed before)."""
    with MDF(path) as file:
        return file.save(path.with_stem(f"{path.stem} {name}"), overwrite=True, compression=compression)


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

    def __init__(self):
        super().__init__(channel=None)

    def _recv_internal(self, timeout):
        return can.Message(1.7e9, 0x123, False, False, False, 0, 8, bytearray(8), False, True), True

    def send(self, msg, timeout=None):
        raise NotImplementedError


def constant_loop(messages):
    """Messages per second through python-can's own `recv`, made of constants: what it takes without any interface."""
    with Constant() as bus:
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


class Rows:
    """The table of times."""

    def __init__(self):
        self.least = {}
        print("| what | database | beside | its processor s | cantap's | | its s | cantap's | |")
        print("|---|---|---|---|---|---|---|---|---|")

    def measure(self, kind, what, database, theirs, by_theirs, by_ours, runs):
        """Prints a row, and returns both results. `kind`: of these the least is printed."""
        (its_cpu, its_wall, counted), (cpu, wall, made) = beside(by_theirs, by_ours, runs)
        print(
            f"| {what} | {database} | {theirs} | {its_cpu:.3f} | {cpu:.4f} | {its_cpu / cpu:.1f} × "
            f"| {its_wall:.3f} | {wall:.4f} | {its_wall / wall:.1f} × |",
            flush=True,
        )
        ratios = its_wall / wall, its_cpu / cpu
        self.least[kind] = tuple(map(min, self.least.get(kind, ratios), ratios))
        return counted, made

    def print_least(self):
        print("\n| the least | by the clock | by the processor |\n|---|---|---|")
        for kind, (wall, cpu) in self.least.items():
            print(f"| {kind} | {wall:.1f} × | {cpu:.1f} × |")


def compare(rows, folder, words, heard, file, frames, runs):
    """All that is decoded with one database."""
    blf, mf4 = make(folder, words, heard, frames)
    counted, table = rows.measure(
        "read BLF", "read BLF", "", "python-can", lambda: read_with_python_can(blf), lambda: cantap.read(blf), runs
    )
    if counted != len(table) or counted != frames:
        raise RuntimeError("not the same frames")
    both = "python-can + cantools"
    theirs_loaded, loaded = cantools.database.load_file(file), cantap.load_database(file)
    for how, their_database, database in (("", file, file), (", loaded before", theirs_loaded, loaded)):
        values, decoded = rows.measure(
            "decode BLF",
            "BLF to a column per signal",
            words + how,
            both,
            lambda: decode_with_cantools(blf, their_database),
            lambda: cantap.decode(blf, database),
            runs,
        )
        if decoded.report.values != values:
            raise RuntimeError(f"{decoded.report.values} values here, {values} there")
    rows.measure(
        "BLF to rows", "BLF to a row per value", words, both, lambda: decode_with_cantools(blf, file), lambda: cantap.read(blf, db=file), 1
    )
    # asammdf takes a loaded database too, but only of canmatrix's kind.
    from asammdf.blocks.utils import load_can_database

    their_loaded = load_can_database(file)
    files = (
        ("decode MF4", mf4, "MF4"),
        ("decode MF4", by_asammdf(mf4, "sorted", 0), "MF4 as asammdf sorts it"),
        ("decode zipped MF4", by_asammdf(mf4, "zipped", 1), "MF4 as asammdf zips it"),
        ("decode zipped MF4", by_asammdf(mf4, "transposed", 2), "MF4 as asammdf zips it, transposed"),
    )
    its = "asammdf `extract_bus_logging`"
    for kind, mdf, what in files:
        for how, their_database, database in (("", str(file), file), (", loaded before", their_loaded, loaded)):
            channels, decoded = rows.measure(
                kind,
                f"{what} to a column per signal",
                words + how,
                its,
                lambda: decode_with_asammdf(mdf, their_database),
                lambda: cantap.decode(mdf, database),
                3 * runs,
            )
            columns = sum(len([name for name in table.column_names[3:] if not name.endswith(".text")]) for table in decoded.values())
            if columns != channels:
                raise RuntimeError(f"{columns} signals here, {channels} there")
        its_values, decoded = rows.measure(
            f"{kind} and values",
            f"{what} to physical values",
            words,
            f"{its} and `get`",
            lambda: values_with_asammdf(mdf, str(file)),
            lambda: cantap.decode(mdf, file),
            runs,
        )
        if its_values != decoded.report.values or its_values != values:
            raise RuntimeError(f"{decoded.report.values} values here, {its_values} there")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--databases", nargs="+", default=["small", "large"], choices=["small", "large"])
    parser.add_argument("--only-decode", action="store_true")
    arguments = parser.parse_args()
    frames, runs = arguments.frames, arguments.runs
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        print(f"{frames} frames, {os.cpu_count()} cores\n")
        rows = Rows()
        if "small" in arguments.databases:
            compare(rows, folder, "small", frames_of_car(), CAR, frames, runs)
        if "large" in arguments.databases:
            large = folder / "large.dbc"
            compare(rows, folder, "large", make_large(large), large, frames, runs)
        rows.print_least()
    if arguments.only_decode:
        return
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
