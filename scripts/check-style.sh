#!/bin/sh
# check-style.sh [ROOT]: what neither the compiler nor clang-format sees.  Prints every line that breaks a rule; fails
# if there is one.
cd "${1:-.}" || exit 2
export LC_ALL=C
{
    find lib autograd models data train infer tests -type f \( -name '*.[ch]' -o -name '*.inc' -o -name '*.def' \)
    find Makefile scripts .ci -type f
} 2>/dev/null | sort | xargs awk '
function fail(why) {
    printf "%s:%d: %s\n", FILENAME, FNR, why
    bad = 1
}

# A rule: lines of files that match where, but not except, must not match re.
function rule(of, where, except, re, why) {
    R++
    of_[R] = of; where_[R] = where; except_[R] = except; re_[R] = re; why_[R] = why
}

# The line without comments, characters and the inside of strings; keeps in_comment from line to line.
function strip(s,    out, i) {
    if (!in_comment) {
        gsub(/\047(\\.|[^\047\\])\047/, "0", s)
        gsub(/"([^"\\]|\\.)*"/, "\"\"", s)
    }
    out = ""
    while (s != "") {
        if (in_comment) {
            i = index(s, "*/")
            if (!i) return out
            s = substr(s, i + 2)
            in_comment = 0
        } else if ((i = index(s, "/*")) > 0) {
            out = out substr(s, 1, i - 1) " "
            s = substr(s, i + 2)
            in_comment = 1
        } else {
            out = out s
            s = ""
        }
    }
    sub("//.*", "", out)
    return out
}

BEGIN {
    any = "."
    none = "^$"
    C = "[.](c|h|inc|def)$"
    word = "(^|[^A-Za-z0-9_])"

    # Marks that say: not finished.  This file spells them.
    rule("raw", any, "^scripts/check-style", word "(TODO|FIXME|XXX|HACK)([^A-Za-z0-9_]|$)", "finish it")
    rule("raw", any, none, "[ \t]$", "space at the end of the line")
    rule("raw", C, none, "\t", "tab")

    # Results must not depend on flags, on threads or on hidden state.
    flags = "-ffast-math|-funsafe-math|-fassociative-math|-freciprocal-math|-ffinite-math|-march=native|-Ofast"
    rule("code", "^(Makefile|scripts/|[.]ci/)", "^scripts/check-style", flags, "changes results or portability")
    rule("code", C, none, "optimize[ ]*[(]|fp_contract|FP_CONTRACT", "flags are set in the Makefile")
    rule("code", C, "^lib/thread[.]c$", "#[ \t]*pragma[ \t]+omp|_Pragma", "threads: only lib/thread.c")
    rule("code", C, none, "reduction[ ]*[(]", "a reduction clause sums in any order: use dar_parallel_sum")
    rule("code", C, none, word "s?rand(om)?(_r)?[ ]*[(]|[^a-z_]drand48", "hidden generator state")

    # Processors.
    rule("code", C, "^lib/kern_", "__(AVX|SSE|FMA|F16C)[A-Z0-9_]*__", "instruction sets: only lib/kern_*")
    rule("code", C, "^lib/kern_", word "(_mm[0-9]*_|__m(128|256|512))", "intrinsics: only lib/kern_*")

    # Memory and errors.
    heap = "(malloc|calloc|realloc|aligned_alloc|posix_memalign|strdup|alloca|free)"
    rule("code", "^(autograd/ops/|lib/(kern|tile))", none, word heap "[ ]*[(]", "ops and kernels do not allocate")
    rule("code", C, none, word "assert[ ]*[(]", "DAR_ASSERT stays in release builds, assert does not")
    rule("code", C, "^lib/status[.]c$", word "abort[ ]*[(]", "DAR_ASSERT says why")
    rule("code", C, none, word "(gets|strcpy|strcat|sprintf|vsprintf|strtok|atoi|atof)[ ]*[(]", "unchecked")

    # Shape of the text.
    rule("raw", C, none, "^[ \t]*#[ \t]*if[ \t]+0", "dead code")
    rule("code", C, none, "typedef.*[a-z0-9]_t[ ]*;|^}[ ]*[a-z0-9_]+_t[ ]*;", "type names have no _t")
    rooms = "^(lib|autograd|models|data)/"
    rule("code", rooms, "^lib/(status|log|args|program)[.]c$", word "f?printf[ ]*[(][ ]*(std|\")", "rooms do not print")
}

FNR == 1 {
    in_comment = in_main = 0
    guard = "DAR_" toupper(FILENAME)
    gsub("[/.]", "_", guard)
    guarded = 0
    is_c = FILENAME ~ C
    delete active
    for (r = 1; r <= R; r++) active[r] = FILENAME ~ where_[r] && FILENAME !~ except_[r]
}

FNR == 801 { fail("more than 800 lines") }

{
    if (is_c) code = strip($0)
    else {
        code = $0
        sub("(^|[ \t])#.*", "", code)
    }
    for (r = 1; r <= R; r++)
        if (active[r] && (of_[r] == "raw" ? $0 : code) ~ re_[r]) fail(why_[r])

    wide = $0
    gsub(/[\200-\277]/, "", wide) # UTF-8: one character, one column
    if (length(wide) > 120) fail("line of " length(wide) " characters, at most 120")

    if (code ~ /^int main[ ]*\(/) in_main = 1
    if (code ~ /^}/) in_main = 0
    if (is_c && !in_main && code ~ word "_?exit[ ]*[(]") fail("exit: only in main")

    if (FILENAME ~ /[.]h$/ && !guarded && code ~ /[^ \t]/) {
        if (code != "#ifndef " guard) fail("expected #ifndef " guard)
        guarded = 1
    }
}

END { exit bad }
'
