/* test_rules.c: the source keeps its rules, and the scripts that say so notice each way of breaking them. */
#include "tests/test.h"

#include <sys/stat.h>
#include <unistd.h>

static char tree[256]; /* a small tree of sources beside this program */

static const struct breach {
    const char *script, *file, *text, *says;
} breaches[] = {
    { "layers", "lib/a.c", "#include \"autograd/b.h\"", "lib must not include autograd" },
    { "layers", "autograd/b.c", "#include \"models/c.h\"", "autograd must not include models" },
    { "layers", "data/d.c", "#include \"models/c.h\"", "data must not include models" },
    { "layers", "models/c.c", "#include \"data/d.h\"", "models must not include data" },
    { "layers", "train/t.c", "#include \"infer/i.h\"", "train must not include infer" },
    { "layers", "infer/i.c", "#include \"train/t.h\"", "infer must not include train" },
    { "layers", "infer/i.c", "#include \"tests/test.h\"", "infer must not include tests" },
    { "layers", "lib/a.c", "#include \"a.h\"", "not written from the root" },
    { "layers", "lib/a.c", "#include \"lib/other.c\"", "compiled, not included" },
    { "layers", "lib/a.c", "#include <cblas.h>", "<cblas.h> belongs to" },
    { "layers", "lib/a.c", "#include \"cblas.h\"", "written with < >" },
    { "layers", "lib/a.c", "#include <omp.h>", "<omp.h> belongs to" },
    { "layers", "lib/a.c", "#include <immintrin.h>", "<immintrin.h> belongs to" },
    { "layers", "tests/test_a.c", "#include <cmocka.h>", "<cmocka.h> belongs to" },
    { "layers", "lib/a.c", "#include <assert.h>", "no header that this project knows" },
    { "layers", "lib/a.c", "#include <Python.h>", "no header that this project knows" },
    { "layers", "lib/a.c", "#include \"lib/other.h\"\n#include \"lib/other.h\"\n#include <math.h>",
      "comes after our headers" },
    { "layers", "lib/other.c", "#include <math.h>\n#include \"lib/other.h\"", "own header lib/other.h comes first" },
    { "style", "lib/a.c",
      "/* TO"
      "DO: later */",
      "finish it" },
    { "style", "Makefile",
      "# FIX"
      "ME",
      "finish it" },
    { "style", "lib/a.c", "int x; ", "space at the end" },
    { "style", "lib/a.c", "\tint x;", "tab" },
    { "style", "Makefile", "CFLAGS += -Ofast", "changes results or portability" },
    { "style", "Makefile", "CFLAGS += -ffast-math", "changes results or portability" },
    { "style", "scripts/x.sh", "gcc -march=native", "changes results or portability" },
    { "style", "lib/a.c", "#pragma GCC optimize(\"fast-math\")", "set in the Makefile" },
    { "style", "lib/a.c", "#pragma STDC FP_CONTRACT ON", "set in the Makefile" },
    { "style", "lib/a.c", "#pragma omp parallel for", "only lib/thread.c" },
    { "style", "lib/thread.c", "#pragma omp parallel for reduction(+ : s)", "any order" },
    { "style", "tests/a.c", "int x = rand();", "hidden generator state" },
    { "style", "lib/a.c", "#ifdef __AVX2__", "only lib/kern_*" },
    { "style", "lib/a.c", "x = _mm256_add_ps(x, y);", "only lib/kern_*" },
    { "style", "autograd/ops/a.c", "float *p = malloc(4);", "do not allocate" },
    { "style", "lib/kern_a.c", "free(p);", "do not allocate" },
    { "style", "lib/a.c", "assert(x);", "stays in release builds" },
    { "style", "lib/a.c", "abort();", "says why" },
    { "style", "lib/a.c", "sprintf(s, \"x\");", "unchecked" },
    { "style", "lib/a.c", "#if 0", "dead code" },
    { "style", "lib/a.h", "typedef int thing_t;", "no _t" },
    { "style", "lib/a.c", "fprintf(stderr, \"x\");", "do not print" },
    { "style", "train/t.c", "static void f(void)\n{\n    exit(1);\n}", "only in main" },
    { "style", "lib/other.h", "#ifndef OTHER_H", "expected #ifndef DAR_LIB_OTHER_H" },
};

/* What the scripts must not take for a breach. */
static const char innocent[] = "/* rand(), malloc( and exit( in a comment,\n * -ffast-math and __AVX2__ too */\n"
                               "static const char *s = \"assert(0) // exit(1) /* \";\n"
                               "static int operand(int x)\n{\n    return x;\n}\n"
                               "int main(void)\n{\n    exit(operand(0));\n}\n";

static void put(const char *file, const char *text)
{
    char path[512];
    snprintf(path, sizeof path, "%s/%s", tree, file);
    for (char *p = path + strlen(tree) + 1; (p = strchr(p, '/')); *p++ = '/') {
        *p = 0;
        mkdir(path, 0777);
    }
    FILE *f = fopen(path, "w");
    CHECK(f && fputs(text, f) >= 0, "%s: cannot write", path);
    fclose(f);
}

/* Exit status of the script on a tree, and what it said. */
static int check(const char *script, const char *root, char *out, size_t size)
{
    char command[512];
    snprintf(command, sizeof command, "scripts/check-%s.sh %s 2>&1", script, root);
    FILE *p = popen(command, "r");
    CHECK(p, "%s: cannot run", command);
    size_t n = fread(out, 1, size - 1, p);
    out[n] = 0;
    return pclose(p);
}

static void repository(const char *script)
{
    static char out[8192];
    int status = check(script, ".", out, sizeof out);
    CHECK(status == 0, "check-%s:\n%s", script, out);
}

static void layers(void **state)
{
    (void)state;
    repository("layers");
}

static void style(void **state)
{
    (void)state;
    repository("style");
}

static void breaches_show(void **state)
{
    (void)state;
    static char out[8192];
    static const char *const headers[] = { "lib/other", "autograd/b", "models/c",  "data/d",
                                           "train/t",   "infer/i",    "tests/test" };

    for (size_t i = 0; i < DAR_COUNT(breaches); i++) {
        const struct breach *b = &breaches[i];
        char command[512], where[256];
        snprintf(command, sizeof command, "rm -rf '%s'", tree);
        CHECK(system(command) == 0 && mkdir(tree, 0777) == 0, "%s: cannot make", tree);
        for (size_t k = 0; k < DAR_COUNT(headers); k++) {
            char file[64], guard[64], text[160];
            snprintf(file, sizeof file, "%s.h", headers[k]);
            snprintf(guard, sizeof guard, "DAR_%s_H", headers[k]);
            for (char *p = guard; *p; p++) *p = *p == '/' ? '_' : *p >= 'a' && *p <= 'z' ? (char)(*p - 32) : *p;
            snprintf(text, sizeof text, "#ifndef %s\n#define %s\n#endif\n", guard, guard);
            put(file, text);
        }
        put("tests/innocent.c", innocent);
        int status = check(b->script, tree, out, sizeof out);
        CHECK(status == 0 && !*out, "check-%s finds fault with nothing:\n%s", b->script, out);

        put(b->file, b->text);
        status = check(b->script, tree, out, sizeof out);
        snprintf(where, sizeof where, "%s:", b->file);
        CHECK(status != 0, "check-%s passes %s: %s", b->script, b->file, b->text);
        CHECK(strncmp(out, where, strlen(where)) == 0 && strstr(out, b->says),
              "check-%s on %s: %s\nexpected: %s\nfound: %s", b->script, b->file, b->text, b->says, out);
    }
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(layers),
        cmocka_unit_test(style),
        cmocka_unit_test(breaches_show),
    };
    (void)argc;
    snprintf(tree, sizeof tree, "%s.tree", argv[0]);
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
