#!/bin/sh
# check-layers.sh [ROOT]: who may include what.  Prints every line that breaks a rule; fails if there is one.
#
#   lib <- autograd <- models <- train, infer      lib <- data <- train, infer      tests look into every room
#
# A third-party header is known to one file, so that its types never spread.  The one exception: tests/bench_gemm.c
# includes cblas.h too, because OpenBLAS is the yardstick there.
cd "${1:-.}" || exit 2
find lib autograd models data train infer tests -type f \( -name '*.[ch]' -o -name '*.inc' \) 2>/dev/null | sort |
    xargs awk '
function fail(why) {
    printf "%s:%d: %s\n", FILENAME, FNR, why
    bad = 1
}

BEGIN {
    may["lib"] = "lib"
    may["autograd"] = "autograd lib"
    may["models"] = "models autograd lib"
    may["data"] = "data lib"
    may["train"] = "train models data autograd lib"
    may["infer"] = "infer models data autograd lib"
    may["tests"] = "tests train infer models data autograd lib"

    only["cblas.h"] = "^(lib/gemm|tests/bench_gemm)[.]c$"
    only["cJSON.h"] = "^lib/json[.]c$"
    only["openssl/evp.h"] = "^lib/sha256[.]c$"
    only["libdeflate.h"] = "^data/(de|in)flate[.]c$"
    only["hdf5.h"] = "^data/h5[.]c$"
    only["openexr.h"] = "^data/exr[.]c$"
    only["png.h"] = "^data/png[.]c$"
    only["jpeglib.h"] = "^data/jpeg[.]c$"
    only["jerror.h"] = "^data/jpeg[.]c$"
    only["meshoptimizer.h"] = "^data/meshopt[.]c$"
    only["cmocka.h"] = "^tests/test[.]h$"
    only["omp.h"] = "^lib/thread[.]c$"
    only["immintrin.h"] = "^lib/kern_[a-z0-9_]*[.](c|h|inc)$"

    standard = "^(complex|ctype|errno|fenv|float|inttypes|limits|locale|math|setjmp|signal|stdalign|stdarg|" \
        "stdatomic|stdbool|stddef|stdint|stdio|stdlib|string|time|wchar|" \
        "dirent|fcntl|fnmatch|ftw|glob|pthread|sched|spawn|strings|unistd|sys/[a-z]+)[.]h$"
}

FNR == 1 {
    room = FILENAME
    sub("/.*", "", room)
    own = FILENAME
    sub("[.][a-z]+$", ".h", own)
    has_own = own != FILENAME && (getline line < own) >= 0
    close(own)
    ours = 0
    seen = 0
}

/^[ \t]*#[ \t]*include/ {
    if (!match($0, "[<\"][^>\"]*[>\"]")) next
    quoted = substr($0, RSTART, 1) == "\""
    name = substr($0, RSTART + 1, RLENGTH - 2)
    if (!seen++ && has_own && name != own) fail("the own header " own " comes first")
    if (!quoted) {
        if (name in only) {
            if (FILENAME !~ only[name]) fail("<" name "> belongs to " only[name])
        } else if (name !~ standard) fail("<" name "> is no header that this project knows")
        if (ours > 1) fail("<" name "> comes after our headers")
        next
    }
    ours++
    if (name ~ "[.]c$") fail("a .c file is compiled, not included")
    if (name in only) {
        fail(name " is written with < >")
        next
    }
    if ((getline line < name) < 0) fail("\"" name "\" is not written from the root")
    close(name)
    there = name
    sub("/.*", "", there)
    if (index(" " may[room] " ", " " there " ") == 0) fail(room " must not include " there)
}

END { exit bad }
'
