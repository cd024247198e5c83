/* rigid.c: rotations and rigid transforms. */
#include "data/rigid.h"

#include <math.h>
#include <string.h>

#include "data/affine.h"

void dar_vec_cross(const double a[3], const double b[3], double y[3])
{
    y[0] = a[1] * b[2] - a[2] * b[1];
    y[1] = a[2] * b[0] - a[0] * b[2];
    y[2] = a[0] * b[1] - a[1] * b[0];
}

double dar_vec_dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static bool unit(double v[3])
{
    double r = sqrt(dar_vec_dot(v, v));
    if (!(r > 0) || !isfinite(r)) return false;
    for (int i = 0; i < 3; i++) v[i] /= r;
    return true;
}

void dar_rigid_inverse(const double m[12], double y[12])
{
    double r[12];
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) r[4 * i + j] = m[4 * j + i];
        r[4 * i + 3] = -(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]);
    }
    memcpy(y, r, sizeof r);
}

double dar_rigid_error(const double m[12])
{
    double worst = 0;
    for (int i = 0; i < 12; i++)
        if (!isfinite(m[i])) return NAN;
    for (int i = 0; i < 3; i++) {
        for (int j = i; j < 3; j++) {
            double dot = m[i] * m[j] + m[4 + i] * m[4 + j] + m[8 + i] * m[8 + j];
            worst = fmax(worst, fabs(dot - (i == j)));
        }
    }
    return dar_affine_det(m) < 0 ? fmax(worst, 2) : worst;
}

/* Newton's iteration R <- (R + R^-T) / 2, quadratic at the end.  Source: Higham 1986. */
bool dar_rigid_nearest(double m[12])
{
    for (int k = 0; k < 64; k++) {
        double det = dar_affine_det(m), cofactor[9], change = 0;
        if (!(det > 1e-30) || !isfinite(det)) return false;
        dar_affine_normals(m, cofactor);
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) {
                double *r = m + 4 * i + j, next = (*r + cofactor[3 * i + j] / det) / 2;
                change = fmax(change, fabs(next - *r));
                *r = next;
            }
        }
        if (change < 1e-15) break;
    }
    return dar_rigid_error(m) < 1e-12;
}

bool dar_rigid_look_at(const double eye[3], const double target[3], const double up[3], double c2w[12])
{
    double forward[3], top[3], right[3], down[3];
    for (int i = 0; i < 3; i++) forward[i] = target[i] - eye[i];
    memcpy(top, up, sizeof top);
    if (!unit(forward)) return false;
    dar_vec_cross(forward, top, right);
    if (!unit(top) || !(dar_vec_dot(right, right) > 1e-12 * dar_vec_dot(up, up))) {
        int least = 0;
        for (int i = 1; i < 3; i++)
            if (fabs(forward[i]) < fabs(forward[least])) least = i;
        for (int i = 0; i < 3; i++) top[i] = i == least;
        dar_vec_cross(forward, top, right);
    }
    unit(right);
    dar_vec_cross(forward, right, down);
    for (int i = 0; i < 3; i++) {
        c2w[4 * i] = right[i];
        c2w[4 * i + 1] = down[i];
        c2w[4 * i + 2] = forward[i];
        c2w[4 * i + 3] = eye[i];
    }
    return true;
}

/* The largest of the four components is found first, so that nothing small is divided by.  Source: Shepperd 1978. */
void dar_rigid_quat(const double m[12], double q[4])
{
    double trace = m[0] + m[5] + m[10];
    int i = 3;
    double most = trace;
    for (int k = 0; k < 3; k++) {
        if (m[5 * k] > most) {
            most = m[5 * k];
            i = k;
        }
    }
    if (i == 3) {
        q[0] = m[9] - m[6];
        q[1] = m[2] - m[8];
        q[2] = m[4] - m[1];
        q[3] = 1 + trace;
    } else {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        q[i] = 1 + 2 * m[5 * i] - trace;
        q[j] = m[4 * i + j] + m[4 * j + i];
        q[k] = m[4 * i + k] + m[4 * k + i];
        q[3] = m[4 * k + j] - m[4 * j + k];
    }
    dar_quat_unit(q);
    if (q[3] < 0)
        for (int k = 0; k < 4; k++) q[k] = -q[k];
}

void dar_rigid_of_quat(const double q[4], const double t[3], double m[12])
{
    static const double one[3] = { 1, 1, 1 };
    dar_affine_trs(t, q, one, m);
}

void dar_quat_mul(const double a[4], const double b[4], double y[4])
{
    double r[4];
    dar_vec_cross(a, b, r);
    for (int i = 0; i < 3; i++) r[i] += a[3] * b[i] + b[3] * a[i];
    r[3] = a[3] * b[3] - dar_vec_dot(a, b);
    memcpy(y, r, sizeof r);
}

void dar_quat_log(const double q[4], double v[3])
{
    double sign = q[3] < 0 ? -1 : 1, s = sqrt(dar_vec_dot(q, q));
    double k = s > 1e-150 ? sign * atan2(s, sign * q[3]) / s : sign;
    for (int i = 0; i < 3; i++) v[i] = k * q[i];
}

void dar_quat_exp(const double v[3], double q[4])
{
    double a = sqrt(dar_vec_dot(v, v)), k = a > 1e-150 ? sin(a) / a : 1;
    for (int i = 0; i < 3; i++) q[i] = k * v[i];
    q[3] = cos(a);
}
