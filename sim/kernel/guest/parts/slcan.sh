#!/bin/sh
# shellcheck shell=dash
# The kernel's slcan driver, set up by slcand and by ip, with can-utils on top of it.

has_port || attach

# listen INTERFACE: candump in the background, with room for a burst at full load.
listen() {
  candump -L -r 8000000 "$1" > dump.txt &
  CANDUMP=$!
  sleep 0.5
}
# heard: waits until nothing more arrives, and leaves in heard.txt what candump printed, without the DLC of remote
# frames.
heard() {
  settled
  sleep 0.3
  kill "$CANDUMP"
  wait "$CANDUMP" 2> /dev/null
  awk '{ print $3 }' dump.txt | sed 's/#R[0-8]$/#R/' > heard.txt
}
without_remote_dlc() { sed 's/#R[0-8]$/#R/' "$1"; }

slcand_is_up() {
  slcand -o "-s$1" -S 3000000 "${PORT#/dev/}" slcan0
  wait_until has_interface slcan0 && ip link set slcan0 up
}

board traffic 0 std0
check "slcand" slcand_is_up 8
sleep 1

for _job in "10 mix 300" "50 mix 2000" "100 mix 3000" "100 std0 6000" "100 ext8 2000"; do
  board mark
  listen slcan0
  # shellcheck disable=SC2086 # three words
  board play 1 $_job
  heard
  board dump slcan
  without_remote_dlc /share/slcan.taken1 | cmp -s - heard.txt
  verdict $? "slcand, candump: $_job" "$(wc -l < heard.txt) of $(wc -l < /share/slcan.taken1) in order"
done

board mark
: > wanted.txt
for _frame in 123#DEADBEEF 1F334455#1122334455667788 7FF#R 000# 5A1#01; do
  cansend slcan0 $_frame
  echo $_frame >> wanted.txt
done
sleep 1
board dump slcan
without_remote_dlc /share/slcan.sent1 | cmp -s - wanted.txt
verdict $? "cansend: the bus saw all of them"

board mark
listen slcan0
board play 1 60 std8 2000
cangen -g 0 -n 500 -e -I 1234567 -L 8 -D i -p 10 slcan0
heard
board dump slcan
grep -v '^01234567#' heard.txt | cmp -s - /share/slcan.taken1 &&
  grep '^01234567#' heard.txt | cmp -s - /share/slcan.sent1 &&
  [ "$(wc -l < /share/slcan.sent1)" = 500 ]
verdict $? "cangen against 60 %" "$(wc -l < /share/slcan.taken1) heard, $(wc -l < /share/slcan.sent1) sent"

killall slcand
sleep 1
board traffic 50 mix
capture_is_exact "a capture after slcand"

board traffic 0 mix
slcand_is_up 6
board play 1 80 mix 100000
sleep 1
detach
killall slcand 2> /dev/null
attach
check "the device works after it was detached with slcan0 up and traffic" info

ldattach 17 "$PORT"
wait_until has_interface can0
iproute2 link set can0 type can bitrate 500000 && ip link set can0 up
verdict $? "slcan, set up by ip link"
board mark
listen can0
board play 1 80 mix 500
heard
[ "$(wc -l < heard.txt)" = 500 ]
verdict $? "ldattach, candump: 80 %" "$(wc -l < heard.txt) of 500"
ip link set can0 down
killall ldattach
sleep 1
board traffic 50 mix
capture_is_exact "a capture after ldattach"
