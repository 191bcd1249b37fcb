#!/bin/bash
# boot.sh CACHE SHARE: boots CACHE's kernel under emulation (no KVM needed); the guest sees SHARE as /share and this computer as 10.0.2.2. The board of
# SHARE/ports can also appear on an emulated xHCI.
set -euo pipefail
cache=$1
share=$2
# shellcheck source=/dev/null
. "$share/ports"
# The kernel tests the timer against a loop, which fails when this computer is busy: hence no_timer_check.
# A guest that hangs is ended after LIMIT seconds.
exec timeout "${LIMIT:-1800}" qemu-system-x86_64 \
  -machine q35 -accel tcg,thread=multi -cpu max -smp 1 -m 1024 \
  -nodefaults -no-user-config -display none -no-reboot \
  -kernel "$cache/vmlinux" -initrd "$cache/initrd" -append "console=ttyS0 panic=-1 quiet no_timer_check" -serial stdio \
  -fsdev "local,id=share,path=$share,security_model=none" -device virtio-9p-pci,fsdev=share,mount_tag=share \
  -netdev user,id=net -device virtio-net-pci,netdev=net,romfile= \
  -device qemu-xhci,id=xhci -chardev "socket,id=board,host=127.0.0.1,port=$REDIR" -device usb-redir,chardev=board,bus=xhci.0 </dev/null
