#!/bin/sh
# shellcheck shell=dash
# `cantap serve` on the board: a capture through it is exact, and a killed server leaves a silent board, and clients that know about it.

has_port || attach
board traffic 50 mix

serve() {
  rm -f serve.sock
  "$CANTAP" serve -d "$PORT" -b 1M --allow send --unix /work/serve.sock > serve.out 2> serve.err &
  SERVER=$!
  wait_until grep -q "Ctrl-C ends it" serve.err || { cat serve.err; return 1; }
}
# A client that acknowledges, so that the board is not silent anyway.
client() {
  rm -f capture.log capture.json
  "$CANTAP" capture -d unix:/work/serve.sock -b 1M --mode normal -o capture.log --json "$@" > capture.json 2> capture.err &
  CAPTURE=$!
}

serve
board mark
client -t 2
wait "$CAPTURE"
exact "a capture through the server"

board mark
client
wait_until is_flowing && sleep 1
[ "$(both dominant_bits)" != "0 0" ]
verdict $? "serve: the client's board acknowledges" "$(both dominant_bits) dominant bits"
kill -9 "$SERVER"
wait "$SERVER" 2> /dev/null
sleep 1
board mark
sleep 1
[ "$(both dominant_bits)" = "0 0" ]
verdict $? "serve: killed while capturing, and the board is silent"
serve
check "serve: the client goes on with the next server" survived
kill -INT "$SERVER"
wait "$SERVER" || cat serve.err
capture_is_exact "a capture after the server"
