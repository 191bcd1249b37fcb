"""CAN FD frames through an adapter that has them: a tunnel to a peer written here, after cannelloni's description of its datagrams."""

import socket
import struct

import pytest

import cantap

BRS, ESI = 1, 2
# The bit of a length that says that flags follow it, and the one of an identifier of 29 bits.
FD, EXTENDED = 0x80, 0x8000_0000


class Peer:
    """The other end of a tunnel."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(30)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.listens = free.getsockname()
        self.address = f"cannelloni://127.0.0.1:{self.socket.getsockname()[1]}?listen={self.listens[1]}"
        self.number = 0

    def say(self, *frames):
        """Frames as identifier, flags (`None` of a classical one), data."""
        items = b""
        for identifier, flags, data in frames:
            is_fd = flags is not None
            items += struct.pack(">IB", identifier, len(data) | (FD if is_fd else 0)) + (bytes([flags]) if is_fd else b"") + data
        header = struct.pack(">BBBH", 2, 0, self.number, len(frames))
        self.number = (self.number + 1) % 256
        self.socket.sendto(header + items, self.listens)

    def hears(self):
        """The next frame that it is sent, as above. Each datagram here has one."""
        datagram = self.socket.recv(2048)
        count, identifier, length = struct.unpack_from(">H I B", datagram, 3)
        assert count == 1
        if length & FD:
            assert len(datagram) == 11 + (length & ~FD)
            return identifier, datagram[10], datagram[11:]
        return identifier, None, datagram[10:]


@pytest.fixture
def peer():
    peer = Peer()
    yield peer
    peer.socket.close()


# Values unlike each other: each flag, both identifiers, lengths that only CAN FD has, and a classical frame among them.
FRAMES = [
    (0x123, BRS, bytes(range(1, 13))),
    (0x18DA_F110 | EXTENDED, ESI, bytes(range(0xC0, 0x100))),
    (0x7FF, None, b"\xa5\x5a"),
    (0x124, BRS | ESI, b""),
    (0x125, 0, b"\x77"),
]


def test_frames_are_received_with_their_flags(peer):
    with cantap.open(peer.address, 500_000) as device:
        peer.say(*FRAMES)
        records = []
        while len(records) < len(FRAMES):
            record = device.read(30)
            assert record is not None
            if record.event == "frame":
                records.append(record)
    for record, (identifier, flags, data) in zip(records, FRAMES, strict=True):
        assert (record.id, record.extended) == (identifier & ~EXTENDED, bool(identifier & EXTENDED))
        assert bytes(record.data) == data
        assert (record.fd, record.brs, record.esi) == (flags is not None, bool((flags or 0) & BRS), bool((flags or 0) & ESI))
    assert [record.dlc for record in records] == [9, 15, 2, 0, 1]


def test_frames_are_sent_with_their_flags(peer):
    with cantap.open(peer.address, 500_000, mode="normal") as device:
        for identifier, flags, data in FRAMES:
            frame = cantap.Frame(
                identifier & ~EXTENDED,
                data,
                extended=bool(identifier & EXTENDED),
                fd=flags is not None,
                brs=bool((flags or 0) & BRS),
                esi=bool((flags or 0) & ESI),
            )
            device.send(1, frame)
            assert peer.hears() == (identifier, flags, data)
        device.send(1, "126##1AABB")
        assert peer.hears() == (0x126, BRS, b"\xaa\xbb")
        with pytest.raises(ValueError):
            device.send(1, cantap.Frame(0x123, bytes(9), fd=True))


def test_python_can_has_the_flags_both_ways(peer):
    can = pytest.importorskip("can")
    with can.Bus(interface="cantap", channel=peer.address, bitrate=500_000, fd=True) as bus:
        assert bus.protocol == can.CanProtocol.CAN_FD
        peer.say(*FRAMES)
        for identifier, flags, data in FRAMES:
            heard = bus.recv(30)
            # The first message says that nobody counts the losses before this program.
            while heard.is_error_frame:
                heard = bus.recv(30)
            assert (heard.arbitration_id, heard.is_extended_id) == (identifier & ~EXTENDED, bool(identifier & EXTENDED))
            assert bytes(heard.data) == data and heard.dlc == len(data) and heard.is_rx
            assert heard.is_fd == (flags is not None)
            assert heard.bitrate_switch == bool((flags or 0) & BRS)
            assert heard.error_state_indicator == bool((flags or 0) & ESI)
            bus.send(heard)
            assert peer.hears() == (identifier, flags, data)
        # A length that no frame has, and a remote frame of CAN FD.
        for wrong in (
            can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, data=bytes(9)),
            can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, is_remote_frame=True, dlc=1),
        ):
            with pytest.raises(can.CanOperationError):
                bus.send(wrong)


def test_a_datagram_that_lies_is_a_loss_and_no_frame(peer):
    with cantap.open(peer.address, 500_000) as device:
        # Nine bytes of CAN FD, of which there are none; and a length beyond the datagram's end.
        peer.say((0x123, BRS, bytes(9)))
        peer.socket.sendto(struct.pack(">BBBHIBB", 2, 0, 1, 1, 0x123, FD | 64, BRS) + b"short", peer.listens)
        peer.number = 2
        peer.say((0x124, BRS, b"\x01"))
        events = []
        while True:
            record = device.read(30)
            assert record is not None
            if record.event == "frame":
                break
            events.append(record.event)
        assert (record.id, events.count("lost")) == (0x124, 3), events
