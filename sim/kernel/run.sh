#!/bin/bash
# run.sh CACHE CANTAP SIM ELF [PART...]: CACHE is prepare.sh's; the `cantap` and `cantap-sim` commands; the firmware. Exit code 0 only if
# every check holds. The part `foreign` is for other firmware than ours, which ELF is then.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
cache=$1 cantap=$2 sim=$3 elf=$4
shift 4

work=$(mktemp -d)
server=
finish() {
  [ -z "$server" ] || kill "$server" 2>/dev/null || true
  if [ -n "${KEEP:-}" ]; then mkdir -p "$KEEP" && cp -r "$work/." "$KEEP"; fi
  rm -rf "$work"
}
trap finish EXIT

share=$work/share
mkdir "$share"
cp -r "$here/guest" "$share"
cp "$cantap" "$share/cantap"
echo "PARTS='$*'" > "$share/settings"

any=
[ "$*" != foreign ] || any=--any
# shellcheck disable=SC2086 # none, or one word
"$sim" usbip $any "$elf" "$share" 2> "$work/server.err" &
server=$!
for _ in $(seq 600); do
  [ ! -s "$share/ports" ] || break
  kill -0 "$server" 2>/dev/null || { cat "$work/server.err" >&2; exit 1; }
  sleep 0.1
done

bash "$here/boot.sh" "$cache" "$share" 2>&1 | stdbuf -oL tr -d '\r' | tee "$work/output" || true

# The board must have survived all of it.
if ! kill -0 "$server" 2>/dev/null; then
  echo "FAIL  the server ended: $(cat "$work/server.err")"
  exit 1
fi
grep -q '^GUEST: exit code 0$' "$work/output"
