#!/bin/sh
# shellcheck shell=dash
# Captures of both channels, frame for frame.

has_port || attach
board traffic 10 mix
capture_is_exact "a capture at 10 %" 2
board traffic 50 mix
capture_is_exact "a capture at 50 %" 2
board traffic 100 mix
capture_is_exact "a capture at 100 %, all kinds of frames" 2
board traffic 100 std0
capture_is_exact "a capture at 100 %, shortest frames" 4
figures
board traffic 50 mix
board lose 7
capture_is_exact "a capture with every 7th handshake lost" 2
board lose 0
