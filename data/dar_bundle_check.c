/* dar_bundle_check.c: quality control of bundles. */
#include "data/bundle.h"
#include "data/dar_bundle.h"
#include "data/quality.h"
#include "lib/log.h"

#define MOST 100000 /* bundles of one call */

static struct {
    bool all, record;
    dar_common common;
} o;

static const dar_option options[] = {
    { .name = "all", .type = DAR_ARG_FLAG, .target = &o.all, .help = "tell every check, not only those that fail" },
    { .name = "record",
      .type = DAR_ARG_FLAG,
      .target = &o.record,
      .help = "write the results into meta.json of the bundle" },
};

/* Of all bundles of a call. */
struct sum {
    size_t good, bad, unreadable;
    dar_status status; /* of the first that cannot be read */
    dar_err why;
};

static void tell(dar_run *r, const char *path, const dar_quality *q)
{
    char text[DAR_QUALITY_TEXT];
    dar_run_say(r, "%s: %s: %zu checks good, %zu bad, %zu not possible", path, q->bad ? "bad" : "good", q->good, q->bad,
                q->unchecked);
    for (int i = 0; i < DAR_QUALITY_CHECKS; i++)
        if (o.all || q->result[i].state == DAR_QUALITY_BAD)
            dar_run_say(r, "  %s", dar_quality_text(q, (dar_quality_name)i, text));
}

static dar_status record(const char *path, const dar_quality *q, dar_err *e)
{
    dar_json_writer w = { 0 };
    dar_quality_print(q, &w, NULL);
    dar_status s =
        w.failed ? dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path) : dar_bundle_set_quality(path, w.text, e);
    dar_json_writer_free(&w);
    return s;
}

static dar_status check_one(dar_run *r, const char *path, struct sum *sum, dar_err *e)
{
    dar_bundle *b;
    dar_quality q;
    DAR_TRY(dar_bundle_open(&b, path, e));
    dar_status s = dar_quality_check(&q, b, e);
    dar_bundle_close(b);
    if (s == DAR_OK && o.record) s = record(path, &q, e);
    if (s != DAR_OK) return s;
    tell(r, path, &q);
    dar_json_write_text(&r->json, "bundle", path);
    dar_quality_print(&q, &r->json, "quality");
    if (q.bad) sum->bad++;
    else sum->good++;
    return DAR_OK;
}

/* A bundle that cannot be read does not keep the others from being checked. */
static dar_status check(dar_run *r, dar_err *e)
{
    const dar_program *p = r->program;
    struct sum sum = { 0 };
    dar_err why;
    if (o.common.dry_run) {
        dar_run_say(r, "%d bundles to check", p->rests);
        return DAR_OK;
    }
    dar_progress progress = dar_progress_begin("check", "bundles", p->rests);
    dar_json_write_array(&r->json, "bundles");
    for (int i = 0; i < p->rests; i++) {
        if (dar_interrupted()) return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: interrupted", p->name);
        dar_json_write_object(&r->json, NULL);
        dar_status s = check_one(r, p->rest[i], &sum, &why);
        if (s != DAR_OK) {
            if (p->rests > 1) dar_run_say(r, "%s: unreadable: %s", p->rest[i], why.text);
            dar_json_write_text(&r->json, "bundle", p->rest[i]);
            dar_json_write_text(&r->json, "unreadable", why.text);
            if (!sum.unreadable++) sum.why = why, sum.status = s;
        }
        dar_json_write_end(&r->json);
        dar_progress_step(&progress, i + 1, NULL);
    }
    if (p->rests > 1) dar_progress_end(&progress);
    dar_json_write_end(&r->json);
    dar_json_write_int(&r->json, "good", (int64_t)sum.good);
    dar_json_write_int(&r->json, "bad", (int64_t)sum.bad);
    dar_json_write_int(&r->json, "unreadable", (int64_t)sum.unreadable);
    if (sum.unreadable) return dar_fail(e, sum.status, "%s", sum.why.text);
    if (!sum.bad) return DAR_OK;
    return dar_fail(e, DAR_ERR_CHECK, "%zu of %d bundles are bad", sum.bad, p->rests);
}

const dar_program dar_command_check = {
    .name = "dar-bundle check",
    .summary = "Check whether bundles are fit to train on; exit status 1 if one is not.",
    .options = options,
    .n_options = DAR_COUNT(options),
    .common = &o.common,
    .run = check,
    .rest_name = "BUNDLE...",
    .rest_help = "directories to check",
    .rest_least = 1,
    .rest_most = MOST,
};
