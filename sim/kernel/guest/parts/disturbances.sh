#!/bin/sh
# shellcheck shell=dash
# Anything that may happen to a client, the driver or the cable in mid-stream: the client reports it and continues when the device is back,
# and the next capture is exact.

has_port || attach
DEVICE=$(device)
ID=$(device_id)
INTERFACE=$(basename "$DEVICE"):1.0
board traffic 100 mix

# after_a_while TENTHS: sleeps for 0.3 s and up to this many tenths more.
after_a_while() { sleep "$(awk -v n="$(random "$1")" 'BEGIN { print 0.3 + n / 10 }')"; }

_bad=0
for _ in 1 2 3 4 5 6; do
  start -t 60
  after_a_while 15
  kill -9 "$CAPTURE"
  wait "$CAPTURE" 2> /dev/null
  info || _bad=1
done
verdict $_bad "the device works after each of 6 clients that were killed in mid-stream"
capture_is_exact "a capture after killed clients"

stream -t 60
echo "$INTERFACE" > /sys/bus/usb/drivers/cdc_acm/unbind
echo "$INTERFACE" > /sys/bus/usb/drivers/cdc_acm/bind
wait_until has_port
check "a client whose driver was unbound goes on" survived
capture_is_exact "a capture after unbind and bind"

stream -t 60
echo 0 > "$DEVICE/authorized"
echo 1 > "$DEVICE/authorized"
wait_until has_port
check "a client whose device was deauthorized goes on" survived
capture_is_exact "a capture after the device was deauthorized"

_bad=0
for _ in 1 2 3 4 5; do usbreset "$ID" > /dev/null || _bad=1; done
verdict $_bad "5 resets of the port"
capture_is_exact "a capture after resets"
stream -t 60
usbreset "$ID" > /dev/null
wait_until has_port
check "a client whose device was reset goes on" survived
capture_is_exact "a capture after a reset in mid-stream"

stty -F "$PORT" sane
timeout 1 cat "$PORT" > /dev/null &
_cat=$!
printf 'AT\r\nATI\r\n~~~\000\377' > "$PORT"
wait "$_cat"
capture_is_exact "a capture after a terminal that echoes, and AT"

stream -t 6
for _ in 1 2 3 4 5; do
  sleep 1
  board halt 82
done
wait "$CAPTURE"
_repeated=$(figure repeated)
counted "bulk IN is halted 5 times in mid-stream, and every frame is told or its loss"
[ "$_repeated" = 0 ]
verdict $? "a halted endpoint begins again with DATA0" "$_repeated packets dropped by their toggle"

"$CANTAP" reset -d "$PORT" > /dev/null
wait_until has_no_port
attach
check "the device works after its own restart" info

# away_and_back COMMAND...: takes the device away at some point of a client's life, and gives it back. A client that had not begun yet ends
# with 1; another has everything up to some point and from another on, and says that there was a gap. One that a busy computer had not let
# open the port yet would know of nothing.
away_and_back() {
  board mark
  start -t 600
  wait_until holds_port
  after_a_while 12
  if ! { "$@" && wait_until has_no_port && attach && wait_until has_outcome; }; then
    # It would keep the port from all that follow.
    echo "no outcome: $(grep State "/proc/$CAPTURE/status"), waits in: $(cat "/proc/$CAPTURE"/task/*/wchan)"
    kill -9 "$CAPTURE"
    wait "$CAPTURE" 2> /dev/null
    cat capture.err
    return 1
  fi
  if is_capturing; then survived && gap_is_told; else had_not_begun; fi && info
}
holds_port() { ! is_capturing || ls -l "/proc/$CAPTURE/fd" 2> /dev/null | grep -q ttyACM; }
had_not_begun() {
  ended 1 && return
  cat capture.err capture.json
  return 1
}
has_outcome() { ! is_capturing || has_told "the device is back after"; }

# Eight random bytes: a frame that is missing cannot be taken for another.
board traffic 50 ext8
_bad=0
for _ in $(seq 6); do away_and_back detach || _bad=$((_bad + 1)); done
verdict $_bad "6 detachments at random times: each client continues when the device is back, and only the gap is missing" "$_bad do not"
capture_is_exact "a capture after detachments"

_bad=0
for _ in 1 2 3; do away_and_back board unplug || _bad=$((_bad + 1)); done
verdict $_bad "the cable is pulled 3 times: each client continues when the device is back, and only the gap is missing" "$_bad do not"
capture_is_exact "a capture after pulled cables"
