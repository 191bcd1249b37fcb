"""python-canopen as the master of `virtual:canopen`, for virtual_canopen.rs.

HOST PORT SHEET     joins by socketcand; prints one JSON object with what the nodes said
"""

import json
import sys
import threading
import time

import can
import canopen
from peer_wait import wait_until

NODE, NEW_NODE = 5, 9
LONG = bytes(range(256)) * 5 + b"the end"


def attempt(action):
    """The result of an action, or the abort code."""
    try:
        return action()
    except canopen.SdoAbortedError as error:
        return f"{error.code:08X}"


def write_blocks(node, data):
    with node.sdo.open(0x2000, 0, "wb", size=len(data), block_transfer=True) as stream:
        stream.write(data)


def read_blocks(node):
    with node.sdo.open(0x2000, 0, "rb", block_transfer=True) as stream:
        return stream.read()


def main(host, port, sheet):
    network = canopen.Network()
    network.bus = can.Bus(interface="socketcand", host=host, port=int(port), channel="can0")
    network.notifier = can.Notifier(network.bus, network.listeners, 0.01)
    said = {}

    node = network.add_node(NODE, sheet)
    node.sdo.RESPONSE_TIMEOUT = 5.0
    said["name"] = node.sdo[0x1008].raw
    said["serial"] = node.sdo[0x1018][4].raw
    node.sdo[0x2001].raw = -1234
    said["target"] = node.sdo[0x2001].raw
    said["refused"] = [
        attempt(lambda: node.sdo.download(0x1000, 0, b"\0\0\0\0")),
        attempt(lambda: node.sdo.upload(0x2005, 0)),
        attempt(lambda: node.sdo.upload(0x3000, 0)),
        attempt(lambda: node.sdo.download(0x1017, 0, b"\0")),
    ]

    # Segments and blocks, in both directions.
    node.sdo.download(0x2000, 0, LONG[:100], force_segment=True)
    said["segments"] = node.sdo.upload(0x2000, 0) == LONG[:100]
    write_blocks(node, LONG)
    said["blocks"] = read_blocks(node) == LONG
    # The nodes lose one segment in each direction, and the master sends or requests it again.
    node.sdo[0x2004].raw = 5
    write_blocks(node, LONG[1:])
    said["written_again"] = node.sdo.upload(0x2000, 0) == LONG[1:]
    node.sdo[0x2004].raw = 7
    said["read_again"] = read_blocks(node) == LONG[1:]

    # States, PDOs, an emergency.
    node.sdo[0x1017].raw = 100
    node.nmt.wait_for_heartbeat(30)
    node.nmt.state = "OPERATIONAL"
    # What the master wishes counts as the state until a heartbeat says it.
    node.nmt.wait_for_heartbeat(30)
    wait_until(lambda: node.nmt.state == "OPERATIONAL")
    said["state"] = node.nmt.state
    node.tpdo.read()
    node.rpdo.read()
    node.rpdo[1]["Controlword"].raw = 0xF
    node.rpdo[1]["Target speed"].raw = 500
    node.rpdo[1].transmit()
    time.sleep(0.5)
    # The node answers within a millisecond, so something must listen before SYNC goes out: `wait_for_reception` forgets what came first.
    received = threading.Event()
    node.tpdo[1].add_callback(lambda _: received.set())
    network.sync.transmit()
    said["sync_pdo"] = received.wait(30)
    said["status"] = node.tpdo[1]["Statusword"].raw
    said["timer_pdo"] = node.tpdo[2].wait_for_reception(30) is not None
    said["speed"] = node.tpdo[2]["Speed"].raw
    node.sdo[0x2003].raw = 0x4210
    wait_until(lambda: node.emcy.log)
    said["emergency"] = [node.emcy.log[-1].code, node.emcy.log[-1].register]

    # The node without a number.
    # Silence is an answer here, so a short wait finds a busy computer's node nowhere, and a long one takes minutes.
    for network.lss.RESPONSE_TIMEOUT in (0.15, 0.5, 1.5):
        found, identity = network.lss.fast_scan()
        if found:
            break
    said["found"], said["identity"] = found, list(identity)
    network.lss.RESPONSE_TIMEOUT = 5.0
    said["inquired"] = network.lss.inquire_lss_address(0x5D)
    network.lss.configure_node_id(NEW_NODE)
    network.lss.store_configuration()
    other = network.add_node(NEW_NODE, sheet)
    started = threading.Event()
    network.subscribe(0x700 + NEW_NODE, lambda _id, data, _stamp: data[0] == 0 and started.set())
    network.lss.send_switch_state_global(network.lss.WAITING_STATE)
    said["started"] = started.wait(30)
    other.sdo.RESPONSE_TIMEOUT = 5.0
    said["other_serial"] = other.sdo[0x1018][4].raw

    network.notifier.stop()
    network.bus.shutdown()
    print(json.dumps(said), flush=True)


main(*sys.argv[1:])
