/* bench_kernels.c: how fast the kernels are, as fractions of what the machine can do in the same seconds.  Prints a
 * table and writes it as CSV. */
#include "tests/bench.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "lib/args.h"
#include "lib/cpu.h"
#include "lib/kern.h"
#include "lib/status.h"
#include "lib/thread.h"

#define ARENA_BYTES ((size_t)6 << 30) /* address space; pages are taken as they are used */
#define ROUNDS_MIN  5
#define ROUNDS_MAX  4096
#define PEAK_EVERY  0.02 /* seconds of kernels between two samples of the peak */

#define NEIGHBOURS 0.05 /* processors that others may take */
#define ATTEMPTS   3    /* at measuring without them */

static const struct options {
    double seconds;      /* each part runs at least this long */
    double flops;        /* no larger row */
    double flops_single; /* no larger row with one thread */
} full = { 0.2, 1e15, 1.5e11 }, quick = { 0.05, 1.5e11, -1 };

struct samples {
    size_t n;
    double x[ROUNDS_MAX];
};

/* What became of the bars. */
static struct tally {
    int bars, met;
    int disturbed;            /* rows that neighbours did not leave alone, ATTEMPTS times */
    int scaling, scaling_met; /* rows bound by arithmetic; those where all threads reach SCALING times one per thread */
    double least;             /* such factor */
    char least_row[96];
} tally = { .least = INFINITY };

#define SCALING 0.95 /* two threads: 1.9 times one */

static FILE *csv;

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int compare(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double median(struct samples *s)
{
    qsort(s->x, s->n, sizeof *s->x, compare);
    return s->n ? s->x[s->n / 2] : NAN;
}

static void keep(struct samples *s, double x)
{
    if (s->n < ROUNDS_MAX) s->x[s->n++] = x;
}

/* ---------------------------------------------------------------- operands */

struct noise {
    const dar_tensor *x;
    uint32_t seed;
};

static void fill_noise(void *ctx, size_t begin, size_t end, int thread)
{
    const struct noise *f = ctx;
    size_t size = dar_dtype_size(f->x->dtype);
    (void)thread;
    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        char *to = (char *)f->x->data + i * size;
        float x[DAR_PIECE];
        for (size_t k = 0; k < n; k++) {
            uint32_t h = ((uint32_t)(i + k) + f->seed) * 2654435769u;
            h = (h ^ h >> 15) * 2246822519u;
            x[k] = (float)(int32_t)(h ^ h >> 13) * 0x1p-31f;
        }
        if (f->x->dtype == DAR_I8) dar_kern_for(DAR_F32)->quantise[DAR_F32](n, x, 1 / 127.0f, 0, to);
        else dar_row_convert(f->x->dtype, to, DAR_F32, x, n);
    }
}

dar_tensor bench_tensor(bench *b, dar_dtype type, dar_shape s)
{
    static uint32_t seed;
    dar_tensor x = dar_tensor_push(b->arena, type, s);
    struct noise f = { &x, seed += 977 };
    dar_parallel_range(dar_tensor_count(&x), 1 << 16, fill_noise, &f);
    for (size_t i = 0; x.scale && i < dar_tensor_rows(&x); i++) x.scale[i] = 1 / 127.0f;
    return x;
}

void bench_input(bench *b, dar_dtype type, dar_shape s, bool wanted)
{
    b->x[b->n] = bench_tensor(b, type, s);
    if (wanted) b->gx[b->n] = dar_tensor_push(b->arena, dar_compute_type(type), s);
    b->n++;
}

/* ---------------------------------------------------------------- ops */

/* Stands after the measured op, so that backward starts with a gradient that is already in its place. */
static dar_shape feed_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)in;
    (void)n_in;
    (void)attr;
    return (dar_shape){ 0 };
}

static void feed_forward(const dar_opctx *c)
{
    memset(c->y.data, 0, dar_tensor_bytes(&c->y));
}

static void feed_backward(const dar_opctx *c)
{
    (void)c;
}

static const dar_op feed = {
    .name = "feed", .n_in = 1, .shape = feed_shape, .forward = feed_forward, .backward = feed_backward
};

void bench_op_forward(bench *b)
{
    dar_val *x[DAR_OP_IN] = { 0 };
    for (int i = 0; i < b->n; i++) {
        if (b->x[i].shape.n < 0) continue;
        x[i] = dar_leaf(&b->tape, b->x[i], b->gx[i].data ? &b->gx[i] : NULL);
        x[i]->has_grad = false; /* written, not added to, as the gradient of a value used once */
    }
    dar_val *y = b->row->kind->call(&b->tape, x, b->s);
    b->y = y->x;
    b->state = y;
}

void bench_op_backward(bench *b)
{
    dar_val *y = b->state;
    y->g = b->gy;
    y->has_grad = true;
    dar_backward(&b->tape, dar_apply(&b->tape, &feed, &y, 1, NULL), NULL);
}

void bench_op_reset(bench *b)
{
    dar_tape_clear(&b->tape);
    dar_arena_reset(b->arena, b->mark);
}

/* Bytes that an op cannot avoid: forward reads every input, backward what it keeps and the gradient; each writes its
 * results once. */
static void op_bytes(bench *b)
{
    const dar_op *op = b->row->kind->op;
    b->bytes[0] = (double)dar_tensor_bytes(&b->y);
    b->bytes[1] = (b->gy.data ? (double)dar_tensor_bytes(&b->gy) : 0) + (op->keep & DAR_KEEP_Y ? b->bytes[0] : 0);
    for (int i = 0; i < b->n; i++) {
        if (b->x[i].shape.n < 0) continue;
        b->bytes[0] += (double)dar_tensor_bytes(&b->x[i]);
        if (op->keep & DAR_KEEP_X(i)) b->bytes[1] += (double)dar_tensor_bytes(&b->x[i]);
        if (b->gx[i].data) b->bytes[1] += (double)dar_tensor_bytes(&b->gx[i]);
    }
}

void bench_op_setup(bench *b)
{
    dar_arena plan;
    dar_err e;
    DAR_ASSERT(dar_arena_init_plan(&plan, "plan", &e) == DAR_OK, "%s", e.text);
    DAR_ASSERT(dar_tape_init(&b->tape, &plan, &e) == DAR_OK, "%s", e.text);
    b->row->kind->inputs(b);
    bench_op_forward(b);
    if (b->row->kind->run[1]) {
        b->gy = bench_tensor(b, dar_compute_type(b->y.dtype), b->y.shape);
        bench_op_backward(b);
    }
    b->flops[0] = b->tape.cost.forward;
    b->flops[1] = b->tape.cost.backward;
    op_bytes(b);
    dar_tape_clear(&b->tape);
    dar_arena_free(&plan);
    b->tape.arena = b->arena;
    b->mark = dar_arena_mark(b->arena);
}

/* ---------------------------------------------------------------- neighbours */

struct busy {
    double wall, all, own; /* clock; processor time of the whole machine, and of this program [s] */
};

static struct busy busy_now(void)
{
    unsigned long long user = 0, nice = 0, system = 0, idle, wait, irq = 0, soft = 0, steal = 0;
    FILE *f = fopen("/proc/stat", "r");
    struct timespec t;

    if (!f || fscanf(f, "cpu %llu %llu %llu %llu %llu %llu %llu %llu", &user, &nice, &system, &idle, &wait, &irq, &soft,
                     &steal) != 8)
        user = nice = system = irq = soft = steal = 0;
    if (f) fclose(f);
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return (struct busy){
        .wall = now(),
        .all = (double)(user + nice + system + irq + soft + steal) / (double)sysconf(_SC_CLK_TCK),
        .own = (double)t.tv_sec + 1e-9 * (double)t.tv_nsec,
    };
}

/* Whether others have since taken processors that our threads wanted. */
static bool disturbed(const struct busy *since)
{
    struct busy b = busy_now();
    double others = (b.all - since->all - (b.own - since->own)) / (b.wall - since->wall);
    return others > NEIGHBOURS + (double)(sysconf(_SC_NPROCESSORS_ONLN) - dar_threads());
}

/* ---------------------------------------------------------------- a row */

static void shape_text(const int64_t *s, char *text, size_t size)
{
    size_t n = 0;
    *text = 0;
    for (int i = 0; i < 6 && s[i] && n < size; i++)
        n += (size_t)snprintf(text + n, size - n, "%s%lld", i ? "x" : "", (long long)s[i]);
}

static double timed(void (*run)(bench *b), bench *b)
{
    double begin = now();
    run(b);
    return now() - begin;
}

/* Rounds until every part has run long enough; times, and the peak between them. */
static void measure(bench *b, const struct options *o, struct samples *part, struct samples *rival,
                    struct samples *peak)
{
    const bench_kind *k = b->row->kind;
    double spent = 0, since = PEAK_EVERY;

    for (size_t round = 0; round <= ROUNDS_MAX; round++) { /* round 0 warms up */
        if (round > ROUNDS_MIN && spent >= o->seconds) break;
        if (since >= PEAK_EVERY) {
            double p = bench_peak_sample(b->row->peak);
            if (round) keep(peak, p);
            since = 0;
        }
        double t[BENCH_PARTS + 1] = { 0 }, least = INFINITY;
        for (int i = 0; i < BENCH_PARTS && k->run[i]; i++) {
            t[i] = timed(k->run[i], b);
            least = fmin(least, t[i]);
        }
        if (k->reset) k->reset(b);
        if (b->row->against_rival) t[BENCH_PARTS] = timed(k->rival, b);
        for (int i = 0; i <= BENCH_PARTS; i++) since += t[i];
        if (!round) continue;
        for (int i = 0; i < BENCH_PARTS; i++) keep(&part[i], t[i]);
        keep(rival, t[BENCH_PARTS]);
        spent += least;
    }
}

/* For a cell of the table; nothing for 0. */
static const char *number(double x, int digits)
{
    static char text[2][32];
    char *t = text[digits > 0];
    snprintf(t, sizeof *text, "%.*f", digits, x);
    return x > 0 ? t : "";
}

/* One line of the table and of the CSV; returns the rate. */
static double report(const bench *b, int i, double seconds, double peak, double rival, bool disturbed)
{
    const bench_row *r = b->row;
    char shape[64], ratio[32] = "", bar[48] = "";
    bool bytes = bench_peak_is_bytes(r->peak);
    double gflops = 1e-9 * b->flops[i] / seconds, gbps = 1e-9 * b->bytes[i] / seconds;
    double fraction = (bytes ? gbps : gflops) / peak, vs = i == 0 && rival > 0 ? rival / seconds : 0;

    shape_text(r->s, shape, sizeof shape);
    if (vs > 0) snprintf(ratio, sizeof ratio, "%.3f", vs);
    if (r->bar[i] > 0 && !disturbed) {
        bool met = fraction >= r->bar[i] && (!r->against_rival || vs >= 1);
        snprintf(bar, sizeof bar, "bar %.2f%s %s %.2f", r->bar[i], r->against_rival ? ", blas" : "",
                 met ? "met" : "MISSED", fraction);
        tally.bars++;
        tally.met += met;
    }
    printf("%-18s %-4s %-16s %2d %10.3f %8s %7s %6.3f %6s  %s\n", r->kind->part[i], dar_dtype_name(r->type), shape,
           dar_threads(), 1e3 * seconds, number(gflops, 0), number(gbps, 1), fraction, ratio,
           disturbed ? "disturbed" : bar);
    fprintf(csv, "%s,%s,%s,%d,%.6g,%.5g,%.5g,%.4f,%s\n", r->kind->part[i], dar_dtype_name(r->type), shape,
            dar_threads(), seconds, gflops, gbps, fraction, ratio);
    fflush(NULL);
    return bytes ? gbps : gflops;
}

static void count_scaling(const bench_row *r, int part, double factor, int threads)
{
    tally.scaling++;
    tally.scaling_met += factor >= SCALING * threads;
    if (factor >= tally.least) return;
    tally.least = factor;
    int n = snprintf(tally.least_row, sizeof tally.least_row, "%s %s ", r->kind->part[part], dar_dtype_name(r->type));
    shape_text(r->s, tally.least_row + n, sizeof tally.least_row - (size_t)n);
}

/* One row with the present number of threads; `one` holds the rates with one thread, or 0. */
static void run_pass(bench *b, const struct options *o, double one[BENCH_PARTS])
{
    static struct samples part[BENCH_PARTS], rival, peak;
    const bench_row *r = b->row;
    bool again = true;

    for (int attempt = 0; again && attempt < ATTEMPTS; attempt++) {
        struct busy start = busy_now();
        rival.n = peak.n = 0;
        for (int i = 0; i < BENCH_PARTS; i++) part[i].n = 0;
        measure(b, o, part, &rival, &peak);
        again = disturbed(&start);
    }
    tally.disturbed += again;
    double top = median(&peak), other = r->against_rival ? median(&rival) : 0;
    for (int i = 0; i < BENCH_PARTS && r->kind->run[i]; i++) {
        double rate = report(b, i, median(&part[i]), top, other, again);
        if (again) continue;
        if (dar_threads() == 1) one[i] = rate;
        else if (one[i] > 0 && !bench_peak_is_bytes(r->peak)) count_scaling(r, i, rate / one[i], dar_threads());
    }
}

static void run_row(const bench_row *r, const struct options *o, dar_arena *arena, int threads_all)
{
    bench b = { .row = r, .s = r->s, .arena = arena };
    double one[BENCH_PARTS] = { 0 };

    dar_threads_set(threads_all);
    r->kind->setup(&b);
    double most = fmax(b.flops[0], b.flops[1]);
    if (threads_all > 1 && most <= o->flops_single) {
        dar_threads_set(1);
        run_pass(&b, o, one);
    }
    dar_threads_set(threads_all);
    if (most <= o->flops) run_pass(&b, o, one);
    dar_tape_free(&b.tape);
    dar_arena_reset(arena, 0);
}

/* ---------------------------------------------------------------- all rows */

static bool wanted(const bench_row *r, const char *filter)
{
    char shape[64], text[160];
    shape_text(r->s, shape, sizeof shape);
    for (int i = 0; i < BENCH_PARTS && r->kind->part[i]; i++) {
        snprintf(text, sizeof text, "%s %s %s", r->kind->part[i], dar_dtype_name(r->type), shape);
        if (strstr(text, filter)) return true;
    }
    return false;
}

static void report_peaks(int threads_all)
{
    static struct samples s;
    for (int threads = 1; threads <= threads_all; threads += threads_all > 1 ? threads_all - 1 : 1) {
        dar_threads_set(threads);
        for (bench_peak p = 0; p < BENCH_PEAKS; p++) {
            bool bytes = bench_peak_is_bytes(p);
            s.n = 0;
            for (int i = 0; i < 16; i++) {
                double x = bench_peak_sample(p);
                if (i) keep(&s, x); /* the first warms up */
            }
            double m = median(&s);
            printf("peak %-6s %2d threads %8.1f %s (%.1f to %.1f)\n", bench_peak_name(p), threads, m,
                   bytes ? "GB/s" : "GF/s", s.x[0], s.x[s.n - 1]);
            fprintf(csv, "peak,%s,,%d,,%s%.5g,%s1,\n", bench_peak_name(p), threads, bytes ? "," : "", m,
                    bytes ? "" : ",");
        }
    }
}

static void run_all(const char *filter, bool quickly, dar_arena *arena)
{
    static const struct {
        const bench_row *rows;
        const size_t *n;
    } tables[] = {
        { bench_product_rows, &bench_n_product_rows }, { bench_op_rows, &bench_n_op_rows },
        { bench_net_rows, &bench_n_net_rows },         { bench_vae_rows, &bench_n_vae_rows },
        { bench_row_rows, &bench_n_row_rows },
    };
    int threads = dar_threads();

    fprintf(csv, "kernel,dtype,shape,threads,median_s,gflops,gbps,fraction_of_peak,vs_openblas\n");
    report_peaks(threads);
    printf("OpenBLAS: %s\n\n%-18s %-4s %-16s %2s %10s %8s %7s %6s %6s\n", bench_blas_core(), "kernel", "type", "shape",
           "th", "ms", "GF/s", "GB/s", "peak", "blas");
    for (size_t t = 0; t < DAR_COUNT(tables); t++)
        for (size_t i = 0; i < *tables[t].n; i++)
            if (wanted(&tables[t].rows[i], filter))
                run_row(&tables[t].rows[i], quickly ? &quick : &full, arena, threads);

    printf("\n%d of %d bars met", tally.met, tally.bars);
    if (tally.scaling)
        printf("; %d threads %.2f times one or more in %d of %d rows, at least %.2f (%s)", threads, SCALING * threads,
               tally.scaling_met, tally.scaling, tally.least, tally.least_row);
}

int main(int argc, char **argv)
{
    static const char *filter, *mask, *output;
    static int64_t threads;
    static bool quickly;
    static const dar_option options[] = {
        { .name = "quick",
          .type = DAR_ARG_FLAG,
          .target = &quickly,
          .help = "shorter, all threads only, without the largest rows" },
        { .name = "filter",
          .placeholder = "TEXT",
          .type = DAR_ARG_TEXT,
          .target = &filter,
          .help = "only rows whose kernel, type and shape, in one line, contain TEXT" },
        { .name = "output",
          .placeholder = "FILE",
          .type = DAR_ARG_TEXT,
          .target = &output,
          .standard = "build/bench/kernels.csv",
          .help = "the table as CSV" },
        { .name = "cpu-mask",
          .placeholder = "MASK",
          .type = DAR_ARG_TEXT,
          .target = &mask,
          .standard = "all",
          .help = "none, avx2, avx512, bf16, vnni or all" },
        { .name = "threads",
          .placeholder = "N",
          .type = DAR_ARG_INT,
          .target = &threads,
          .standard = "0",
          .lo = 0,
          .hi = 1024,
          .help = "beside one; 0: all processors" },
    };
    dar_program p = { .name = "bench_kernels",
                      .summary = "Measure kernels as fractions of the machine's peak.",
                      .options = options,
                      .n_options = DAR_COUNT(options) };
    dar_arena arena = { 0 };
    dar_err e;
    unsigned cpu = 0;
    double begin = now();

    dar_status s = dar_args_parse(&p, argc, argv, &e);
    if (s == DAR_OK && dar_args_answer(&p, stdout)) return 0;
    if (s == DAR_OK) s = dar_cpu_parse(mask, &cpu, &e);
    if (s == DAR_OK) s = dar_arena_init(&arena, "bench", ARENA_BYTES, &e);
    if (s == DAR_OK && !(csv = fopen(output, "w"))) s = dar_fail(&e, DAR_ERR_IO, "%s: %s", output, strerror(errno));
    if (s != DAR_OK) {
        fprintf(stderr, "bench_kernels: %s\n", e.text);
        return dar_status_exit(s);
    }
    dar_cpu_init(cpu);
    if (threads) dar_threads_set((int)threads);
    run_all(filter ? filter : "", quickly, &arena);
    printf("; %.0f s\n", now() - begin);
    if (tally.disturbed)
        printf("Other programs disturbed %d rows, whose figures are too low and do not count.\n", tally.disturbed);
    dar_arena_free(&arena);
    return fclose(csv) != 0;
}
