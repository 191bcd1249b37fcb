#!/bin/sh
# shellcheck shell=dash
# The same device on a host controller that QEMU emulates, xHCI, by usbredir: the kernel's driver for it, with its resets, addresses and
# halts. Only once per boot of the guest: QEMU does not reconnect.

quiet_on_xhci() {
  ! dmesg | grep -E "usb [0-9]+-[0-9]+|xhci" | grep -iE "error|unable|invalid|fail|warning|not respond"
}

has_no_port || detach
dmesg -c > /dev/null
modprobe xhci-pci
board traffic 50 mix
board redirect
check "xHCI: the kernel makes a serial port of it" wait_until has_port
check "xHCI: the kernel has nothing to complain about" quiet_on_xhci
check "xHCI: cantap info" info
capture_is_exact "xHCI: a capture at 50 %" 2
board traffic 100 std0
capture_is_exact "xHCI: a capture at 100 %, shortest frames" 2
usbreset "$(device_id)" > /dev/null
wait_until has_port
capture_is_exact "xHCI: a capture after a reset"
stream -t 60
board unplug
check "xHCI: a client whose cable is pulled says so" wait_until has_told "continues when the device is back"
kill -INT "$CAPTURE"
wait "$CAPTURE"
wait_until has_no_port
