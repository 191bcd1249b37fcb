#!/bin/sh
# shellcheck shell=dash
# Behind a high-speed hub, with hosts that leave at least 250 us from one packet to the next: 0.26 MB/s, and half of that.

has_port || attach
board pace real

for _microframes in 2 4; do
  board hub $_microframes
  board traffic 100 std0
  board mark
  start -t 4
  wait "$CAPTURE"
  counted "behind a hub, $_microframes microframes to a packet: 100 %, shortest frames"
  figures
done
board hub 0
board pace client
board traffic 50 mix
capture_is_exact "a capture after the hub"
