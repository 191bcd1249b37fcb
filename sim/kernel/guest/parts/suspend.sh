#!/bin/sh
# shellcheck shell=dash
# Suspension, with the port closed and open.

has_port || attach
DEVICE=$(device)
board traffic 50 mix

is_suspended() { [ "$(cat "$DEVICE/power/runtime_status")" = suspended ]; }
is_active() { [ "$(cat "$DEVICE/power/runtime_status")" = active ]; }

echo 0 > "$DEVICE/power/autosuspend_delay_ms"
echo auto > "$DEVICE/power/control"
check "the kernel suspends it while its port is closed" wait_until is_suspended
# The kernel's virtual controller tells its far end nothing of this.
board suspend
sleep 0.2
capture_is_exact "a capture wakes it"

# A driver whose port is open keeps the device awake, as long as nobody can wake it remotely.
stream -t 3
check "an open port keeps it awake" is_active
wait "$CAPTURE"
exact "a capture with autosuspend switched on"
echo on > "$DEVICE/power/control"

stream
board suspend
sleep 1
board resume
check "a client whose bus was suspended says so and goes on" survived
capture_is_exact "a capture after it"
