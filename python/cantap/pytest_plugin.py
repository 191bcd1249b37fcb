"""Fixtures for pytest: `bus`, a bus to test on, and `node`, which starts nodes on it.

The bus is simulated, in simulated time, unless `--cantap-device` says where a device is; with several, each test runs on each.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from typing import Any

import pytest

from .bench import Bus, Node
from .traces import load_database


def pytest_addoption(parser: pytest.Parser) -> None:
    """The options."""
    group = parser.getgroup("cantap", "CAN buses")
    group.addoption(
        "--cantap-device",
        action="append",
        metavar="ADDRESS",
        help="run tests that use a bus on this device, which then takes part in the bus; may be given several times. "
        "Without it, the bus is simulated, in simulated time",
    )
    group.addoption("--cantap-channel", type=int, default=1, metavar="N", help="the device's channel: 1")
    group.addoption("--cantap-bitrate", type=int, metavar="BPS", help="its bit rate, in bit/s")
    group.addoption("--cantap-db", action="append", metavar="FILE", help="a database, for messages by name")


def pytest_configure(config: pytest.Config) -> None:
    """The marker."""
    config.addinivalue_line(
        "markers",
        "cantap(db=None, bitrate=None, options='load=0'): a test's database, bit rate, and what else is on a simulated bus",
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Runs a test on each device."""
    if "cantap_device" in metafunc.fixturenames:
        devices = metafunc.config.getoption("cantap_device") or [None]
        ids = [device or "simulated" for device in devices]
        metafunc.parametrize("cantap_device", devices, ids=ids, indirect=True, scope="function")


@pytest.fixture
def cantap_device(request: pytest.FixtureRequest) -> str | None:
    """The device's address; `None` for a simulated bus."""
    address: str | None = request.param
    return address


@pytest.fixture
def bus(request: pytest.FixtureRequest, cantap_device: str | None) -> Iterator[Bus]:
    """A bus of the test's own. A node that ends with an error fails the test."""
    marker = request.node.get_closest_marker("cantap")
    wanted: dict[str, Any] = dict(marker.kwargs) if marker else {}
    config = request.config
    files = wanted.pop("db", None) or config.getoption("cantap_db")
    with Bus(
        cantap_device,
        channel=config.getoption("cantap_channel"),
        bitrate=wanted.pop("bitrate", None) or config.getoption("cantap_bitrate"),
        db=load_database(files) if files else None,
        **wanted,
    ) as opened:
        yield opened
        errors = [f"{name}: {error}" for name, error in opened.errors]
        if errors:
            pytest.fail("\n".join(errors), pytrace=False)


@pytest.fixture
def node(bus: Bus) -> Callable[..., Node]:
    """Starts nodes: `node("obd", speed=60)`, `node("mine.rhai")`."""
    return bus.start


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, None]:
    """Attaches to a failure what was on the bus before it."""
    outcome = yield
    report: pytest.TestReport = outcome.get_result()
    used = getattr(item, "funcargs", {}).get("bus")
    if call.when == "call" and report.failed and isinstance(used, Bus):
        try:
            trace, log = used.trace, used.log
        except Exception as error:
            report.sections.append(("the bus", f"its trace cannot be had: {error}"))
            return
        if trace:
            report.sections.append((f"the last {len(trace)} frames on the bus", "\n".join(trace)))
        if log:
            lines = [f"{time:.6f} {name}: {text}" for time, name, text in log]
            report.sections.append(("what nodes have logged", "\n".join(lines)))
