#!/bin/sh
# shellcheck shell=dash
# The kernel's enumeration, and what lsusb makes of the descriptors.

quiet_kernel() {
  ! dmesg | grep -iE "usb 1-1.*(error|not|unable|invalid|fail|warning)|cdc_acm.*(error|fail|zero|quirk)"
}
quiet_lsusb() {
  lsusb -v -d "$(device_id)" > /share/lsusb.txt 2>&1
  ! grep -nE "Missing|Warning|INVALID|invalid|junk|can't|unknown|error|UNRECOGNIZED" /share/lsusb.txt
}
check "the kernel makes a serial port of it" attach
dmesg | grep -E "usb 1-1|cdc_acm"
check "the kernel has nothing to complain about" quiet_kernel
check "lsusb -v has nothing to complain about" quiet_lsusb
check "cantap info" info
cat info.txt
check "cantap list" "$CANTAP" list
status_is_told() { "$CANTAP" status -d "$PORT" > /dev/null; }
check "cantap status" status_is_told
