"""Reads a trace with python-can, writes it to a second file if one is named, and prints how many messages and seconds
that took."""

import sys
import time

import can

begin = time.perf_counter()
messages = 0
with can.LogReader(sys.argv[1]) as reader:
    if len(sys.argv) > 2:
        with can.Logger(sys.argv[2]) as writer:
            for message in reader:
                writer(message)
                messages += 1
    else:
        for message in reader:
            messages += 1
print(messages, time.perf_counter() - begin)
