#!/bin/bash
# Runs the README's two commands where nothing is left over from other work: in a new Debian that has only git, a C compiler and the
# Rust toolchain, first as an ordinary user who cannot install anything, then as root.
#   packaging/try-fresh.sh [DIRECTORY [COMMIT]]
# DIRECTORY (default: a new one under /var/tmp) gets the system, 2 GB, and 20 GB while the commands run; COMMIT (default: HEAD) is what
# is tried. It has to be started by root, on a Debian with rustup; the new system uses this one's package sources and settings of cargo and pip.
# WHO="user" or WHO="root" runs one half; COMMANDS are others to run instead, separated by semicolons.
set -euo pipefail
cd "$(dirname "$0")/.."

root=${1:-$(mktemp -d /var/tmp/cantap-fresh.XXXXXX)}
commit=$(git rev-parse "${2:-HEAD}")
commands=${COMMANDS:-cargo demo; cargo xtask test}
who=${WHO:-user root}
export DEBIAN_FRONTEND=noninteractive

[ "$(id -u)" = 0 ] || { echo "try-fresh.sh: only root can make a new system; run it with sudo" >&2; exit 1; }
for tool in debootstrap rustup; do
    command -v "$tool" >/dev/null || [ "$tool" = rustup ] || apt-get -q install -y --no-install-recommends "$tool"
done

if [ ! -e "$root/etc/debian_version" ]; then
    mirror=$(cat /etc/apt/sources.list.d/debian.sources /etc/apt/sources.list 2>/dev/null \
        | sed -nE 's/^(URIs: *|deb (\[[^]]*\] )?)(https?:[^ ]+).*/\3/p' | grep -v security | head -n 1) || true
    debootstrap --variant=minbase --include=ca-certificates,git,gcc,libc6-dev bookworm "$root" "${mirror:-http://deb.debian.org/debian}"
    rm -f "$root/etc/apt/sources.list"
    for file in /etc/apt/sources.list.d/debian.sources /etc/apt/sources.list; do
        [ ! -e "$file" ] || install -D "$file" "$root$file"
    done
    # How this machine reaches package servers, which a new one would be told as well.
    cp -a /etc/apt/apt.conf.d/. "$root/etc/apt/apt.conf.d/"
    for file in /etc/resolv.conf /etc/hosts /etc/ssl/certs/ca-certificates.crt /etc/pip.conf; do
        [ ! -e "$file" ] || install -D "$(readlink -f "$file")" "$root$file"
    done
    chroot "$root" useradd --create-home user
fi
# The toolchain as rustup installed it, read-only for all.
mkdir -p "$root/opt"
rust=$(dirname "$(dirname "$(rustup which cargo)")")
[ -e "$root/opt/rust" ] || cp -a "$rust" "$root/opt/rust"

mounted=()
cleanup() {
    for ((i = ${#mounted[@]} - 1; i >= 0; i--)); do umount -l "${mounted[i]}"; done
}
trap cleanup EXIT
bind() { mkdir -p "$root$2"; mount "${@:3}" "$1" "$root$2"; mounted+=("$root$2"); }
bind proc /proc -t proc
bind sysfs /sys -t sysfs
bind /dev /dev --bind
bind /dev/pts /dev/pts --bind
bind tmpfs /dev/shm -t tmpfs

# Settings of the registries' clients; nothing else of this session's environment gets in.
settings=()
while IFS= read -r name; do
    value=${!name}
    case $name in
    PIP_* | CARGO_HTTP_* | CARGO_NET_* | CARGO_REGISTRIES_* | *_CA_* | *_CERT* | SSL_* | http_proxy | https_proxy | no_proxy | HTTP_PROXY | HTTPS_PROXY | NO_PROXY)
        settings+=("$name=$value")
        [ ! -f "$value" ] || install -D -m 644 "$value" "$root$value"
        ;;
    esac
done < <(compgen -e)

for person in $who; do
    case $person in user) home=/home/user ;; root) home=/root ;; *) echo "try-fresh.sh: WHO is user or root" >&2; exit 1 ;; esac
    rm -rf "$root$home/cantap"
    git clone -q --no-hardlinks . "$root$home/cantap"
    git -C "$root$home/cantap" checkout -q "$commit"
    mkdir -p "$root$home/.cargo"
    [ ! -e "${CARGO_HOME:-$HOME/.cargo}/config.toml" ] || cp "${CARGO_HOME:-$HOME/.cargo}/config.toml" "$root$home/.cargo/"
    chroot "$root" chown -R "$person:" "$home"
    IFS=';' read -ra list <<<"$commands"
    for command in "${list[@]}"; do
        echo "=== $person: $command"
        begin=$SECONDS
        # Neither CI nor any other variable: a new user has none.
        chroot "$root" su "$person" -s /bin/bash -c "cd $home/cantap && env -i HOME=$home TERM=dumb LANG=C.UTF-8 \
            PATH=/opt/rust/bin:/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin $(printf '%q ' "${settings[@]}") $command" </dev/null
        echo "=== $person: $command: ok, $((SECONDS - begin)) s"
    done
    rm -rf "$root$home/cantap"
done
