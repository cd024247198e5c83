/* dar_eval.h: what the files of dar-eval share: methods, clips, and one number for each of them, measure and area.
 *
 *   dar_eval.c           the command line, the order of work
 *   dar_eval_find.c      bundles, methods, where a method's pictures of a clip are
 *   dar_eval_clip.c      one clip: pictures of every method against the truth
 *   dar_eval_warp.c      the oracle: frame 0 carried along the surfaces
 *   dar_eval_codec.c     the truth through a model's autoencoder
 *   dar_eval_variant.c   one scene with many references: shape and appearance
 *   dar_eval_table.c     tables as rows of cells: Markdown
 *   dar_eval_paper.c     which tables there are
 *   dar_eval_beside.c    published figures beside ours
 *   dar_eval_file.c      JSON and CSV
 *   dar_eval_sheet.c     last frames of some clips, methods side by side
 *   dar_eval_page.c      the report in HTML
 *   dar_eval_study.c     a page that asks people
 *   dar_eval_answers.c   what they answered */
#ifndef DAR_INFER_DAR_EVAL_H
#define DAR_INFER_DAR_EVAL_H

#include <limits.h>
#include <stdio.h>

#include "data/bundle.h"
#include "data/condition.h"
#include "data/metric.h"
#include "data/sheet.h"
#include "lib/stats.h"
#include "models/encode.h"
#include "models/lpips.h"

/* ---------------------------------------------------------------- what is measured */

enum {
    DAR_EVAL_ALEX = DAR_METRICS, /* LPIPS */
    DAR_EVAL_VGG,
    DAR_EVAL_MEASURES
};

typedef enum dar_eval_aim { DAR_EVAL_LESS, DAR_EVAL_MORE, DAR_EVAL_ONE } dar_eval_aim;

typedef struct dar_eval_measure {
    const char *name, *title;
    int digits; /* behind the point */
    dar_eval_aim aim;
} dar_eval_measure;

extern const dar_eval_measure dar_eval_table[DAR_EVAL_MEASURES];

/* Of which frames a clip's number is the mean: all; all but the first, which is given; the last. */
typedef enum dar_eval_span { DAR_EVAL_ALL, DAR_EVAL_LATER, DAR_EVAL_LAST, DAR_EVAL_SPANS } dar_eval_span;

extern const char *const dar_eval_span_name[DAR_EVAL_SPANS];
extern const char *const dar_eval_area_name[DAR_METRIC_AREAS];

typedef struct dar_eval_row {
    double v[DAR_METRIC_AREAS][DAR_EVAL_MEASURES]; /* NAN: there is none */
} dar_eval_row;

/* Of renders of one scene with many references (dar_eval_variant.c). */
typedef enum dar_eval_variant_number {
    DAR_EVAL_VARIANT_IOU,     /* of what is seen of the objects with their geometry */
    DAR_EVAL_VARIANT_OWN,     /* distance from the truth of its own reference, 0 .. 255 */
    DAR_EVAL_VARIANT_OTHER,   /* from the nearest of the others' */
    DAR_EVAL_VARIANT_MARGIN,  /* other - own */
    DAR_EVAL_VARIANT_NEAREST, /* 1: its own is the nearest; 0 */
    DAR_EVAL_VARIANTS
} dar_eval_variant_number;

extern const char *const dar_eval_variant_name[DAR_EVAL_VARIANTS];

/* A method on a clip. */
typedef struct dar_eval_cell {
    bool there, aligned; /* aligned: of other length or size, sampled by normalised time, resized */
    dar_eval_row span[DAR_EVAL_SPANS];
    dar_eval_row *frame; /* [frames] */
    double variant[DAR_EVAL_VARIANTS];
} dar_eval_cell;

/* ---------------------------------------------------------------- methods and clips */

/* Where the pictures come from: somebody's; frame 0 again and again; frame 0 carried along; the autoencoder's. */
typedef enum dar_eval_kind {
    DAR_EVAL_GIVEN,
    DAR_EVAL_REPEAT,
    DAR_EVAL_WARP,
    DAR_EVAL_CODEC,
    DAR_EVAL_KINDS
} dar_eval_kind;

#define DAR_EVAL_NAME 64

typedef struct dar_eval_method {
    dar_eval_kind kind;
    const char *path;
    char name[DAR_EVAL_NAME]; /* "dar@2000" */
    char set[DAR_EVAL_NAME];  /* channels in the order of data/condition.h: "tracking+world+normal"; "": unknown */
    char mode[16];            /* "lora", "full", "" */
    int64_t step, seed;       /* -1: unknown */
    bool external;            /* of another protocol: shown, not ranked */
    size_t clips;             /* found */
} dar_eval_method;

typedef struct dar_eval_clip {
    char path[PATH_MAX], name[DAR_EVAL_NAME], set[DAR_EVAL_NAME], trajectory[DAR_EVAL_NAME], family[DAR_EVAL_NAME];
    size_t number; /* in its set */
    size_t frames, width, height;
    double fps;
    bool masks;
    double lost[2]; /* share of what frame 0 does not show of surfaces: mean over frames, last frame; NAN: unknown */
    double seen;    /* of reference variants, IoU of the truth's objects, as seen, with their geometry; NAN: unknown */
} dar_eval_clip;

/* Of table.csv. */
#define DAR_EVAL_COLUMNS "set,mode,seed,step,split,trajectory,clips,psnr,psnr_lo,psnr_hi,ssim,lpips,flip,templ1,refl1"

/* A published line of it. */
typedef struct dar_eval_figure {
    char set[DAR_EVAL_NAME], mode[16], split[DAR_EVAL_NAME], trajectory[DAR_EVAL_NAME];
    int64_t step; /* -1: none */
    double v[DAR_EVAL_MEASURES];
} dar_eval_figure;

typedef struct dar_eval {
    dar_eval_method *method;
    size_t methods;
    dar_eval_clip *clip;
    size_t clips;
    dar_eval_cell *cell; /* [methods, clips] */
    dar_weights **weights;
    size_t files;                 /* of weights */
    struct dar_eval_codec *codec; /* NULL: no model is given */
    bool align, masked;
    dar_eval_figure *figure;
    size_t figures;
    uint64_t seed;
    double *work;    /* [DAR_BOOTSTRAP] */
    double *value;   /* [clips] */
    size_t base;     /* the method that others are compared with */
    const char *out; /* directory that files go to */
    size_t tile;     /* width of a picture of the report [px]; 0: no report */
    double report;   /* bytes that all films of it may have */
    dar_sheet sheet; /* of the report; rgb NULL: there is none */
} dar_eval;

static inline dar_eval_cell *dar_eval_at(const dar_eval *v, size_t method, size_t clip)
{
    return &v->cell[method * v->clips + clip];
}

/* ---------------------------------------------------------------- finding */

/* Bundles of these directories, each a bundle or a directory of bundles, with what their manifest and meta.json say.
 * The arrays are the caller's to free, also after a failure. */
dar_status dar_eval_find_clips(dar_eval *v, const char *const *path, size_t n, dar_err *e);

/* Methods of the command line: [NAME=]PATH, after that the rows of reference, of the codec if there is one. */
dar_status dar_eval_find_methods(dar_eval *v, char *const *word, size_t n, bool reference, dar_err *e);

/* Channels by any of their names, in the order of data/condition.h; *set stays as it is if they are none. */
void dar_eval_channels(const char *text, char set[DAR_EVAL_NAME]);

/* Where method m has its pictures of clip c; false: nowhere. */
bool dar_eval_find(const dar_eval *v, size_t m, size_t c, char path[PATH_MAX]);

/* ---------------------------------------------------------------- a clip */

/* Measure all methods on clip c; pictures for the report go to v->out. */
dar_status dar_eval_clip_run(dar_eval *v, size_t c, dar_err *e);

/* Frame of a clip of `from` frames at the time of frame t of `to`: round(t / (to - 1) (from - 1)). */
size_t dar_eval_same_time(size_t t, size_t to, size_t from);

/* Frame 0 carried along: every covered pixel of a frame takes the colour of the element of frame 0 with its identity.
 */
typedef struct dar_eval_warp dar_eval_warp;

/* b must have tracking; first [H, W, 3], which must outlive it.  On failure *out is NULL. */
dar_status dar_eval_warp_open(dar_eval_warp **out, dar_bundle *b, const uint8_t *first, dar_err *e);
void dar_eval_warp_close(dar_eval_warp *w);

/* rgb [H, W, 3]; lost: covered pixels whose element frame 0 does not show (they take the nearest one's colour), covered
 * pixels.  What nothing covers keeps the colour it has in frame 0. */
dar_status dar_eval_warp_frame(dar_eval_warp *w, size_t t, uint8_t *rgb, size_t lost[2], dar_err *e);

/* The autoencoder of a model, in bf16 as dar-sample has it: the most that its renders can reach. */
typedef struct dar_eval_codec dar_eval_codec;

typedef struct dar_eval_codec_files {
    const char *model, *weights, *vae; /* models/model.h: the model; directory, file of its weights, or NULL */
} dar_eval_codec_files;

/* On failure *out is NULL. */
dar_status dar_eval_codec_open(dar_eval_codec **out, const dar_eval_codec_files *files, dar_err *e);
void dar_eval_codec_close(dar_eval_codec *c); /* accepts NULL */

/* Whether clips of this length and size can be encoded. */
dar_status dar_eval_codec_check(const dar_eval_codec *c, const dar_eval_clip *clip, dar_err *e);

/* rgb [T, H, W, 3] of the clip there and back; the sink gets the frames. */
dar_status dar_eval_codec_run(dar_eval_codec *c, const dar_eval_clip *clip, const uint8_t *rgb, dar_decode_sink *sink,
                              void *ctx, dar_err *e);

/* ---------------------------------------------------------------- reference variants */

typedef struct dar_eval_variant dar_eval_variant;

/* For clip c and its truth [T, H, W, 3]; *out is NULL if its set is not refvar, or its clips differ in geometry, which
 * is told, and on failure. */
dar_status dar_eval_variant_open(dar_eval_variant **out, dar_eval *v, size_t c, dar_bundle *b, const uint8_t *truth,
                                 dar_err *e);
void dar_eval_variant_close(dar_eval_variant *x); /* accepts NULL */

/* Frames of a method in order, then its numbers, NAN where there are none. */
void dar_eval_variant_frame(dar_eval_variant *x, size_t t, const uint8_t *found);
void dar_eval_variant_end(dar_eval_variant *x, double row[DAR_EVAL_VARIANTS]);

/* Mean and interval of a method over the clips of a set. */
dar_interval dar_eval_variant_interval(dar_eval *v, size_t m, const char *set, dar_eval_variant_number k);

/* ---------------------------------------------------------------- tables */

typedef enum dar_eval_rank { DAR_EVAL_PLAIN, DAR_EVAL_BEST, DAR_EVAL_SECOND } dar_eval_rank;

typedef struct dar_eval_entry {
    char text[96], range[48]; /* range: the interval; "": none */
    dar_eval_rank rank;
    bool apart; /* the first of a row: the row is not ranked */
} dar_eval_entry;

typedef struct dar_eval_sheet {
    char title[160], note[512];
    char set[DAR_EVAL_NAME];         /* of the clips; "": no name */
    size_t rows, columns;            /* column 0 names the row */
    char (*head)[2 * DAR_EVAL_NAME]; /* [columns] */
    dar_eval_entry *entry;           /* [rows, columns] */
} dar_eval_sheet;

typedef struct dar_eval_sheets {
    dar_eval_sheet *at;
    size_t n;
    bool failed; /* memory ran out */
} dar_eval_sheets;

/* A sheet with empty entries; NULL: memory ran out. */
dar_eval_sheet *dar_eval_sheet_add(dar_eval_sheets *s, const char *title, const char *set, size_t rows, size_t columns);
void dar_eval_sheets_free(dar_eval_sheets *s);

/* Mark best and second of column k among the rows that have a value[row] and are not apart. */
void dar_eval_sheet_rank(dar_eval_sheet *s, size_t k, const double *value, dar_eval_aim aim);

void dar_eval_sheet_markdown(const dar_eval_sheet *s, FILE *f);

/* All tables that these methods and clips give. */
void dar_eval_paper(dar_eval *v, dar_eval_sheets *s);

/* Read published figures: a file in the columns of table.csv.  v->figure is the caller's to free, also after a failure.
 */
dar_status dar_eval_beside_open(dar_eval *v, const char *path, dar_err *e);

/* Those of this set of clips that have a method of ours. */
void dar_eval_beside(dar_eval *v, dar_eval_sheets *s, const char *split);

/* ---------------------------------------------------------------- numbers of sets of clips */

/* Clips that a number is taken over; NULL: any. */
typedef struct dar_eval_where {
    const char *set, *trajectory;
    size_t divide, row; /* divide > 0: those whose number / divide is row */
    size_t modulo, column;
} dar_eval_where;

bool dar_eval_is_in(const dar_eval_clip *c, const dar_eval_where *w);

/* Mean and interval of method m over those clips; with base < methods, of m minus base, paired by clip. */
dar_interval dar_eval_interval(dar_eval *v, size_t m, size_t base, const dar_eval_where *w, dar_eval_span span,
                               dar_metric_area area, int measure);

/* ---------------------------------------------------------------- files */

dar_status dar_eval_files(dar_eval *v, const dar_eval_sheets *s, dar_err *e);
dar_status dar_eval_page(dar_eval *v, const dar_eval_sheets *s, dar_err *e);

/* sheet.png: rows are clips, columns frame 0, the true last frame, that of every method. */
dar_status dar_eval_sheet_begin(dar_eval *v, dar_err *e);

/* Frame t of clip c as method m, or (m = v->methods) the truth, has it, rgb [H, W, 3]; most are not shown. */
void dar_eval_sheet_show(dar_eval *v, size_t c, size_t m, size_t t, const uint8_t *rgb);
dar_status dar_eval_sheet_end(dar_eval *v, dar_err *e);

/* ---------------------------------------------------------------- people */

#define DAR_EVAL_QUESTIONS 3

extern const char *const dar_eval_question[DAR_EVAL_QUESTIONS][2]; /* name, words */

/* study.html and study-key.json: pairs are NAME:NAME. */
dar_status dar_eval_study(dar_eval *v, const char *const *pair, size_t n, size_t *trials, dar_err *e);

/* What people answered: by pair and question, and by camera path and family; answers.md, answers.json in v->out. */
dar_status dar_eval_answers(dar_eval *v, const char *key, const char *const *file, size_t n, size_t *answers,
                            dar_err *e);

/* A file of v->out, in one moment; text and size as open_memstream left them. */
dar_status dar_eval_write(const dar_eval *v, const char *name, const char *text, size_t size, dar_err *e);

#endif
