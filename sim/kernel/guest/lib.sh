#!/bin/sh
# shellcheck shell=dash
# What the parts share. USBIP and CONTROL, the board's ports on the computer outside, come from /share/ports.
# shellcheck source=/dev/null
. /share/ports

OUTSIDE=10.0.2.2
PORT=/dev/ttyACM0
CANTAP=/work/cantap
CHECKS=0
FAILED=0

mkdir -p /work
cd /work || exit 1
# What is in /share is read again at every use.
cp /share/cantap .
dmesg -n 1
modprobe -a vhci-hcd cdc-acm can-raw slcan

uptime_s() { cut -d' ' -f1 /proc/uptime; }

# Waits until a command succeeds: a minute, which only a hang reaches.
wait_until() {
  _tries=1200
  until "$@"; do
    _tries=$((_tries - 1))
    [ $_tries -gt 0 ] || return 1
    sleep 0.05
  done
}

# until_all N COMMAND...: until it counts to N; however slow this computer is, for as long as it counts on, but for 20 s of standing still.
until_all() {
  _wanted=$1
  _before=
  shift
  while _now=$("$@"); [ "$_now" != "$_wanted" ]; do
    [ "$_now" = "$_before" ] || _still=20
    _before=$_now
    _still=$((_still - 1))
    [ $_still -gt 0 ] || return 1
    sleep 1
  done
}

# random N: a number below N.
random() { echo $(($(od -An -N4 -tu4 /dev/urandom) % $1)); }

# ---- Checks ----

# verdict STATUS NAME [DETAIL]: counts a check, by its exit status. NAME says what must hold.
verdict() {
  CHECKS=$((CHECKS + 1))
  if [ "$1" = 0 ]; then
    echo "ok    $2${3:+ ($3)}"
  else
    echo "FAIL  $2${3:+ ($3)}"
    FAILED=$((FAILED + 1))
  fi
}

# check NAME COMMAND...: the command's verdict.
check() {
  _name=$1
  shift
  "$@"
  verdict $? "$_name"
}

# ---- The board's script (docs/emulator.md) ----

# board LINE...: sends a line to the board and returns its answer.
board() {
  _answer=$(echo "$*" | nc -w 30 "$OUTSIDE" "$CONTROL")
  case $_answer in
    error:* | '') echo "the board says to \"$*\": $_answer" >&2; return 1 ;;
  esac
}

figures() { echo status | nc -w 30 "$OUTSIDE" "$CONTROL"; }

# figure NAME: a number counted since the mark; if there is one per channel, the first.
figure() { figures | sed "s/.*\"$1\":\[*\([0-9.]*\).*/\1/"; }

# both NAME: the two numbers of a figure with one per channel.
both() { figures | sed "s/.*\"$1\":\[\([0-9]*\),\([0-9]*\)\].*/\1 \2/"; }

# settled: waits until nothing more has come from the device for a second and a half; on a busy computer the board stands still for a while, too.
settled() {
  _before=none
  _equal=0
  while _now=$(figure in_bytes) && [ $_equal -lt 3 ]; do
    if [ "$_before" = "$_now" ]; then _equal=$((_equal + 1)); else _equal=0; fi
    _before=$_now
    sleep 0.5
  done
}

# ---- The device ----

# The port gets another name while a client still holds the old one.
has_port() {
  for _port in /dev/ttyACM*; do
    [ -c "$_port" ] && PORT=$_port && return
  done
  return 1
}
has_no_port() { ! has_port; }
attach() {
  usbip --tcp-port "$USBIP" attach -r "$OUTSIDE" -b 1-1 > attach.log 2>&1
  wait_until has_port
}
detach() {
  usbip detach -p 00 > /dev/null 2>&1
  wait_until has_no_port
}

# The device's folder in sysfs, and its two IDs.
device() { dirname "$(grep -l cantap /sys/bus/usb/devices/*/manufacturer)"; }
device_id() { echo "$(cat "$(device)/idVendor"):$(cat "$(device)/idProduct")"; }

has_interface() { [ -e "/sys/class/net/$1" ]; }

# ---- The command ----

info() {
  timeout 60 "$CANTAP" info -d "$PORT" > info.txt 2>&1 && return
  cat info.txt
  return 1
}

# start [OPTION...]: a capture in the background, as $CAPTURE.
start() {
  rm -f capture.log capture.json
  "$CANTAP" capture -d "$PORT" -b 1M -o capture.log --json "$@" > capture.json 2> capture.err &
  CAPTURE=$!
}

# stream [OPTION...]: the same, beginning at a mark; returns once frames flow.
is_flowing() { [ "$(figure taken)" -gt 50 ]; }
stream() {
  board mark
  start "$@"
  wait_until is_flowing || verdict 1 "frames flow when a capture has begun"
}

# ended CODE: waits for the capture and checks how it ended.
ended() {
  wait "$CAPTURE"
  [ $? = "$1" ]
}

# A child that has ended is either a zombie or gone.
is_capturing() { [ -e "/proc/$CAPTURE/status" ] && ! grep -q '^State:.*Z' "/proc/$CAPTURE/status"; }
has_told() { grep -q "$1" capture.err; }

# survived: the capture has reported that the device went away and came back, and ends as if nothing had happened.
survived() {
  wait_until has_told "continues when the device is back" &&
    wait_until has_told "the device is back after" && sleep 0.3 &&
    kill -INT "$CAPTURE" && ended 0 && return
  kill -9 "$CAPTURE" 2> /dev/null
  cat capture.err
  return 1
}

# delivered N: the frames of channel N in the capture.
delivered() { awk -v name=can$(($1 - 1)) '$2 == name { print $3 }' capture.log; }

# stamps N: the times of channel N in the capture, against those of the frames on the bus: how many are not as far from the one before as they
# should be, and the worst, in us. A stamp is late by the latency of an interrupt, which differs; a capture has whole microseconds; and the
# clock may be moved towards UTC by 100 ppm (docs/architecture.md).
stamps() {
  awk -v name=can$(($1 - 1)) -v books="/share/capture.stamps$1" '
    $2 == name {
      split(substr($1, 2), part, ".")
      if (!n++) first = part[1]
      # Busybox takes digits after a zero for octal ones.
      us = (part[1] - first) * 1e6 + ("1" part[2]) - 1e6
      if ((getline valid < books) <= 0) { off++; next }
      valid /= 1000
      if (n > 1) {
        error = (us - before) - (valid - was)
        if (error < 0) error = -error
        if (error > worst) worst = error
        if (error > 4 + (valid - was) * 1e-4) off++
      }
      before = us
      was = valid
    }
    END { printf "%d %.1f\n", off, worst }' capture.log
}

# exact NAME: the capture holds every frame that both controllers received, in order, and there are many; and their times are those of the bus.
exact() {
  board dump capture
  _bad=0
  for _n in 1 2; do
    delivered $_n > got$_n
    cmp -s got$_n /share/capture.taken$_n && [ "$(wc -l < got$_n)" -gt 50 ] || _bad=1
    stamps $_n > stamps$_n
    # One in a thousand may be off: a frame found behind another, whose stamp is an upper bound, which this format does not say.
    [ $(($(cut -d' ' -f1 stamps$_n) * 1000)) -le "$(wc -l < got$_n)" ] || _bad=1
  done
  verdict $_bad "$1" "$(wc -l < got1) + $(wc -l < got2) frames, $(cut -d' ' -f1 stamps1) + $(cut -d' ' -f1 stamps2) stamps off, $(cut -d' ' -f2 stamps1) and $(cut -d' ' -f2 stamps2) us at most"
  [ $_bad = 0 ] || { wc -l /share/capture.taken?; cp capture.log /share; cat capture.json capture.err; }
}

# holes N: at how many places the capture lacks frames that channel N's controller received; "disorder" if it has others. Error frames, which say
# so, are not among them.
holes() {
  delivered "$1" | grep -v '^2[0-9A-F]\{7\}#' | awk '
    NR == FNR { got[++n] = $0; next }
    i < n && $0 == got[i + 1] { i++; hole = 0; next }
    !hole { holes++; hole = 1 }
    END { print (i < n) ? "disorder" : holes + 0 }' - "/share/capture.taken$1"
}

# gap_is_told: the capture went through one absence of the device: each channel's frames are there in order, up to some point and from another on,
# and the summary has the gap.
gap_is_told() {
  board dump capture
  for _n in 1 2; do
    _holes=$(holes $_n)
    case $_holes in
      0 | 1) ;;
      *) echo "channel $_n: $_holes holes, $(delivered $_n | wc -l) of $(wc -l < /share/capture.taken$_n)"; return 1 ;;
    esac
  done
  grep -q '"gaps":{"count":1,' capture.json && delivered 1 | grep -q '^2[0-9A-F]\{7\}#' || { cat capture.json; return 1; }
}

# capture_is_exact NAME [SECONDS]: a complete capture from beginning to end.
capture_is_exact() {
  wait_until has_port
  board mark
  start -t "${2:-1}"
  wait "$CAPTURE"
  exact "$1"
}

# captures INTERFACE: a capture receives from it. Only its socket asks for error frames: the one through which it looks at the interface first, and
# which it closes again, does not.
captures() { grep -q "^ *$1 .* raw *$" /proc/net/can/rcvlist_err; }

# of_channel N: frames delivered and frames counted lost, from the capture's summary.
of_channel() { sed "s/.*\"channel\":$1,\"frames\":\([0-9]*\),\"lost\":\([0-9]*\).*/\1 \2/" capture.json; }

# counted NAME: frames delivered plus frames counted lost equal those that crossed, on both channels.
counted() {
  board dump capture
  for _n in 1 2; do
    # shellcheck disable=SC2046 # two words
    set -- "$1" $(of_channel $_n)
    _crossed=$(wc -l < /share/capture.taken$_n)
    [ "$_crossed" -gt 50 ] && [ $(($2 + $3)) = "$_crossed" ]
    verdict $? "$1, channel $_n" "${2:-none} delivered + ${3:-none} lost, $_crossed crossed"
  done
  cat capture.err
}
