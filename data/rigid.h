/* rigid.h: rotations and rigid transforms in f64: row-major [3, 4] as in data/affine.h, quaternions (x, y, z, w). */
#ifndef DAR_DATA_RIGID_H
#define DAR_DATA_RIGID_H

#include <stdbool.h>

/* y = m^-1 of a rotation and a translation; y may be m. */
void dar_rigid_inverse(const double m[12], double y[12]);

/* Largest element of |R^T R - 1|; 2 if R mirrors; NaN if a number of m is not finite. */
double dar_rigid_error(const double m[12]);

/* Replace the linear part by the rotation nearest to it (the orthogonal factor of its polar decomposition).  False, and
 * m undefined, if there is none: it mirrors or has no extent. */
bool dar_rigid_nearest(double m[12]);

/* x right, y down, z towards the target; `up` is what the picture's top points to.  If up lies along the view, the
 * world axis that is farthest from the view stands in for it.  False if eye and target are the same point. */
bool dar_rigid_look_at(const double eye[3], const double target[3], const double up[3], double c2w[12]);

/* The rotation of m as a unit quaternion with w >= 0. */
void dar_rigid_quat(const double m[12], double q[4]);

/* m from a unit quaternion and a translation. */
void dar_rigid_of_quat(const double q[4], const double t[3], double m[12]);

void dar_quat_mul(const double a[4], const double b[4], double y[4]); /* y may be a or b */

/* v: half the angle [rad] times the axis, of a unit q; the shorter of both ways.  And back. */
void dar_quat_log(const double q[4], double v[3]);
void dar_quat_exp(const double v[3], double q[4]);

void dar_vec_cross(const double a[3], const double b[3], double y[3]); /* y may not be a or b */
double dar_vec_dot(const double a[3], const double b[3]);

#endif
