#!/bin/sh
# Installs Debian's package in a clean Debian, as root, and checks that everything it brings is there and works:
#   debootstrap --variant=minbase bookworm ROOT && cp cantap_*.deb packaging/try-deb.sh ROOT/root/
#   chroot ROOT sh /root/try-deb.sh /root/cantap_VERSION_amd64.deb
# or in a container of debian:12.
set -eu
export DEBIAN_FRONTEND=noninteractive

apt-get -q update
apt-get -q install -y --no-install-recommends "$1"

cantap --version
for file in /usr/lib/udev/rules.d/60-cantap.rules /usr/share/bash-completion/completions/cantap \
    /usr/share/zsh/vendor-completions/_cantap /usr/share/fish/vendor_completions.d/cantap.fish \
    /usr/lib/systemd/user/cantap.socket /usr/lib/systemd/user/cantap.service /usr/lib/systemd/system/cantap-lab.service \
    /usr/share/doc/cantap/copyright /usr/share/doc/cantap/THIRD-PARTY.txt; do
    test -s "$file" || { echo "missing: $file"; exit 1; }
done
# A page for each subcommand that the help lists.
for name in $(cantap --help | sed -n '/^Look at/,/^Topics/s/^  \([a-z][a-z0-9]*\) .*/\1/p' | grep -v '^help$'); do
    test -s "/usr/share/man/man1/cantap-$name.1.gz" || { echo "missing: the page of cantap $name"; exit 1; }
done
gzip -t /usr/share/man/man1/cantap.1.gz
bash -n /usr/share/bash-completion/completions/cantap

cantap demo --time 3s
cantap capture -d virtual -b 500k -t 1s -o /tmp/virtual.log
test "$(grep -c '#' /tmp/virtual.log)" -gt 100
dpkg --verify cantap
apt-get -q remove -y cantap
test ! -e /usr/bin/cantap
echo "the package installs, works and goes"
