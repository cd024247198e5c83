#!/bin/sh
# check.sh [static]: every rule that a machine can keep.  One line per rule, the details of those that fail, and a
# summary; fails if a rule does.  `static` stops before the builds.  Logs and builds: build/check.
cd "$(dirname "$0")/.." || exit 2
scripts/install-deps.sh check || exit
mkdir -p build/check
jobs=$(nproc)
started=$(date +%s)
failed=
rules=0

# rule NAME COMMAND...
rule() {
    name=$1
    shift
    log=build/check/$(echo "$name" | tr -c 'a-z0-9\n' '-').log
    begin=$(date +%s)
    printf 'check: %-36s' "$name"
    rules=$((rules + 1))
    if "$@" >"$log" 2>&1; then
        echo "ok $(($(date +%s) - begin)) s"
    else
        echo "FAILED, $log:"
        grep -v '^CC ' "$log" | tail -40
        failed="$failed, $name"
    fi
}

finish() {
    if [ -n "$failed" ]; then
        echo "check: FAILED:${failed#,}"
        exit 1
    fi
    echo "check: $rules rules hold, $(($(date +%s) - started)) s"
    exit 0
}

# Versions of clang-format disagree; the tree is in the shape of this one.
format() {
    tool=clang-format-14
    command -v $tool || tool=clang-format
    $tool --version | grep 'version 14' || {
        echo "found $($tool --version), expected version 14"
        return 1
    }
    find lib autograd models data train infer tests -name '*.[ch]' -o -name '*.inc' | xargs $tool --dry-run -Werror
}

shell_syntax() {
    for f in scripts/*.sh .ci/run; do sh -n "$f" || return 1; done
}

pages() {
    scripts/install-deps.sh pages && scripts/check-pages.sh build/check/gcc-release
}

# Every global name of the library starts with dar_.
names() {
    nm -g --defined-only "$1" | awk 'NF == 3 && $3 !~ /^dar_/ { print "exported: " $3; bad = 1 } END { exit bad }'
}

# build CC MODE [TARGET], in a folder of its own
build() {
    make --no-print-directory -j"$jobs" CC="$1" MODE="$2" B="build/check/$1-$2" "${3:-everything}"
}

rule "layers" scripts/check-layers.sh
rule "style" scripts/check-style.sh
rule "format" format
rule "shell syntax" shell_syntax
rule "headers alone" build gcc debug headers
[ "$1" = static ] || [ -n "$failed" ] && finish

rule "gcc release: build and tests" build gcc release test-built
rule "pages in a browser" pages
rule "exported names" names build/check/gcc-release/libdar.a
rule "clang release: build and tests" build clang release test-built
rule "gcc debug: build" build gcc debug
rule "gcc asan, ubsan: build and tests" build gcc asan test-built
finish
