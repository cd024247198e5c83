/* view.h: a camera at one moment.
 *
 * Axes as in OpenCV: x right, y down, z forward.  Pixels: the centre of the first is (0.5, 0.5).  A point X of the
 * world has camera coordinates v = R^T (X - o) and lands on the picture at x = fx v0 / v2 + cx, y = fy v1 / v2 + cy;
 * its depth is v2. */
#ifndef DAR_DATA_VIEW_H
#define DAR_DATA_VIEW_H

typedef struct dar_view {
    int width, height;     /* [px] */
    double fx, fy, cx, cy; /* [px] */
    double c2w[12];        /* row-major [3, 4]: columns x, y, z of R (orthonormal, right-handed), then the origin o */
    double near;           /* > 0: nothing nearer than this depth is seen */
} dar_view;

#endif
