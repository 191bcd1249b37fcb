#!/bin/sh
# shellcheck shell=dash
# `cantap bridge`: both channels on interfaces of the kernel's own, used by can-utils and python-can.

has_port || attach
modprobe -a vcan vxcan

# bridge OPTION...: starts it in the background, as $BRIDGE, and waits until programs can use it.
bridge() {
  # What the one before said is no sign of this one, which may take a while to begin.
  : > bridge.err
  "$CANTAP" bridge -d "$PORT" -b 1M "$@" > bridge.out 2> bridge.err &
  BRIDGE=$!
  wait_until grep -q "Ctrl-C ends it" bridge.err || { cat bridge.err; return 1; }
}
end_bridge() {
  kill -INT "$BRIDGE"
  wait "$BRIDGE" || { cat bridge.err; return 1; }
  tail -n 2 bridge.err
}

# listen INTERFACE...: candump on each in the background, with room for all frames of a part (a frame takes less than a kilobyte, and the kernel
# doubles the figure), errors among the frames.
listen() {
  LISTENERS=
  for _interface in "$@"; do
    candump -d -L -r 32000000 "$_interface,0:0,#FFFFFFFF" > "$_interface.txt" &
    LISTENERS="$LISTENERS $!"
  done
  sleep 0.5
}
# quiet: waits until no more frames cross. (A session has bytes on the wire all the time.)
quiet() {
  _before=none
  while _now="$(both taken) $(both sent)" && [ "$_before" != "$_now" ]; do
    _before=$_now
    sleep 1
  done
}
# heard: waits until nothing more arrives.
heard() {
  quiet
  sleep 0.5
  # shellcheck disable=SC2086 # several
  kill $LISTENERS
  # shellcheck disable=SC2086
  wait $LISTENERS 2> /dev/null
}
# The kernel tells what a socket dropped with the next frame that it takes: so one more is sent once nothing else comes, until it is there.
LAST=7EF#4C415354
is_last() { tail -n 1 "$1.txt" | grep -q "$LAST"; }
last() {
  _tries=60
  until is_last "$1" || [ $_tries = 0 ]; do
    cansend "$1" $LAST
    sleep 0.5
    _tries=$((_tries - 1))
  done
}
# frames FILE: a candump log's frames, without the last, without errors, and without a DLC above 8, which not every version of candump prints.
frames() { grep -v -e DROPCOUNT -e "$LAST" "$1" | awk '{ print $3 }' | grep -v '^2[0-9A-F]\{7\}#' | bare; }
# dropped FILE: what its socket lost, as candump says.
dropped() { sed -n 's/^DROPCOUNT: .*(total drops \([0-9]*\)).*/\1/p' "$1" | tail -n 1 | grep . || echo 0; }
bare() { sed 's/#R.*$/#R/; s/_[0-9A-F]$//'; }
errors() { awk '{ print $3 }' "$1" | grep -c '^2[0-9A-F]\{7\}#'; }

"$CANTAP" bridge -d "$PORT" -b 1M bus0 2> bridge.err
[ $? = 1 ] && grep -q "ip link add bus0 type vcan && ip link set bus0 up" bridge.err
verdict $? "bridge: without an interface, the line for root is there"

# The line itself, with the `ip` program that knows about CAN.
for _bus in bus0 bus1; do
  iproute2 link add $_bus type vcan && ip link set $_bus up
done

# The bridge is ended before candump: by then it has handed on everything captured, however far behind the guest is. What is missing must
# be counted, by the bridge or by candump, whose socket may overflow.
crossed() { [ "$(both taken)" = "$_frames $_frames" ]; }
grown() { wc -c bus0.txt bus1.txt | tail -n 1; }
for _job in "100 mix 4000" "100 std0 20000"; do
  board traffic 0 mix
  bridge bus0 bus1
  listen bus0 bus1
  board mark
  _frames=${_job##* }
  for _n in 1 2; do
    # shellcheck disable=SC2086 # words
    board play $_n $_job
  done
  for _ in 1 2 3 4 5 6; do wait_until crossed && break; done
  board dump bridge
  check "bridge: ends with Ctrl-C" end_bridge
  _before=none
  while _now=$(grown) && [ "$_before" != "$_now" ]; do
    _before=$_now
    sleep 0.5
  done
  for _bus in bus0 bus1; do last $_bus; done
  heard
  for _n in 1 2; do
    _bus=bus$((_n - 1))
    frames $_bus.txt > got$_n
    _got=$(wc -l < got$_n)
    # shellcheck disable=SC2046 # three words
    set -- $(sed -n "s/^.*$_bus: \([0-9]*\) frames heard, \([0-9]*\) lost before that, \([0-9]*\) not taken.*/\1 \2 \3/p" bridge.err)
    _dropped=$(dropped $_bus.txt)
    [ "$(($1 + $2 + $3))" = "$_frames" ] && [ "$((_got + _dropped))" = "$1" ] && [ "$_got" -gt 3000 ]
    verdict $? "bridge, candump: $_job, all accounted for on channel $_n" "$1 heard, $2 lost, $3 not taken; $_got, $_dropped dropped by candump"
    if [ "$_got" = "$_frames" ]; then
      bare < /share/bridge.taken$_n | cmp -s - got$_n
      verdict $? "bridge, candump: $_job, in order on channel $_n"
    fi
  done
done

# While the bridge only listens, what programs write is not sent, and the bridge says so.
board traffic 0 mix
bridge bus0
listen bus0
board mark
cansend bus0 123#11
sleep 1
heard
[ "$(both dominant_bits)" = "0 0" ] && [ "$(errors bus0.txt)" = 1 ] && grep -q "channel 1 only listens" bridge.err
verdict $? "bridge: a channel that only listens sends nothing and says so" "$(errors bus0.txt) error frame"
end_bridge

bridge --mode normal bus0 bus1
board mark
: > wanted.txt
for _frame in 123#DEADBEEF 1F334455#1122334455667788 7FF#R 000# 5A1#01; do
  cansend bus0 $_frame
  cansend bus1 $_frame
  echo $_frame >> wanted.txt
done
sleep 3
board dump bridge
_bad=0
for _n in 1 2; do bare < /share/bridge.sent$_n | cmp -s - wanted.txt || _bad=1; done
verdict $_bad "bridge, cansend: both buses saw all of them"

board mark
listen bus0
board play 1 60 std8 2000
cangen -g 0 -n 500 -e -I 1234567 -L 8 -D i -p 10 bus0
heard
board dump bridge
frames bus0.txt > heard.txt
grep -v '^01234567#' heard.txt | cmp -s - /share/bridge.taken1 &&
  [ "$(grep -c '^01234567#' heard.txt)" = 500 ] &&
  grep '^01234567#' heard.txt | cmp -s - /share/bridge.sent1
verdict $? "bridge, cangen against 60 %: each frame once" "$(wc -l < /share/bridge.taken1) heard, $(wc -l < /share/bridge.sent1) sent"

listen bus0
board noise 30
board play 1 50 mix 300
quiet
board noise 0
board acknowledge no
cansend bus0 123#22
sleep 1
heard
board acknowledge yes
[ "$(errors bus0.txt)" -gt 20 ] && grep -q ' 20000204#' bus0.txt
verdict $? "bridge: bus errors and states are error frames" "$(errors bus0.txt) of them"

cat > program.py << 'PROGRAM'
import can, sys
bus = can.Bus(interface="socketcan", channel="bus0")
print("ready", flush=True)
# As many as fit into its socket.
frames = [bus.recv(30) for _ in range(150)]
assert all(frame is not None and not frame.is_error_frame for frame in frames), len([frame for frame in frames if frame])
assert any(frame.is_extended_id for frame in frames) and any(frame.dlc == 0 for frame in frames)
for number in range(20):
    bus.send(can.Message(arbitration_id=0x1ABBCC00 + number, data=[number, 0xFF], is_extended_id=True))
bus.shutdown()
print("done", flush=True)
PROGRAM
if python3 -c "import can" 2> python.err; then
  sleep 1
  board mark
  python3 program.py > python.out 2> python.err &
  _python=$!
  wait_until grep -q ready python.out || wait_until grep -q ready python.out
  board play 1 50 mix 150
  wait $_python
  sleep 1
  board dump bridge
  grep -q done python.out && [ "$(grep -c '^1ABBCC[01].#' /share/bridge.sent1)" = 20 ]
  verdict $? "bridge, python-can: hears 150 frames and sends 20"
  cat python.err
else
  echo "SKIPPED: this guest has no python-can: $(tail -n 1 python.err)"
fi
end_bridge

# A pair: programs use its other end, in any network namespace. Their frames come back once: from the kernel, or as the confirmation.
iproute2 link add bus2 type vxcan peer name app2 && ip link set bus2 up && ip link set app2 up
bridge --mode normal bus2
listen app2
board mark
board play 1 30 std8 100
cangen -g 1 -n 50 -e -I 1234567 -L 2 -D i -p 10 app2
heard
frames app2.txt > heard.txt
[ "$(grep -c '^01234567#' heard.txt)" = 50 ] && [ "$(wc -l < heard.txt)" = 150 ]
verdict $? "bridge, vxcan: each frame once" "$(wc -l < heard.txt) frames, flags $(cat /sys/class/net/app2/flags)"

# Killed: the board leaves its buses.
board traffic 50 mix
sleep 1
kill -9 "$BRIDGE"
wait "$BRIDGE" 2> /dev/null
sleep 1
board mark
sleep 1
[ "$(both dominant_bits)" = "0 0" ]
verdict $? "bridge: killed, and the board is silent"
capture_is_exact "a capture after the bridge"
iproute2 link del bus2
