/* rays.c: Pluecker rays. */
#include "data/rays.h"

#include <math.h>
#include <string.h>

#include "data/affine.h"
#include "data/rigid.h"
#include "lib/thread.h"

/* A task takes a tile through all frames: as long as the lens stays, the roots and quotients are those of frame 0. */
#define STRIP 512
#define ROWS  8

const char *const dar_plucker_name[] = { "wan", "paper", NULL };
const char *const dar_rays_frame_name[] = { "camera0", "world", NULL };

void dar_rays_at(const dar_view *v, double x, double y, double o[3], double d[3])
{
    const double r[3] = { (x - v->cx) / v->fx, (y - v->cy) / v->fy, 1 };
    double length = sqrt(dar_vec_dot(r, r));
    for (int i = 0; i < 3; i++) {
        d[i] = dar_vec_dot(v->c2w + 4 * i, r) / length;
        o[i] = v->c2w[4 * i + 3];
    }
}

size_t dar_rays_latent_frames(size_t frames)
{
    return frames % DAR_RAYS_GROUP == 1 ? (frames + DAR_RAYS_GROUP - 1) / DAR_RAYS_GROUP : 0;
}

/* One picture's rays: component c of the pixel (x, y) is (step[c] x + row[c]) / |(x, y, 1)|, for moments too, because
 * the cross product is linear. */
typedef struct frame {
    double step[DAR_RAYS_COMPONENTS], down[DAR_RAYS_COMPONENTS], ahead[DAR_RAYS_COMPONENTS];
} frame;

static frame frame_of(const double c2w[12], dar_plucker plucker)
{
    const double o[3] = { c2w[3], c2w[7], c2w[11] };
    double part[3][DAR_RAYS_COMPONENTS];
    int moment = plucker == DAR_PLUCKER_WAN ? 0 : 3, direction = 3 - moment;
    frame f;
    for (int j = 0; j < 3; j++) {
        for (int i = 0; i < 3; i++) part[j][direction + i] = c2w[4 * i + j];
        dar_vec_cross(o, part[j] + direction, part[j] + moment);
    }
    memcpy(f.step, part[0], sizeof f.step);
    memcpy(f.down, part[1], sizeof f.down);
    memcpy(f.ahead, part[2], sizeof f.ahead);
    return f;
}

typedef struct job {
    const dar_camera_path *path;
    dar_rays_options options;
    double w2c[12]; /* of the frame that rays are in */
    float *y;
    size_t F, H, W, strips; /* strips: tasks per row */
} job;

/* What the lens alone decides, for a tile of the picture: rows down, columns right. */
typedef struct tile {
    const dar_view *lens; /* whose it is; NULL: nobody's yet */
    size_t j, i, rows, columns;
    double x[STRIP], y[ROWS], scale[ROWS][STRIP]; /* scale: 1 / |(x, y, 1)| */
} tile;

static void set_lens(tile *s, const dar_view *v)
{
    const dar_view *old = s->lens;
    s->lens = v;
    if (old && old->fx == v->fx && old->fy == v->fy && old->cx == v->cx && old->cy == v->cy) return;
    for (size_t i = 0; i < s->columns; i++) s->x[i] = ((double)(int)(s->i + i) + 0.5 - v->cx) / v->fx;
    for (size_t j = 0; j < s->rows; j++) {
        double y = s->y[j] = ((double)(s->j + j) + 0.5 - v->cy) / v->fy;
        for (size_t i = 0; i < s->columns; i++) s->scale[j][i] = 1 / sqrt(s->x[i] * s->x[i] + (y * y + 1));
    }
}

/* Frame t of a tile: every component of every row, then on to its channels, of which frame 0 has four each. */
static void pack_frame(const job *b, const tile *s, size_t t)
{
    double c2w[12];
    float line[STRIP];
    size_t group = (t + DAR_RAYS_GROUP - 1) / DAR_RAYS_GROUP;
    size_t first = t ? (t - 1) % DAR_RAYS_GROUP : 0, last = t ? first : DAR_RAYS_GROUP - 1;

    dar_affine_mul(b->w2c, b->path->view[t].c2w, c2w);
    if (t == 0 && b->options.frame == DAR_RAYS_CAMERA0) memcpy(c2w, dar_affine_identity, sizeof c2w);
    frame f = frame_of(c2w, b->options.plucker);
    for (size_t c = 0; c < DAR_RAYS_COMPONENTS; c++) {
        for (size_t j = 0; j < s->rows; j++) {
            double step = f.step[c], row = f.down[c] * s->y[j] + f.ahead[c];
            const double *x = s->x, *scale = s->scale[j];
            for (size_t i = 0; i < s->columns; i++) line[i] = (float)((step * x[i] + row) * scale[i]);
            for (size_t k = first; k <= last; k++)
                memcpy(b->y + (((c * DAR_RAYS_GROUP + k) * b->F + group) * b->H + s->j + j) * b->W + s->i, line,
                       s->columns * sizeof(float));
        }
    }
}

static void pack_tile(void *ctx, size_t task, int thread)
{
    const job *b = ctx;
    tile s;
    (void)thread;
    s.lens = NULL;
    s.j = task / b->strips * ROWS;
    s.i = task % b->strips * STRIP;
    s.rows = b->H - s.j < ROWS ? b->H - s.j : ROWS;
    s.columns = b->W - s.i < STRIP ? b->W - s.i : STRIP;
    for (size_t t = 0; t < b->path->frames; t++) {
        set_lens(&s, &b->path->view[t]);
        pack_frame(b, &s, t);
    }
}

void dar_rays_pack(const dar_camera_path *p, dar_rays_options options, const dar_tensor *y)
{
    const dar_view *v = &p->view[0];
    size_t F = dar_rays_latent_frames(p->frames);
    dar_shape expected = DAR_SHAPE(DAR_RAYS_CHANNELS, (int64_t)F, v->height, v->width);
    char found[96];
    DAR_ASSERT(F > 0, "rays: %zu frames, expected 1, 5, 9, ...", p->frames);
    DAR_ASSERT(y->dtype == DAR_F32 && dar_tensor_contiguous(y) && dar_shape_equal(&y->shape, &expected),
               "rays: y is %s, expected [24, %zu, %d, %d] f32", dar_shape_text(&y->shape, found, sizeof found), F,
               v->height, v->width);
    job b = { .path = p, .options = options, .y = y->data, .F = F, .H = (size_t)v->height, .W = (size_t)v->width };
    b.strips = (b.W + STRIP - 1) / STRIP;
    memcpy(b.w2c, dar_affine_identity, sizeof b.w2c);
    if (options.frame == DAR_RAYS_CAMERA0) dar_rigid_inverse(v->c2w, b.w2c);
    dar_parallel((b.H + ROWS - 1) / ROWS * b.strips, pack_tile, &b);
}
