"""Nodes of other programs on a simulated bus, and other decoders, for protocols_agree_with_peers.rs.

isotp, uds, canopen, j1939     two nodes talk; prints each frame as "MILLISECONDS ID#DATA", and what was said as "= JSON"
nmea2000 LOG                   prints canboat's reading of a candump log, one JSON object per message
groups                         prints "PGN NAME" of every parameter group that canmatrix' J1939 database or can-j1939 has
eds FILE...                    prints "file PATH", then one JSON object for every entry that python-canopen has
"""

import gzip
import json
import sys
import threading
import time

import can


class Listener(can.Listener):
    """Records every frame in bus order."""

    def __init__(self):
        self.frames = []

    def on_message_received(self, message):
        self.frames.append(message)


def bus(name="peers"):
    return can.Bus(interface="virtual", channel=name, receive_own_messages=False)


class Lost(Exception):
    """A message did not arrive: on a busy computer can-isotp misses frames of its own simulated bus."""


def recorded(talk, attempts=3):
    """Runs `talk`, which returns what was said; prints the frames and that. What the peer itself has lost is said anew, from the beginning."""
    listener = Listener()
    ear = bus()
    notifier = can.Notifier(ear, [listener], timeout=0.05)
    try:
        said = talk()
    except Lost:
        notifier.stop()
        ear.shutdown()
        if attempts == 1:
            raise
        return recorded(talk, attempts - 1)
    time.sleep(0.2)
    notifier.stop()
    ear.shutdown()
    start = listener.frames[0].timestamp
    for frame in listener.frames:
        width = 8 if frame.is_extended_id else 3
        data = "R%d" % frame.dlc if frame.is_remote_frame else bytes(frame.data).hex().upper()
        mark = "##1" if frame.is_fd else "#"
        print(f"{(frame.timestamp - start) * 1000:.3f} {frame.arbitration_id:0{width}X}{mark}{data}")
    for one in said:
        print("=", json.dumps(one))


def isotp_pair(mode, **ids):
    import isotp

    def stack(one, other):
        parameters = {"blocksize": 4, "stmin": 1, "rx_flowcontrol_timeout": 5000, "rx_consecutive_frame_timeout": 5000}
        return isotp.CanStack(bus(), address=isotp.Address(mode, **one), params=parameters)

    swapped = {
        "txid": ids.get("rxid"),
        "rxid": ids.get("txid"),
        "target_address": ids.get("source_address"),
        "source_address": ids.get("target_address"),
        "address_extension": ids.get("address_extension"),
    }
    return stack(ids, swapped), stack({key: value for key, value in swapped.items() if value is not None}, ids)


def talk_isotp():
    import isotp

    modes = [
        (isotp.AddressingMode.Normal_11bits, {"txid": 0x6A0, "rxid": 0x6B0}),
        (isotp.AddressingMode.NormalFixed_29bits, {"target_address": 0x10, "source_address": 0xF1}),
        (isotp.AddressingMode.Mixed_29bits, {"target_address": 0x20, "source_address": 0xF1, "address_extension": 0x55}),
        (isotp.AddressingMode.Extended_11bits, {"txid": 0x6F1, "rxid": 0x612, "target_address": 0x12, "source_address": 0xF1}),
    ]
    said = []
    for mode, ids in modes:
        one, other = isotp_pair(mode, **ids)
        one.start()
        other.start()
        # Long ones first, so that the pair is found.
        for length in (100, 7, 1, 8, 130):
            for sender, receiver in ((one, other), (other, one)):
                payload = bytes((length + at) & 0xFF for at in range(length if mode.name.startswith("Normal") else max(1, length - 1)))
                sender.send(payload)
                got = receiver.recv(block=True, timeout=20)
                if got is None:
                    one.stop()
                    other.stop()
                    raise Lost((mode, length))
                assert bytes(got) == payload, (mode, length)
                said.append(payload.hex().upper())
        one.stop()
        other.stop()
    return said


def talk_uds():
    import isotp
    import udsoncan
    from udsoncan.client import Client
    from udsoncan.connections import PythonIsoTpConnection

    answers = {
        "1003": ["5003003201F4"],
        "22F190": ["62F190" + b"WVWZZZ1KZAW000001".hex()],
        "22F18C": ["7F2278", "7F2278", "62F18C" + b"SERIAL-42".hex()],
        "2701": ["670111223344"],
        "2702AABB": ["7F2735"],
        "190209": ["59020901231108C1580009"],
        "3101FF00": ["7101FF0000"],
        "14FFFFFF": ["54"],
    }
    one, other = isotp_pair(isotp.AddressingMode.Normal_11bits, txid=0x7E0, rxid=0x7E8)
    other.start()
    over = threading.Event()

    def serve():
        while not over.is_set():
            request = other.recv(block=True, timeout=0.1)
            for answer in answers.get(bytes(request or b"").hex().upper(), []):
                other.send(bytes.fromhex(answer))
                time.sleep(0.01)

    server = threading.Thread(target=serve)
    server.start()
    config = dict(udsoncan.configs.default_client_config)
    config["data_identifiers"] = {0xF190: udsoncan.AsciiCodec(17), 0xF18C: udsoncan.AsciiCodec(9)}
    config["p2_timeout"] = config["request_timeout"] = 10
    said = []
    with Client(PythonIsoTpConnection(one), config=config) as client:
        client.change_session(3)
        said.append({"sid": 0x10, "sub_function": 3})
        vin = client.read_data_by_identifier_first(0xF190)
        said.append({"sid": 0x22, "did": 0xF190, "value": vin})
        serial = client.read_data_by_identifier_first(0xF18C)
        said.append({"sid": 0x22, "did": 0xF18C, "value": serial, "pending": 2})
        client.request_seed(1)
        said.append({"sid": 0x27, "sub_function": 1, "seed": "11223344"})
        try:
            client.send_key(2, b"\xaa\xbb")
        except udsoncan.exceptions.NegativeResponseException as refused:
            said.append({"sid": 0x27, "nrc": refused.response.code, "nrc_text": refused.response.code_name})
        codes = client.get_dtc_by_status_mask(9).service_data.dtcs
        said.append({"sid": 0x19, "trouble_codes": len(codes)})
        client.start_routine(0xFF00)
        said.append({"sid": 0x31, "sub_function": 1, "routine": 0xFF00})
        client.clear_dtc(0xFFFFFF)
        said.append({"sid": 0x14, "group": 0xFFFFFF})
    over.set()
    server.join()
    other.stop()
    return said


SHEET = """[DeviceInfo]
VendorName=Peers
ProductName=Node
[1008]
ParameterName=Device name
ObjectType=0x7
DataType=0x0009
AccessType=rw
DefaultValue=A node with a long name
[1017]
ParameterName=Producer heartbeat time
ObjectType=0x7
DataType=0x0006
AccessType=rw
DefaultValue=0
[2000]
ParameterName=Text
ObjectType=0x7
DataType=0x0009
AccessType=rw
[2001]
ParameterName=Counter
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=7
"""


def talk_canopen():
    import io

    import canopen

    def network():
        net = canopen.Network()
        net.bus = bus()
        net.notifier = can.Notifier(net.bus, net.listeners, 0.05)
        return net

    def sheet():
        text = io.StringIO(SHEET)
        text.name = "node.eds"
        return text

    here, there = network(), network()
    server = there.create_node(5, sheet())
    client = here.add_node(5, sheet())
    said = []
    server.nmt.send_command(0)
    name = client.sdo["Device name"].raw
    said.append({"index": 0x1008, "value": name, "transport": "segmented"})
    client.sdo["Counter"].raw = 123456
    said.append({"index": 0x2001, "value": 123456, "transport": "expedited"})
    client.sdo["Text"].raw = "written in more than one frame"
    said.append({"index": 0x2000, "value": "written in more than one frame", "transport": "segmented"})
    try:
        client.sdo.upload(0x3000, 0)
    except canopen.SdoAbortedError as abort:
        said.append({"index": 0x3000, "abort": abort.code, "abort_text": str(abort)})
    client.sdo["Producer heartbeat time"].raw = 50
    said.append({"index": 0x1017, "value": 50, "transport": "expedited"})
    client.nmt.state = "OPERATIONAL"
    server.nmt.state = "OPERATIONAL"
    said.append({"kind": "nmt", "command": 1})
    time.sleep(0.3)
    server.emcy.send(0x8130, 0x11, b"\x01\x02")
    said.append({"kind": "emergency", "code": 0x8130})
    time.sleep(0.1)
    for net in (here, there):
        net.notifier.stop()
        net.bus.shutdown()
    return said


def talk_j1939():
    import j1939

    said = []

    ecu = j1939.ElectronicControlUnit()
    ecu.connect(interface="virtual", channel="peers")
    other = j1939.ElectronicControlUnit()
    other.connect(interface="virtual", channel="peers")

    def name(identity):
        return j1939.Name(
            arbitrary_address_capable=0, industry_group=1, vehicle_system_instance=1, vehicle_system=1,
            function=1, function_instance=1, ecu_instance=1, manufacturer_code=666, identity_number=identity,
        )

    here = j1939.ControllerApplication(name(1), 128)
    there = j1939.ControllerApplication(name(2), 129)
    ecu.add_ca(controller_application=here)
    other.add_ca(controller_application=there)
    here.start()
    there.start()
    time.sleep(1)
    for identity, address in ((1, 128), (2, 129)):
        said.append({"pgn": 60928, "source": address, "identity": identity, "manufacturer": 666})
    single = [1, 2, 3, 4, 5, 6, 7, 8]
    here.send_pgn(0, 0xFE, 0xF6, 6, single)
    said.append({"pgn": 0xFEF6, "source": 128, "data": bytes(single).hex().upper()})
    time.sleep(0.1)
    broadcast = [at & 0xFF for at in range(100)]
    here.send_pgn(0, 0xFE, 0xF7, 6, broadcast)
    said.append({"pgn": 0xFEF7, "source": 128, "data": bytes(broadcast).hex().upper(), "transport": "BAM"})
    time.sleep(2)
    directed = [at * 3 & 0xFF for at in range(200)]
    here.send_pgn(0, 0xD0, 129, 6, directed)
    said.append({"pgn": 0xD000, "source": 128, "data": bytes(directed).hex().upper(), "transport": "RTS/CTS"})
    time.sleep(2)
    ecu.disconnect()
    other.disconnect()
    return said


# The types of unused fields: reserved and spare.
UNUSED = ([19], [20])


def read_nmea2000(path):
    from nmea2000.decoder import NMEA2000Decoder

    decoder = NMEA2000Decoder()
    with gzip.open(path, "rt") as log:
        for line in log:
            if line.startswith("#"):
                continue
            message = decoder.decode(line.strip())
            if message is None:
                continue
            plain = json.loads(message.to_json())
            fields = [
                [field["name"], field["value"], field["raw_value"]]
                for field in plain["fields"]
                if not isinstance(field["value"], list) and field["type"] not in UNUSED
            ]
            lists = [field["value"] for field in plain["fields"] if isinstance(field["value"], list)]
            print(
                json.dumps(
                    {
                        "pgn": plain["PGN"],
                        "source": plain["source"],
                        "title": plain["description"],
                        "fields": fields,
                        "repeated": sum(len(one) for one in lists),
                    }
                )
            )


def read_eds(paths):
    import canopen

    for path in paths:
        print("file", path)
        dictionary = canopen.import_od(path)
        for index, thing in sorted(dictionary.items()):
            # Lower numbers are data types, which are mapped to unused space in a PDO.
            if index < 0x20:
                continue
            is_variable = isinstance(thing, canopen.objectdictionary.ODVariable)
            for sub, variable in {0: thing}.items() if is_variable else sorted(thing.subindices.items()):
                values = [getattr(variable, name, None) for name in ("value", "default")]
                numbers = [value for value in values if isinstance(value, (int, float))]
                entry = {
                    "index": index,
                    "sub": sub,
                    "name": variable.name,
                    "type": variable.data_type,
                    "access": variable.access_type,
                    "mappable": variable.pdo_mappable,
                    "value": numbers[0] if numbers else None,
                    "low": variable.min,
                    "high": variable.max,
                }
                print(json.dumps(entry))


def read_groups():
    import pathlib
    import re

    import canmatrix
    import j1939

    database = (pathlib.Path(canmatrix.__file__).parent / "j1939.dbc").read_text("latin-1")
    for identifier, name in re.findall(r"^BO_ (\d+) (\w+):", database, re.MULTILINE):
        group = int(identifier) >> 8 & 0x3FFFF
        print(group if group & 0xFF00 >= 0xF000 else group & 0x3FF00, name)
    for name, group in vars(j1939.ParameterGroupNumber.PGN).items():
        if name.startswith("DM"):
            print(group, f"DM{int(name[2:])}")


if __name__ == "__main__":
    what = sys.argv[1]
    if what == "nmea2000":
        read_nmea2000(sys.argv[2])
    elif what == "eds":
        read_eds(sys.argv[2:])
    elif what == "groups":
        read_groups()
    else:
        recorded(globals()[f"talk_{what}"])
