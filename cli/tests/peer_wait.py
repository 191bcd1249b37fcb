"""How the peers wait for what a busy computer may bring late."""

import time


def wait_until(condition):
    """Whether it holds within half a minute, which only a hang reaches."""
    until = time.monotonic() + 30
    while not condition() and time.monotonic() < until:
        time.sleep(0.02)
    return condition()
