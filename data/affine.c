/* affine.c: small matrices. */
#include "data/affine.h"

#include <math.h>
#include <string.h>

const double dar_affine_identity[12] = { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0 };

void dar_affine_mul(const double a[12], const double b[12], double y[12])
{
    double r[12];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 4; j++)
            r[4 * i + j] =
                a[4 * i] * b[j] + a[4 * i + 1] * b[4 + j] + a[4 * i + 2] * b[8 + j] + (j == 3 ? a[4 * i + 3] : 0);
    memcpy(y, r, sizeof r);
}

void dar_affine_trs(const double t[3], const double q[4], const double s[3], double m[12])
{
    double x = q[0], y = q[1], z = q[2], w = q[3];
    const double r[9] = {
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w),     2 * (x * z + y * w),     /* row 0 */
        2 * (x * y + z * w),     1 - 2 * (x * x + z * z), 2 * (y * z - x * w),     /* row 1 */
        2 * (x * z - y * w),     2 * (y * z + x * w),     1 - 2 * (x * x + y * y), /* row 2 */
    };
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) m[4 * i + j] = r[3 * i + j] * s[j];
        m[4 * i + 3] = t[i];
    }
}

static void cofactors(const double m[12], double n[9])
{
    for (int i = 0; i < 3; i++) {
        const double *a = m + 4 * ((i + 1) % 3), *b = m + 4 * ((i + 2) % 3);
        n[3 * i] = a[1] * b[2] - a[2] * b[1];
        n[3 * i + 1] = a[2] * b[0] - a[0] * b[2];
        n[3 * i + 2] = a[0] * b[1] - a[1] * b[0];
    }
}

double dar_affine_det(const double m[12])
{
    double n[9];
    cofactors(m, n);
    return m[0] * n[0] + m[1] * n[1] + m[2] * n[2];
}

void dar_affine_normals(const double m[12], double n[9])
{
    cofactors(m, n);
    if (m[0] * n[0] + m[1] * n[1] + m[2] * n[2] < 0)
        for (int i = 0; i < 9; i++) n[i] = -n[i];
}

bool dar_quat_unit(double q[4])
{
    double r = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (!(r > 0) || !isfinite(r)) return false;
    for (int i = 0; i < 4; i++) q[i] /= r;
    return true;
}

/* Source: Shoemake 1985.  The angle comes from |a - b| and |a + b|, exact also where the cosine is nearly 1. */
void dar_quat_slerp(const double a[4], const double b[4], double u, double y[4])
{
    double dot = 0, minus = 0, plus = 0;
    for (int i = 0; i < 4; i++) dot += a[i] * b[i];
    double sign = dot < 0 ? -1 : 1;
    for (int i = 0; i < 4; i++) {
        double d = a[i] - sign * b[i], s = a[i] + sign * b[i];
        minus += d * d;
        plus += s * s;
    }
    double angle = 2 * atan2(sqrt(minus), sqrt(plus)), whole = sin(angle);
    double wa = whole > 1e-9 ? sin((1 - u) * angle) / whole : 1 - u;
    double wb = whole > 1e-9 ? sin(u * angle) / whole : u;
    for (int i = 0; i < 4; i++) y[i] = wa * a[i] + wb * sign * b[i];
    dar_quat_unit(y);
}
