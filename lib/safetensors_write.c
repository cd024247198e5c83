/* safetensors_write.c: plan the shards, write all under temporary names, rename all. */
#include "lib/safetensors_write.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "lib/file.h"
#include "lib/json_write.h"
#include "lib/weights.h"

#define SUFFIX ".safetensors"

struct shard {
    size_t first, n; /* items, in the caller's order */
    dar_file_out out;
};

struct plan {
    const char *path;
    const dar_safetensors_item *item;
    size_t n;
    const dar_safetensors_options *o;
    struct shard *shard;
    size_t shards;
    dar_file_out index;
    dar_json_writer json; /* of one header after the other, then of the index */
};

static size_t bytes_of(const dar_safetensors_item *t)
{
    return dar_mul_size(dar_tensor_count(&t->x), dar_dtype_size(t->x.dtype));
}

static int by_name(const void *a, const void *b)
{
    return strcmp(*(const char *const *)a, *(const char *const *)b);
}

static dar_status check_items(const struct plan *p, dar_err *e)
{
    for (size_t i = 0; i < p->n; i++) {
        const dar_safetensors_item *t = &p->item[i];
        DAR_ASSERT(*t->name && strlen(t->name) <= DAR_WEIGHTS_NAME && strcmp(t->name, "__metadata__") != 0,
                   "safetensors: name '%s'", t->name);
        DAR_ASSERT(t->x.data && dar_tensor_contiguous(&t->x) && dar_tensor_count(&t->x),
                   "safetensors: %s: not contiguous, or empty", t->name);
    }
    const char **name = malloc((p->n + 1) * sizeof *name), *twice = NULL;
    if (!name) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", p->path);
    for (size_t i = 0; i < p->n; i++) name[i] = p->item[i].name;
    qsort(name, p->n, sizeof *name, by_name);
    for (size_t i = 1; i < p->n; i++)
        if (strcmp(name[i - 1], name[i]) == 0) twice = name[i];
    free(name);
    DAR_ASSERT(!twice, "safetensors: %s twice", twice);
    return DAR_OK;
}

/* Fill shards in the caller's order. */
static dar_status cut(struct plan *p, dar_err *e)
{
    size_t limit = p->o && p->o->shard_bytes ? p->o->shard_bytes : SIZE_MAX, full = SIZE_MAX;

    for (size_t i = 0; i < p->n || !p->shards; i++) {
        size_t bytes = p->n ? bytes_of(&p->item[i]) : 0;
        if (full == SIZE_MAX || bytes > limit - full || full > limit) {
            struct shard *grown = realloc(p->shard, (p->shards + 1) * sizeof *grown);
            if (!grown) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", p->path);
            p->shard = grown;
            memset(&p->shard[p->shards], 0, sizeof *grown);
            p->shard[p->shards++].first = i;
            full = 0;
        }
        full += bytes;
        p->shard[p->shards - 1].n += p->n > 0;
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- one shard */

static void describe(dar_json_writer *w, const dar_safetensors_item *t, size_t *offset)
{
    static const char *const names[] = {
        [DAR_F64] = "F64", [DAR_F32] = "F32", [DAR_BF16] = "BF16", [DAR_F16] = "F16", [DAR_I8] = "I8"
    };
    size_t end = dar_add_size(*offset, bytes_of(t));

    dar_json_write_object(w, t->name);
    dar_json_write_text(w, "dtype", names[t->x.dtype]);
    dar_json_write_array(w, "shape");
    for (int i = 0; i < t->x.shape.n; i++) dar_json_write_int(w, NULL, t->x.shape.d[i]);
    dar_json_write_end(w);
    dar_json_write_array(w, "data_offsets");
    dar_json_write_int(w, NULL, (int64_t)*offset);
    dar_json_write_int(w, NULL, (int64_t)end);
    dar_json_write_end(w);
    dar_json_write_end(w);
    *offset = end;
}

static dar_status write_header(struct plan *p, struct shard *s, dar_err *e)
{
    dar_json_writer *w = &p->json;
    unsigned char n[8], pad[DAR_ALIGN];
    size_t offset = 0;

    dar_json_writer_reset(w);
    dar_json_write_object(w, NULL);
    if (p->o && p->o->meta && *p->o->meta) {
        dar_json_write_object(w, "__metadata__");
        for (const char *const *m = p->o->meta; *m; m += 2) dar_json_write_text(w, m[0], m[1]);
        dar_json_write_end(w);
    }
    for (size_t size = 8; size; size /= 2)
        for (size_t i = s->first; i < s->first + s->n; i++)
            if (dar_dtype_size(p->item[i].x.dtype) == size) describe(w, &p->item[i], &offset);
    dar_json_write_end(w);
    if (w->failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", s->out.path);

    size_t padding = (DAR_ALIGN - (8 + w->size) % DAR_ALIGN) % DAR_ALIGN;
    size_t header = w->size + padding;
    DAR_ASSERT(s->n <= DAR_WEIGHTS_TENSORS && header <= DAR_WEIGHTS_HEADER,
               "safetensors: %zu tensors, %zu bytes of header", s->n, header);
    for (size_t i = 0; i < 8; i++) n[i] = (unsigned char)(header >> (8 * i));
    memset(pad, ' ', sizeof pad);
    DAR_TRY(dar_file_write(&s->out, n, sizeof n, e));
    DAR_TRY(dar_file_write(&s->out, w->text, w->size, e));
    return dar_file_write(&s->out, pad, padding, e);
}

static dar_status write_shard(struct plan *p, struct shard *s, const char *path, dar_err *e)
{
    DAR_TRY(dar_file_create(&s->out, path, e));
    DAR_TRY(write_header(p, s, e));
    for (size_t size = 8; size; size /= 2)
        for (size_t i = s->first; i < s->first + s->n; i++)
            if (dar_dtype_size(p->item[i].x.dtype) == size)
                DAR_TRY(dar_file_write(&s->out, p->item[i].x.data, bytes_of(&p->item[i]), e));
    return dar_file_flush(&s->out, e);
}

/* ---------------------------------------------------------------- all of them */

/* "STEM.safetensors" -> "STEM" with another end. */
static dar_status name_beside(char *buf, const char *path, const char *rest, dar_err *e)
{
    size_t n = strlen(path), m = strlen(SUFFIX);
    if (n >= m && strcmp(path + n - m, SUFFIX) == 0) n -= m;
    if (snprintf(buf, PATH_MAX, "%.*s%s", (int)n, path, rest) < PATH_MAX) return DAR_OK;
    return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
}

static dar_status write_index(struct plan *p, dar_err *e)
{
    dar_json_writer *w = &p->json;
    char path[PATH_MAX];
    size_t total = 0;

    for (size_t i = 0; i < p->n; i++) total = dar_add_size(total, bytes_of(&p->item[i]));
    dar_json_writer_reset(w);
    w->pretty = true;
    dar_json_write_object(w, NULL);
    dar_json_write_object(w, "metadata");
    dar_json_write_int(w, "total_size", (int64_t)total);
    dar_json_write_end(w);
    dar_json_write_object(w, "weight_map");
    for (const struct shard *s = p->shard; s < p->shard + p->shards; s++) {
        const char *slash = strrchr(s->out.path, '/');
        for (size_t i = s->first; i < s->first + s->n; i++)
            dar_json_write_text(w, p->item[i].name, slash ? slash + 1 : s->out.path);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
    if (w->failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", p->path);
    DAR_TRY(name_beside(path, p->path, SUFFIX ".index.json", e));
    DAR_TRY(dar_file_create(&p->index, path, e));
    DAR_TRY(dar_file_write(&p->index, w->text, w->size, e));
    DAR_TRY(dar_file_write(&p->index, "\n", 1, e));
    return dar_file_flush(&p->index, e);
}

static dar_status write_all(struct plan *p, dar_err *e)
{
    char path[PATH_MAX], rest[64];
    bool one = p->shards == 1;

    for (size_t i = 0; i < p->shards; i++) {
        snprintf(rest, sizeof rest, "-%05zu-of-%05zu" SUFFIX, i + 1, p->shards);
        if (!one) DAR_TRY(name_beside(path, p->path, rest, e));
        DAR_TRY(write_shard(p, &p->shard[i], one ? p->path : path, e));
    }
    if (!one) DAR_TRY(write_index(p, e));

    for (size_t i = 0; i < p->shards; i++) DAR_TRY(dar_file_commit(&p->shard[i].out, e));
    if (!one) DAR_TRY(dar_file_commit(&p->index, e));
    if (one) DAR_TRY(name_beside(path, p->path, SUFFIX ".index.json", e));
    const char *other = one ? path : p->path;
    if (unlink(other) != 0 && errno != ENOENT) return dar_fail(e, DAR_ERR_IO, "%s: %s", other, strerror(errno));
    return DAR_OK;
}

dar_status dar_safetensors_write(const char *path, const dar_safetensors_item *item, size_t n,
                                 const dar_safetensors_options *o, dar_err *e)
{
    struct plan p = { .path = path, .item = item, .n = n, .o = o };
    dar_status s = check_items(&p, e);

    if (s == DAR_OK) s = cut(&p, e);
    if (s == DAR_OK) s = write_all(&p, e);
    for (size_t i = 0; i < p.shards; i++) dar_file_discard(&p.shard[i].out);
    dar_file_discard(&p.index);
    free(p.shard);
    dar_json_writer_free(&p.json);
    return s;
}
