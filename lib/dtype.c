/* dtype.c: scalar conversions, the definition that the vector kernels are tested against. */
#include "lib/dtype.h"

#include <string.h>

#include "lib/status.h"

static const struct {
    const char *name;
    size_t size;
} table[DAR_DTYPES] = {
    [DAR_F64] = { "f64", 8 }, [DAR_F32] = { "f32", 4 }, [DAR_BF16] = { "bf16", 2 },
    [DAR_F16] = { "f16", 2 }, [DAR_I8] = { "i8", 1 },
};

size_t dar_dtype_size(dar_dtype t)
{
    return table[t].size;
}

const char *dar_dtype_name(dar_dtype t)
{
    return table[t].name;
}

static uint32_t bits_of(float x)
{
    uint32_t u;
    memcpy(&u, &x, sizeof u);
    return u;
}

static float float_of(uint32_t u)
{
    float x;
    memcpy(&x, &u, sizeof x);
    return x;
}

uint16_t dar_bf16_from_f32(float x)
{
    uint32_t u = bits_of(x);
    if ((u & 0x7fffffffu) > 0x7f800000u) return (uint16_t)(u >> 16 | 0x40); /* NaN: keep it one, and quiet */
    return (uint16_t)((u + 0x7fffu + (u >> 16 & 1)) >> 16);
}

float dar_bf16_to_f32(uint16_t h)
{
    return float_of((uint32_t)h << 16);
}

uint16_t dar_f16_from_f32(float x)
{
    uint32_t u = bits_of(x), a = u & 0x7fffffffu;
    uint16_t sign = (uint16_t)(u >> 16 & 0x8000);

    if (a > 0x7f800000u) return (uint16_t)(sign | 0x7e00 | (a >> 13 & 0x1ff)); /* NaN */
    if (a >= 0x477ff000u) return (uint16_t)(sign | 0x7c00);                    /* rounds past 65504 */
    if (a < 0x38800000u) {                                                     /* subnormal: let the adder round */
        uint32_t r = bits_of(float_of(a) + 0.5f) - 0x3f000000u;
        return (uint16_t)(sign | r);
    }
    return (uint16_t)(sign | ((a - 0x38000000u + 0xfffu + (a >> 13 & 1)) >> 13));
}

float dar_f16_to_f32(uint16_t h)
{
    uint32_t sign = (uint32_t)(h & 0x8000) << 16, e = h >> 10 & 31, m = h & 0x3ff;

    if (e == 31) return float_of(sign | 0x7f800000u | (m ? m << 13 | 0x400000u : 0));
    if (e) return float_of(sign | (e + 112) << 23 | m << 13);
    float x = (float)m * 0x1p-24f;
    return sign ? -x : x;
}

double dar_dtype_get(dar_dtype t, const void *row, size_t i)
{
    switch (t) {
    case DAR_F64: return ((const double *)row)[i];
    case DAR_F32: return ((const float *)row)[i];
    case DAR_BF16: return dar_bf16_to_f32(((const uint16_t *)row)[i]);
    case DAR_F16: return dar_f16_to_f32(((const uint16_t *)row)[i]);
    default: DAR_ASSERT(0, "dtype: %s has no elements of its own", dar_dtype_name(t));
    }
}

void dar_dtype_set(dar_dtype t, void *row, size_t i, double x)
{
    switch (t) {
    case DAR_F64: ((double *)row)[i] = x; break;
    case DAR_F32: ((float *)row)[i] = (float)x; break;
    case DAR_BF16: ((uint16_t *)row)[i] = dar_bf16_from_f32((float)x); break;
    case DAR_F16: ((uint16_t *)row)[i] = dar_f16_from_f32((float)x); break;
    default: DAR_ASSERT(0, "dtype: %s has no elements of its own", dar_dtype_name(t));
    }
}
