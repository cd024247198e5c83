#!/bin/sh
# install-deps.sh: install the Debian packages that are missing; quick and silent when none is.
need="gcc make libc6-dev libopenblas-openmp-dev libcjson-dev libcmocka-dev
libmeshoptimizer-dev libpng-dev libjpeg62-turbo-dev libhdf5-dev libdeflate-dev libssl-dev libopenexr-dev ffmpeg"
# `make check` and `make fuzz` want clang too: scripts/install-deps.sh check
[ "$1" = check ] && need="$need clang clang-format libomp-dev libclang-rt-14-dev"
# the rule of `make check` that opens pages: scripts/install-deps.sh pages
[ "$1" = pages ] && need="$need chromium"
missing=
for p in $need; do
    [ "$(dpkg-query -W -f='${db:Status-Status}' "$p" 2>/dev/null)" = installed ] || missing="$missing $p"
done
[ -z "$missing" ] && exit 0
echo "installing:$missing"
sudo=
[ "$(id -u)" = 0 ] || sudo=sudo
export DEBIAN_FRONTEND=noninteractive
# shellcheck disable=SC2086
$sudo apt-get update -qq && $sudo apt-get install -y -qq --no-install-recommends $missing >/dev/null || {
    echo "install-deps: could not install:$missing" >&2
    exit 3
}
