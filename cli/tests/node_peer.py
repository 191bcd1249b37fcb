"""Nodes of other programs on a board shared by `cantap serve`, for nodes.rs: they connect through socketcand.

uds, memory, ecus, servers, obd, obd_29, obd_on_uds, canopen, drive, j1939 HOST PORT     serves until standard input ends; prints "ready" when it does
tester HOST PORT                                     prints "ready", and then what udsoncan has read of the ECU that is asked with 7E0
"""

import sys
import threading
import time

import can


def bus(host, port):
    return can.Bus(interface="socketcand", host=host, port=int(port), channel="can0")


def wait():
    print("ready", flush=True)
    sys.stdin.read()


def serve(stack, take):
    """Hands on each request until standard input ends."""
    over = threading.Event()

    def requests():
        while not over.is_set():
            request = bytes(stack.recv(block=True, timeout=0.1) or b"")
            if request:
                take(request)

    stack.start()
    server = threading.Thread(target=requests)
    server.start()
    wait()
    over.set()
    server.join()
    stack.stop()


def serve_uds(host, port):
    """An ECU on can-isotp; the request's bytes decide the answer, and the seed the key."""
    import isotp

    answers = {
        "1003": ["5003003201F4"],
        "22F190": ["62F190" + b"WVWZZZ1KZAW000001".hex()],
        "22F18C": ["7F2278", "7F2278", "62F18C" + b"SERIAL-42".hex()],
        "2701": ["670111223344"],
        "2702EEDDCCBB": ["6702"],
        "2702": ["7F2735"],
        "190209": ["59020901231108C1580009"],
        "3101FF00": ["7101FF0000"],
        "3E00": ["7E00"],
        "36": ["7601"],
    }
    address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E8, rxid=0x7E0)
    parameters = {"blocksize": 3, "stmin": 1, "rx_flowcontrol_timeout": 5000, "rx_consecutive_frame_timeout": 5000}
    stack = isotp.CanStack(bus(host, port), address=address, params=parameters)

    def answer(request):
        request = request.hex().upper()
        known = answers.get(request) or next((answers[key] for key in ("2702", "36") if request.startswith(key)), [])
        if request.startswith("36"):
            # The block's number, and as many bytes as came, in two.
            known = [f"76{request[2:4]}{len(request) // 2:04X}"]
        for each in known:
            stack.send(bytes.fromhex(each))
            time.sleep(0.02)

    serve(stack, answer)


def serve_memory(host, port):
    """An ECU with a session that ends after three seconds without a request, a key, and 256 bytes of memory from 2000 on."""
    import isotp

    address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E8, rxid=0x7E0)
    stack = isotp.CanStack(bus(host, port), address=address, params={"blocksize": 0, "stmin": 0})
    memory = bytearray(256)
    ecu = {"session": False, "unlocked": False, "last": 0.0, "place": 0, "left": 0, "counter": 0, "writes": False}

    def answer(request):
        now = time.monotonic()
        if now - ecu["last"] > 3:
            ecu["session"] = ecu["unlocked"] = False
        ecu["last"] = now
        service = request[0]
        if service == 0x10:
            ecu["session"] = request[1] == 3
            return bytes([0x50, request[1], 0x00, 0x32, 0x01, 0xF4])
        if request == b"\x3E\x80":
            return None
        if not ecu["session"]:
            return bytes([0x7F, service, 0x7F])
        if request == b"\x27\x01":
            return bytes.fromhex("670111223344")
        if request == bytes.fromhex("2702EEDDCCBB"):
            ecu["unlocked"] = True
            return bytes.fromhex("6702")
        if not ecu["unlocked"]:
            return bytes([0x7F, service, 0x33])
        if service in (0x34, 0x35) and request[1:3] == b"\x00\x44":
            start, size = int.from_bytes(request[3:7], "big"), int.from_bytes(request[7:11], "big")
            if not 0x2000 <= start <= start + size <= 0x2100:
                return bytes([0x7F, service, 0x31])
            ecu.update(place=start - 0x2000, left=size, counter=0, writes=service == 0x34)
            return bytes([service + 0x40, 0x20, 0x00, 0x12])
        if service == 0x36:
            ecu["counter"] = ecu["counter"] + 1 & 0xFF
            length = len(request) - 2 if ecu["writes"] else min(16, ecu["left"])
            if request[1] != ecu["counter"] or length > ecu["left"] or length > 16:
                return bytes([0x7F, service, 0x73])
            part = slice(ecu["place"], ecu["place"] + length)
            ecu["place"], ecu["left"] = ecu["place"] + length, ecu["left"] - length
            if ecu["writes"]:
                memory[part] = request[2:]
            return bytes([0x76, request[1]]) + (b"" if ecu["writes"] else memory[part])
        if service == 0x37:
            return b"\x77" if ecu["left"] == 0 else bytes([0x7F, service, 0x24])
        return bytes([0x7F, service, 0x11])

    def send_answer(request):
        reply = answer(request)
        if reply:
            stack.send(reply)

    serve(stack, send_answer)


VIN = b"WVWZZZ1KZAW00000"


def serve_four(host, port, lengths, answers):
    """Four ECUs on can-isotp, each with its own flow control; `answers` of each by request."""
    import isotp

    channel = bus(host, port)
    notifier = can.Notifier(channel, [], 0.02)
    over = threading.Event()
    threads, stacks, asked = [], [], []

    def serve(stack, own, functional):
        while not over.is_set():
            request = functional.pop(0) if functional else bytes(stack.recv(block=True, timeout=0.02) or b"")
            request = request.hex().upper()
            known = [f"76{request[2:4]}{len(request) // 2:04X}"] if request.startswith("36") else own.get(request, [])
            for answer in known:
                if answer.startswith("7F") and answer.endswith("78"):
                    stack.send(bytes.fromhex(answer))
                    time.sleep(0.15)
                else:
                    stack.send(bytes.fromhex(answer))

    for extended in lengths:
        for number, own in enumerate(answers):
            if extended:
                mode, ids = isotp.AddressingMode.NormalFixed_29bits, {"source_address": 0x10 + number, "target_address": 0xF1}
            else:
                mode, ids = isotp.AddressingMode.Normal_11bits, {"rxid": 0x7E0 + number, "txid": 0x7E8 + number}
            parameters = {"blocksize": 1 + number, "stmin": number}
            stack = isotp.NotifierBasedCanStack(channel, notifier, address=isotp.Address(mode, **ids), params=parameters)
            stack.start()
            functional = []
            asked.append((0x18DB33F1 if extended else 0x7DF, functional))
            threads.append(threading.Thread(target=serve, args=(stack, own, functional)))
            stacks.append(stack)

    def all_are_asked(message):
        for identifier, functional in asked:
            if message.arbitration_id == identifier and message.data[0] >> 4 == 0:
                functional.append(bytes(message.data[1 : 1 + message.data[0]]))

    notifier.add_listener(all_are_asked)
    for thread in threads:
        thread.start()
    wait()
    over.set()
    for thread in threads:
        thread.join()
    for stack in stacks:
        stack.stop()
    notifier.stop()


def serve_ecus(host, port):
    """Asked for F190, each in its own way."""
    vin = lambda number: "62F190" + (VIN + number).hex()
    answers = [[vin(b"1")], ["7F2278", "7F2278", vin(b"2")], ["7F2231"], ["62F190" + b"F4".hex()]]
    serve_four(host, port, [False, True], [{"22F190": known} for known in answers])


def serve_servers(host, port):
    """ECUs of all kinds: prompt, late, one that refuses, one that sends answers without end, one with an address, one with 29 bits, and one that sends
    with the identifier of requests to 7E5. Whatever is not "tester present" is printed."""
    import can

    line = bus(host, port)
    over = threading.Event()

    def say(id, data, after=0.002):
        def later():
            time.sleep(after)
            line.send(can.Message(arbitration_id=id, is_extended_id=id > 0x7FF, data=bytes.fromhex(data)))

        threading.Thread(target=later, daemon=True).start()

    def answer(message):
        id, data = message.arbitration_id, bytes(message.data)
        if bytes([0x3E, 0]) not in data[:4]:
            print(f"{id:X}#{data.hex()}", flush=True)
        if id == 0x7E0 or id == 0x7DF:
            say(0x7E8, "027E00")
        if id == 0x7E1:
            say(0x7E9, "027E00AAAAAAAAAA", 0.4)
        if id == 0x7E2:
            say(0x7EA, "037F3E11AAAAAAAA")
        if id == 0x7E3:
            for _ in range(50):
                say(0x7EB, "027E00AAAAAAAAAA", 0.01)
        if id == 0x6F1 and data[0] == 0x12:
            say(0x612, "F1027E00")
        if id == 0x18DA10F1:
            say(0x18DAF110, "027E00")
        if id == 0x7E5:
            say(0x7ED, "027E00")

    def others():
        while not over.is_set():
            line.send(can.Message(arbitration_id=0x7E5, is_extended_id=False, data=[2, 0x3E, 0]))
            time.sleep(0.1)

    can.Notifier(line, [answer])
    threading.Thread(target=others, daemon=True).start()
    wait()
    over.set()


def serve_obd(host, port, extended=False):
    vin = lambda number: "490201" + (VIN + number).hex()
    none = {"03": ["4300"], "07": ["4700"], "0A": ["4A00"]}
    engine = {
        "0100": ["410000180000"], "010C": ["410C1AF8"], "010D": ["410D32"], "0900": ["490040000000"], "0902": [vin(b"1")], **none, "03": ["43010133"],
    }
    gearbox = {
        "0100": ["7F0178", "410000080000"], "010D": ["410D31"], "0900": ["490040000000"], "0902": ["7F0978", vin(b"2")], **none,
        "03": ["43040301030203034155"],
    }
    serve_four(host, port, [extended], [engine, gearbox, {"0100": ["7F0112"]}, {}])


def serve_obd_29(host, port):
    serve_obd(host, port, True)


def serve_obd_on_uds(host, port):
    """SAE J1979-2: OBD-II's own services are not answered."""
    none = {"194233041E": ["594233FF1E04"], "195533": ["595533FF04"]}
    engine = {
        "22F400": ["62F40000180000"], "22F40C": ["62F40C1AF8"], "22F40D": ["62F40D32"], "22F802": ["62F802" + (VIN + b"1").hex()], **none,
        "194233081E": ["594233FF1E0402" + "01330008"], "14FFFF33": ["54"],
    }
    gearbox = {"22F400": ["7F2278", "62F40000080000"], "22F40D": ["62F40D31"], **none}
    serve_four(host, port, [False], [engine, gearbox, {"22F400": ["7F2211"]}, {}])


def serve_tester(host, port):
    """udsoncan's client, over can-isotp."""
    import json

    import isotp
    import udsoncan
    from udsoncan.client import Client
    from udsoncan.connections import PythonIsoTpConnection

    channel = bus(host, port)
    address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E0, rxid=0x7E8)
    stack = isotp.CanStack(channel, address=address, params={"blocksize": 2, "stmin": 3, "tx_padding": 0xAA})
    text = udsoncan.AsciiCodec
    config = dict(udsoncan.configs.default_client_config, data_identifiers={0xF190: text(17), 0xF187: text(13), 0xF18C: text(10)})
    print("ready", flush=True)
    said = {}
    with Client(PythonIsoTpConnection(stack), config=config, request_timeout=5) as client:
        client.change_session(3)
        client.tester_present()
        for did in config["data_identifiers"]:
            said[f"{did:04X}"] = client.read_data_by_identifier(did).service_data.values[did]
        codes = client.get_dtc_by_status_mask(0xFF).service_data.dtcs
        said["codes"] = [[code.id, code.status.get_byte_as_int()] for code in codes]
        try:
            client.routine_control(0xFF00, 1)
        except udsoncan.NegativeResponseException as refusal:
            said["refused"] = refusal.response.code
        # Flow control, padding and timing of theirs, on the longest there is.
        client.clear_dtc()
        said["after"] = len(client.get_dtc_by_status_mask(0xFF).service_data.dtcs)
    print(json.dumps(said), flush=True)
    sys.stdin.read()
    channel.shutdown()


SHEET = """[DeviceInfo]
VendorName=Peers
ProductName=Node
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
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
[1018]
ParameterName=Identity
ObjectType=0x9
SubNumber=5
[1018sub0]
ParameterName=Entries
ObjectType=0x7
DataType=0x0005
AccessType=ro
DefaultValue=4
[1018sub1]
ParameterName=Vendor
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x29C
[1018sub2]
ParameterName=Product
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=1
[1018sub3]
ParameterName=Revision
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x10002
[1018sub4]
ParameterName=Serial
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=1234
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


def serve_canopen(host, port):
    """Node 5 on python-canopen. Its library has no LSS slave: the node without a number is implemented here, according to CiA 305."""
    import io

    import canopen

    network = canopen.Network()
    network.bus = bus(host, port)
    network.notifier = can.Notifier(network.bus, network.listeners, 0.05)
    text = io.StringIO(SHEET)
    text.name = "node.eds"
    node = network.create_node(5, text)
    node.nmt.send_command(0)
    identity, state = [0x29C, 1, 0x10002, 0x4D2], {"at": 0, "configured": False, "node": None}

    def lss(_id, data, _time):
        command = data[0]
        say = lambda *first: network.send_message(0x7E4, bytes(first) + bytes(8 - len(first)))
        if command == 0x51 and state["node"] is None:
            asked, (bit, part, following) = int.from_bytes(data[1:5], "little"), data[5:8]
            if bit == 0x80:
                state["at"] = 0
                say(0x4F)
            elif part == state["at"] and (identity[part] ^ asked) >> bit == 0:
                if bit == 0 and following != part:
                    state["at"] = following
                    state["configured"] = part == 3
                say(0x4F)
        elif command == 0x04:
            state["configured"] = data[1] == 1
        elif state["configured"] and command == 0x11:
            state["node"] = data[1]
            say(0x11, 0)
        elif state["configured"] and command == 0x13:
            say(0x13, 0 if data[2] < 5 else 1)
        elif state["configured"] and command == 0x17:
            say(0x17, 0)

    network.subscribe(0x7E5, lss)
    wait()
    network.notifier.stop()
    network.bus.shutdown()


def serve_drive(host, port):
    """Node 5 is a drive on python-canopen: its server of objects, and the transitions and statuswords of its profile 402. Motion takes no time."""
    import pathlib

    import canopen
    from canopen.profiles.p402 import State402

    network = canopen.Network()
    network.bus = bus(host, port)
    network.notifier = can.Notifier(network.bus, network.listeners, 0.01)
    folder = pathlib.Path(__file__).resolve().parents[2]
    node = network.create_node(5, str(folder / "host" / "scripts" / "nodes" / "drive.eds"))
    drive = {"state": "SWITCH ON DISABLED", "word": 0, "flags": 0x400}

    def show():
        node.sdo[0x6041].raw = State402.SW_MASK[drive["state"]][1] | drive["flags"] | 0x200

    def written(index, subindex, od, data):
        number = int.from_bytes(data, "little", signed=True)
        if index == 0x6060:
            node.sdo[0x6061].raw = number
        elif index == 0x60FF:
            node.sdo[0x606C].raw = number if drive["state"] == "OPERATION ENABLED" else 0
        elif index == 0x6040:
            for (before, after), command in State402.TRANSITIONTABLE.items():
                if before == drive["state"] and command == number & 0x8F:
                    drive["state"] = after
                    break
            if drive["state"] != "OPERATION ENABLED":
                node.sdo[0x606C].raw = 0
            elif number & ~drive["word"] & 0x10:
                drive["flags"] |= 0x1000
                if node.sdo[0x6061].raw == 1:
                    start = node.sdo[0x6064].raw if number & 0x40 else 0
                    node.sdo[0x6064].raw = start + node.sdo[0x607A].raw
            if not number & 0x10 and node.sdo[0x6061].raw == 1:
                drive["flags"] &= ~0x1000
            drive["word"] = number
            show()

    node.add_write_callback(written)
    show()
    wait()
    network.notifier.stop()
    network.bus.shutdown()


def serve_j1939(host, port):
    """Node 129 on can-j1939: answers requests for two groups, one of them in many frames, and repeats what is sent to it."""
    import j1939

    ecu = j1939.ElectronicControlUnit()
    ecu.connect(interface="socketcand", host=host, port=int(port), channel="can0")
    name = j1939.Name(
        arbitrary_address_capable=0, industry_group=1, vehicle_system_instance=1, vehicle_system=1,
        function=1, function_instance=1, ecu_instance=1, manufacturer_code=666, identity_number=2,
    )

    class Node(j1939.ControllerApplication):
        def on_request(self, src, dest, pgn):
            if pgn == 0xFEF6:
                self.send_pgn(0, 0xFE, 0xF6, 6, [1, 2, 3, 4, 5, 6, 7, 8])
            elif pgn == 0xFEEC:
                self.send_pgn(0, 0xFE, 0xEC, 6, list(b"WVWZZZ1KZAW000001*"))
            elif pgn == 0xEF00:
                self.send_pgn(0, 0xEF, src, 6, [at & 0xFF for at in range(100)])
            elif pgn == 0xFECA:
                self.send_pgn(0, 0xFE, 0xCA, 6, [0x04, 0xFF, 0x64, 0x00, 0x03, 0x05, 0xFF, 0xFF])

    node = Node(name, 129)
    ecu.add_ca(controller_application=node)
    node.subscribe_request(node.on_request)
    node.start()

    class Second(j1939.ControllerApplication):
        """Several codes, which are more than a frame has; its NAME is the highest, so it has to give up an address that others claim."""

        def on_request(self, src, dest, pgn):
            if pgn == 0xFECA:
                self.send_pgn(0, 0xFE, 0xCA, 6, [0x10, 0xFF] + [part for spn in (100, 110, 190) for part in (spn, 0x00, 0x04, 0x02)])

    second = Second(
        j1939.Name(
            arbitrary_address_capable=1, industry_group=7, vehicle_system_instance=15, vehicle_system=127, function=255,
            function_instance=31, ecu_instance=7, manufacturer_code=2047, identity_number=2097151,
        ),
        130,
    )
    ecu.add_ca(controller_application=second)
    second.subscribe_request(second.on_request)
    second.start()

    def echo(priority, pgn, source, timestamp, data):
        if pgn >> 8 == 0xD0 and len(data) > 8:
            node.send_pgn(0, 0xFF, 0x01, 6, list(len(data).to_bytes(2, "little")) + [sum(data) & 0xFF])

    ecu.subscribe(echo)
    time.sleep(1)
    wait()
    ecu.disconnect()


if __name__ == "__main__":
    globals()[f"serve_{sys.argv[1]}"](*sys.argv[2:])
