#!/bin/sh
# shellcheck shell=dash
# cannelloni itself, at both kinds of tunnel: on a virtual interface of the kernel at its end, and `-d cannelloni…` at the other; and its client at
# `cantap serve --cannelloni-tcp`. Among the parts that run by themselves only if it is there, since it is none of this repository: build it without
# shared libraries (`cmake -D SCTP_SUPPORT=OFF -D CMAKE_EXE_LINKER_FLAGS=-static`), and put it at guest/cannelloni.

CANNELLONI=/share/guest/cannelloni
modprobe -a vcan can-raw
iproute2 link add cn0 type vcan && iproute2 link set cn0 mtu 72 && iproute2 link set cn0 up
ip link set lo up
# hears INTERFACE N: so many sockets hear all of an interface.
hears() { [ "$(grep -c "^ *$1 .* raw *$" /proc/net/can/rcvlist_all)" -ge "$2" ]; }
has_last() { grep -q 7EF#4C415354 "$1"; }
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
  wait_until hears cn0 2
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

# crossed NAME FROM TO: 1001 frames of all kinds on one interface, which must come out of the other.
crossed() {
  candump -L -r 8000000 "$2" > from.txt &
  DUMPS=$!
  candump -L -r 8000000 "$3" > to.txt &
  DUMPS="$DUMPS $!"
  wait_until hears "$2" 2 && wait_until hears "$3" 2
  cangen -g 1 -n 500 -L r -D r -e "$2"
  cangen -g 1 -n 500 -m -L r -D r "$2"
  cansend "$2" 7EF#4C415354
  wait_until has_last to.txt
  sleep 1
  # shellcheck disable=SC2086 # two words
  kill $DUMPS
  # shellcheck disable=SC2086
  wait $DUMPS 2> /dev/null
  tunnel_frames from.txt > from
  tunnel_frames to.txt | cmp -s - from
  verdict $? "cannelloni, its client at our server: $1" "$(tunnel_frames to.txt | wc -l) of $(wc -l < from), $(grep -c '##' from) of CAN FD"
}

iproute2 link add cn1 type vcan && iproute2 link set cn1 mtu 72 && iproute2 link set cn1 up
"$CANTAP" serve -d cn1 -b 500k --allow cannelloni:send --cannelloni-tcp 1:127.0.0.1:20003 > serve.out 2> serve.err &
SERVER=$!
wait_until grep -q "Ctrl-C ends it" serve.err
$CANNELLONI -I cn0 -C c -R 127.0.0.1 -r 20003 > cannelloni.out 2>&1 &
PEER=$!
wait_until grep -q "is in and may send" serve.err
crossed "each frame of our bus is on its interface, in order" cn1 cn0
crossed "each frame of its interface is on our bus, in order" cn0 cn1
kill $PEER
wait $PEER 2> /dev/null
wait_until grep -q "has left" serve.err
verdict $? "cannelloni, its client at our server: it leaves"
kill -INT $SERVER
wait $SERVER
verdict $? "cannelloni: our server ends"
[ $FAILED = 0 ] || cat serve.err
iproute2 link del cn1
iproute2 link del cn0
