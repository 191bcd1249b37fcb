#!/bin/sh
# shellcheck shell=dash
# slcan with K1 (docs/slcan.md): losses, errors and states reach the interface's counters.

has_port || attach
counter() { cat "/sys/class/net/can0/statistics/$1"; }
is_in_state() { iproute2 -details link show can0 | grep -q "state $1"; }

board traffic 0 mix
ldattach -c "$(printf 'K1\r')" 17 "$PORT"
wait_until has_interface can0
iproute2 link set can0 type can bitrate 1000000 && ip link set can0 up
sleep 0.5
board mark
board play 1 50 mix 300
settled
[ "$(counter rx_packets)" = 300 ] && [ "$(counter rx_errors)" = 0 ] && [ "$(counter rx_over_errors)" = 0 ]
verdict $? "slcan's reports: none on a bus without faults" "$(counter rx_packets) frames, $(counter rx_errors) errors"

board noise 30
board play 1 50 mix 300
settled
board noise 0
[ "$(counter rx_errors)" -gt 0 ] && [ "$(counter rx_over_errors)" = 0 ]
verdict $? "slcan's reports: bus errors reach the interface's counters" "$(counter rx_errors) errors"

# A frame that nobody acknowledges makes the sender error passive (ISO 11898-1, fault confinement), and it stays
# that way.
board acknowledge no
cansend can0 123#11
check "slcan's reports: a frame that nobody acknowledges makes the interface error passive" wait_until is_in_state ERROR-PASSIVE
[ "$(counter tx_errors)" -gt 0 ]
verdict $? "slcan's reports: acknowledgement errors reach the interface's counters" "$(counter tx_errors) errors"
board acknowledge yes
cangen -g 5 -n 60 -I 124 -L 0 -p 10 can0
check "slcan's reports: error active again when frames are acknowledged" wait_until is_in_state ERROR-ACTIVE

# A host that fetches a packet every 4 ms cannot keep up with a full bus; the queue holds about a second of it.
_errors=$(counter rx_errors)
_packets=$(counter rx_packets)
board pace real
board hub 32
board mark
board play 1 100 ext8 8000
played() { [ "$(figure taken)" -ge "$_until" ] || [ "$(figure emulated_s | cut -d. -f1)" -ge 3 ]; }
_until=8000
wait_until played || wait_until played || wait_until played || wait_until played
board hub 0
settled
board pace client
_heard=$(($(counter rx_packets) - _packets))
[ $_heard -lt 8000 ] && [ "$(counter rx_over_errors)" -gt 0 ]
verdict $? "slcan's reports: losses reach the interface's counters" "$_heard of 8000 frames, $(counter rx_over_errors) gaps, $(($(counter rx_errors) - _errors)) errors"
iproute2 -details -statistics link show can0
ip link set can0 down
killall ldattach
sleep 1

# slcand sends no `K1`; the saved setting applies.
board traffic 0 mix
saves() {
  stty -F "$PORT" raw -echo && (
    printf '%b' "$1"
    sleep 2
  ) > "$PORT"
}
slcand_has_errors() {
  slcand -o -s8 -S 3000000 "${PORT#/dev/}" slcan0
  wait_until has_interface slcan0 && ip link set slcan0 up
  sleep 0.5
  board noise 30
  board play 1 50 mix 300
  settled
  board noise 0
  _errors=$(cat /sys/class/net/slcan0/statistics/rx_errors)
  killall slcand
  sleep 1
  [ "$_errors" -gt 0 ]
}
saves 'K1\rQ1\r'
check "slcan's reports: slcand has them when K1 was saved" slcand_has_errors
saves 'Q0\r'
has_no_errors() { ! slcand_has_errors; }
check "slcan's reports: and none when it was not" has_no_errors
board traffic 50 mix
capture_is_exact "a capture after slcan's reports"
