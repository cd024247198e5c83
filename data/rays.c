/* rays.c: Pluecker rays. */
#include "data/rays.h"

#include <math.h>
#include <string.h>

#include "data/affine.h"
#include "data/rigid.h"
#include "lib/thread.h"

#define STRIP 256 /* pixels at a time: their rays stay in the nearest cache until they are spread over the channels */
#define ROWS  16  /* of a picture per task */

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

static void strip(const dar_view *v, const frame *f, size_t j, size_t begin, size_t n,
                  float y[DAR_RAYS_COMPONENTS][STRIP])
{
    double q = ((double)j + 0.5 - v->cy) / v->fy, x[STRIP], scale[STRIP];
    for (size_t i = 0; i < n; i++) {
        x[i] = ((double)(int)(begin + i) + 0.5 - v->cx) / v->fx;
        scale[i] = 1 / sqrt(x[i] * x[i] + (q * q + 1));
    }
    for (int c = 0; c < DAR_RAYS_COMPONENTS; c++) {
        double step = f->step[c], row = f->down[c] * q + f->ahead[c];
        for (size_t i = 0; i < n; i++) y[c][i] = (float)((step * x[i] + row) * scale[i]);
    }
}

typedef struct job {
    const dar_camera_path *path;
    dar_rays_options options;
    double w2c[12]; /* of the frame that rays are in */
    float *y;
    size_t F, H, W, blocks; /* blocks: tasks per frame */
} job;

static void pack_rows(void *ctx, size_t task, int thread)
{
    const job *b = ctx;
    size_t t = task / b->blocks, begin = task % b->blocks * ROWS, end = begin + ROWS < b->H ? begin + ROWS : b->H;
    const dar_view *v = &b->path->view[t];
    float y[DAR_RAYS_COMPONENTS][STRIP];
    double c2w[12];
    (void)thread;

    dar_affine_mul(b->w2c, v->c2w, c2w);
    if (t == 0 && b->options.frame == DAR_RAYS_CAMERA0) memcpy(c2w, dar_affine_identity, sizeof c2w);
    frame f = frame_of(c2w, b->options.plucker);
    size_t group = (t + DAR_RAYS_GROUP - 1) / DAR_RAYS_GROUP;
    size_t first = t ? (t - 1) % DAR_RAYS_GROUP : 0, last = t ? first : DAR_RAYS_GROUP - 1;
    for (size_t j = begin; j < end; j++) {
        for (size_t i = 0; i < b->W; i += STRIP) {
            size_t n = b->W - i < STRIP ? b->W - i : STRIP;
            strip(v, &f, j, i, n, y);
            for (size_t c = 0; c < DAR_RAYS_COMPONENTS; c++)
                for (size_t k = first; k <= last; k++)
                    memcpy(b->y + (((c * DAR_RAYS_GROUP + k) * b->F + group) * b->H + j) * b->W + i, y[c],
                           n * sizeof(float));
        }
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
    b.blocks = (b.H + ROWS - 1) / ROWS;
    memcpy(b.w2c, dar_affine_identity, sizeof b.w2c);
    if (options.frame == DAR_RAYS_CAMERA0) dar_rigid_inverse(v->c2w, b.w2c);
    dar_parallel(p->frames * b.blocks, pack_rows, &b);
}
