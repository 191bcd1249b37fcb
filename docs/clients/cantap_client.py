#!/usr/bin/env python3
"""A client for cantap's wire protocol on one page, written from docs/wire-protocol.md. Python 3.8 on Linux or macOS; no packages.

    cantap_client.py PORT [BITRATE [SECONDS]]   sends a frame on channel 1, awaits its confirmation, captures; then the books
    cantap_client.py --decode FILE              prints what a device's byte stream says
"""
import os, select, sys, time, tty, zlib

PROTOCOL = 7
REPLIES = "Hello Done Opened Status Time Filters Queued Registers Defaults Failures Edges Gateway GatewayRule".split()
REFUSALS = ("Protocol Malformed NoSession Unsupported BadTiming BadId BadDlc BadTag BadEntry BadSlot ChannelOpen ChannelClosed "
            "ListenOnly QueueFull BanksExhausted WouldDisturb TooFarAhead Hardware NothingSaved NotBusOff "
            "NotMeasuring NotGranted Held OtherSettings NoBoard NotNormal GatewayRunning "
            "DisturbanceLocked TooOften TooLate").split()
NUMBERS = {"Protocol": 1, "QueueFull": 1, "BanksExhausted": 2, "NotGranted": 1}  # numbers after a refusal
STAGES = "controller queue link host gateway".split()
ERRORS = "stuff form acknowledgment bit-recessive bit-dominant crc".split()
STATES = "active warning passive bus-off".split()
ENDS = "suspended board-lost server-ended configured".split()
FAILURES = "arbitration-lost bus-error aborted closed bus-off overtaken loop".split()


def varint(n):
    out = bytearray()
    while n > 127:
        out.append(n & 127 | 128)
        n >>= 7
    return bytes(out + bytes([n]))


class Reader:
    """Takes values off a message; an IndexError says that it was too short."""
    def __init__(self, data):
        self.data, self.at = data, 0

    def byte(self):
        self.at += 1
        return self.data[self.at - 1]

    def take(self, count):
        if self.at + count > len(self.data):
            raise IndexError
        self.at += count
        return self.data[self.at - count:self.at]

    def number(self):
        value = shift = 0
        while True:
            byte = self.byte()
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def signed(self):
        value = self.number()
        return value >> 1 ^ -(value & 1)

    def more(self):
        return self.at < len(self.data)


def seal(message):
    data, out = message + zlib.crc32(message).to_bytes(4, "little"), bytearray()
    while True:
        run = data[:254].find(0)
        run = min(len(data), 254) if run < 0 else run
        out += bytes([run + 1]) + data[:run]
        full, data = run == 254, data[run:]
        if not data:
            return bytes(out) + b"\0"
        data = data if full else data[1:]
        if not full and not data:  # the zero was the last byte
            return bytes(out) + b"\1\0"


def unseal(encoded):
    out, at = bytearray(), 0
    while at < len(encoded):
        run = encoded[at]
        if at + run > len(encoded):
            return None
        out += encoded[at + 1:at + run]
        at += run
        if run < 255 and at < len(encoded):
            out.append(0)
    good = len(out) >= 4 and zlib.crc32(out[:-4]).to_bytes(4, "little") == out[-4:]
    return bytes(out[:-4]) if good else None


def show_frame(ident, extended, dlc, remote, data, omitted=False):
    end = " remote" if remote else " no-data" if omitted else " " + data.hex() if data else ""
    return f"{ident:08X} {dlc}{end}" if extended else f"{ident:03X} {dlc}{end}"


class Stream:
    """What a device says: lines to print, responses by their id, and the books of each channel."""
    def __init__(self, say):
        self.say, self.partial, self.responses, self.ended, self.sent = say, b"", {}, False, []
        self.begin()

    def begin(self):
        self.sequence, self.frames, self.lost = 0, [0, 0], [0, 0]

    def push(self, data):
        *messages, self.partial = (self.partial + data).split(b"\0")
        for encoded in filter(None, messages):
            message = unseal(encoded)
            try:
                self.say("damaged") if message is None else self.message(Reader(message))
            except IndexError:  # the next batch counts what is missing
                self.say("unreadable")

    def message(self, m):
        kind = m.number()
        if kind == 1:
            return self.response(m)
        if kind == 2:
            reason = m.number()
        sequence, ticks, before = m.number(), m.number(), [m.number(), m.number()]
        ahead = sequence - self.sequence & 0xFFFFFFFF
        missing = [told - had & 0xFFFFFFFF for told, had in zip(before, self.frames)]
        if max(ahead, *missing) >= 1 << 31:
            return self.say("out of order")  # from an older session, or a repetition
        if any(missing):
            self.say(f"lost on the link {missing[0]} {missing[1]}")
        self.lost = [lost + more for lost, more in zip(self.lost, missing)]
        self.sequence, self.frames = sequence + 1, before
        if kind == 2:
            self.ended = True
            return self.say(f"{ticks} session ended: {ENDS[reason]}")
        while m.more():
            ticks = self.record(m, ticks)

    def response(self, m):
        ident = m.number()
        if m.byte():
            name = REFUSALS[m.number()]
            numbers = [m.number() for _ in range(NUMBERS.get(name, 0))]
            self.responses[ident] = name, None
            return self.say(" ".join(map(str, ["response", ident, "refused", name, *numbers])))
        name = REPLIES[m.number()]
        if name == "Hello":
            self.begin()
        self.responses[ident] = name, m
        self.say(f"response {ident} {name}")

    def record(self, m, ticks):
        head, qualifiers = m.byte(), 0
        if 0x41 <= head <= 0x46:
            qualifiers, head = head & 7, m.byte()
        if head < 0x80:
            return self.event(head, m, ticks)
        channel, extended, remote, dlc = head >> 6 & 1, head >> 5 & 1, head >> 4 & 1, head & 15
        ident = int.from_bytes(m.take(4 if extended else 2), "little")
        ticks += 0 if qualifiers & 2 else m.signed()
        data = m.take(0 if remote or qualifiers & 4 else min(dlc, 8))
        self.frames[channel] = self.frames[channel] + 1 & 0xFFFFFFFF
        shown = show_frame(ident, extended, dlc, remote, data, qualifiers & 4)
        self.say(f"{ticks} can{channel + 1} {shown}{['', ' upper-bound', ' no-time'][qualifiers & 3]}")
        return ticks

    def event(self, index, m, ticks):
        if index == 8:
            text = f"sof {m.number()} doubled {m.number()}"
            return self.told(text, m, ticks)
        channel = m.number()
        if index == 0:
            stage, count, at_least = STAGES[m.number()], m.number(), m.byte()
            self.lost[channel] += count
            text = f"lost {'at-least ' if at_least else ''}{count} {stage}"
        elif index == 1:
            text = f"error {ERRORS[m.number()]} tec {m.byte()} rec {m.byte()}"
        elif index == 2:
            text = f"errors-suppressed {m.number()}"
        elif index == 3:
            text = f"state {STATES[m.number()]} tec {m.byte()} rec {m.byte()}"
        elif index in (4, 5):
            text = ("started", "stopped")[index - 4]
        elif index == 6:
            tag, ident, dlc = m.number(), m.number(), m.byte()
            data = m.take(m.number())
            self.sent.append(tag)
            text = f"sent tag {tag} " + show_frame(ident & 0x1FFFFFFF, ident >> 31, dlc, ident >> 30 & 1, data)
        elif index == 7:
            tag, reason = m.number(), m.number()
            text = f"not-sent tag {tag} {FAILURES[reason]}" + (f" {m.number()}" if reason == 5 else "")
        elif index == 9:
            text = f"disturbed {m.number()}"
        else:
            raise IndexError  # a record of a newer protocol: nothing after it can be read
        return self.told(f"can{channel + 1} {text}", m, ticks)

    def told(self, text, m, ticks):
        ticks += m.signed()
        self.say(f"{ticks} {text}")
        return ticks


class Client:
    def __init__(self, path):
        self.port = os.open(path, os.O_RDWR | os.O_NOCTTY)  # opening it raises DTR
        tty.setraw(self.port)
        self.stream, self.next_id = Stream(print), 0
        os.write(self.port, b"\0")  # ends another program's unfinished request, and chooses this protocol

    def read(self, seconds):
        if select.select([self.port], [], [], seconds)[0]:
            self.stream.push(os.read(self.port, 65536))

    def ask(self, *command, patience=2.0):
        """The reply's fields. A request is `id`, then the command's index and fields."""
        self.next_id += 1
        request = varint(self.next_id) + b"".join(c if isinstance(c, bytes) else varint(c) for c in command)
        os.write(self.port, seal(request))
        ends = time.monotonic() + patience
        while self.next_id not in self.stream.responses:
            if time.monotonic() > ends:
                sys.exit("the device does not answer")
            self.read(0.05)
        name, fields = self.stream.responses.pop(self.next_id)
        if fields is None:
            sys.exit(f"the device refuses: {name}")
        return fields


def timing(clock_hz, bitrate):
    """Prescaler, segment 1, segment 2, jump width, with the sample point near 87.5 %."""
    for quanta in range(18, 7, -1):
        if clock_hz % (bitrate * quanta) == 0 and clock_hz // (bitrate * quanta) <= 1024:
            segment2 = quanta // 8 or 1
            return clock_hz // (bitrate * quanta), quanta - 1 - segment2, segment2, 1
    sys.exit(f"{clock_hz} Hz does not reach {bitrate} bit/s")


def main(path, bitrate=500_000, seconds=2.0):
    client = Client(path)
    hello = client.ask(0, PROTOCOL)
    hello.number(), [hello.number() for _ in range(3)]  # protocol and firmware versions
    board, serial = hello.take(hello.number()).decode(), hello.take(hello.number()).decode()
    channels, tick_hz, clock_hz = hello.byte(), hello.number(), hello.number()
    print(f"board {board} serial {serial} channels {channels} ticks/s {tick_hz}")
    prescaler, segment1, segment2, jump = timing(clock_hz, int(bitrate))
    NORMAL = 1  # acknowledges and sends; 0 only listens
    config = varint(prescaler) + bytes([segment1, segment2, jump, NORMAL, 0, 0, 0, 0])
    client.ask(1, 0, b"\1" + config)
    # One frame, tag 7, identifier 123, two bytes, at once.
    client.ask(6, 0, 1, 7, 0x123, b"\2\2\x11\x22", 0)
    ends = time.monotonic() + float(seconds)
    while time.monotonic() < ends and not client.stream.ended:
        client.read(0.05)
    # Responses overtake records: all of them have arrived once `Stopped` has.
    stopped = []
    said, client.stream.say = client.stream.say, lambda line: (print(line), stopped.append(line.endswith("can1 stopped")))
    client.ask(2, 0)
    while not any(stopped):
        client.read(0.05)
    status = client.ask(3)
    [status.number() for _ in range(4)]  # ticks, queue fill, highest fill, bad requests
    if status.byte():
        status.signed()  # temperature
    if status.byte():
        status.number()  # supply
    assert status.byte() == 0, "channel 1 is closed"
    status.take(3)  # state and error counters
    if status.byte():
        status.number()  # the last error
    taken, overruns, stream = status.number(), status.number(), client.stream
    print(f"frames {stream.frames[0]} lost {stream.lost[0]} taken {taken} overruns {overruns} confirmed {stream.sent.count(7)}")
    return 0 if stream.frames[0] + stream.lost[0] == taken + overruns and stream.sent.count(7) == 1 else 1


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] == "--decode":
        with open(sys.argv[2], "rb") as file:
            Stream(print).push(file.read())
    elif len(sys.argv) >= 2:
        sys.exit(main(*sys.argv[1:4]))
    else:
        sys.exit(__doc__)
