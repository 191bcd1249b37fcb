"""Runs `cantap monitor` in a pseudo-terminal at full load on both channels and measures what a user feels.

    python3 xtask/src/bench/live_view.py target/release/cantap [SECONDS]

Redraws per second, time from a key to its page, processor time per thread, memory every ten seconds. Then it
counts the recording: at 100 % load of these frames the bus carries 20 833.3 per second and channel.
"""
import fcntl
import json
import math
import os
import pty
import re
import select
import struct
import subprocess
import sys
import tempfile
import termios
import time

ROWS, COLUMNS = 50, 160
WARM_UP_S = 8
# Pages one after the other, each another than the one before.
KEYS = "12534"
# The mark at the shown page's tab: the first output that has it is the answer to a key.
MARK = "▸".encode()


def main():
    binary = os.path.abspath(sys.argv[1])
    seconds = float(sys.argv[2]) if len(sys.argv) > 2 else 600
    with tempfile.TemporaryDirectory() as folder:
        recording = os.path.join(folder, "recording.blf")
        View(binary, recording).measure(seconds)
        said = subprocess.run([binary, "stats", recording, "-b", "1M", "--json"], capture_output=True, check=True)
        for channel in json.loads(said.stdout)["channels"]:
            print(
                f"recorded on channel {channel['channel']}: {channel['frames']} frames, "
                f"{channel['frames_per_s']:.1f} frames/s, {channel['bus_load_pct']:.3f} %, lost {channel['lost']['total']}"
            )


class View:
    def __init__(self, binary, recording):
        self.pid, self.terminal = pty.fork()
        if self.pid == 0:
            os.environ.update(TERM="xterm-256color", LC_ALL="C.UTF-8")
            device = ["-d", "virtual:load=100,frames=std0", "-b", "1M", "--view", "trace"]
            os.execv(binary, [binary, "monitor", *device, "-o", recording])
        fcntl.ioctl(self.terminal, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        self.redraws = 0
        self.last_output = 0.0

    def read_until(self, end, wanted=None):
        """Reads until that time, or until `wanted` comes; then returns when it came."""
        seen = b""
        while (now := time.time()) < end:
            ready, _, _ = select.select([self.terminal], [], [], min(0.02, end - now))
            if not ready:
                continue
            seen += os.read(self.terminal, 65536)
            now = time.time()
            # Output without a pause in it is one redraw.
            self.redraws += now - self.last_output > 0.015
            self.last_output = now
            if wanted and wanted in seen:
                return now
        return None

    def processor_s(self):
        """Processor time by thread, in seconds; the process's own thread draws."""
        tick = os.sysconf("SC_CLK_TCK")
        times = {}
        for thread in os.listdir(f"/proc/{self.pid}/task"):
            with open(f"/proc/{self.pid}/task/{thread}/stat") as file:
                name, _, fields = file.read().partition("(")[2].rpartition(")")
            fields = fields.split()
            name = "display" if int(thread) == self.pid else name
            times[name] = times.get(name, 0) + (int(fields[11]) + int(fields[12])) / tick
        return times

    def memory_mb(self):
        with open(f"/proc/{self.pid}/status") as file:
            return int(re.search(r"VmRSS:\s+(\d+)", file.read()).group(1)) / 1024

    def measure(self, seconds):
        self.read_until(time.time() + WARM_UP_S)
        before, start, redraws = self.processor_s(), time.time(), self.redraws
        memory, answers = [self.memory_mb()], []
        second = 0
        while time.time() - start < seconds:
            second += 1
            self.read_until(min(start + second, start + seconds))
            sent = time.time()
            os.write(self.terminal, KEYS[second % len(KEYS)].encode())
            came = self.read_until(sent + 0.5, MARK)
            answers.append((came - sent) * 1000 if came else math.inf)
            if second % 10 == 0:
                memory.append(self.memory_mb())
        took, after = time.time() - start, self.processor_s()
        answers.sort()
        print(f"{took:.0f} s, {(self.redraws - redraws) / took:.1f} redraws/s")
        for name, used in sorted(after.items()):
            print(f"{name:16} {100 * (used - before.get(name, 0)) / took:5.1f} % of a core")
        middle, late = answers[len(answers) // 2], answers[int(len(answers) * 0.95)]
        print(f"{len(answers)} keys, ms: median {middle:.1f}, 95 % within {late:.1f}, longest {answers[-1]:.1f}")
        print("memory, MB, every 10 s:", " ".join(f"{size:.1f}" for size in memory))
        os.write(self.terminal, b"q")
        try:
            self.read_until(time.time() + 10, b"never")
        except OSError:
            pass  # The view has closed the terminal.
        os.waitpid(self.pid, 0)


main()
