/* affine.h: 3 x 4 matrices in f64, row-major, y = M (x, 1); quaternions (x, y, z, w). */
#ifndef DAR_DATA_AFFINE_H
#define DAR_DATA_AFFINE_H

#include <stdbool.h>

extern const double dar_affine_identity[12];

/* y = a b; y may be a or b. */
void dar_affine_mul(const double a[12], const double b[12], double y[12]);

/* M = T R S of a unit quaternion. */
void dar_affine_trs(const double t[3], const double q[4], const double s[3], double m[12]);

/* Determinant of the linear part. */
double dar_affine_det(const double m[12]);

/* n [3, 3]: takes normals along with m, up to their length: the matrix of cofactors with the sign of the determinant,
 * which is the inverse transpose scaled, and exists where that does not. */
void dar_affine_normals(const double m[12], double n[9]);

/* Scale to unit length; false if it has none. */
bool dar_quat_unit(double q[4]);

/* From unit a (u = 0) to unit b (u = 1) along the shorter arc. */
void dar_quat_slerp(const double a[4], const double b[4], double u, double y[4]);

#endif
