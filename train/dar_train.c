/* dar_train.c: the program dar-train: a configuration and bundles in, a trained model out. */
#include <stdio.h>

#include "lib/log.h"
#include "lib/program.h"
#include "train/export.h"
#include "train/learner.h"

static struct {
    dar_arg_list set;
    const char *resume, *export;
    double budget;
    dar_common common;
} o;

/* clang-format off */
static const dar_option options[] = {
    { .name = "set", .placeholder = "KEY=VALUE", .type = DAR_ARG_LIST, .target = &o.set,
      .help = "a key of the configuration (train/config.h): --set condition.channels=depth" },
    { .name = "resume", .placeholder = "auto|DIR", .type = DAR_ARG_TEXT, .target = &o.resume,
      .help = "go on from the run's newest checkpoint that is whole, or from that one" },
    { .name = "export", .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &o.export,
      .help = "train nothing: write a checkpoint, named instead of a configuration, as a model of its own, matrices in "
      "bf16: additions and adapter, and in DIR/backbone what they were trained on; a model in DIR is replaced" },
    { .name = "mem-budget", .placeholder = "GB", .type = DAR_ARG_NUMBER, .target = &o.budget, .standard = "0",
      .lo = 0, .hi = 1e9, .help = "memory to use: the fastest way of training that fits is taken (default: all)" },
};
/* clang-format on */

static dar_status open_config(dar_train_config *c, const dar_run *r, dar_err *e)
{
    const char *set[DAR_ARG_MANY + 2];
    char seed[64], budget[64];
    size_t n = 0;
    for (; n < o.set.n; n++) set[n] = o.set.at[n];
    if (o.common.seed) {
        snprintf(seed, sizeof seed, "seed=%llu", (unsigned long long)o.common.seed);
        set[n++] = seed;
    }
    if (o.budget > 0) {
        snprintf(budget, sizeof budget, "memory_budget=%.17g", o.budget);
        set[n++] = budget;
    }
    return dar_train_config_open(c, r->program->rest[0], set, n, e);
}

/* ---------------------------------------------------------------- what a run takes */

static double gigabytes(size_t bytes)
{
    return (double)bytes / 1e9;
}

static void say_plan(dar_run *r, const dar_train_config *c, const dar_loop_plan *p)
{
    char time[2][32];
    const dar_step_plan *s = &p->step[p->how];
    double seconds = p->flops / p->peak;
    dar_run_say(r, "parameters   %.2f M trained, %.2f M frozen", (double)p->trained / 1e6, (double)p->frozen / 1e6);
    dar_run_say(r,
                "memory       %.3f GB: weights and gradients %.3f, moments %.3f, a step %.3f, batches %.3f, validation "
                "%.3f, the program %.3f",
                gigabytes(dar_loop_bytes(p)), gigabytes(p->weights), gigabytes(p->moments),
                gigabytes(s->bytes[0] + s->bytes[1]), gigabytes(p->batches), gigabytes(p->validation),
                gigabytes(p->program));
    if (dar_loop_bytes(p) > p->budget)
        dar_run_say(r, "             more than the %.3f GB that it may take: it would not start", gigabytes(p->budget));
    for (int k = DAR_RECOMPUTE_NONE; k <= DAR_RECOMPUTE_ALL; k++)
        dar_run_say(r, "  recompute %-9s  a step %.3f GB, %.3f TFLOP%s", dar_recompute_name[k],
                    gigabytes(p->step[k].bytes[0] + p->step[k].bytes[1]),
                    (p->step[k].forward + p->step[k].backward) * (double)c->accumulate / 1e12,
                    k == (int)p->how ? "   <- taken" : "");
    dar_run_say(r, "work         %.3f TFLOP a step, %.0f tokens; at %.0f GFLOP/s, what products reach here, %s",
                p->flops / 1e12, p->tokens, p->peak / 1e9, dar_log_duration(seconds, time[0], sizeof time[0]));
    dar_run_say(r, "in all       %lld steps, at least %s", (long long)c->steps,
                dar_log_duration(seconds * (double)c->steps, time[1], sizeof time[1]));
}

static void print_plan(dar_json_writer *w, const dar_train_config *c, const dar_loop_plan *p)
{
    const dar_step_plan *s = &p->step[p->how];
    dar_json_write_object(w, "plan");
    dar_json_write_int(w, "trained", (int64_t)p->trained);
    dar_json_write_int(w, "frozen", (int64_t)p->frozen);
    dar_json_write_int(w, "weight_bytes", (int64_t)p->weights);
    dar_json_write_int(w, "moment_bytes", (int64_t)p->moments);
    dar_json_write_int(w, "step_bytes", (int64_t)(s->bytes[0] + s->bytes[1]));
    dar_json_write_int(w, "batch_bytes", (int64_t)p->batches);
    dar_json_write_int(w, "validation_bytes", (int64_t)p->validation);
    dar_json_write_int(w, "program_bytes", (int64_t)p->program);
    dar_json_write_int(w, "bytes", (int64_t)dar_loop_bytes(p));
    dar_json_write_int(w, "budget", (int64_t)p->budget);
    dar_json_write_text(w, "recompute", dar_recompute_name[p->how]);
    dar_json_write_number(w, "tokens", p->tokens);
    dar_json_write_number(w, "flops", p->flops);
    dar_json_write_number(w, "peak", p->peak);
    dar_json_write_number(w, "seconds", p->flops / p->peak);
    dar_json_write_int(w, "steps", c->steps);
    dar_json_write_end(w);
}

/* The run is done: RUN/merged stands by itself. */
static dar_status merge(const dar_train_config *c, dar_err *e)
{
    char checkpoint[PATH_MAX + 32], out[PATH_MAX];
    if (!c->save_merged || c->what != DAR_TRAIN_LORA) return DAR_OK;
    snprintf(checkpoint, sizeof checkpoint, "%s/checkpoint-%lld", c->output, (long long)c->steps);
    snprintf(out, sizeof out, "%.4000s/merged", c->output);
    DAR_TRY(dar_export_merged(checkpoint, out, (dar_dtype)c->storage, e));
    dar_log(DAR_LOG_INFO, "%s: additions and adapter merged into the weights", out);
    return DAR_OK;
}

/* Instead of training. */
static dar_status export(dar_run *r, dar_err *e)
{
    size_t bytes;
    if (o.common.dry_run || o.resume || o.set.n)
        return dar_fail(e, DAR_ERR_USAGE, "--export: expected a checkpoint and no --dry-run, --resume, --set");
    DAR_TRY(dar_export(r->program->rest[0], o.export, DAR_BF16, &bytes, e));
    dar_run_say(r, "%s: %.1f MB of weights", o.export, (double)bytes / 1e6);
    dar_json_write_text(&r->json, "model", o.export);
    dar_json_write_int(&r->json, "bytes", (int64_t)bytes);
    return DAR_OK;
}

static dar_status train(dar_run *r, dar_err *e)
{
    static const dar_learner *const learners[] = {
        [DAR_TRAIN_LORA] = &dar_learner_dit, [DAR_TRAIN_FULL] = &dar_learner_dit, [DAR_TRAIN_VAE] = &dar_learner_vae
    };
    const dar_loop_options how = { .resume = o.resume, .plan = o.common.dry_run };
    dar_train_config c;
    dar_loop *l;
    if (o.export) return export(r, e);
    DAR_TRY(open_config(&c, r, e));
    dar_status s = dar_loop_open(&l, learners[c.what], &c, &how, e);
    if (s == DAR_OK) print_plan(&r->json, &c, &l->plan);
    if (s == DAR_OK && how.plan) say_plan(r, &c, &l->plan);
    if (s == DAR_OK && !how.plan) s = dar_loop_run(l, e);
    dar_loop_close(l);
    if (s == DAR_OK && !how.plan) s = merge(&c, e);
    if (s == DAR_OK && !how.plan) {
        dar_run_say(r, "%s: %lld steps done", c.output, (long long)c.steps);
        dar_json_write_text(&r->json, "run", c.output);
    }
    dar_train_config_close(&c);
    return s;
}

int main(int argc, char **argv)
{
    static const dar_program program = {
        .name = "dar-train",
        .summary = "Train a model to render bundles: the channel set and all else is in the configuration.",
        .options = options,
        .n_options = DAR_COUNT(options),
        .common = &o.common,
        .run = train,
        .rest_name = "CONFIG.json",
        .rest_help = "what to train, on what, how (train/configs); with --export, a checkpoint",
        .rest_least = 1,
        .rest_most = 1,
    };
    return dar_program_main(&program, argc, argv);
}
