/* place.c: draw a place, or a way, until it is free. */
#include "data/place.h"

#include <math.h>
#include <string.h>

#include "data/affine.h"
#include "data/camera.h"
#include "data/rigid.h"

const char *const dar_place_motion_name[] = { "still", "spin", "tilt", "bob", "slide", "sway", "self-orbit", "walk" };

bool dar_place_meet(const dar_box *a, const dar_box *b)
{
    for (int k = 0; k < 3; k++)
        if (a->hi[k] < b->lo[k] || b->hi[k] < a->lo[k]) return false;
    return true;
}

static void turn_about(int axis, double angle, double q[4])
{
    for (int k = 0; k < 3; k++) q[k] = k == axis ? sin(angle / 2) : 0;
    q[3] = cos(angle / 2);
}

/* The box of a turned and moved box. */
static dar_box carried(const dar_box *b, const double turn[4], const double at[3])
{
    static const double one[3] = { 1, 1, 1 };
    dar_box y;
    double m[12];
    dar_affine_trs(at, turn, one, m);
    for (int r = 0; r < 3; r++) {
        double middle = m[4 * r + 3], half = 0;
        for (int c = 0; c < 3; c++) {
            middle += m[4 * r + c] * (b->lo[c] + b->hi[c]) / 2;
            half += fabs(m[4 * r + c]) * (b->hi[c] - b->lo[c]) / 2;
        }
        y.lo[r] = middle - half;
        y.hi[r] = middle + half;
    }
    return y;
}

/* ---------------------------------------------------------------- is it free? */

static bool inside(const dar_place_area *area, const dar_box *b)
{
    double x = fmax(fabs(b->lo[0]), fabs(b->hi[0])), z = fmax(fabs(b->lo[2]), fabs(b->hi[2]));
    return hypot(x, z) <= area->radius;
}

static bool apart(const dar_box *a, const dar_box *b, double margin)
{
    return a->hi[0] + margin < b->lo[0] || b->hi[0] + margin < a->lo[0] || a->hi[2] + margin < b->lo[2] ||
           b->hi[2] + margin < a->lo[2];
}

static bool is_free(const dar_place_area *area, const dar_place_thing *thing, size_t n)
{
    for (size_t t = 0; t < area->frames; t++) {
        const dar_box *mine = &thing[n].box[t];
        if (!inside(area, mine)) return false;
        for (size_t i = 0; i < n; i++)
            if (thing[i].placed && !apart(mine, &thing[i].box[t], area->margin)) return false;
    }
    return true;
}

/* ---------------------------------------------------------------- ways */

/* How high the root is: what stays stands with its lowest moment on the ground, who walks with every moment. */
static void stand(const dar_place_area *area, dar_place_thing *x)
{
    double least = INFINITY, base = x->asset->way == DAR_ASSET_FLIES ? x->asset->height : 0;
    for (size_t t = 0; t < area->frames; t++) {
        x->box[t] = carried(&x->local[t], x->turn[t], x->at[t]);
        least = fmin(least, x->box[t].lo[1] - x->at[t][1]);
    }
    for (size_t t = 0; t < area->frames; t++) {
        double low = x->asset->way == DAR_ASSET_WALKS ? x->box[t].lo[1] - x->at[t][1] : least;
        x->at[t][1] += base - low;
        x->box[t] = carried(&x->local[t], x->turn[t], x->at[t]);
    }
}

#define STRIDE 0.4 /* [m] between keys, about */

/* A walk: keys on the way of a random walker who turns back in the outer half, Catmull and Rom's spline between them,
 * facing where it goes. */
static void draw_walk(const dar_place_area *area, dar_place_thing *x, dar_dice *d)
{
    enum { LEAST = 6, MOST = 32 };
    dar_camera_key key[MOST];
    double last = (double)(area->frames > 1 ? area->frames - 1 : 1), length = x->asset->speed * last / area->fps;
    double heading = dar_dice_in(d, -M_PI, M_PI), r = area->radius * sqrt(dar_dice_in(d, 0, 1)),
           a = dar_dice_in(d, -M_PI, M_PI);
    double at[2] = { r * sin(a), r * cos(a) }, bend = dar_dice_in(d, -0.9, 0.9);
    size_t keys = (size_t)fmin(fmax(length / STRIDE + 1, LEAST), MOST);
    double step = length / (double)(keys - 1);
    for (size_t k = 0; k < keys; k++) {
        key[k] = (dar_camera_key){ .time = last * (double)k / (double)(keys - 1) };
        memcpy(key[k].view.c2w, dar_affine_identity, sizeof key[k].view.c2w);
        key[k].view.c2w[3] = at[0];
        key[k].view.c2w[11] = at[1];
        at[0] += step * sin(heading);
        at[1] += step * cos(heading);
        heading += step * (bend + dar_dice_in(d, -0.8, 0.8));
        if (hypot(at[0], at[1]) > 0.5 * area->radius) {
            double back = remainder(atan2(-at[0], -at[1]) - heading, 2 * M_PI);
            heading += copysign(fmin(fabs(back), 2.2 * step), back);
        }
    }
    for (size_t t = 0; t < area->frames; t++) {
        const dar_camera_style style = { DAR_TURN_SLERP, DAR_MOVE_CATMULL_ROM };
        dar_view now, next;
        double s = (double)t, ahead = fmin(s, last - 0.5) + 0.5;
        dar_camera_between(key, keys, style, s, &now);
        dar_camera_between(key, keys, style, ahead - 0.5, &next);
        double from[2] = { next.c2w[3], next.c2w[11] };
        dar_camera_between(key, keys, style, ahead, &next);
        turn_about(1, atan2(next.c2w[3] - from[0], next.c2w[11] - from[1]), x->turn[t]);
        x->at[t][0] = now.c2w[3], x->at[t][1] = 0, x->at[t][2] = now.c2w[11];
    }
}

/* Standing somewhere, with one of the simple motions. */
static void draw_place(const dar_place_area *area, dar_place_thing *x, dar_place_motion motion, bool first, dar_dice *d)
{
    double r = first ? 0.15 * area->radius : area->radius * sqrt(dar_dice_in(d, 0, 1)), a = dar_dice_in(d, -M_PI, M_PI);
    double yaw = first ? dar_dice_in(d, -0.6, 0.6) : dar_dice_in(d, -M_PI, M_PI), f = dar_dice_in(d, 0.4, 1.1);
    double phase = dar_dice_in(d, 0, 2 * M_PI), way = dar_dice_in(d, -M_PI, M_PI), rate = dar_dice_in(d, 0.8, 2.2);
    double angle = dar_dice_in(d, 0.12, 0.3), reach = dar_dice_in(d, 0.12, 0.4);
    if (dar_dice_chance(d, 0.5)) rate = -rate;
    for (size_t t = 0; t < area->frames; t++) {
        double s = (double)t / area->fps, wave = sin(2 * M_PI * f * s + phase), q[4], *at = x->at[t];
        at[0] = r * sin(a), at[1] = 0, at[2] = r * cos(a);
        turn_about(1, yaw, x->turn[t]);
        if (motion == DAR_PLACE_SPIN) turn_about(1, yaw + rate * s, x->turn[t]);
        if (motion == DAR_PLACE_BOB) at[1] = reach * (1 + wave);
        if (motion == DAR_PLACE_SLIDE) at[0] += reach * wave * sin(way), at[2] += reach * wave * cos(way);
        if (motion == DAR_PLACE_ORBIT) {
            at[0] += reach * sin(phase + rate * s), at[2] += reach * cos(phase + rate * s);
            turn_about(1, yaw + rate * s, x->turn[t]);
        }
        if (motion == DAR_PLACE_TILT || motion == DAR_PLACE_SWAY) {
            turn_about(motion == DAR_PLACE_TILT ? 0 : 2, (motion == DAR_PLACE_TILT ? 1.6 : 0.8) * angle * wave, q);
            dar_quat_mul(x->turn[t], q, x->turn[t]);
        }
    }
}

bool dar_place_put(const dar_place_area *area, dar_place_thing *thing, size_t n, dar_place_motion wanted, dar_dice *d)
{
    dar_place_thing *x = &thing[n];
    bool goes = x->asset->way != DAR_ASSET_STAYS;
    x->placed = false;
    for (size_t walk = goes ? 2 : 1; walk-- > 0 && !x->placed;) {
        x->motion = walk ? DAR_PLACE_WALK : goes ? DAR_PLACE_STILL : wanted;
        for (size_t i = 0; i < area->tries && !x->placed; i++) {
            if (walk) draw_walk(area, x, d);
            else draw_place(area, x, x->motion, n == 0 && i == 0, d);
            stand(area, x);
            x->placed = is_free(area, thing, n);
        }
    }
    return x->placed;
}
