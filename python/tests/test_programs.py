"""Programs of other people that take a Bus of python-can. Their time limits are long: the computer may be busy."""

import os
import signal
import subprocess
import sys
import time

import pytest

can = pytest.importorskip("can")

QUIET = "virtual:load=0,wire=joined"


def bus(channel, **options):
    return can.Bus(interface="cantap", channel=channel, bitrate=500_000, **options)


@pytest.fixture
def pair():
    with bus(f"{QUIET}:1") as first, bus(f"{QUIET}:2") as second:
        yield first, second


def until(condition):
    """Waits for something."""
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_logger_of_python_can_writes_files_one_after_another(tmp_path):
    command = [sys.executable, "-m", "can.logger", "-i", "cantap", "-c", "virtual:car", "-b", "500000"]
    process = subprocess.Popen([*command, "-f", tmp_path / "log.asc", "-s", "2000"], stderr=subprocess.PIPE, text=True)
    try:
        until(lambda: len(os.listdir(tmp_path)) > 2 or process.poll() is not None)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=120)
    finally:
        process.kill()
    assert "CantapWarning" not in said and len(os.listdir(tmp_path)) > 2, said


def test_transfers_of_isotp_arrive(pair):
    isotp = pytest.importorskip("isotp")
    first, second = pair
    patient = {"rx_flowcontrol_timeout": 10_000, "rx_consecutive_frame_timeout": 10_000}
    with can.Notifier(first, []) as one, can.Notifier(second, []) as other:
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E0, rxid=0x7E8)
        back = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E8, rxid=0x7E0)
        sender = isotp.NotifierBasedCanStack(first, one, address=address, params=patient)
        receiver = isotp.NotifierBasedCanStack(second, other, address=back, params=patient)
        sender.start()
        receiver.start()
        try:
            payload = bytes(at & 0xFF for at in range(1000))
            sender.send(payload)
            assert receiver.recv(block=True, timeout=120) == payload
        finally:
            sender.stop()
            receiver.stop()


def test_the_car_tells_udsoncan_its_number():
    isotp = pytest.importorskip("isotp")
    udsoncan = pytest.importorskip("udsoncan")
    from udsoncan.client import Client
    from udsoncan.connections import PythonIsoTpConnection

    with bus("virtual:car") as car:
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E0, rxid=0x7E8)
        patient = {"rx_flowcontrol_timeout": 10_000, "rx_consecutive_frame_timeout": 10_000}
        stack = isotp.CanStack(car, address=address, params=patient)
        config = {"data_identifiers": {0xF190: udsoncan.AsciiCodec(17)}, "request_timeout": 20, "p2_timeout": 20}
        with Client(PythonIsoTpConnection(stack), config=config) as client:
            values = client.read_data_by_identifier(0xF190).service_data.values
    assert values[0xF190].startswith("WCT")


def test_canopen_finds_the_drive_and_reads_its_name():
    canopen = pytest.importorskip("canopen")
    network = canopen.Network()
    network.connect(interface="cantap", channel="virtual:canopen", bitrate=500_000)
    try:
        network.scanner.search()
        until(lambda: network.scanner.nodes)
        node = network.add_node(network.scanner.nodes[0])
        node.sdo.RESPONSE_TIMEOUT = 10
        assert node.sdo.upload(0x1008, 0) == b"cantap virtual drive"
        with node.sdo.open(0x1008, 0, "rb", block_transfer=True) as file:
            assert file.read() == b"cantap virtual drive"
        synced = []
        node.nmt.state = "OPERATIONAL"
        network.subscribe(0x180 + node.id, lambda *message: synced.append(message))
        network.sync.start(0.02)
        until(lambda: len(synced) > 5)
        network.sync.stop()
    finally:
        network.disconnect()


def test_j1939_claims_addresses_and_transfers_long_messages():
    j1939 = pytest.importorskip("j1939")

    def name(number):
        return j1939.Name(
            arbitrary_address_capable=1, industry_group=0, vehicle_system_instance=0, vehicle_system=0, function=number,
            function_instance=0, ecu_instance=0, manufacturer_code=1, identity_number=number,
        )

    units, heard = [j1939.ElectronicControlUnit() for _ in range(2)], []
    try:
        applications = []
        for number, unit in enumerate(units, 1):
            unit.connect(interface="cantap", channel=f"{QUIET}:{number}", bitrate=250_000)
            applications.append(j1939.ControllerApplication(name(number), 127 + number))
            unit.add_ca(controller_application=applications[-1])
        applications[1].subscribe(lambda priority, pgn, source, stamp, data: heard.append((source, len(data))))
        for application in applications:
            application.start()
        until(lambda: all(each.state == j1939.ControllerApplication.State.NORMAL for each in applications))
        # To everybody: without the other side's answers, which a busy computer would delay too long.
        applications[0].send_pgn(0, 0xFE, 0xF6, 6, [7] * 100)
        until(lambda: (128, 100) in heard)
    finally:
        for unit in units:
            unit.disconnect()


def test_a_bus_for_several_threads_is_one_like_any_other(pair):
    _, second = pair
    with can.ThreadSafeBus(interface="cantap", channel=f"{QUIET}:1", bitrate=500_000) as safe:
        safe.send(can.Message(arbitration_id=5, is_extended_id=False), timeout=120)
        assert second.recv(10).arbitration_id == 5 and safe.losses()["lost"] == 0
        task = safe.send_periodic(can.Message(arbitration_id=6, is_extended_id=False), 0.01)
        assert type(task).__name__ == "DeviceCyclicTask" and second.recv(10).arbitration_id == 6
        task.stop()
