/* sha256.c: through OpenSSL's libcrypto, which uses the processor's own instructions for it where there are any. */
#include "lib/sha256.h"

#include <openssl/evp.h>
#include <stdbool.h>
#include <stdio.h>

#include "lib/file.h"

void dar_sha256_init(dar_sha256 *h)
{
    h->state = EVP_MD_CTX_new();
    bool made = h->state && EVP_DigestInit_ex(h->state, EVP_sha256(), NULL) == 1;
    DAR_ASSERT(made, "sha256: out of memory");
}

void dar_sha256_add(dar_sha256 *h, const void *data, size_t size)
{
    bool added = EVP_DigestUpdate(h->state, data, size) == 1;
    DAR_ASSERT(added, "sha256: %zu bytes refused", size);
}

void dar_sha256_finish(dar_sha256 *h, char text[DAR_SHA256_TEXT])
{
    unsigned char sum[EVP_MAX_MD_SIZE];
    bool finished = EVP_DigestFinal_ex(h->state, sum, NULL) == 1;
    DAR_ASSERT(finished, "sha256: no sum");
    EVP_MD_CTX_free(h->state);
    for (int i = 0; i < DAR_SHA256_TEXT / 2; i++) snprintf(text + 2 * i, 3, "%02x", sum[i]);
}

dar_status dar_sha256_file(const char *path, char text[DAR_SHA256_TEXT], dar_err *e)
{
    dar_sha256 h;
    dar_file_map m;
    DAR_TRY(dar_file_map_open(&m, path, e));
    dar_sha256_init(&h);
    if (m.size) dar_sha256_add(&h, m.data, m.size);
    dar_sha256_finish(&h, text);
    dar_file_map_close(&m);
    return DAR_OK;
}
