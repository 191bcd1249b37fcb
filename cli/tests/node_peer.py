"""Nodes of other programs on a board shared by `cantap serve`, for nodes.rs: they connect through socketcand.

uds, canopen, j1939 HOST PORT     serves until standard input ends; prints "ready" when it does
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
    stack.start()
    over = threading.Event()

    def serve():
        while not over.is_set():
            request = bytes(stack.recv(block=True, timeout=0.1) or b"").hex().upper()
            known = answers.get(request) or next((answers[key] for key in ("2702", "36") if request.startswith(key)), [])
            if request.startswith("36"):
                # As many bytes as came, in two.
                known = ["7601" + f"{len(request) // 2:04X}"]
            for answer in known:
                stack.send(bytes.fromhex(answer))
                time.sleep(0.02)

    server = threading.Thread(target=serve)
    server.start()
    wait()
    over.set()
    server.join()
    stack.stop()


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

    def echo(priority, pgn, source, timestamp, data):
        if pgn >> 8 == 0xD0 and len(data) > 8:
            node.send_pgn(0, 0xFF, 0x01, 6, list(len(data).to_bytes(2, "little")) + [sum(data) & 0xFF])

    ecu.subscribe(echo)
    time.sleep(1)
    wait()
    ecu.disconnect()


if __name__ == "__main__":
    globals()[f"serve_{sys.argv[1]}"](*sys.argv[2:])
