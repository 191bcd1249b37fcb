"""pyxcp as the master of `virtual:ecu`, for xcp.rs.

HOST PORT     joins by socketcand; prints one JSON object with what the ECU said
"""

import json
import logging
import sys
import time

from pyxcp.config import create_application_from_config
from pyxcp.master import Master
from pyxcp.transport.transport_ext import FrameAcquisitionPolicy, FrameCategory

MEASURED, PARAMETERS = 0x2000_0000, 0x3000_0000


class Collect(FrameAcquisitionPolicy):
    """Keeps data packets."""

    def __init__(self):
        super().__init__(None)
        self.packets = []

    def feed(self, category, counter, timestamp, payload):
        if category == FrameCategory.DAQ:
            self.packets.append(bytes(payload))

    def finalize(self):
        pass


def attempt(master, action, *arguments):
    """The name of the error that an action ends with."""
    return str(master.try_command(action, *arguments)[1].error_code)


def main(host, port):
    application = create_application_from_config(log_level=logging.ERROR)
    application.transport.layer = "CAN"
    can = application.transport.can
    can.interface, can.channel, can.bitrate = "socketcand", "can0", 500_000
    can.can_id_master, can.can_id_slave = 0x7F0, 0x7F1
    can.socketcand.host, can.socketcand.port = host, int(port)
    policy = Collect()
    said = {}
    with Master("can", config=application, policy=policy) as master:
        connected = master.connect()
        said["max_cto"], said["max_dto"] = connected.maxCto, connected.maxDto
        said["status"] = master.getStatus().resourceProtectionStatus.calpag
        master.getCommModeInfo()
        said["name"] = master.identifier(1)
        said["idle"] = list(master.shortUpload(2, PARAMETERS))
        master.setMta(MEASURED)
        said["block"] = len(master.fetch(14))
        master.setMta(PARAMETERS)
        master.download(bytes([0xA0, 0x0F]), last=True)
        said["written"] = list(master.shortUpload(2, PARAMETERS))
        said["refused"] = [
            attempt(master, master.shortUpload, 4, 0x1000),
            attempt(master, master.setDaqPtr, 7, 0, 0),
        ]
        info = master.getDaqInfo()
        said["events"] = [channel["name"] for channel in info["channels"]]
        master.freeDaq()
        master.allocDaq(1)
        master.allocOdt(0, 2)
        master.allocOdtEntry(0, 0, 1)
        master.allocOdtEntry(0, 1, 2)
        master.setDaqPtr(0, 0, 0)
        master.writeDaq(0xFF, 2, 0, MEASURED)
        master.setDaqPtr(0, 1, 0)
        master.writeDaq(0xFF, 4, 0, MEASURED + 8)
        master.writeDaq(0xFF, 1, 0, MEASURED + 3)
        master.setDaqListMode(0x10, 0, 0, 1, 0)
        said["first_pid"] = master.startStopDaqList(2, 0).firstPid
        master.startStopSynch(1)
        deadline = time.monotonic() + 30
        while len(policy.packets) < 20 and time.monotonic() < deadline:
            time.sleep(0.05)
        master.startStopSynch(0)
        master.disconnect()
    said["packets"] = [packet.hex() for packet in policy.packets[:20]]
    print(json.dumps(said))


main(*sys.argv[1:])
