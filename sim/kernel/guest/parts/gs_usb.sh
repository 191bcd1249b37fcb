#!/bin/sh
# shellcheck shell=dash
# A gs_usb adapter with two channels on one bus: behind the kernel's own driver, as can0 and can1; and without it, by USB alone. The adapter is
# a stand-in (gs_usb.pl); the kernel's driver is what shows that it is a gs_usb adapter.

GS=/work/gs
GS_PORT=3241
mkdir -p $GS
modprobe -a gs_usb can-raw

gs_attach() {
  rm -f $GS/listening
  perl /share/guest/gs_usb.pl $GS_PORT $GS 2> gs.err &
  GS_SERVER=$!
  wait_until test -e $GS/listening
  usbip --tcp-port $GS_PORT attach -r 127.0.0.1 -b 1-1 > attach.log 2>&1 && wait_until has_gs
}
has_gs() { grep -q 606f /sys/bus/usb/devices/*/idProduct 2> /dev/null; }
has_no_gs() { ! has_gs; }
# gs_start OPTION...: a capture in the background, as $CAPTURE; returns once it receives.
gs_start() {
  rm -f capture.log capture.json
  "$CANTAP" capture -o capture.log --json "$@" > capture.json 2> capture.err &
  CAPTURE=$!
}
gs_end() {
  kill -INT "$CAPTURE"
  ended 0 || { cat capture.json capture.err; return 1; }
}
# The frames of a log on an interface, without errors.
frames_on() { awk -v name="$1" '$2 == name { print $3 }' "$2" | grep -v '^2[0-9A-F]\{7\}#'; }
is_started() { [ "$(grep -c "^2 $1 01000000" $GS/requests)" -ge "$2" ]; }
can_is_up() {
  # shellcheck disable=SC2086 # words
  ip link set $1 down
  iproute2 link set "$1" type can bitrate 500000 listen-only "$2" && ip link set "$1" up
}
receives() { [ "$(grep -c "^ *$1 .* raw *$" /proc/net/can/rcvlist_all)" -ge "$2" ]; }

gs_attach || { cat attach.log gs.err; false; }
verdict $? "gs_usb: the adapter is attached"
wait_until has_interface can1
check "gs_usb: the kernel's driver takes the stand-in for what it is" has_interface can1

# The command sets it up, where it is asked to: not without rights, not while somebody receives, and as it was if a step fails.
chmod 755 "$CANTAP"
is_set() { iproute2 -details link show can0 > link.txt && grep -q "<.*[<,]UP[,>]" link.txt && grep -q "bitrate $1 sample-point $2" link.txt; }
/usr/bin/setpriv --reuid 1000 --clear-groups "$CANTAP" interface can0 -b 500k > set.txt 2>&1
[ $? = 1 ] && grep -q "As root: ip link set can0 up type can bitrate 500000 listen-only on;.*setcap cap_net_admin=ep $CANTAP" set.txt && ! is_set 500000 0
verdict $? "interface: without rights it says the lines for root, and nothing is changed" "$(head -n 1 set.txt)"
"$CANTAP" interface can0 -b 500k > set.txt 2>&1 && is_set 500000 0 && grep -q LISTEN-ONLY link.txt
verdict $? "interface: bit rate, listening only, and up" "$(sed -n 's/^ *bitrate/bitrate/p' link.txt)"
"$CANTAP" interface can0 -b 500k > set.txt 2>&1 && grep -q "was so already" set.txt
verdict $? "interface: one that is so is left alone" "$(head -n 1 set.txt)"
"$CANTAP" interface can0 -b 250k --mode normal --sample-point 75 --json > set.json 2> set.txt && is_set 250000 0.75 &&
  ! grep -q LISTEN-ONLY link.txt && grep -q '"bitrate_bps":250000' set.json && grep -q '"mode":"normal"' set.json
verdict $? "interface: another bit rate, mode and sample point" "$(cat set.json set.txt)"
cp link.txt before.txt
"$CANTAP" interface can0 -b 777777 > set.txt 2>&1
[ $? = 1 ] && grep -q "777777 bit/s as [0-9]*, which is too far off.*can0 runs as before" set.txt && is_set 250000 0.75 && cmp -s before.txt link.txt
verdict $? "interface: a bit rate that the clock does not reach leaves it as it was" "$(head -n 1 set.txt)"
"$CANTAP" interface can0 -b 500k --data-bitrate 2M > set.txt 2>&1
[ $? = 1 ] && grep -q "leave out what its driver or controller does not have. can0 runs as before" set.txt && is_set 250000 0.75 && cmp -s before.txt link.txt
verdict $? "interface: CAN FD on a controller without it leaves it as it was" "$(head -n 1 set.txt)"
# Its driver has no restart either.
"$CANTAP" interface can0 -b 250k --mode normal --sample-point 75 --recovery 100ms > set.txt 2>&1
[ $? = 1 ] && grep -q "restarted 100 ms after bus-off .*can0 runs as before" set.txt && is_set 250000 0.75 && cmp -s before.txt link.txt
verdict $? "interface: a restart that its driver does not have leaves it as it was" "$(head -n 1 set.txt)"
candump -L can0 > dump.txt 2> /dev/null &
CANDUMP=$!
wait_until receives can0 1
"$CANTAP" interface can0 -b 500k > set.txt 2>&1
[ $? = 1 ] && grep -q "programs receive from 'can0' (raw)" set.txt && is_set 250000 0.75 && kill -0 $CANDUMP
verdict $? "interface: one that somebody receives from is not taken from them" "$(head -n 1 set.txt)"
"$CANTAP" interface can0 -b 500k --yes > set.txt 2>&1 && is_set 500000 0
verdict $? "interface: but with --yes" "$(cat set.txt | tr '\n' ' ')"
kill $CANDUMP 2> /dev/null
wait $CANDUMP 2> /dev/null
"$CANTAP" interface can0 --restart > set.txt 2>&1
[ $? = 1 ] && grep -q "can0' is not to be restarted" set.txt
verdict $? "interface: what is not off its bus is not restarted" "$(head -n 1 set.txt)"
"$CANTAP" interface can0 --down > set.txt 2>&1 && grep -q "^up  *no" set.txt && ! is_set 500000 0
verdict $? "interface: it is taken down"
iproute2 link add vcan9 type vcan
"$CANTAP" interface vcan9 -b 500k > set.txt 2>&1
[ $? = 1 ] && grep -q "'vcan9' is virtual (vcan): it has no bit rate" set.txt
verdict $? "interface: a virtual one has no bit rate, and says so" "$(head -n 1 set.txt)"
iproute2 link del vcan9

can_is_up can0 off && can_is_up can1 off
verdict $? "gs_usb, kernel: both channels are up"
"$CANTAP" info -d can0 > info.txt 2>&1
grep -q "controller's hardware clock" info.txt && grep -q "accepted by the adapter" info.txt && grep -q "acknowledges frames while it is up" info.txt
verdict $? "gs_usb, kernel: hardware stamps, that an echo proves nothing, and the mode are in the row"

gs_start -d can0
wait_until captures can0
candump -L -r 8000000 can0 > dump.txt &
CANDUMP=$!
wait_until receives can0 2
cangen -g 1 -p 100 -n 500 -e -L r -D r can1
echo 2000 > $GS/traffic
echo '00000088 0000040000000000' > $GS/error
sent() { cat $GS/sent 2> /dev/null | wc -l; }
captured() { { frames_on can0 capture.log; frames_on can1 capture.log; } | wc -l; }
dumped() { frames_on can0 dump.txt | wc -l; }
of_can0() { frames_on can0 capture.log | wc -l; }
until_all 2500 dumped
until_all 2500 of_can0
check "gs_usb, kernel: the capture ends" gs_end
kill $CANDUMP
wait $CANDUMP 2> /dev/null
frames_on can0 capture.log > got1
frames_on can0 dump.txt | cmp -s - got1 && [ "$(wc -l < got1)" = 2500 ]
verdict $? "gs_usb, kernel: each frame that candump has, in order" "$(wc -l < got1) frames, $(frames_on can0 dump.txt | wc -l) in candump"
[ "$(grep -c ' 20000[02]88#000004' capture.log)" = 1 ]
verdict $? "gs_usb, kernel: a stuff error is one"
# shellcheck disable=SC2046 # two words
set -- $(of_channel 1)
[ "$2" = 0 ]
verdict $? "gs_usb, kernel: no losses" "$2"
[ "$2" = 0 ] || cat capture.json capture.err

candump -L can1 > dump.txt &
CANDUMP=$!
wait_until receives can1 1
timeout 60 "$CANTAP" send -d can0 1 123#0102 1ABCDEF0#R > send.txt 2>&1
_code=$?
sleep 0.5
kill $CANDUMP
wait $CANDUMP 2> /dev/null
[ $_code = 0 ] && [ "$(awk '{ print $3 }' dump.txt | sed 's/#R.*/#R/' | tr '\n' ' ')" = "123#0102 1ABCDEF0#R " ]
verdict $? "gs_usb, kernel: frames sent are confirmed by the echo, and were on the bus" "$(tail -n 1 send.txt)"

# Nobody acknowledges: there is no confirmation.
can_is_up can1 on
timeout 60 "$CANTAP" send -d can0 1 123#03 > send.txt 2>&1
[ $? != 0 ]
verdict $? "gs_usb, kernel: a frame that nobody acknowledges is not confirmed" "$(tail -n 1 send.txt)"
"$CANTAP" info -d can1 > info.txt 2>&1
grep -q "yes: the interface acknowledges nothing" info.txt && grep -q "nothing can be sent" info.txt
verdict $? "gs_usb, kernel: an interface that only listens is said to"
timeout 60 "$CANTAP" send -d can1 1 123#04 > send.txt 2>&1
[ $? != 0 ]
verdict $? "gs_usb, kernel: on an interface that only listens nothing is sent" "$(tail -n 1 send.txt)"

# Pulled out behind the kernel's driver, plugged in again, and set up by the command: the capture goes on.
can_is_up can1 off
gs_start -d can0
wait_until captures can0
cansend can1 001#
is_in_capture() { grep -q " $1" capture.log; }
wait_until is_in_capture 001#
kill $GS_SERVER
wait_until has_told "can0 is gone"
verdict $? "gs_usb, kernel: a pulled adapter is reported, with what to do" "$(grep 'is gone' capture.err | head -n 1)"
wait_until has_no_gs
gs_attach && wait_until has_interface can1
"$CANTAP" interface can1 -b 500k --mode normal > set.txt 2>&1 && "$CANTAP" interface can0 -b 500k --mode normal >> set.txt 2>&1
verdict $? "gs_usb, kernel: it is back, and set up again"
wait_until has_told "the device is back after" && wait_until captures can0 && cansend can1 002# && wait_until is_in_capture 002# && gs_end &&
  grep -q '"gaps":{"count":1,' capture.json
verdict $? "gs_usb, kernel: the capture continues, and has the gap" "$(frames_on can0 capture.log | tr '\n' ' ')"

# Without the kernel's driver.
"$CANTAP" info -d gs_usb: > info.txt 2>&1
[ $? != 0 ] && grep -q "rmmod gs_usb" info.txt
verdict $? "gs_usb: while the kernel's driver has it, the message says what to do" "$(tail -n 1 info.txt)"
ip link set can0 down
ip link set can1 down
rmmod gs_usb
"$CANTAP" info -d gs_usb:0042 > info.txt 2>&1
grep -q "^serial number   0042" info.txt && grep -q "^channels        2" info.txt
verdict $? "gs_usb: it is found by its serial number" "$(head -n 1 info.txt)"
"$CANTAP" info -d gs_usb:0043 > info.txt 2>&1
[ $? != 0 ] && grep -q "there are 0042" info.txt
verdict $? "gs_usb: another number's message lists those that there are"
rm -f $GS/sent
: > $GS/requests
gs_start -d gs_usb: -b 500k
wait_until is_started 0 1 && wait_until is_started 1 1
sleep 0.5
echo 5000 > $GS/traffic
until_all 5000 sent
until_all 10000 captured
check "gs_usb: a capture of both channels ends" gs_end
_bad=0
for _n in 0 1; do frames_on can$_n capture.log | cmp -s - $GS/sent || _bad=1; done
verdict $_bad "gs_usb: every frame of both channels, in order" "$(frames_on can0 capture.log | wc -l) + $(frames_on can1 capture.log | wc -l) of $(wc -l < $GS/sent)"
[ $_bad = 0 ] || { cat capture.json capture.err gs.err; grep '^2 ' $GS/requests; }
# Listen-only, with stamps and bus errors.
[ "$(grep -c '^2 [01] 0100000011100000' $GS/requests)" = 2 ] && [ "$(grep '^2 [01]' $GS/requests | tail -n 2 | grep -c ' 0000000000000000')" = 2 ]
verdict $? "gs_usb: both only listened, and are off afterwards"

touch $GS/peer
timeout 60 "$CANTAP" send -d gs_usb: -b 500k 1 123#0102 > send.txt 2>&1
verdict $? "gs_usb: a frame sent is confirmed" "$(tail -n 1 send.txt)"
rm $GS/peer
timeout 60 "$CANTAP" send -d gs_usb: -b 500k 1 123#0102 > send.txt 2>&1
[ $? != 0 ]
verdict $? "gs_usb: a frame that nobody acknowledges is not" "$(tail -n 1 send.txt)"

: > $GS/requests
rm -f $GS/sent
gs_start -d gs_usb: -b 500k
wait_until is_started 1 1
sleep 0.5
echo 100 > $GS/traffic
until_all 100 sent
until_all 200 captured
kill $GS_SERVER
wait_until has_told "unplugged"
verdict $? "gs_usb: a pulled adapter is reported" "$(grep unplugged capture.err)"
wait_until has_no_gs
gs_attach || { cat attach.log gs.err; false; }
verdict $? "gs_usb: it is attached again"
# The kernel's driver is loaded again by nobody here.
wait_until has_told "the device is back after" && wait_until is_started 0 2
verdict $? "gs_usb: the capture continues when it is back"
sleep 0.5
echo 100 > $GS/traffic
until_all 200 sent
until_all 400 captured
check "gs_usb: the capture ends" gs_end
frames_on can0 capture.log | cmp -s - $GS/sent && grep -q '"gaps":{"count":1,' capture.json
verdict $? "gs_usb: before and after, every frame, and one gap" "$(frames_on can0 capture.log | wc -l) of $(wc -l < $GS/sent)"
kill $GS_SERVER
wait_until has_no_gs
cat gs.err
