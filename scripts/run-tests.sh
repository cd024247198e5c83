#!/bin/sh
# run-tests.sh BUILD TEST...: run every test program, keep its output in BUILD/TEST.log, print failures, skips and the
# programs' own "note:" lines, then the totals.  Fails if a program fails or if the number of skips is not
# EXPECTED_SKIPS (default 0).
#
# Idle threads sleep: programs that ask for more threads than there are processors, as tests do, else spin for nothing.
export OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive}
build=$1
shift
passed=0 failed=0 skipped=0 bad=0
export ASAN_OPTIONS="${ASAN_OPTIONS:-handle_segv=2:detect_leaks=1}" CMOCKA_MESSAGE_OUTPUT=STDOUT
for t in "$@"; do
    start=$(date +%s.%N)
    "$build/$t" >"$build/$t.log" 2>&1
    status=$?
    end=$(date +%s.%N)
    p=$(grep -c '^\[       OK \]' "$build/$t.log")
    s=$(grep -c '^\[  SKIPPED \] [^0-9]' "$build/$t.log")
    f=$(grep -c '^\[  FAILED  \] [^0-9]' "$build/$t.log")
    s=$((s / 2)) f=$((f / 2)) # cmocka names each twice
    if [ $status -ne 0 ]; then
        [ $f -eq 0 ] && f=1
        bad=1
        echo "FAILED $t (status $status): $build/$t.log"
        grep -vE '^\[ RUN|^\[       OK' "$build/$t.log" | head -40
    fi
    printf '%-18s %3d passed %3d failed %3d skipped %6.1f s\n' "$t" "$p" "$f" "$s" "$(awk "BEGIN{print $end - $start}")"
    grep '^skip: ' "$build/$t.log"
    sed -n 's/^note: //p' "$build/$t.log"
    passed=$((passed + p)) failed=$((failed + f)) skipped=$((skipped + s))
done
if [ "$skipped" -ne "${EXPECTED_SKIPS:-0}" ]; then
    echo "skipped $skipped, expected ${EXPECTED_SKIPS:-0}"
    bad=1
fi
# The gradient check's figure stands right before the totals.
cat "$build"/*.log 2>/dev/null | grep '^gradcheck: worst' | tail -1
echo "$passed passed, $failed failed, $skipped skipped"
exit $bad
