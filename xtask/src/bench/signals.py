"""Decodes frames with cantools as often as asked, and prints how many signals and seconds that took."""

import sys
import time

import cantools

database = cantools.database.load_file(sys.argv[1])
with open(sys.argv[2]) as file:
    frames = [(int(line[:8], 16), bytes.fromhex(line[9:])) for line in file]
decode = database.decode_message
signals = 0
begin = time.perf_counter()
for _ in range(int(sys.argv[3])):
    for identifier, data in frames:
        signals += len(decode(identifier, data))
print(signals, time.perf_counter() - begin)
