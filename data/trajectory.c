/* trajectory.c: named camera paths around a scene. */
#include "data/trajectory.h"

#include <math.h>
#include <string.h>

#include "data/rigid.h"
#include "lib/nearest.h"
#include "lib/rng.h"

#define DEGREE     (M_PI / 180)
#define NEAR_SHARE 1e-3 /* of the distance, where the stage says nothing */
#define FRONT      0.1  /* of the distance: no point of the scene is nearer */

/* Bounds that several rows share. */
/* clang-format off */
#define ONE(x) { x, x }
#define NO     { 0, 0 }
#define FIT    { 1, 1 }
#define ROOM   { 1, 1.2 }
#define ANY    { -180, 180 }
#define FACE   { -35, 35 }
#define LEVEL  { 5, 20 }
/* clang-format on */

const dar_trajectory_kind dar_trajectory_kinds[] = {
    /* name, family, mirror, yaw, span, pitch, rise, roll, dolly, pan, radius */
    { "dolly-15", "benchmark", false, { ONE(-15), ONE(30), ONE(10), NO, NO, ONE(-0.25), NO, FIT } },
    { "orbit-30", "benchmark", false, { ONE(-30), ONE(60), ONE(10), NO, NO, NO, NO, FIT } },
    { "orbit-60", "benchmark", false, { ONE(-60), ONE(120), ONE(10), NO, NO, NO, NO, FIT } },
    { "orbit-0-45", "benchmark", false, { NO, ONE(45), ONE(10), NO, NO, NO, NO, FIT } },

    { "short-orbit", "blender", true, { FACE, { 30, 90 }, LEVEL, NO, NO, NO, NO, ROOM } },
    { "half-orbit", "blender", true, { ANY, { 150, 210 }, LEVEL, NO, NO, NO, NO, ROOM } },
    { "full-orbit", "blender", true, { ANY, { 330, 360 }, LEVEL, NO, NO, NO, NO, ROOM } },
    { "orbit-dolly-in", "blender", true, { FACE, { 45, 120 }, LEVEL, NO, NO, { -0.4, -0.15 }, NO, ROOM } },
    { "orbit-dolly-out", "blender", true, { FACE, { 45, 120 }, LEVEL, NO, NO, { 0.2, 0.6 }, NO, ROOM } },
    { "top-down-orbit", "blender", true, { ANY, { 60, 150 }, { 50, 75 }, { -8, 8 }, NO, NO, NO, ROOM } },
    { "top-down-full-orbit", "blender", true, { ANY, { 300, 360 }, { 50, 75 }, NO, NO, NO, NO, ROOM } },
    { "low-arc", "blender", true, { FACE, { 40, 120 }, { 1, 4 }, { 0, 4 }, NO, NO, NO, ROOM } },
    { "low-arc-half", "blender", true, { ANY, { 150, 210 }, { 1, 4 }, NO, NO, NO, NO, ROOM } },
    { "dolly-in", "blender", true, { FACE, { 0, 6 }, LEVEL, NO, NO, { -0.45, -0.2 }, NO, ROOM } },
    { "dolly-out", "blender", true, { FACE, { 0, 6 }, LEVEL, NO, NO, { 0.25, 0.8 }, NO, ROOM } },
    { "lateral-pan", "blender", true, { FACE, NO, LEVEL, NO, NO, NO, { 0.3, 0.8 }, ROOM } },
    { "rolling-orbit", "blender", true, { FACE, { 40, 120 }, LEVEL, NO, { 8, 25 }, NO, NO, ROOM } },
    { "orbit-pan", "blender", true, { FACE, { 40, 100 }, LEVEL, NO, NO, NO, { 0.2, 0.6 }, ROOM } },
    { "vertical-arc-up", "blender", true, { FACE, { 0, 20 }, { 2, 10 }, { 25, 55 }, NO, NO, NO, ROOM } },
    { "vertical-arc-down", "blender", true, { FACE, { 0, 20 }, { 45, 65 }, { -40, -25 }, NO, NO, NO, ROOM } },

    { "ue-orbit-short", "unreal", true, { ANY, { 25, 80 }, LEVEL, NO, NO, NO, NO, ROOM } },
    { "ue-orbit-half", "unreal", true, { ANY, { 140, 200 }, LEVEL, NO, NO, NO, NO, ROOM } },
    { "ue-orbit-full", "unreal", true, { ANY, { 320, 360 }, { 8, 25 }, NO, NO, NO, NO, ROOM } },
    { "ue-orbit-low", "unreal", true, { ANY, { 40, 120 }, { 1, 4 }, NO, NO, NO, NO, ROOM } },
    { "ue-corridor-forward", "unreal", true, { FACE, NO, { 2, 8 }, NO, NO, { -0.5, -0.35 }, NO, { 1, 1.5 } } },
    { "ue-corridor-back", "unreal", true, { FACE, NO, { 2, 8 }, NO, NO, { 0.6, 1.2 }, NO, { 1, 1.1 } } },
    { "ue-corridor-side", "unreal", true, { FACE, NO, { 2, 8 }, NO, NO, NO, { 0.5, 0.9 }, ROOM } },
    { "ue-dolly-in", "unreal", true, { ANY, { 0, 8 }, LEVEL, NO, NO, { -0.4, -0.2 }, NO, ROOM } },
    { "ue-dolly-out", "unreal", true, { ANY, { 0, 8 }, LEVEL, NO, NO, { 0.25, 0.7 }, NO, ROOM } },
    { "ue-dolly-arc", "unreal", true, { ANY, { 30, 75 }, LEVEL, { 0, 10 }, NO, { -0.35, -0.1 }, NO, ROOM } },
    { "ue-top-spin", "unreal", true, { ANY, { 180, 360 }, { 78, 88 }, NO, NO, NO, NO, ROOM } },
    { "ue-top-spin-dive", "unreal", true, { ANY, { 120, 270 }, { 75, 85 }, { -30, -15 }, NO, { -0.3, 0 }, NO, ROOM } },
    { "ue-oblique-orbit", "unreal", true, { ANY, { 60, 180 }, { 30, 50 }, NO, { -8, 8 }, NO, NO, ROOM } },
    { "ue-oblique-dolly", "unreal", true, { ANY, { 10, 40 }, { 30, 50 }, { -12, 12 }, NO, { -0.4, -0.1 }, NO, ROOM } },
};

const size_t dar_trajectory_count = DAR_COUNT(dar_trajectory_kinds);

dar_status dar_trajectory_find(const char *name, const dar_trajectory_kind **kind, dar_err *e)
{
    dar_nearest n = dar_nearest_to(name);
    for (size_t i = 0; i < dar_trajectory_count; i++) {
        *kind = &dar_trajectory_kinds[i];
        if (strcmp((*kind)->name, name) == 0) return DAR_OK;
        dar_nearest_try(&n, (*kind)->name);
    }
    *kind = NULL;
    return dar_fail(e, DAR_ERR_USAGE, "trajectory: found \"%s\", expected one of %zu names, such as %s", name,
                    dar_trajectory_count, n.best ? n.best : "orbit-30, short-orbit, ue-oblique-orbit");
}

dar_trajectory dar_trajectory_draw(const dar_trajectory_kind *kind, uint64_t seed, uint64_t index)
{
    enum { DRAWS = 16 }; /* per trajectory: parts and the mirror, with room for more */
    dar_trajectory t = { .kind = kind };
    uint64_t stream = dar_rng_stream(kind->name);
    for (uint64_t i = 0; i < DAR_TRAJECTORY_PARTS; i++) {
        dar_span b = kind->bound[i];
        t.part[i] = b.lo + (b.hi - b.lo) * dar_rng_f64(seed, stream, DRAWS * index + i);
    }
    if (kind->mirror && dar_rng_f64(seed, stream, DRAWS * index + DAR_TRAJECTORY_PARTS) < 0.5) {
        t.part[DAR_TRAJECTORY_SPAN] *= -1;
        t.part[DAR_TRAJECTORY_ROLL] *= -1;
        t.part[DAR_TRAJECTORY_PAN] *= -1;
    }
    return t;
}

dar_stage dar_stage_standard(void)
{
    return (dar_stage){ .has_ground = true, .width = 832, .height = 480, .fov = 40 * DEGREE, .margin = 0.05 };
}

/* ---------------------------------------------------------------- a path around a scene */

static dar_box cover(const dar_stage *stage)
{
    dar_box all = stage->box[0];
    for (size_t b = 1; b < stage->boxes; b++) {
        for (int i = 0; i < 3; i++) {
            all.lo[i] = fmin(all.lo[i], stage->box[b].lo[i]);
            all.hi[i] = fmax(all.hi[i], stage->box[b].hi[i]);
        }
    }
    return all;
}

static const dar_box *box_at(const dar_stage *stage, size_t frame)
{
    return &stage->box[stage->boxes > 1 ? frame : 0];
}

static void corner_of(const dar_box *b, int i, double x[3])
{
    for (int a = 0; a < 3; a++) x[a] = i >> a & 1 ? b->hi[a] : b->lo[a];
}

/* Where the camera is at one frame, for D radius = 1. */
typedef struct pose {
    double c2w[12];  /* rotation; place relative to the centre */
    double shift[3]; /* of the target, in the camera's frame */
    double distance;
} pose;

static pose pose_at(const dar_trajectory *t, const dar_stage *stage, double half_width, double s)
{
    const double *part = t->part;
    double yaw = (part[DAR_TRAJECTORY_YAW] + part[DAR_TRAJECTORY_SPAN] * s) * DEGREE;
    double pitch = (part[DAR_TRAJECTORY_PITCH] + part[DAR_TRAJECTORY_RISE] * s) * DEGREE;
    double roll = part[DAR_TRAJECTORY_ROLL] * s * DEGREE;
    double pan = part[DAR_TRAJECTORY_PAN] * (s - 0.5) * half_width;
    pose p = { .distance = 1 + part[DAR_TRAJECTORY_DOLLY] * s, .shift = { cos(roll) * pan, -sin(roll) * pan, 0 } };

    double back[3] = { sin(yaw) * cos(pitch), sin(pitch), cos(yaw) * cos(pitch) };
    double right[3] = { cos(yaw), 0, -sin(yaw) }, column[4][3], down[3];
    dar_vec_cross(right, back, down);
    for (int i = 0; i < 3; i++) {
        column[0][i] = cos(roll) * right[i] + sin(roll) * down[i];
        column[1][i] = cos(roll) * down[i] - sin(roll) * right[i];
        column[2][i] = -back[i];
        column[3][i] = p.distance * back[i] + pan * right[i];
    }
    for (int j = 0; j < 4; j++) {
        p.c2w[j] = column[j][0];
        p.c2w[4 + j] = stage->z_up ? -column[j][2] : column[j][1];
        p.c2w[8 + j] = stage->z_up ? column[j][1] : column[j][2];
    }
    return p;
}

/* Smallest D radius at which the box is in view.  A corner x is at r - D shift + D distance (0, 0, 1) with r = R^T (x -
 * centre), and is in view if |x| <= tan[0] z and |y| <= tan[1] z: linear in D.  Negative: there is none. */
static double fit(const pose *p, const dar_box *box, const double centre[3], const double tangent[2])
{
    double least = 0;
    for (int c = 0; c < 8; c++) {
        double x[3], r[3];
        corner_of(box, c, x);
        for (int i = 0; i < 3; i++) x[i] -= centre[i];
        for (int i = 0; i < 3; i++) r[i] = p->c2w[i] * x[0] + p->c2w[4 + i] * x[1] + p->c2w[8 + i] * x[2];
        least = fmax(least, -r[2] / ((1 - FRONT) * p->distance));
        for (int i = 0; i < 2; i++) {
            for (int sign = -1; sign <= 1; sign += 2) {
                double growth = tangent[i] * p->distance + sign * p->shift[i];
                if (!(growth > 1e-6)) return -1;
                least = fmax(least, (sign * r[i] - tangent[i] * r[2]) / growth);
            }
        }
    }
    return least;
}

static dar_status check_boxes(const dar_stage *stage, size_t frames, dar_err *e)
{
    DAR_ASSERT(stage->boxes == 1 || stage->boxes == frames, "%zu boxes for %zu frames", stage->boxes, frames);
    DAR_ASSERT(stage->margin >= 0 && stage->margin < 0.4 && stage->fov > 0 && stage->fov < M_PI, "margin %g, fov %g",
               stage->margin, stage->fov);
    for (size_t b = 0; b < stage->boxes; b++) {
        for (int i = 0; i < 3; i++) {
            double lo = stage->box[b].lo[i], hi = stage->box[b].hi[i];
            if (!(lo <= hi && fabs(lo) <= DAR_CAMERA_LARGEST && fabs(hi) <= DAR_CAMERA_LARGEST))
                return dar_fail(e, DAR_ERR_NUMERIC, "bounds of frame %zu: found %g to %g, expected finite numbers", b,
                                lo, hi);
        }
    }
    return DAR_OK;
}

dar_status dar_trajectory_path(const dar_trajectory *t, const dar_stage *stage, dar_camera_path *p, dar_err *e)
{
    DAR_TRY(check_boxes(stage, p->frames, e));
    double focal = dar_camera_focal(stage->fov, fmin(stage->width, stage->height)), centre[3], reach = 0;
    double half[2] = { stage->width / 2.0 / focal, stage->height / 2.0 / focal };
    double tangent[2] = { half[0] * (1 - 2 * stage->margin), half[1] * (1 - 2 * stage->margin) };
    double last = p->frames > 1 ? (double)p->frames - 1 : 1;
    dar_box all = cover(stage);
    for (int i = 0; i < 3; i++) centre[i] = all.lo[i] + (all.hi[i] - all.lo[i]) / 2;

    for (size_t f = 0; f < p->frames; f++) {
        pose at = pose_at(t, stage, half[0], (double)f / last);
        double least = fit(&at, box_at(stage, f), centre, tangent);
        if (least < 0)
            return dar_fail(e, DAR_ERR_USAGE,
                            "trajectory %s: frame %zu: found no distance that keeps the scene in view", t->kind->name,
                            f);
        reach = fmax(reach, least);
    }
    if (!(reach > 0))
        return dar_fail(e, DAR_ERR_NUMERIC, "trajectory %s: the scene is a point: expected bounds with an extent",
                        t->kind->name);
    reach *= t->part[DAR_TRAJECTORY_RADIUS] * (1 + 1e-12);

    for (size_t f = 0; f < p->frames; f++) {
        pose at = pose_at(t, stage, half[0], (double)f / last);
        dar_view *v = &p->view[f];
        *v = (dar_view){
            stage->width,       stage->height,       focal, focal,
            stage->width / 2.0, stage->height / 2.0, { 0 }, stage->near > 0 ? stage->near : NEAR_SHARE * reach
        };
        memcpy(v->c2w, at.c2w, sizeof v->c2w);
        for (int i = 0; i < 3; i++) v->c2w[4 * i + 3] = centre[i] + reach * at.c2w[4 * i + 3];
    }
    size_t frame;
    dar_path_fault fault = dar_trajectory_check(p, stage, &frame);
    if (fault != DAR_PATH_SAFE)
        return dar_fail(e, DAR_ERR_USAGE, "trajectory %s: frame %zu: %s", t->kind->name, frame,
                        dar_path_fault_text[fault]);
    return DAR_OK;
}

/* ---------------------------------------------------------------- is it safe? */

const char *const dar_path_fault_text[] = {
    [DAR_PATH_SAFE] = "safe",
    [DAR_PATH_INSIDE] = "the camera is inside the scene's bounds",
    [DAR_PATH_NEAR] = "the near plane cuts the scene's bounds",
    [DAR_PATH_GROUND] = "the camera is below the ground",
    [DAR_PATH_BEHIND] = "nothing of the scene is in front of the camera",
};

/* The near plane touches the box if the box comes nearer than the plane's farthest corner: a little stricter than need
 * be. */
static dar_path_fault check_view(const dar_view *v, const dar_box *box)
{
    double away = 0, front = -INFINITY;
    for (int i = 0; i < 3; i++) {
        double x = v->c2w[4 * i + 3], d = fmax(fmax(box->lo[i] - x, x - box->hi[i]), 0);
        away += d * d;
    }
    if (away <= 0) return DAR_PATH_INSIDE;
    double x = fmax(v->cx, v->width - v->cx) / v->fx, y = fmax(v->cy, v->height - v->cy) / v->fy;
    if (sqrt(away) <= v->near * sqrt(1 + x * x + y * y)) return DAR_PATH_NEAR;
    for (int c = 0; c < 8; c++) {
        double p[3], z = 0;
        corner_of(box, c, p);
        for (int i = 0; i < 3; i++) z += v->c2w[4 * i + 2] * (p[i] - v->c2w[4 * i + 3]);
        front = fmax(front, z);
    }
    return front > v->near ? DAR_PATH_SAFE : DAR_PATH_BEHIND;
}

dar_path_fault dar_trajectory_check(const dar_camera_path *p, const dar_stage *stage, size_t *frame)
{
    int up = stage->z_up ? 2 : 1;
    double ground = cover(stage).lo[up];
    DAR_ASSERT(stage->boxes == 1 || stage->boxes == p->frames, "%zu boxes for %zu frames", stage->boxes, p->frames);
    for (*frame = 0; *frame < p->frames; ++*frame) {
        dar_path_fault fault = check_view(&p->view[*frame], box_at(stage, *frame));
        if (fault != DAR_PATH_SAFE) return fault;
        if (stage->has_ground && p->view[*frame].c2w[4 * up + 3] < ground) return DAR_PATH_GROUND;
    }
    return DAR_PATH_SAFE;
}

bool dar_trajectory_in_view(const dar_view *v, const dar_box *box, double margin)
{
    double x0 = margin * v->width, x1 = v->width - x0, y0 = margin * v->height, y1 = v->height - y0, w2c[12];
    dar_rigid_inverse(v->c2w, w2c);
    for (int c = 0; c < 8; c++) {
        double p[3], q[3];
        corner_of(box, c, p);
        for (int i = 0; i < 3; i++) q[i] = dar_vec_dot(w2c + 4 * i, p) + w2c[4 * i + 3];
        double x = v->fx * q[0] / q[2] + v->cx, y = v->fy * q[1] / q[2] + v->cy;
        if (!(q[2] > 0 && x >= x0 && x <= x1 && y >= y0 && y <= y1)) return false;
    }
    return true;
}
