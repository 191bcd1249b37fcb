"""python-can's own tests, unchanged, on the analyser. They are fetched, not copied: `cargo xtask ci --only python` does that."""

import os
import pathlib
import re
import subprocess
import sys

import pytest

SOURCE = os.environ.get("CANTAP_PYTHON_CAN_SOURCE")

# Each file, the part of it that applies to any interface, and the least number of tests that pass. In the first two,
# python-can leaves out one test that measures time if the variable `CI` is set.
TESTS = [
    ("back2back_test.py", "Back2BackTestCase", 11),
    # `restart` and `thread_based` are about the class of python-can's threads.
    ("simplecyclic_test.py", "not restart and not thread_based", 4),
    ("notifier_test.py", "", 5),
    ("test_message_filtering.py", "", 3),
    ("contextmanager_test.py", "", 2),
]


@pytest.mark.skipif(SOURCE is None, reason="CANTAP_PYTHON_CAN_SOURCE names no sources of python-can")
@pytest.mark.parametrize("channels", ["two channels", "one channel"])
@pytest.mark.parametrize(("file", "chosen", "least"), TESTS)
def test_python_cans_own(file, chosen, least, channels):
    here = pathlib.Path(__file__).parent / "python_can"
    path = os.pathsep.join([str(here), *filter(None, [os.environ.get("PYTHONPATH")])])
    result = subprocess.run(
        [sys.executable, "-P", "-m", "pytest", "-p", "cantap_harness", "-p", "no:cacheprovider", "-q",
         "-c", os.devnull, "--rootdir", SOURCE, f"{SOURCE}/test/{file}", "-k", chosen],
        capture_output=True,
        text=True,
        cwd=SOURCE,
        env={**os.environ, "PYTHONPATH": path, "CANTAP_ON": channels},
        timeout=120,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    passed = re.search(r"(\d+) passed", result.stdout)
    assert passed and int(passed[1]) >= least, result.stdout
