#!/bin/sh
# shellcheck shell=dash
# Runs in the guest: the parts, one after the other. Exit code 0 only if nothing failed.
# shellcheck source=/dev/null
. /share/guest/lib.sh

# shellcheck source=/dev/null
. /share/settings
ALL_PARTS="enumeration captures stalls slcan slcan_reports socketcan gs_usb bridge serve disturbances chapter9 suspend hub modem_manager xhci"
# A program of others, where it is.
[ ! -x /share/guest/cannelloni ] || ALL_PARTS="$ALL_PARTS cannelloni"
for part in ${PARTS:-$ALL_PARTS}; do
  echo "--- $part, at $(uptime_s) s"
  # shellcheck source=/dev/null # whichever it is
  . "/share/guest/parts/$part.sh"
done

dmesg > /share/dmesg.txt
figures > /share/figures.json
echo "--- $CHECKS checks, $FAILED failed, at $(uptime_s) s"
[ "$FAILED" = 0 ]
