/* nearest.c: edit distance by dynamic programming over three rows. */
#include "lib/nearest.h"

#include <stdint.h>
#include <string.h>

#include "lib/size.h"

#define WORD_MAX 64

size_t dar_nearest_distance(const char *a, const char *b)
{
    size_t n = strlen(a), m = strlen(b);
    size_t row[3][WORD_MAX + 1]; /* distances of a[0, i) to every b[0, j), for i, i - 1, i - 2 */

    if (n > WORD_MAX || m > WORD_MAX) return SIZE_MAX;
    for (size_t j = 0; j <= m; j++) row[0][j] = j;
    for (size_t i = 1; i <= n; i++) {
        size_t *now = row[i % 3], *one = row[(i + 2) % 3], *two = row[(i + 1) % 3];
        now[0] = i;
        for (size_t j = 1; j <= m; j++) {
            now[j] = dar_least(dar_least(now[j - 1], one[j]) + 1, one[j - 1] + (a[i - 1] != b[j - 1]));
            if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1])
                now[j] = dar_least(now[j], two[j - 2] + 1);
        }
    }
    return row[n % 3][m];
}

dar_nearest dar_nearest_to(const char *word)
{
    /* More than half of the letters wrong is another word. */
    return (dar_nearest){ .word = word, .distance = strlen(word) / 2 + 1 };
}

void dar_nearest_try(dar_nearest *n, const char *candidate)
{
    size_t d = dar_nearest_distance(n->word, candidate);
    if (d < n->distance) {
        n->distance = d;
        n->best = candidate;
    }
}
