"""Runs `cantap monitor` in tmux at full load on both channels and measures how responsive it is.

    cargo xtask bench monitor [--seconds N]

Redraws per second, time from a key to its page, processor time per thread, memory every ten seconds. Keys go in through
`tmux send-keys` and pages come out through `tmux pipe-pane`, so that starting tmux's client counts, too. Then it counts the
frames recorded: at 100 % load of these frames the bus carries 20 833.3 per second and channel.
"""
import json
import math
import os
import re
import select
import subprocess
import sys
import tempfile
import time

ROWS, COLUMNS = 50, 160
WARM_UP_S = 8
# Pages one after another, each different from the previous one.
KEYS = "12534"
# The mark at the current page's tab: the first output that contains it is the response to a key.
MARK = "▸".encode()
# Each redraw is wrapped in these (synchronized output).
REDRAW = b"\x1b[?2026h"
DEVICE = "virtual:load=100,frames=std0"


def main():
    binary, seconds = os.path.abspath(sys.argv[1]), float(sys.argv[2])
    with tempfile.TemporaryDirectory() as folder:
        recording = os.path.join(folder, "recording.blf")
        view = View(binary, folder, recording)
        try:
            view.measure(seconds)
        finally:
            view.tmux("kill-server")
        said = subprocess.run([binary, "stats", recording, "-b", "1M", "--json"], capture_output=True, check=True)
        for channel in json.loads(said.stdout)["channels"]:
            print(
                f"recorded on channel {channel['channel']}: {channel['frames']} frames, "
                f"{channel['frames_per_s']:.1f} frames/s, {channel['bus_load_pct']:.3f} %, lost {channel['lost']['total']}"
            )


class View:
    def __init__(self, binary, folder, recording):
        self.socket, pipe = os.path.join(folder, "tmux"), os.path.join(folder, "pane")
        os.mkfifo(pipe)
        line = f"exec {binary} monitor -d {DEVICE} -b 1M --view trace -o {recording}"
        self.tmux("-f", "/dev/null", "new-session", "-d", "-x", str(COLUMNS), "-y", str(ROWS), line, LC_ALL="C.UTF-8")
        self.tmux("set", "-g", "status", "off")
        # Held open, so that it does not end when nobody writes.
        self.output = os.open(pipe, os.O_RDWR | os.O_NONBLOCK)
        self.tmux("pipe-pane", f"exec cat > {pipe}")
        self.pid = int(self.tmux("display", "-p", "#{pane_pid}"))
        self.server = int(self.tmux("display", "-p", "#{pid}"))
        self.redraws = 0

    def tmux(self, *arguments, **environment):
        line = ["tmux", "-u", "-S", self.socket, *arguments]
        done = subprocess.run(line, capture_output=True, check=True, env={**os.environ, **environment})
        return done.stdout.decode()

    def read_until(self, end, wanted=None):
        """Reads until `end`, or until `wanted` arrives; in that case returns when it did."""
        seen = b""
        while (now := time.time()) < end:
            ready, _, _ = select.select([self.output], [], [], min(0.02, end - now))
            if not ready:
                continue
            before = len(seen)
            seen += os.read(self.output, 65536)
            now = time.time()
            self.redraws += seen.count(REDRAW, max(0, before - len(REDRAW) + 1))
            if wanted and wanted in seen:
                return now
        return None

    @staticmethod
    def processor_s(pid):
        """Processor time by thread, in seconds; the process's own thread draws."""
        tick = os.sysconf("SC_CLK_TCK")
        times = {}
        for thread in os.listdir(f"/proc/{pid}/task"):
            with open(f"/proc/{pid}/task/{thread}/stat") as file:
                name, _, fields = file.read().partition("(")[2].rpartition(")")
            fields = fields.split()
            name = "display" if int(thread) == pid else name
            times[name] = times.get(name, 0) + (int(fields[11]) + int(fields[12])) / tick
        return times

    def all_s(self):
        return {**self.processor_s(self.pid), "tmux": sum(self.processor_s(self.server).values())}

    def memory_mb(self):
        with open(f"/proc/{self.pid}/status") as file:
            return int(re.search(r"VmRSS:\s+(\d+)", file.read()).group(1)) / 1024

    def measure(self, seconds):
        self.read_until(time.time() + WARM_UP_S)
        before, start, redraws = self.all_s(), time.time(), self.redraws
        memory, answers = [self.memory_mb()], []
        second = 0
        while time.time() - start < seconds:
            second += 1
            self.read_until(min(start + second, start + seconds))
            sent = time.time()
            self.tmux("send-keys", KEYS[second % len(KEYS)])
            came = self.read_until(sent + 0.5, MARK)
            answers.append((came - sent) * 1000 if came else math.inf)
            if second % 10 == 0:
                memory.append(self.memory_mb())
        took, after = time.time() - start, self.all_s()
        answers.sort()
        print(f"{took:.0f} s in tmux, {COLUMNS} x {ROWS}; {(self.redraws - redraws) / took:.1f} redraws/s")
        for name, used in sorted(after.items()):
            print(f"{name:16} {100 * (used - before.get(name, 0)) / took:5.1f} % of a core")
        middle, late = answers[len(answers) // 2], answers[int(len(answers) * 0.95)]
        print(f"{len(answers)} keys, ms: median {middle:.1f}, 95 % within {late:.1f}, longest {answers[-1]:.1f}")
        print("memory, MB, every 10 s:", " ".join(f"{size:.1f}" for size in memory))
        self.tmux("send-keys", "5")
        self.read_until(time.time() + 0.5)
        print("the page of statistics then:\n" + self.tmux("capture-pane", "-p").rstrip())
        # The end of the pane must not end the server before the recording is complete.
        self.tmux("set", "-g", "remain-on-exit", "on")
        self.tmux("send-keys", "q")
        while os.path.exists(f"/proc/{self.pid}") and self.tmux("display", "-p", "#{pane_dead}").strip() != "1":
            self.read_until(time.time() + 0.2)


main()
