#!/bin/sh
# shellcheck shell=dash
# The kernel's own CAN interfaces as devices, `-d can0`: virtual ones, and one with a bit rate, a state and errors (slcan, on the board).

modprobe -a vcan vxcan
BUS=sock0
iproute2 link add $BUS type vcan && ip link set $BUS up

# is_bound N: so many sockets receive frames of the interface.
is_bound() { [ "$(grep -c "^ *$BUS .* raw *$" /proc/net/can/rcvlist_all)" -ge "$1" ]; }
# capture_bus [OPTION...]: a capture of it in the background, as $CAPTURE; returns once it receives.
capture_bus() {
  rm -f capture.log capture.json
  "$CANTAP" capture -d socketcan:$BUS -o capture.log --json "$@" > capture.json 2> capture.err &
  CAPTURE=$!
  wait_until captures $BUS || { cat capture.err; return 1; }
}
# end_capture CODE
end_capture() {
  kill -INT "$CAPTURE"
  ended "$1" || { cat capture.json capture.err; return 1; }
}
# Frames of a candump log, without the DLC of remote frames, and without errors.
bare_frames() { awk '{ print $3 }' "$1" | grep -v '^2[0-9A-F]\{7\}#' | sed 's/#R.*$/#R/; s/_[0-9A-F]$//'; }
frames_so_far() { bare_frames capture.log 2> /dev/null | wc -l; }
# lost_at STAGE: from the capture's summary.
lost_at() { sed "s/.*\"lost\":{[^}]*\"$1\":\([0-9]*\).*/\1/" capture.json; }

"$CANTAP" info -d can77 > info.txt 2>&1
[ $? != 0 ] && grep -q "there are $BUS" info.txt
verdict $? "socketcan: an interface that is not there: the message lists those that are" "$(head -n 1 info.txt)"
"$CANTAP" info -d socketcan:$BUS > info.txt 2>&1
check "socketcan: what a virtual interface can tell" grep -q "kernel's, when the driver hands a frame over" info.txt

# Every frame that candump has.
capture_bus -b 500k
: > dump.txt
candump -L -r 32000000 $BUS > dump.txt &
CANDUMP=$!
wait_until is_bound 2
for _options in "-I i -L r -D r" "-e -L r -D r" "-R -L r" "-e -R -L r"; do
  # shellcheck disable=SC2086 # words
  cangen -g 0 -n 1500 $_options $BUS
done
cansend $BUS 7EF#4C415354
is_in_dump() { grep -q '7EF#4C415354' dump.txt; }
wait_until is_in_dump
sleep 1
check "socketcan: a capture ends with Ctrl-C" end_capture 0
kill "$CANDUMP"
wait "$CANDUMP" 2> /dev/null
bare_frames capture.log > got1
bare_frames dump.txt | cmp -s - got1 && [ "$(wc -l < got1)" = 6001 ]
verdict $? "socketcan: cangen: each frame that candump has, in order" "$(wc -l < got1) of $(wc -l < dump.txt)"
# The time is the kernel's, as candump's is: never early, and to 100 us the same (the clock is moved by ppm).
paste dump.txt capture.log | awk '
  { a = substr($1, 2, 17); b = substr($4, 2, 17); split(a, x, "."); split(b, y, ".")
    us = (y[1] - x[1]) * 1e6 + ("1" substr(y[2], 1, 6)) - ("1" substr(x[2], 1, 6)); if (us < 0) us = -us
    if (us > worst) worst = us }
  END { print worst + 0; exit worst > 5000 }' > worst.txt
verdict $? "socketcan: candump's times" "$(cat worst.txt) us apart at most"

# CAN FD frames among the others, with each flag. Newer kernels also flag that it is one.
BUS=sockfd0
iproute2 link add $BUS type vcan && iproute2 link set $BUS mtu 72 && iproute2 link set $BUS up
capture_bus -b 500k
: > dump.txt
candump -L -r 32000000 $BUS > dump.txt &
CANDUMP=$!
wait_until is_bound 2
cangen -g 0 -n 1500 -m -L r -D r $BUS
cansend $BUS 7EF##34C415354
is_in_dump() { grep -q '7EF##.4C415354' dump.txt; }
wait_until is_in_dump
sleep 1
check "socketcan: a capture of CAN FD ends with Ctrl-C" end_capture 0
kill "$CANDUMP"
wait "$CANDUMP" 2> /dev/null
bare_frames capture.log > got1
bare_frames dump.txt | sed 's/##4/##0/; s/##5/##1/; s/##6/##2/; s/##7/##3/' | cmp -s - got1 && [ "$(wc -l < got1)" = 1501 ]
verdict $? "socketcan: cangen with CAN FD: each frame that candump has, in order" "$(grep -c '##' got1) of CAN FD among $(wc -l < got1)"
# Sent beside a classical one, each is confirmed, and candump has it with its flags: what cansend sends of the same text.
: > dump.txt
candump -L $BUS > dump.txt &
CANDUMP=$!
wait_until is_bound 1
_long=$(printf '18DAF110##1%0128d' 0)
timeout 60 "$CANTAP" send -d socketcan:$BUS -b 500k 1 123##1AABB 123#DEAD 7FF##0 "$_long" 124##2112233445566778899AABBCC > send.txt 2>&1
_code=$?
for _frame in 123##1AABB 123#DEAD 7FF##0 "$_long" 124##2112233445566778899AABBCC; do
  cansend $BUS "$_frame"
done
is_in_dump() { [ "$(wc -l < dump.txt)" = 10 ]; }
wait_until is_in_dump
kill "$CANDUMP"
wait "$CANDUMP" 2> /dev/null
bare_frames dump.txt | sed 's/##4/##0/; s/##5/##1/; s/##6/##2/; s/##7/##3/' > got1
head -n 5 got1 > ours
tail -n 5 got1 | cmp -s - ours && [ $_code = 0 ] && [ "$(wc -l < ours)" = 5 ] && [ "$(grep -c '##' ours)" = 4 ]
verdict $? "socketcan: CAN FD frames sent are confirmed, and candump has them as cansend's" "$(cut -c 1-40 ours | tr '\n' ' ')"
[ $_code = 0 ] || cat send.txt
iproute2 link set $BUS down && iproute2 link set $BUS mtu 16 && iproute2 link set $BUS up
timeout 60 "$CANTAP" send -d socketcan:$BUS -b 500k 1 123#11 123##1AABB > send.txt 2>&1
[ $? = 1 ] && grep -q "CAN FD is off on $BUS; as root: ip link set $BUS down" send.txt && ! grep -q '123#11 T' send.txt
verdict $? "socketcan: CAN FD frames are refused, before anything is sent, where the interface has it off" "$(head -n 1 send.txt)"
iproute2 link del $BUS
BUS=sock0

# More than a small socket holds, at full speed, while the capture is stopped: as somebody who may not have a large one.
mkdir -p open && chmod 777 open
chmod 755 "$CANTAP"
echo 100000 > /proc/sys/net/core/rmem_max
_frames=20000
(
  cd open || exit 1
  # Busybox's shell prefers its own, which knows less.
  exec /usr/bin/setpriv --reuid 1000 --clear-groups "$CANTAP" capture -d socketcan:$BUS -b 1M -o capture.log --json > ../capture.json 2> ../capture.err
) &
CAPTURE=$!
wait_until captures $BUS
cangen -g 0 -n $((_frames / 2)) -I 123 -L 8 -D i $BUS &
_generator=$!
sleep 0.2
kill -STOP "$CAPTURE"
wait $_generator
kill -CONT "$CAPTURE"
sleep 1
kill -STOP "$CAPTURE"
# The last of these are dropped with nothing after them.
cangen -g 0 -n $((_frames / 2)) -I 123 -L 8 -D i $BUS
kill -CONT "$CAPTURE"
sleep 1
check "socketcan: a capture with a small socket ends" end_capture 0
# shellcheck disable=SC2046 # two words
set -- $(of_channel 1)
[ $(($1 + $2)) = $_frames ] && [ "$(lost_at queue)" -gt 1000 ] && [ "$(grep -c ' 123#' open/capture.log)" = "$1" ]
verdict $? "socketcan: 20,000 frames, a small socket, a stopped client: all accounted for" "$1 delivered + $2 lost, $(lost_at queue) of them by the socket and $(lost_at link) before it"
echo 212992 > /proc/sys/net/core/rmem_max

# At 20,000 frames a second with a large one, nothing is lost.
capture_bus -b 1M
_began=$(uptime_s)
cangen -g 0 -n $_frames -I 123 -L 8 -D i $BUS
_took=$(echo "$_began $(uptime_s)" | awk '{ print $2 - $1 }')
sleep 1
end_capture 0
# shellcheck disable=SC2046 # two words
set -- $(of_channel 1)
[ $(($1 + $2)) = $_frames ] && [ "$2" = 0 ]
verdict $? "socketcan: 20,000 frames as fast as cangen can: none is lost" "$1 delivered + $2 lost, in $_took s"

# Error frames, as any program may write them on a virtual bus.
capture_bus -b 500k
cansend $BUS 20000088#0000040000000000
cansend $BUS 20000204#0010000000000382
cansend $BUS 123#11
sleep 1
end_capture 0
awk '{ print $3 }' capture.log | tr '\n' ' ' > got1
grep -q '^20000288#0000040000000000 20000284#0030000000000382 123#11 $' got1
verdict $? "socketcan: error frames are errors and states" "$(cat got1)"

# Sending: other programs have it, and it is confirmed.
: > dump.txt
candump -L $BUS > dump.txt &
CANDUMP=$!
wait_until is_bound 1
timeout 60 "$CANTAP" send -d socketcan:$BUS -b 500k 1 123#DEADBEEF 1F334455#1122 7FF#R > send.txt 2>&1
_code=$?
sleep 0.5
kill "$CANDUMP"
wait "$CANDUMP" 2> /dev/null
[ $_code = 0 ] && [ "$(bare_frames dump.txt | tr '\n' ' ')" = "123#DEADBEEF 1F334455#1122 7FF#R " ]
verdict $? "socketcan: frames sent are confirmed, and other programs have them" "$(bare_frames dump.txt | tr '\n' ' ')"
[ $_code = 0 ] || cat send.txt

# Down and up again, and gone.
is_in_capture() { grep -q " $1" capture.log; }
capture_bus -b 500k
cansend $BUS 001# && wait_until is_in_capture 001#
ip link set $BUS down
wait_until has_told "taken down"
verdict $? "socketcan: an interface that is taken down is reported, with the line for root"
ip link set $BUS up
wait_until has_told "the device is back after" && wait_until captures $BUS && cansend $BUS 002# && sleep 1 && end_capture 0 &&
  [ "$(bare_frames capture.log | tr '\n' ' ')" = "001# 002# " ] && grep -q '"gaps":{"count":1,' capture.json
verdict $? "socketcan: the capture continues when it is up again, and has the gap" "$(bare_frames capture.log | tr '\n' ' ')"
capture_bus -b 500k
# Once the first is in the file, the second follows just before the end.
cansend $BUS 001# && wait_until is_in_capture 001# && cansend $BUS 002#
iproute2 link del $BUS
wait_until has_told "is gone"
verdict $? "socketcan: an interface that is deleted is reported"
kill -INT "$CAPTURE"
wait "$CAPTURE"
[ "$(bare_frames capture.log | tr '\n' ' ')" = "001# 002# " ]
verdict $? "socketcan: what was captured before is there" "$(cat capture.log capture.err)"

# An interface with a bit rate: the kernel's slcan on the board.
has_port || attach
board traffic 0 mix
ldattach 17 "$PORT"
wait_until has_interface can0
iproute2 link set can0 type can bitrate 500000 && ip link set can0 up
verdict $? "socketcan: slcan, set up by ip link"
sleep 1
"$CANTAP" info -d can0 > info.txt 2>&1
grep -q "acknowledges frames while it is up" info.txt
verdict $? "socketcan: an interface in normal mode is said to acknowledge" "$(iproute2 -brief link show can0)"
rm -f capture.log
"$CANTAP" capture -d can0 -b 250k -t 1 -o capture.log > capture.json 2> capture.err
[ $? != 0 ] && grep -q "can0 runs at 500000 bit/s" capture.err && grep -q "ip link set can0 up type can bitrate 250000" capture.err
verdict $? "socketcan: another bit rate than the interface's is refused, with the line for root" "$(head -n 1 capture.err)"
board mark
BUS=can0
capture_bus
board play 1 60 mix 1500
until_all 1500 cat /sys/class/net/can0/statistics/rx_packets
settled
check "socketcan: a capture without -b, at the interface's rate, ends" end_capture 0
board dump socketcan
delivered 1 | grep -v '^2[0-9A-F]\{7\}#' | sed 's/#R.*$/#R/' > got1
sed 's/#R[0-8]$/#R/' /share/socketcan.taken1 | cmp -s - got1
verdict $? "socketcan: slcan at 60 %, frame for frame" "$(wc -l < got1) of $(wc -l < /share/socketcan.taken1)"
board mark
timeout 60 "$CANTAP" send -d can0 1 123#0102 > send.txt 2>&1
_code=$?
sleep 1
board dump socketcan
[ $_code = 0 ] && [ "$(cat /share/socketcan.sent1)" = 123#0102 ]
verdict $? "socketcan: a frame sent through slcan is on the bus" "$(cat send.txt)"

# Its cable is pulled in the middle of a burst: the interface goes with the board, and what had come is there.
board mark
capture_bus
board play 1 50 mix 200
until_all 200 frames_so_far
board unplug
wait_until has_told "the interface can0 is gone"
verdict $? "socketcan: slcan, pulled: it is reported, with what to do" "$(grep vanished capture.err)"
killall ldattach 2> /dev/null
attach
ldattach 17 "$PORT"
wait_until has_interface can0
iproute2 link set can0 type can bitrate 500000 && ip link set can0 up
wait_until has_told "the device is back after" && wait_until is_bound 1
board play 1 50 mix 100
until_all 300 frames_so_far
end_capture 0 && grep -q '"gaps":{"count":1,' capture.json
verdict $? "socketcan: slcan, back: the capture goes on, and has the gap" "$(frames_so_far) of 300"
ip link set can0 down
killall ldattach
sleep 1
