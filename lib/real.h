/* real.h: the lesser and the greater of two numbers, for hot loops: fmin and fmax are calls, because they take care of
 * NaN on both sides.  These return y where x is not a number. */
#ifndef DAR_LIB_REAL_H
#define DAR_LIB_REAL_H

static inline double dar_lesser(double x, double y)
{
    return x < y ? x : y;
}

static inline double dar_greater(double x, double y)
{
    return x > y ? x : y;
}

static inline float dar_lesserf(float x, float y)
{
    return x < y ? x : y;
}

static inline float dar_greaterf(float x, float y)
{
    return x > y ? x : y;
}

#endif
