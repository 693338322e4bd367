#!/bin/bash
# SPDX-License-Identifier: Apache-2.0
# Does the package install on arm64 and calibrate there? In a Debian under emulation, from nothing.
#
#     benchmark/arm64.sh [FOLDER]
#
# FOLDER (measured/arm64): 1 GB; a step whose result is there is not repeated. Needs an environment
# with the package, root's rights, and Debian's debootstrap, proot and qemu-user-static. Prints how
# long each step takes, and the figures of both architectures. The drive is rendered by the host:
# that would take an hour. Emulation takes 10 to 20 times as long as a computer of that kind.
set -euo pipefail

usage='usage: arm64.sh [FOLDER]'
case ${1:-} in -h|--help) echo "$usage"; exit;; -*) echo "$usage" >&2; exit 2;; esac
sources=$(cd "$(dirname "$0")/.." && pwd)
folder=${1:-$sources/measured/arm64}
mkdir -p "$folder"
folder=$(cd "$folder" && pwd)
root=$folder/root

step() {  # NAME COMMAND...: run it, and print the seconds
    local name=$1 begun=$SECONDS
    shift
    "$@" > "$folder/log.txt" 2>&1 || { tail -n 20 "$folder/log.txt" >&2; exit 1; }
    echo "$name: $((SECONDS - begun)) s"
}

make_root() {
    rm -rf "$root"
    debootstrap --foreign --arch=arm64 --variant=minbase \
        --include=python3,python3-venv,python3-pip bookworm "$root"
    # in a container, debootstrap makes a link of it, which is a loop in the root
    rm -f "$root/proc"
    mkdir -p "$root/proc"
    # the packages are not configured: their scripts take long, and Python needs none
    local package
    for package in "$root"/var/cache/apt/archives/*.deb; do dpkg-deb -x "$package" "$root"; done
    rm "$root"/var/cache/apt/archives/*.deb
}

emulated() {  # COMMAND...: run it in the root
    local binds=() file
    for file in /proc /dev /etc/resolv.conf /etc/hosts /etc/ssl/certs /etc/pip.conf; do
        if [ -e "$file" ]; then binds+=(-b "$file"); fi
    done
    env -u PYTHONPATH HOME=/root LC_ALL=C.UTF-8 TMPDIR=/tmp PATH=/opt/venv/bin:/usr/bin:/bin \
        nice proot -q qemu-aarch64-static -0 -r "$root" -w / "${binds[@]}" "$@"
}

install_package() {
    rm -rf "$root/src" "$root/opt/venv"
    mkdir "$root/src"
    git -C "$sources" ls-files -z | tar -C "$sources" -c --null -T - | tar -C "$root/src" -x
    emulated /usr/bin/python3 -m venv /opt/venv
    emulated pip install /src
    emulated pip list
}

render() {
    # the exit code is 3 where the verdict is weak: the figures show it
    dashcalib demo --keep-bag --out "$folder/demo" || [ $? = 3 ]
    dashcalib run "$folder/demo/bag" --out "$folder/x86" --set reconstruct.engine=opencv \
        || [ $? = 3 ]
}

calibrate() {
    cp -r "$folder/demo/bag" "$root/tmp/bag"
    emulated dashcalib run /tmp/bag --out /tmp/result || [ $? = 3 ]
    mv "$root/tmp/result" "$folder/arm64"
}

[ -e "$root/usr/bin/python3" ] || step 'root' make_root
[ -e "$root/opt/venv/bin/dashcalib" ] || step 'pip install .' install_package
echo "$(emulated python3 -c 'import platform; print(platform.machine())'): $(
    emulated dashcalib --version)"
[ -e "$folder/x86/result.json" ] || step 'x86: render, calibrate twice' render
[ -e "$folder/arm64/result.json" ] || step 'arm64: calibrate' calibrate
python3 - "$folder" <<'END'
import json, pathlib, sys

folder = pathlib.Path(sys.argv[1])
truth = json.loads((folder / 'demo/truth.json').read_text())
print('| where | engine | verdict | fx px | off | sigma px | k1 |\n|---|---|---|---|---|---|---|')
verdicts = []
for name, where in (('x86', 'demo'), ('x86', 'x86'), ('arm64', 'arm64')):
    found = json.loads((folder / where / 'result.json').read_text())
    fx, k1 = found['intrinsics']['fx'], found['intrinsics']['k1']
    verdicts.append(found['verdict'])
    print(f"| {name} | {found['versions']['engine']} | {found['verdict']} | {fx:.2f} "
          f"| {100 * (fx / truth['fx'] - 1):+.2f} % | {found['sigma']['fx']:.2f} | {k1:.4f} |")
sys.exit(verdicts[-1] != 'accepted')
END
