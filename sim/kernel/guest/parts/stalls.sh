#!/bin/sh
# shellcheck shell=dash
# A client that stops reading while time goes on: the law of counting.

has_port || attach
took() { [ "$(figure taken)" -gt $((_until)) ]; }

board pace real
board traffic 100 std0
stream
sleep 1
kill -STOP "$CAPTURE"
# More than the device's queue holds.
_until=$(($(figure taken) + 25000))
_patience=90
until took || [ $_patience = 0 ]; do
  _patience=$((_patience - 1))
  sleep 1
done
kill -CONT "$CAPTURE"
sleep 2
kill -INT "$CAPTURE"
wait "$CAPTURE"
counted "a client that stalls is told every frame or its loss"
check "its stall filled the queue" grep -q '"queue":[1-9]' capture.json
board pace client
board traffic 50 mix
capture_is_exact "a capture after the stall"
