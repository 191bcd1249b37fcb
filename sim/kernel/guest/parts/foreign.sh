#!/bin/sh
# shellcheck shell=dash
# Other firmware for a gs_usb adapter on the emulated board (`cantap-sim usbip --any`), behind the kernel's own driver and without it: nothing of ours is
# between the two. Not among the parts that run by themselves, since that firmware is none of this repository.

modprobe -a gs_usb can-raw
is_gs() { grep -q 606f /sys/bus/usb/devices/*/idProduct 2> /dev/null; }
is_no_gs() { ! is_gs; }
taken() { figure taken; }
bus_frames() { awk '{ print $3 }' "$1" | grep -v '^2[0-9A-F]\{7\}#'; }
frames_in() { bus_frames "$1" 2> /dev/null | wc -l; }
foreign_is_complete() { board dump foreign && bus_frames "$1" | cmp -s - /share/foreign.taken1; }

usbip --tcp-port "$USBIP" attach -r "$OUTSIDE" -b 1-1 > attach.log 2>&1 && wait_until is_gs && wait_until has_interface can0
verdict $? "foreign: the kernel's driver takes it" "$(cat /sys/bus/usb/devices/*/product 2> /dev/null | tail -n 1)"
iproute2 -details link show can0 | grep -E 'clock|tseg'
iproute2 link set can0 type can bitrate 500000 && ip link set can0 up
verdict $? "foreign, kernel: the channel comes up at 500 kbit/s"
# candleLight's shows a pattern with its lamps first, and receives nothing meanwhile.
sleep 10

board mark
candump -L -r 8000000 can0 > dump.txt &
CANDUMP=$!
sleep 1
board play 1 50 mix 2000
until_all 2000 taken
of_dump() { frames_in dump.txt; }
until_all 2000 of_dump
kill $CANDUMP
wait $CANDUMP 2> /dev/null
foreign_is_complete dump.txt
verdict $? "foreign, kernel: candump has each frame of a half-full bus, in order" "$(frames_in dump.txt) of $(taken)"

board mark
timeout 60 "$CANTAP" send -d can0 1 123#0102 1ABCDEF0#R > send.txt 2>&1
_code=$?
board dump foreign
[ $_code = 0 ] && [ "$(sed 's/#R.*/#R/' /share/foreign.sent1 | tr '\n' ' ')" = "123#0102 1ABCDEF0#R " ]
verdict $? "foreign, kernel: frames that cantap sends are on the bus" "$(tail -n 1 send.txt)"
ip link set can0 down
rmmod gs_usb

"$CANTAP" info -d gs_usb: > info.txt 2>&1
verdict $? "foreign: our driver, without the kernel's" "$(head -n 1 info.txt)"
cat info.txt
board mark
"$CANTAP" capture -d gs_usb: -b 500k -o capture.log --json > capture.json 2> capture.err &
CAPTURE=$!
sleep 3
board play 1 50 mix 2000
until_all 2000 taken
of_capture() { frames_in capture.log; }
until_all 2000 of_capture
kill -INT "$CAPTURE"
ended 0 && foreign_is_complete capture.log
verdict $? "foreign: our driver has each frame of a half-full bus, in order" "$(frames_in capture.log) of $(taken)"
[ "$(figure dominant_bits)" = 0 ]
verdict $? "foreign: listening, it drives no bit" "$(both dominant_bits)"
cat capture.json capture.err

board mark
timeout 60 "$CANTAP" send -d gs_usb: -b 500k 1 123#0102 > send.txt 2>&1
_code=$?
board dump foreign
[ $_code = 0 ] && [ "$(cat /share/foreign.sent1)" = "123#0102" ]
verdict $? "foreign: a frame that our driver sends is on the bus" "$(tail -n 1 send.txt)"
board unplug
wait_until is_no_gs
verdict $? "foreign: pulled"
