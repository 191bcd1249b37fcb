#!/bin/bash
# prepare.sh CACHE [KERNEL]: Debian's packages -> CACHE/vmlinux and CACHE/initrd. Needs apt-get, cpio, kmod, xz-utils and zstd. Ends with 75 if the
# packages cannot be fetched.
# The guest's packages are unpacked, never installed here. No version is pinned: it is the stock kernel of this Debian release, or another that it
# has, named by its metapackage (linux-image-6.12-amd64).
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
kernel=${2:-linux-image-amd64}
mkdir -p "$1"
cd "$1"

# Nothing to do if what is there was made from the same recipe.
recipe=$({ echo "$kernel" && cat "$here/prepare.sh" "$here/init"; } | sha256sum)
if [ -f initrd ] && [ "$recipe" = "$(cat recipe 2>/dev/null)" ]; then
  exit 0
fi

programs="busybox-static can-utils usbip kmod usbutils iproute2 util-linux perl-base"
modem_manager="modemmanager udev dbus-daemon dbus-bin"
python="python3-can python3-wrapt python3-typing-extensions python3-packaging python3-msgpack python3-pkg-resources python3-minimal"
modules="virtio_pci virtio_net 9p 9pnet_virtio can can-raw vcan vxcan slcan gs_usb cdc-acm vhci-hcd xhci-pci"

# `apt-get` prints where each file comes from, which is only useful if it fails.
quietly() { "$@" > log 2>&1 || { cat log >&2; return 1; }; }

# A mirror may fail for a moment: each of these is tried again. If something cannot be fetched at all, this ends with 75, "try again
# later".
fetch() {
  for pause in 5 20 60 0; do
    quietly apt-get -q -o Acquire::Retries=3 "$@" && return
    sleep $pause
  done
  echo "the guest's packages cannot be fetched" >&2
  exit 75
}

# Only root may do this; others use what was last fetched.
[ "$(id -u)" != 0 ] || fetch update
image=$(apt-cache show --no-all-versions "$kernel" | sed -n 's/^Depends: \(linux-image-[^ ]*\).*/\1/p')
[ -n "$image" ] || { echo "Debian's packages here have no $kernel" >&2; exit 75; }
# The interpreter has its version in its name.
python="$python $(apt-cache depends python3-minimal | sed -n 's/^ *PreDepends: \(python3[^ ]*\)$/\1/p')"
# The libraries that the programs need, and those that these need; but not packages that are only named as alternatives.
# shellcheck disable=SC2086 # lists of words
libraries=$(apt-cache depends --recurse --no-recommends --no-suggests --no-conflicts --no-breaks --no-replaces --no-enhances \
  $programs $modem_manager $python | grep -E '^(lib[a-z0-9+.-]+|zlib1g)$' | grep -vE 'perl|pam|elogind|installer|cryptsetup|systemd-shared' | sort -u)
rm -rf packages root kernel vmlinux
mkdir packages root kernel
# shellcheck disable=SC2086
cd packages
fetch download "$image" $programs $modem_manager $python $libraries
cd ..

for package in packages/*.deb; do
  case $package in
    packages/linux-image-*) ;;
    *) dpkg-deb -x "$package" root ;;
  esac
done
rm -rf root/usr/share/{doc,man,locale,info,lintian,bash-completion,perl,zoneinfo} root/lib/udev/hwdb.d
rm -rf root/usr/lib/*/{gconv,perl-base/unicore}
install -m 755 "$here/init" root/init
# Busybox's shell prefers its own `ip`, which knows nothing about CAN.
mv "$(find root -path '*bin/ip' -type f)" root/usr/bin/iproute2
mkdir -p root/{proc,sys,dev,run,share,tmp,root,var/lib}
ln -sfn ../run root/var/run
echo 'root:x:0:0:root:/root:/bin/sh' > root/etc/passwd
echo 'root:x:0:' > root/etc/group

# Modules, with everything they depend on.
dpkg-deb --fsys-tarfile packages/linux-image-*.deb | tar -x -C kernel --wildcards './boot/vmlinuz*' './lib/modules/*/modules.*' \
  './lib/modules/*/kernel/net/*' './lib/modules/*/kernel/fs/*' './lib/modules/*/kernel/lib/*' './lib/modules/*/kernel/crypto/*' \
  './lib/modules/*/kernel/drivers/usb/*' './lib/modules/*/kernel/drivers/net/*' './lib/modules/*/kernel/drivers/virtio/*'
version=$(basename kernel/lib/modules/*)
depmod -b kernel "$version"
for module in $modules; do
  modprobe -d "$PWD/kernel" -S "$version" --show-depends "$module" | sed -n 's/^insmod \([^ ]*\).*/\1/p'
done | sort -u | sed "s|^$PWD/kernel/||" > wanted
(cd kernel && xargs cp --parents -t ../root < ../wanted && cp --parents lib/modules/"$version"/modules.{builtin,builtin.modinfo,order} ../root)
depmod -b root "$version"
# Not compressed: the emulated processor would have to unpack it.
(cd root && find . | cpio -o -H newc --quiet) > initrd

# Under emulation, a kernel that need not unpack itself boots in 5 s rather than 20. Its payload is one stream, xz or, since 6.12, zstd (found by
# its magic number), with something after it, about which both programs complain; a payload that is not an ELF is a failure.
unpack() {
  offset=$(LC_ALL=C grep -obUaP -m1 "$1" kernel/boot/vmlinuz-* | head -1 | cut -d: -f1) || true
  [ -n "$offset" ] || return 0
  shift
  tail -c +$((offset + 1)) kernel/boot/vmlinuz-* | "$@" > vmlinux 2>/dev/null || true
}
unpack '\xfd7zXZ\x00' xz -dc --single-stream
[ -s vmlinux ] || unpack '\x28\xb5\x2f\xfd' zstd -dc
[ "$(head -c 4 vmlinux | od -An -tx1)" = " 7f 45 4c 46" ] || { echo "the kernel's image holds no ELF" >&2; exit 1; }

rm -rf packages root kernel wanted log
echo "$recipe" > recipe
