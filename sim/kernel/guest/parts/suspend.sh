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
# The kernel's virtual controller does not tell its far end about this.
board suspend
sleep 0.2
capture_is_exact "a capture wakes it"

# A driver keeps the device awake while its port is open, as long as the device cannot wake the
# host.
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
