#!/bin/sh
# shellcheck shell=dash
# ModemManager probes every new serial port. It must do no harm: no channel is opened, not a single dominant bit is sent, and what follows
# works.

has_port || attach

# The bus carries traffic, so that a channel that took part would acknowledge.
board traffic 50 mix

no_harm() {
  [ "$(both dominant_bits)" = "0 0" ] && [ "$(both openings)" = "0 0" ]
}

mkdir -p /run/dbus
dbus-daemon --config-file=/share/guest/dbus.conf --fork
/lib/systemd/systemd-udevd --daemon
udevadm trigger --action=add
udevadm settle

# modem_manager RULE END: runs it with a new device until its log says END, for two minutes at most, and leaves the log in /share/mm.txt.
modem_manager() {
  mkdir -p /run/udev/rules.d
  echo "$1" > /run/udev/rules.d/90-cantap.rules
  udevadm control --reload
  detach
  attach
  udevadm settle
  board mark
  ModemManager --debug > /share/mm.txt 2>&1 &
  _manager=$!
  _patience=120
  until grep -q "$2" /share/mm.txt || [ $_patience = 0 ]; do
    _patience=$((_patience - 1))
    sleep 1
  done
  kill $_manager
  wait $_manager 2> /dev/null
}

# The interface's protocol tells it that nothing there understands AT commands.
modem_manager "" "ttyACM[0-9].*port filtered"
check "ModemManager as Debian ships it leaves the port alone" grep "ttyACM[0-9].*port filtered" /share/mm.txt
check "ModemManager as Debian ships it: the bus is silent" no_harm
capture_is_exact "a capture after ModemManager"

# The same when it is configured to try every protocol it knows.
modem_manager 'SUBSYSTEMS=="usb", ATTRS{manufacturer}=="cantap", ENV{ID_MM_DEVICE_PROCESS}="1"' "task 0: finished"
grep -E "ttyACM[0-9]/[a-z]+\] (-->|<--)" /share/mm.txt
check "ModemManager probes the port where it is told to" grep -q "ttyACM[0-9]/at.*--> 'AT<CR>'" /share/mm.txt
check "ModemManager finds no modem" grep -q "couldn't create modem" /share/mm.txt
check "ModemManager's probing: the bus is silent" no_harm
capture_is_exact "a capture after ModemManager's probing"
killall systemd-udevd dbus-daemon
