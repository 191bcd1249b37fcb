#!/bin/sh
# shellcheck shell=dash
# cannelloni itself, at both kinds of tunnel: on a virtual interface of the kernel at its end, and `-d cannelloni…` at the other. Not among
# the parts that run by themselves, since cannelloni is none of this repository: build it without shared libraries, and put it at guest/cannelloni.

CANNELLONI=/share/guest/cannelloni
modprobe -a vcan can-raw
iproute2 link add cn0 type vcan && iproute2 link set cn0 mtu 72 && iproute2 link set cn0 up
ip link set lo up
on_cn0() { [ "$(grep -c "^ *cn0 .* raw *$" /proc/net/can/rcvlist_all)" -ge "$1" ]; }
# Without errors and losses.
tunnel_frames() { awk '{ print $3 }' "$1" 2> /dev/null | grep -v '^2[0-9A-F]\{7\}#' | sed 's/##4/##0/; s/##5/##1/; s/##6/##2/; s/##7/##3/; s/#R.*$/#R/; s/_[0-9A-F]$//'; }
captured_all() { [ "$(tunnel_frames capture.log | wc -l)" -ge 1001 ]; }

# tunnel_both NAME ADDRESS: 1001 frames of all kinds from cannelloni's interface, and three to it.
tunnel_both() {
  rm -f capture.log
  "$CANTAP" capture -d "$2" -b 500k -o capture.log --json > capture.json 2> capture.err &
  CAPTURE=$!
  sleep 4
  : > dump.txt
  candump -L -r 8000000 cn0 > dump.txt &
  CANDUMP=$!
  wait_until on_cn0 2
  cangen -g 1 -n 500 -L r -D r -e cn0
  cangen -g 1 -n 500 -m -L r -D r cn0
  cansend cn0 7EF#4C415354
  wait_until captured_all
  kill -INT "$CAPTURE"
  ended 0
  tunnel_frames capture.log > got1
  tunnel_frames dump.txt | cmp -s - got1
  verdict $? "cannelloni, $1: each frame that candump has, in order" "$(wc -l < got1) of $(wc -l < dump.txt), $(grep -c '##' got1) of CAN FD"
  : > dump.txt
  sleep 3
  timeout 60 "$CANTAP" send -d "$2" -b 500k 1 123#DEADBEEF 1F334455#1122 123##1AABB > send.txt 2>&1
  _code=$?
  sleep 1
  kill $CANDUMP
  wait $CANDUMP 2> /dev/null
  [ $_code = 0 ] && [ "$(tunnel_frames dump.txt | tail -n 3 | tr '\n' ' ')" = "123#DEADBEEF 1F334455#1122 123##1AABB " ]
  verdict $? "cannelloni, $1: frames that cantap sends are on its interface" "$(tunnel_frames dump.txt | tail -n 3 | tr '\n' ' ')"
  [ $_code = 0 ] || cat send.txt
}

$CANNELLONI -I cn0 -C s -p -l 20000 > cannelloni.out 2>&1 &
PEER=$!
sleep 2
tunnel_both "over TCP, its server" "cannelloni:tcp://127.0.0.1:20000"
kill $PEER
wait $PEER 2> /dev/null
$CANNELLONI -I cn0 -R 127.0.0.1 -r 20001 -l 20002 > cannelloni.out 2>&1 &
PEER=$!
sleep 2
tunnel_both "over UDP" "cannelloni://127.0.0.1:20002?listen=20001"
kill $PEER
wait $PEER 2> /dev/null
iproute2 link del cn0
