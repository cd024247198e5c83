/* reuse.c: see reuse.h. */
#include "models/reuse.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "models/flow.h"

const char *const dar_reuse_name[] = { "none", "table", "change", NULL };

/* ---------------------------------------------------------------- rules */

typedef bool rule(dar_reuse *r);

static bool always(dar_reuse *r)
{
    (void)r;
    return true;
}

static bool by_table(dar_reuse *r)
{
    return fmod((double)r->step, r->c.at) == 0;
}

static double rescaled(const dar_reuse_config *c, double d)
{
    double y = 0;
    bool given = false;
    for (int i = DAR_REUSE_COEFFICIENTS - 1; i >= 0; i--) y = y * d + c->f[i], given |= c->f[i] != 0;
    return given ? y : d;
}

/* Numbers that are not finite ask. */
static bool by_change(dar_reuse *r)
{
    r->sum += rescaled(&r->c, r->moved / r->size);
    return !isfinite(r->sum) || !(r->sum < r->c.at);
}

static const struct {
    rule *asks;
    double least, most; /* of config.at */
    bool whole, rescales;
    const char *form;
} rules[DAR_REUSE_RULES] = {
    [DAR_REUSE_NONE] = { always, 0, 0, .form = "none" },
    [DAR_REUSE_TABLE] = { by_table, 1, 1000, .whole = true, .form = "table:N" },
    [DAR_REUSE_CHANGE] = { by_change, 0, 1e6, .rescales = true, .form = "change:THRESHOLD[:F0,F1,...]" },
};

/* ---------------------------------------------------------------- as text */

/* Numbers after ':', with commas between them; how many. */
static int read_numbers(const char **text, double *x, int most)
{
    int n = 0;
    char *end;
    do {
        if (n == most) return 0;
        x[n] = strtod(++*text, &end);
        if (end == *text || !isfinite(x[n])) return 0;
        *text = end;
        n++;
    } while (**text == ',');
    return n;
}

static bool read_rule(dar_reuse_config *c, const char *text)
{
    const size_t n = strcspn(text, ":");
    const char *end = text + n;
    int k = 0;
    while (k < DAR_REUSE_RULES && (strlen(dar_reuse_name[k]) != n || memcmp(text, dar_reuse_name[k], n) != 0)) k++;
    if (k == DAR_REUSE_RULES) return false;
    *c = (dar_reuse_config){ .rule = (dar_reuse_rule)k };
    if (k == DAR_REUSE_NONE) return !*end;
    if (*end != ':' || !read_numbers(&end, &c->at, 1)) return false;
    if (c->at < rules[k].least || c->at > rules[k].most || (rules[k].whole && c->at != floor(c->at))) return false;
    if (*end == ':' && rules[k].rescales && !read_numbers(&end, c->f, DAR_REUSE_COEFFICIENTS)) return false;
    return !*end;
}

dar_status dar_reuse_read(dar_reuse_config *c, const char *text, dar_err *e)
{
    if (read_rule(c, text)) return DAR_OK;
    *c = (dar_reuse_config){ 0 };
    return dar_fail(e, DAR_ERR_USAGE, "found rule '%s', expected %s, %s or %s", text, rules[0].form, rules[1].form,
                    rules[2].form);
}

/* ---------------------------------------------------------------- a run */

void dar_reuse_init(dar_reuse *r, const dar_reuse_config *c, size_t steps)
{
    *r = (dar_reuse){ .c = *c, .steps = steps };
}

void dar_reuse_see(dar_reuse *r, const dar_tensor *m, const dar_tensor *before)
{
    if (r->step) {
        r->moved += dar_flow_size(2, (double[]){ 1, -1 }, (const dar_tensor *[]){ m, before });
        r->size += dar_flow_size(1, (double[]){ 1 }, (const dar_tensor *[]){ before });
    }
    dar_tensor_copy(before, m);
}

bool dar_reuse_asks(dar_reuse *r)
{
    bool asks = rules[r->c.rule].asks(r) || r->step == 0 || r->step + 1 == r->steps;
    if (asks) r->sum = 0;
    else r->held++;
    r->moved = r->size = 0;
    r->step++;
    return asks;
}
