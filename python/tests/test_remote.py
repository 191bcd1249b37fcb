"""Analysers on other computers: through a real ssh, and over TLS. The server is the command `cantap`, named by `CANTAP_COMMAND`."""

import contextlib
import os
import pathlib
import socket
import subprocess
import sys
import threading
import time

import pytest

import cantap

COMMAND = os.environ.get("CANTAP_COMMAND", "")
pytestmark = pytest.mark.skipif(
    not COMMAND, reason="CANTAP_COMMAND does not name the command `cantap`, which is the server"
)


def capture(device):
    """Some frames; none may be missing. So many that both channels are among them, even if a busy machine's server sends one channel's
    first."""
    table = device.batch(seconds=4, rows=2000)
    assert len(table) == 2000
    assert all(counts["lost"] == 0 for counts in device.losses.values())
    return table.to_pyarrow()


def run(*command, **options):
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, **options)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture
def keys(tmp_path):
    folder = tmp_path / "keys"
    run(COMMAND, "serve", "keygen", folder, "--host", "127.0.0.1", "--client", "alice:send", "--client", "bob:listen")
    return folder


def serving(*arguments, device="virtual:load=50,wire=joined"):
    """Starts a server; it and its address."""
    command = [COMMAND, "serve", "-d", device, "-b", "500k", "--allow", "send", *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True)
    heard = []
    for line in process.stderr:
        heard.append(line)
        words = [word.rstrip(".,;:") for word in line.split() if word.startswith(("tls://", "tcp://"))]
        if words:
            return process, words[0]
    process.wait(timeout=120)
    pytest.skip("the server tells no address: " + "".join(heard))


def test_an_address_of_ipv6_is_one_like_any_other():
    server, address = serving("--tcp", "[::1]:0")
    try:
        # With a zone as well: the loopback's number, as the system takes names for addresses of a link only.
        for other in (address, address.replace("::1", "::1%1")):
            with cantap.open(other, 500_000) as device:
                assert len(device.batch(seconds=10, rows=100)) == 100
        with pytest.raises(ValueError, match="brackets"):
            cantap.open(address.replace("[", "").replace("]", ""))
    finally:
        server.kill()
        server.communicate(timeout=120)


def test_a_server_that_is_started_again_is_reached_again():
    can = pytest.importorskip("can")
    server, address = serving("--tcp", "127.0.0.1:0")
    device = cantap.open(address, 500_000)
    bus = can.Bus(interface="cantap", channel=f"{address}:1", bitrate=500_000)
    assert bus.recv(10) is not None and device.read(10) is not None
    server.kill()
    server.communicate(timeout=120)
    with pytest.raises(cantap.DeviceError, match="vanished"):
        for _ in device:
            pass
    with pytest.raises(can.CanOperationError, match="vanished"):
        while bus.recv(10):
            pass
    # Not only once: whoever iterates again would wait for ever, or take it for the end.
    for again in (lambda: device.read(1), lambda: next(iter(device)), lambda: list(device), lambda: device.batch(1)):
        with pytest.raises(cantap.DeviceError, match="vanished"):
            again()
    for again in (lambda: bus.recv(1), lambda: next(iter(bus))):
        with pytest.raises(can.CanOperationError, match="vanished"):
            again()
    server, _ = serving("--tcp", address.removeprefix("tcp://"))
    try:
        # Although the old object is still there.
        with can.Bus(interface="cantap", channel=f"{address}:1", bitrate=500_000) as other:
            assert other.recv(10) is not None
        bus.shutdown()
        device.close()
        with cantap.open(address, 500_000) as device:
            assert device.read(10) is not None
    finally:
        server.kill()
        server.communicate(timeout=120)


def test_bus_objects_of_several_programs_hear_each_other_through_a_server():
    can = pytest.importorskip("can")
    server, address = serving("--tcp", "127.0.0.1:0", device="virtual:load=0,wire=joined")
    hears = """if True:
        import can, sys
        with can.Bus(interface="cantap", channel=sys.argv[1], bitrate=500_000,
                     can_filters=[{"can_id": 0x100, "can_mask": 0x7FF}]) as bus:
            print("ready", flush=True)
            for _ in range(2):
                heard = bus.recv(30)
                print(f"{heard.arbitration_id:X}", heard.is_rx, flush=True)
            bus.send(can.Message(arbitration_id=0x555, is_extended_id=False), timeout=120)
    """
    try:
        command = [sys.executable, "-c", hears, f"{address}:1"]
        with (
            can.Bus(interface="cantap", channel=f"{address}:1", bitrate=500_000) as first,
            can.Bus(interface="cantap", channel=f"{address}:1", bitrate=500_000) as second,
            subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other,
        ):
            assert other.stdout.readline() == "ready\n"
            for identifier in (0x100, 0x200):
                first.send(can.Message(arbitration_id=identifier, is_extended_id=False), timeout=120)
            second.send(can.Message(arbitration_id=0x100, is_extended_id=False), timeout=120)
            assert other.communicate(timeout=120)[0] == "100 True\n100 True\n"
            assert [first.recv(10).arbitration_id for _ in range(2)] == [0x100, 0x555]
            heard = [second.recv(10) for _ in range(3)]
            assert [one.arbitration_id for one in heard] == [0x100, 0x200, 0x555] and all(one.is_rx for one in heard)
    finally:
        server.kill()
        server.communicate(timeout=120)


def test_a_connection_that_is_cut_anywhere_is_an_error():
    server, address = serving("--tcp", "127.0.0.1:0")
    there = ("127.0.0.1", int(address.rpartition(":")[2]))

    def pump(source, target, limit):
        try:
            while limit > 0 and (data := source.recv(min(limit, 4096))):
                target.sendall(data)
                limit -= len(data)
        except OSError:
            pass
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    try:
        for limit in (0, 1, 10, 50, 200, 1000, 3000):
            with socket.create_server(("127.0.0.1", 0)) as proxy:
                def serve_once():
                    client, _ = proxy.accept()
                    with client, socket.create_connection(there) as upstream:
                        up = threading.Thread(target=pump, args=(client, upstream, 2**40))
                        up.start()
                        pump(upstream, client, limit)
                        up.join(timeout=120)

                thread = threading.Thread(target=serve_once)
                thread.start()
                with pytest.raises(cantap.DeviceError):
                    with cantap.open(f"tcp://127.0.0.1:{proxy.getsockname()[1]}", 500_000) as device:
                        for _ in device:
                            pass
                thread.join(timeout=120)
                assert not thread.is_alive()
    finally:
        server.kill()
        server.communicate(timeout=120)


@pytest.fixture
def tls(keys):
    """A server with keys; its address."""
    command = [COMMAND, "serve", "-d", "virtual:load=50,wire=joined", "-b", "500k", "--tcp", "0", "--allow", "send"]
    command += ["--tls", f"{keys}/server.pem,{keys}/server-key.pem", "--clients", keys / "ca.pem"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True)
    try:
        heard = []
        for line in process.stderr:
            heard.append(line)
            words = [word.rstrip(".,;:") for word in line.split() if word.startswith("tls://127.0.0.1:")]
            if words:
                yield words[0]
                return
        pytest.fail("the server tells no address: " + "".join(heard))
    finally:
        process.terminate()
        process.communicate(timeout=120)


def test_a_device_behind_tls_is_one_beside_it(tls, keys, monkeypatch):
    with cantap.open(f"{tls}?keys={keys}/bob") as device:
        # At the server's bit rate.
        assert [device.open_channel(channel) for channel in (1, 2)] == [500_000, 500_000]
        assert set(capture(device)["channel"].to_pylist()) == {1, 2}
        with pytest.raises(cantap.DeviceError, match="the right to send"):
            device.send(1, "123#11")
    monkeypatch.setenv("CANTAP_KEYS", str(keys / "alice"))
    with cantap.open(tls, 500_000, mode="normal") as device:
        assert device.info["serial"] == "VIRTUAL" and len(device.send(1, "123#11")) == 1


def test_without_the_right_keys_tls_lets_nobody_in(tls, keys, tmp_path, monkeypatch):
    monkeypatch.delenv("CANTAP_KEYS", raising=False)
    with pytest.raises(cantap.DeviceError, match="CANTAP_KEYS"):
        cantap.open(tls)
    other = tmp_path / "other"
    run(COMMAND, "serve", "keygen", other, "--host", "127.0.0.1", "--client", "eve:send")
    with pytest.raises(cantap.DeviceError, match="lets nobody in"):
        cantap.open(f"{tls}?keys={other}/eve")
    with pytest.raises(cantap.DeviceError):
        cantap.open(tls.replace("tls:", "tcp:"))


@pytest.fixture
def ssh(tmp_path, monkeypatch):
    """An ssh server on this computer with its own keys, which `CANTAP_SSH` connects to."""
    sshd = pathlib.Path("/usr/sbin/sshd")
    if not sshd.exists() or not pathlib.Path("/usr/bin/ssh").exists():
        pytest.skip("there is no ssh and sshd; on Debian run `apt-get install openssh-server`")
    for key in ("host", "user"):
        run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", tmp_path / key)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    (tmp_path / "known").write_text(f"[127.0.0.1]:{port} {(tmp_path / 'host.pub').read_text()}")
    (tmp_path / "server").write_text(
        f"Port {port}\nListenAddress 127.0.0.1\nHostKey {tmp_path}/host\nPidFile none\nStrictModes no\nUsePAM no\n"
        f"AuthorizedKeysFile {tmp_path}/user.pub\nPasswordAuthentication no\nKbdInteractiveAuthentication no\n"
        f"SetEnv PATH={pathlib.Path(COMMAND).resolve().parent}:/usr/bin:/bin\n"
    )
    (tmp_path / "client").write_text(
        f"Host there\n HostName 127.0.0.1\n Port {port}\n IdentityFile {tmp_path}/user\n IdentitiesOnly yes\n"
        f" UserKnownHostsFile {tmp_path}/known\n StrictHostKeyChecking yes\n"
    )
    program = tmp_path / "ssh"
    program.write_text(f'#!/bin/sh\nexec /usr/bin/ssh -F {tmp_path}/client "$@"\n')
    program.chmod(0o755)
    if os.getuid() == 0:
        # The folder to which it confines itself; a package's own start script creates it otherwise.
        os.makedirs("/run/sshd", exist_ok=True)
    with (tmp_path / "log").open("w") as log:
        server = subprocess.Popen([sshd, "-D", "-e", "-f", tmp_path / "server"], stderr=log)
        try:
            until = time.monotonic() + 120
            while subprocess.run([program, "-oBatchMode=yes", "there", "true"], capture_output=True).returncode:
                if time.monotonic() > until:
                    pytest.skip("sshd lets nobody in: " + (tmp_path / "log").read_text())
                time.sleep(0.1)
            monkeypatch.setenv("CANTAP_SSH", str(program))
            yield
        finally:
            server.terminate()
            server.wait(timeout=120)


def test_a_device_behind_ssh_is_one_beside_it(ssh):
    with cantap.open("ssh://there/virtual:load=50,wire=joined", 500_000) as device:
        assert set(capture(device)["channel"].to_pylist()) == {1, 2}
        assert device.address.startswith("ssh://there")
    with pytest.raises(cantap.DeviceError, match="allow|right to send"):
        cantap.open("ssh://there/virtual", 500_000, mode="normal").send(1, "123#11")
    with cantap.open("ssh://there/virtual:load=0,wire=joined?allow=send", 500_000, mode="normal") as device:
        assert len(device.send(1, "123#11", timeout=120)) == 1


def test_a_computer_that_ssh_does_not_know_is_an_error(ssh):
    with pytest.raises(cantap.DeviceError, match="nowhere.invalid"):
        cantap.open("ssh://nowhere.invalid/virtual")
