"""The fixtures for pytest, as a user's tests have them."""

import pathlib
import re

import pytest

import cantap
from cantap.bench import Bus, ready_nodes

pytest_plugins = ["pytester"]

ROOT = pathlib.Path(__file__).parents[2]
VIRTUAL = "virtual:load=0"
DATABASE = """VERSION ""
BU_: A
BO_ 256 Engine: 8 A
 SG_ Speed : 0|16@1+ (0.25,0) [0|8000] "rpm" A
"""


def examples():
    """The tests of the pages, as they stand there."""
    for page in ("docs/scripts.md", "python/README.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            if "def test_" in block:
                yield page, block


@pytest.mark.parametrize("page, block", list(examples()), ids=lambda value: value if value.endswith(".md") else "")
def test_the_pages_examples_pass_on_simulated_buses_and_on_a_device(pytester, page, block):
    pytester.makepyfile(block)
    count = block.count("def test_")
    pytester.runpytest_inprocess().assert_outcomes(passed=count)
    result = pytester.runpytest_inprocess("--cantap-device", VIRTUAL, "--cantap-bitrate", "500000", "-v")
    result.assert_outcomes(passed=count)
    result.stdout.fnmatch_lines([f"*[[]{VIRTUAL}[]] PASSED*"])


def test_both_pages_have_an_example():
    assert {page for page, _ in examples()} == {"docs/scripts.md", "python/README.md"}


@pytest.mark.parametrize("device", [(), ("--cantap-device", VIRTUAL, "--cantap-bitrate", "500000")], ids=["simulated", "device"])
def test_a_failure_has_the_frames_before_it_and_what_nodes_have_logged(pytester, device):
    pytester.makefile(".rhai", echo='on_frame("123", |f| { log("asked"); send(frame(0x124, f.data)); });')
    pytester.makepyfile(
        """
        def test_it(bus, node):
            node("echo.rhai")
            bus.send("123#0102")
            assert bus.expect("124", within="2s").data == b"\\1\\2"
            bus.expect("125", within="300ms")
        """
    )
    result = pytester.runpytest_inprocess(*device)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "*AssertionError: no frame 125 within 300ms",
            "*the last 2 frames on the bus*",
            "(*) can0 123#0102",
            "(*) can0 124#0102",
            "*what nodes have logged*",
            "*echo.rhai: asked",
        ]
    )


def test_a_node_that_ends_with_an_error_fails_its_test(pytester):
    pytester.makepyfile(
        """
        def test_it(bus):
            bus.start("bad", 'after("10ms", || fail("no"));')
            bus.wait("1s")
        """
    )
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*bad: line 1: no*"])


def test_messages_are_sent_and_expected_by_name_and_the_marker_chooses_the_database(pytester):
    pytester.makefile(".dbc", engine=DATABASE)
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.cantap(db="engine.dbc")
        def test_it(bus):
            bus.start("engine", 'wait("5ms"); send("Engine", #{ Speed: 1000 });')
            assert bus.expect("Engine", within="10ms", where=lambda m: m["Speed"] > 900)["Speed"] == 1000
            bus.start("driver", 'on_message("Engine", |m| log(m.Speed));')
            bus.wait("1ms")
            bus.send("Engine", {"Speed": 2000})
            bus.wait("1ms")
            assert [text for _, _, text in bus.log] == ["2000"]
        """
    )
    pytester.runpytest_inprocess("--strict-markers").assert_outcomes(passed=1)


def test_simulated_time_is_exact_and_passes_only_while_a_test_waits():
    def run():
        with Bus() as bus:
            bus.start("clock", 'every("10ms", || send("100#"));')
            assert bus.now == 0
            times = [bus.expect("100", within="20ms").time for _ in range(100)]
            bus.wait(10)
            assert bus.now == pytest.approx(times[-1] + 10, abs=1e-9)
            return times

    times = run()
    assert times == run()
    assert all(abs(later - earlier - 0.01) < 1e-9 for earlier, later in zip(times, times[1:]))
    with Bus() as bus:
        bus.send("123#01")
        with pytest.raises(AssertionError, match="no frame 123 within 20ms"):
            bus.expect("123", within="20ms")
        repeated = bus.periodic("200#01", "10ms")
        bus.start("listener", 'on_frame("200", |f| log(f.data[0]));')
        bus.wait("25ms")
        repeated.update("200#02")
        bus.wait("20ms")
        repeated.stop()
        bus.wait("100ms")
        said = [text for _, _, text in bus.log]
        assert said[0] == "1" and said[-1] == "2" and 4 <= len(said) <= 6, said


def test_what_is_wrong_is_said():
    assert {name for name, _ in ready_nodes()} >= {"obd", "engine", "drive", "valves", "boat"}
    with Bus() as bus:
        with pytest.raises(ValueError, match="there is no ready node"):
            bus.start("boot")
        with pytest.raises(ValueError, match="write a time as a number and a unit"):
            bus.wait("soon")
        with pytest.raises(ValueError, match="no database"):
            bus.send("Engine")
        with pytest.raises(ValueError, match="neither an identifier"):
            bus.expect("Engine", within=1)
        with pytest.raises(ValueError, match="there is no channel"):
            bus.send("123#", channel=3)
        bus.start("obd", vin="SHORT")
        bus.wait("1ms")
        assert "the vin SHORT has 5 characters" in bus.errors[0][1]
    with pytest.raises(cantap.DeviceError, match="closed"):
        bus.send("123#")
