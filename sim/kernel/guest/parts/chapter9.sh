#!/bin/sh
# shellcheck shell=dash
# Chapter 9 of USB 2.0: what hosts seldom do and devices must be able to do.

has_port || attach
DEVICE=$(device)
ID=$(device_id)
board traffic 50 mix

configured_anew() {
  echo 0 > "$DEVICE/bConfigurationValue"
  echo 1 > "$DEVICE/bConfigurationValue"
  wait_until has_port
}

# The number of packets sent before decides which toggle is next, so several numbers are tried. `info` sends 12 when none is lost.
_bad=0
_seen=
for _i in 1 2 3 4; do
  info
  [ $((_i % 2)) = 0 ] || "$CANTAP" status -d "$PORT" > /dev/null
  configured_anew
  board mark
  info
  _out=$(figure out_packets)
  _repeated=$(figure repeated)
  _seen="$_seen $_out/$_repeated"
  [ "$_out" = 12 ] && [ "$_repeated" = 0 ] || _bad=1
done
verdict $_bad "a new configuration begins with DATA0" "packets out/dropped by their toggle:$_seen"

board halt 01
info > /dev/null
configured_anew
info
_bad=$?
verdict $_bad "a new configuration ends a halt"
if [ $_bad != 0 ]; then
  usbreset "$ID" > /dev/null
  wait_until has_port
fi
capture_is_exact "a capture after new configurations"

check "requests that no driver makes" perl /share/guest/odd_requests.pl "$(printf '/dev/bus/usb/%03d/%03d' "$(cat "$DEVICE/busnum")" "$(cat "$DEVICE/devnum")")"
capture_is_exact "a capture after odd requests"
