"""Other people's programs ask the ready nodes of `cantap run`, for ready_nodes.rs.

KIND HOST PORT [SHEET]     joins by socketcand; prints one JSON object with what the node said
"""

import json
import sys
import threading
import time

import can
from peer_wait import wait_until


def bus(host, port):
    return can.Bus(interface="socketcand", host=host, port=int(port), channel="can0")


def obd(host, port):
    """udsoncan's client over can-isotp, and OBD-II's services by can-isotp alone."""
    import isotp
    import udsoncan
    from udsoncan.client import Client
    from udsoncan.connections import PythonIsoTpConnection

    channel = bus(host, port)
    address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E0, rxid=0x7E8)
    stack = isotp.CanStack(channel, address=address, params={"blocksize": 2, "stmin": 3, "tx_padding": 0xAA})
    text = udsoncan.AsciiCodec
    config = dict(
        udsoncan.configs.default_client_config,
        data_identifiers={0xF190: text(17), 0xF187: text(13)},
        security_algo=lambda level, seed, params: bytes(0xFF ^ byte for byte in seed),
        # The computer may be busy: not the 50 ms that the vehicle promises.
        use_server_timing=False,
        request_timeout=10,
        p2_timeout=10,
        p2_star_timeout=10,
    )
    said = {}
    connection = PythonIsoTpConnection(stack)
    with Client(connection, config=config) as client:
        client.change_session(3)
        client.tester_present()
        client.unlock_security_access(1)
        said["vin"] = client.read_data_by_identifier(0xF190).service_data.values[0xF190]
        codes = client.get_dtc_by_status_mask(0xFF).service_data.dtcs
        said["uds_codes"] = [[f"{code.id:06X}", code.status.get_byte_as_int()] for code in codes]
        refusals = []
        for ask in (lambda: client.routine_control(0xFF00, 1), lambda: client.read_data_by_identifier(0xF187) and client.ecu_reset(1)):
            try:
                ask()
            except udsoncan.NegativeResponseException as refusal:
                refusals.append(refusal.response.code)
        said["refused"] = refusals

        def ask(*request):
            connection.send(bytes(request))
            return connection.wait_frame(timeout=10).hex().upper()

        asked = "0100 0120 010C 010D 0105 03 07 0A 020200 0902 0904 04 03 07 0A".split()
        said["answers"] = [[name, ask(*bytes.fromhex(name))] for name in asked]
    print(json.dumps(said), flush=True)
    channel.shutdown()


def engine(host, port):
    """can-j1939: what the engine sends by itself, and what it answers."""
    import j1939

    ecu = j1939.ElectronicControlUnit()
    ecu.connect(interface="socketcand", host=host, port=int(port), channel="can0")
    name = j1939.Name(
        arbitrary_address_capable=0, industry_group=1, vehicle_system_instance=1, vehicle_system=1,
        function=1, function_instance=1, ecu_instance=1, manufacturer_code=666, identity_number=2,
    )
    tester = j1939.ControllerApplication(name, 249)
    ecu.add_ca(controller_application=tester)
    heard, arrived = {}, threading.Condition()

    def take(priority, pgn, source, timestamp, data):
        if source == 0:
            with arrived:
                heard.setdefault(pgn, []).append(bytes(data).hex().upper())
                arrived.notify_all()

    # Also what is only for the tester.
    ecu.subscribe(take)
    tester.subscribe(take)
    trouble = []
    dm1 = j1939.Dm1(tester)
    dm1.subscribe(lambda source, status, codes, time: trouble.append((source, status, codes)))
    tester.start()
    wait_until(lambda: tester.state == j1939.ControllerApplication.State.NORMAL)

    def next_of(pgn, to=None, asked=None, length=None):
        """The next message of a group, after a request of it, or of another group, to an address."""
        with arrived:
            before = len(heard.get(pgn, []))
        if to is not None:
            tester.send_request(0, asked or pgn, to)
        found = []

        def has_come():
            found[:] = [data for data in heard.get(pgn, [])[before:] if length in (None, len(data) // 2)]
            return bool(found)

        with arrived:
            assert arrived.wait_for(has_come, 30), f"{pgn} did not come"
        return found[0]

    said = {
        "eec1": next_of(61444),
        "ccvs": next_of(65265),
        "temperatures": next_of(65262),
        "component_to_one": bytes.fromhex(next_of(65259, 0)).decode(),
        "component_to_all": bytes.fromhex(next_of(65259, 255)).decode(),
        "dm1": next_of(65226),
    }
    wait_until(lambda: trouble)
    source, status, codes = trouble[-1]
    said["trouble"] = [[code["spn"], code["fmi"], code["oc"]] for code in codes]
    # A group that it does not have.
    said["refused"] = next_of(59392, 0, asked=65100)
    said["cleared"] = next_of(59392, 0, asked=65235)
    # One that began before may still be under way: it is longer.
    said["dm1_after"] = next_of(65226, 0, length=8)
    print(json.dumps(said), flush=True)
    ecu.disconnect()


def drive(host, port, sheet):
    """python-canopen's CiA 402 node."""
    import canopen
    from canopen.profiles.p402 import BaseNode402

    # The computer may be busy.
    for name in ("RESET_FAULT", "SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(BaseNode402, f"TIMEOUT_{name}", 20)
    network = canopen.Network()
    network.bus = bus(host, port)
    network.notifier = can.Notifier(network.bus, network.listeners, 0.01)
    node = BaseNode402(5, sheet)
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = 10.0
    said = {"beat": node.nmt.wait_for_heartbeat(30), "name": node.sdo[0x1008].raw}
    booted = threading.Event()
    network.subscribe(0x705, lambda _id, data, _stamp: data[0] == 0 and booted.set())
    node.nmt.send_command(0x81)
    said["booted"] = booted.wait(30)
    node.nmt.wait_for_heartbeat(30)
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"

    # Until the first status word came, the library knows no state.
    states = [wait_until(lambda: node.state == "SWITCH ON DISABLED") and node.state]
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
        states.append(node.state)
    said["states"] = states
    node.op_mode = "PROFILED VELOCITY"
    said["mode"] = node.op_mode
    node.rpdo[2]["Target velocity"].raw = 1500
    node.rpdo[2].transmit()
    received = threading.Event()

    def by_sync():
        received.clear()
        network.sync.transmit()
        received.wait(30)
        return node.tpdo[2]["Velocity actual value"].raw

    node.tpdo[2].add_callback(lambda _: received.set())
    said["velocity"] = wait_until(lambda: by_sync() == 1500) and by_sync()
    said["forward"] = node.tpdo[2]["Position actual value"].raw > 0
    said["homed"] = node.homing(timeout=60)
    node.op_mode = "PROFILED POSITION"
    node.rpdo[2]["Target position"].raw = 5000
    node.rpdo[2].transmit()
    node.controlword = 0x0F
    node.controlword = 0x1F
    wait_until(lambda: node.statusword & 0x1000)
    node.controlword = 0x0F
    wait_until(lambda: node.statusword & 0x400)
    said["position"] = node.sdo[0x6064].raw
    emergency = threading.Event()
    node.emcy.add_callback(lambda error: emergency.set())
    node.sdo[0x2000].raw = 0x2310
    wait_until(lambda: node.state == "FAULT")
    said["fault"] = [node.state, node.sdo[0x603F].raw, emergency.wait(30)]
    node.controlword = 0x80
    wait_until(lambda: node.state == "SWITCH ON DISABLED")
    said["after"] = [node.state, node.sdo[0x603F].raw]
    try:
        node.sdo[0x6041].raw = 0
    except canopen.SdoAbortedError as error:
        said["refused"] = f"{error.code:08X}"
    network.notifier.stop()
    network.bus.shutdown()
    print(json.dumps(said), flush=True)


def number(host, port, sheet):
    """python-canopen's LSS master gives the drive a number, then another one by its identity."""
    import canopen

    network = canopen.Network()
    network.bus = bus(host, port)
    network.notifier = can.Notifier(network.bus, network.listeners, 0.01)
    said, boots = {}, {node: threading.Event() for node in (12, 13)}
    for node, booted in boots.items():
        network.subscribe(0x700 + node, lambda _id, data, _stamp, booted=booted: data[0] == 0 and booted.set())
    # Silence is an answer here, so a short wait finds a busy computer's node nowhere, and a long one takes minutes.
    for network.lss.RESPONSE_TIMEOUT in (0.15, 0.5, 1.5):
        found, identity = network.lss.fast_scan()
        if found:
            break
    said["found"], said["identity"] = found, list(identity or [])
    network.lss.RESPONSE_TIMEOUT = 10.0
    said["inquired"] = network.lss.inquire_node_id()
    network.lss.configure_node_id(12)
    network.lss.send_switch_state_global(network.lss.WAITING_STATE)
    said["first"] = boots[12].wait(30)
    node = network.add_node(12, sheet)
    node.sdo.RESPONSE_TIMEOUT = 10.0
    said["serial"] = node.sdo[0x1018][4].raw
    said["selected"] = network.lss.send_switch_state_selective(*identity)
    network.lss.configure_node_id(13)
    network.lss.store_configuration()
    network.lss.send_switch_state_global(network.lss.WAITING_STATE)
    node.nmt.send_command(0x82)
    said["second"] = boots[13].wait(30)
    other = network.add_node(13, sheet)
    other.sdo.RESPONSE_TIMEOUT = 10.0
    said["same"] = other.sdo[0x1018][4].raw
    network.notifier.stop()
    network.bus.shutdown()
    print(json.dumps(said), flush=True)


def boat(host, port):
    """The nmea2000 package, by canboat's definitions."""
    from nmea2000 import NMEA2000Decoder

    channel = bus(host, port)
    decoder = NMEA2000Decoder()
    wanted = {129025, 129026, 129029, 128267, 130306, 127488, 127489, 130310, 126996, 60928}
    said = {}

    def request(pgn):
        channel.send(can.Message(arbitration_id=0x18EA23F9, data=pgn.to_bytes(3, "little"), is_extended_id=True))

    request(126996)
    request(60928)
    until = time.monotonic() + 60
    while wanted - said.keys() and time.monotonic() < until:
        frame = channel.recv(1.0)
        if frame is None or not frame.is_extended_id:
            continue
        message = decoder.decode(frame)
        if message is None:
            continue
        said.setdefault(message.PGN, {field.id: field.value for field in message.fields})
    print(json.dumps({str(pgn): fields for pgn, fields in said.items()}, default=str), flush=True)
    channel.shutdown()


globals()[sys.argv[1]](*sys.argv[2:])
