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

# The number of packets before decides which toggle is next, so it is tried until either direction would have gone on with DATA1 twice. A
# packet with the wrong toggle is dropped, by the device (thrown away) or by the host (repeated), and both are counted: how many packets there
# were does not matter, which depends on how busy this computer is.
_bad=0
_seen=
_in=0
_out=0
# A packet to the device and one back.
one_packet() { (printf 'V\r' && sleep 0.3) > "$PORT"; }
for _attempt in 1 2 3 4 5 6 7 8 9 10 11 12; do
  [ $_in -ge 2 ] && [ $_out -ge 2 ] && break
  [ $((_attempt % 3)) = 0 ] || info
  stty -F "$PORT" raw -echo
  one_packet
  # shellcheck disable=SC2046 # two words
  set -- $(both next_data1)
  _in=$((_in + $1))
  _out=$((_out + $2))
  configured_anew
  board mark
  info || _bad=1
  _dropped="$(figure thrown_away)/$(figure repeated)"
  _seen="$_seen $1$2:$_dropped"
  [ "$_dropped" = 0/0 ] && [ "$(figure out_packets)" -gt 0 ] || _bad=1
done
[ $_in -ge 2 ] && [ $_out -ge 2 ] || _bad=1
verdict $_bad "a new configuration begins with DATA0" "DATA1 in/out was next:packets dropped by device/host:$_seen"

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
