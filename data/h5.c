/* h5.c: the only user of HDF5.
 *
 * Chunks are unpacked here: the library takes whatever its filters leave for a whole chunk, so that a damaged file
 * makes it read past the end. */
#include "data/h5.h"

#include <errno.h>
#include <hdf5.h>
#include <inttypes.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/inflate.h"
#include "lib/file.h"

#define DEFLATE_LEVEL 1

struct dar_h5 {
    hid_t id; /* negative: closed */
    bool writing;
    dar_file_out out;
    unsigned char *scratch; /* of one chunk on its way */
    size_t room;
    char path[PATH_MAX];
};

static const struct type {
    const char *name;
    size_t size;
} types[DAR_H5_TYPES] = {
    [DAR_H5_U8] = { "u8", 1 },   [DAR_H5_U16] = { "u16", 2 }, [DAR_H5_I16] = { "i16", 2 },
    [DAR_H5_U32] = { "u32", 4 }, [DAR_H5_F32] = { "f32", 4 },
};

size_t dar_h5_type_size(dar_h5_type type)
{
    DAR_ASSERT((unsigned)type < DAR_H5_TYPES, "h5: type %d", (int)type);
    return types[type].size;
}

static hid_t stored_type(dar_h5_type type)
{
    switch (type) {
    case DAR_H5_U8: return H5T_STD_U8LE;
    case DAR_H5_U16: return H5T_STD_U16LE;
    case DAR_H5_I16: return H5T_STD_I16LE;
    case DAR_H5_U32: return H5T_STD_U32LE;
    default: return H5T_IEEE_F32LE;
    }
}

/* ---------------------------------------------------------------- one thread at a time */

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

/* The library is not re-entrant on every system.  Its silence may be kept per thread, so every entry says it again.  At
 * exit it would visit files that it could not close, a full disk for example, and crash: it is not asked to tidy up
 * there. */
static void enter(void)
{
    pthread_mutex_lock(&lock);
    H5dont_atexit();
    H5Eset_auto2(H5E_DEFAULT, NULL, NULL);
    H5Eclear2(H5E_DEFAULT);
}

static void leave(void)
{
    pthread_mutex_unlock(&lock);
}

/* ---------------------------------------------------------------- errors */

struct cause {
    char text[160];
    int error; /* errno, if the system refused; else 0 */
};

/* The innermost entry of HDF5's stack is the cause. */
static herr_t first_cause(unsigned n, const H5E_error2_t *x, void *to)
{
    struct cause *c = to;
    if (n || !x->desc) return 0;
    const char *error = strstr(x->desc, "errno = ");
    snprintf(c->text, sizeof c->text, "%s", x->desc);
    if (error) c->error = (int)strtol(error + strlen("errno = "), NULL, 10);
    return 0;
}

static dar_status refused(const dar_h5 *f, const char *name, const char *what, dar_err *e)
{
    struct cause why = { "no reason given", 0 };
    H5Ewalk2(H5E_DEFAULT, H5E_WALK_UPWARD, first_cause, &why);
    bool full = why.error == ENOSPC || why.error == EDQUOT || why.error == EFBIG;
    if (f->writing && full) return dar_fail(e, DAR_ERR_NOMEM, "%s: %s", f->path, strerror(why.error));
    return dar_fail(e, f->writing ? DAR_ERR_IO : DAR_ERR_FORMAT, "%s: %s%s%s: HDF5: %s", f->path, name,
                    *name ? ": " : "", what, why.text);
}

/* ---------------------------------------------------------------- files */

static dar_status allocate(dar_h5 **out, const char *path, bool writing, dar_err *e)
{
    dar_h5 *f = calloc(1, sizeof *f);
    *out = f;
    if (!f) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    f->id = H5I_INVALID_HID;
    f->writing = writing;
    snprintf(f->path, sizeof f->path, "%s", path);
    return DAR_OK;
}

/* Without locks on files: a child that another thread starts meanwhile would inherit one and keep it. */
static hid_t access_list(void)
{
    hid_t p = H5Pcreate(H5P_FILE_ACCESS);
    if (p >= 0) H5Pset_file_locking(p, false, true);
    return p;
}

static dar_status finish_open(dar_h5 **out, dar_status s)
{
    if (s == DAR_OK) return s;
    dar_h5_close(*out);
    *out = NULL;
    return s;
}

/* HDF5 writes to the temporary file by name; out.fd, open on the same file, flushes it at the end. */
dar_status dar_h5_create(dar_h5 **out, const char *path, dar_err *e)
{
    dar_status s = allocate(out, path, true, e);
    if (s == DAR_OK) s = dar_file_create(&(*out)->out, path, e);
    if (s == DAR_OK) {
        enter();
        hid_t p = access_list();
        (*out)->id = H5Fcreate((*out)->out.temp, H5F_ACC_TRUNC, H5P_DEFAULT, p);
        if ((*out)->id < 0) s = refused(*out, "", "cannot create", e);
        if (p >= 0) H5Pclose(p);
        leave();
    }
    return finish_open(out, s);
}

dar_status dar_h5_commit(dar_h5 *f, dar_err *e)
{
    DAR_ASSERT(f->writing && f->id >= 0, "%s: not open for writing", f->path);
    enter();
    dar_status s = H5Fclose(f->id) < 0 ? refused(f, "", "cannot finish", e) : DAR_OK;
    f->id = H5I_INVALID_HID;
    leave();
    return s == DAR_OK ? dar_file_commit(&f->out, e) : s;
}

dar_status dar_h5_open(dar_h5 **out, const char *path, dar_err *e)
{
    dar_file_map m;
    *out = NULL;
    DAR_TRY(dar_file_map_open(&m, path, e)); /* says clearly that there is no such file */
    dar_file_map_close(&m);

    dar_status s = allocate(out, path, false, e);
    if (s == DAR_OK) {
        enter();
        hid_t p = access_list();
        (*out)->id = H5Fopen(path, H5F_ACC_RDONLY, p);
        if ((*out)->id < 0) s = refused(*out, "", "cannot open", e);
        if (p >= 0) H5Pclose(p);
        leave();
    }
    return finish_open(out, s);
}

void dar_h5_close(dar_h5 *f)
{
    if (!f) return;
    enter();
    if (f->id >= 0) H5Fclose(f->id);
    leave();
    dar_file_discard(&f->out);
    free(f->scratch);
    free(f);
}

/* ---------------------------------------------------------------- arrays */

static void check_array(const char *name, const dar_h5_array *a)
{
    DAR_ASSERT((unsigned)a->type < DAR_H5_TYPES && a->rank >= 1 && a->rank <= DAR_H5_RANK, "%s: type %d, rank %d", name,
               (int)a->type, a->rank);
}

/* Space of `count` leading indices. */
static hid_t space_of(const dar_h5_array *a, uint64_t count)
{
    hsize_t n[DAR_H5_RANK];
    for (int i = 0; i < a->rank; i++) n[i] = i ? a->dim[i] : count;
    return H5Screate_simple(a->rank, n, NULL);
}

static hid_t creation(const dar_h5_array *a)
{
    hsize_t chunk[DAR_H5_RANK];
    uint64_t lead = a->chunk ? a->chunk : 1;
    for (int i = 0; i < a->rank; i++) chunk[i] = i ? a->dim[i] : lead < a->dim[0] ? lead : a->dim[0];

    hid_t p = H5Pcreate(H5P_DATASET_CREATE);
    static const unsigned char zero[8];
    bool done = p >= 0 && H5Pset_chunk(p, a->rank, chunk) >= 0 && H5Pset_shuffle(p) >= 0 &&
                H5Pset_deflate(p, DEFLATE_LEVEL) >= 0 && H5Pset_fill_value(p, stored_type(a->type), zero) >= 0 &&
                H5Pset_obj_track_times(p, false) >= 0; /* the same content gives the same bytes */
    if (!done && p >= 0) H5Pclose(p);
    return done ? p : H5I_INVALID_HID;
}

dar_status dar_h5_make(dar_h5 *f, const char *name, const dar_h5_array *a, dar_err *e)
{
    check_array(name, a);
    for (int i = 0; i < a->rank; i++) DAR_ASSERT(a->dim[i] > 0, "%s: dimension %d is 0", name, i);
    enter();
    hid_t space = space_of(a, a->dim[0]), p = creation(a), links = H5Pcreate(H5P_LINK_CREATE), set = H5I_INVALID_HID;
    if (space >= 0 && p >= 0 && links >= 0 && H5Pset_create_intermediate_group(links, 1) >= 0)
        set = H5Dcreate2(f->id, name, stored_type(a->type), space, links, p, H5P_DEFAULT);
    dar_status s = set < 0 ? refused(f, name, "cannot make", e) : DAR_OK;
    if (set >= 0) H5Dclose(set);
    if (links >= 0) H5Pclose(links);
    if (p >= 0) H5Pclose(p);
    if (space >= 0) H5Sclose(space);
    leave();
    return s;
}

/* Every group on the way must be there before HDF5 can be asked for the last one. */
static bool has(dar_h5 *f, const char *name)
{
    char part[256];
    for (const char *p = name;; p++) {
        if (*p && *p != '/') continue;
        int n = snprintf(part, sizeof part, "%.*s", (int)(p - name), name);
        if (n >= (int)sizeof part || H5Lexists(f->id, part, H5P_DEFAULT) <= 0) return false;
        if (!*p) return true;
    }
}

bool dar_h5_has(dar_h5 *f, const char *name)
{
    enter();
    bool there = has(f, name);
    leave();
    return there;
}

/* How a dataset lies in the file. */
struct storage {
    hsize_t chunk[DAR_H5_RANK];
    uint64_t bytes; /* of a chunk; 0: contiguous */
    size_t element;
    bool shuffle, deflate;
};

/* Filters other than shuffle, then deflate: no.  Chunks' masks number them in this order. */
static bool filters_of(hid_t p, struct storage *s)
{
    int n = H5Pget_nfilters(p);
    if (n < 0 || n > 2) return false;
    for (int i = 0; i < n; i++) {
        unsigned flags, config, value[8] = { 0 };
        size_t values = DAR_COUNT(value);
        H5Z_filter_t x = H5Pget_filter2(p, (unsigned)i, &flags, &values, value, 0, NULL, &config);
        if (x == H5Z_FILTER_SHUFFLE && i == 0) s->shuffle = values == 1 && value[0] == s->element;
        else if (x == H5Z_FILTER_DEFLATE && i == n - 1) s->deflate = true;
        else return false;
    }
    return s->shuffle + s->deflate == n;
}

/* False for what is not read: another file's data, and code loaded for a filter. */
static bool storage_of(hid_t p, const dar_h5_array *a, struct storage *s)
{
    H5D_layout_t layout = H5Pget_layout(p);
    *s = (struct storage){ .element = types[a->type].size };
    if (H5Pget_external_count(p) != 0) return false;
    if (layout == H5D_CONTIGUOUS) return true;
    if (layout != H5D_CHUNKED || H5Pget_chunk(p, DAR_H5_RANK, s->chunk) != a->rank) return false;
    s->bytes = s->element;
    for (int i = 0; i < a->rank; i++)
        if (!s->chunk[i] || __builtin_mul_overflow(s->bytes, s->chunk[i], &s->bytes)) return false;
    return filters_of(p, s);
}

static const char *describe(char *to, size_t size, const char *type, int rank, const hsize_t *dim)
{
    int n = snprintf(to, size, "%s[", type);
    for (int i = 0; i < rank && n < (int)size; i++)
        n += dim[i] ? snprintf(to + n, size - (size_t)n, "%s%" PRIuHSIZE, i ? "," : "", dim[i])
                    : snprintf(to + n, size - (size_t)n, "%sany", i ? "," : "");
    if (n < (int)size) snprintf(to + n, size - (size_t)n, "]");
    return to;
}

static dar_status compare(const dar_h5 *f, const char *name, dar_h5_array *a, hid_t type, hid_t space, dar_err *e)
{
    char found[160], expected[160];
    hsize_t dim[H5S_MAX_RANK], wanted[DAR_H5_RANK];
    const char *found_type = "another type";
    int rank = H5Sget_simple_extent_ndims(space);
    if (rank < 0 || H5Sget_simple_extent_dims(space, dim, NULL) < 0) return refused(f, name, "cannot read sizes", e);
    bool same = rank == a->rank && H5Tequal(type, stored_type(a->type)) > 0;
    for (int i = 0; i < DAR_H5_TYPES; i++)
        if (H5Tequal(type, stored_type((dar_h5_type)i)) > 0) found_type = types[i].name;
    for (int i = 0; i < rank && same; i++) same = dim[i] > 0 && (!a->dim[i] || dim[i] == a->dim[i]);
    for (int i = 0; i < a->rank; i++) wanted[i] = a->dim[i];
    if (!same)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found %s, expected %s", f->path, name,
                        describe(found, sizeof found, found_type, rank, dim),
                        describe(expected, sizeof expected, types[a->type].name, a->rank, wanted));
    uint64_t bytes = types[a->type].size;
    for (int i = 0; i < rank; i++)
        if (__builtin_mul_overflow(bytes, dim[i], &bytes) || bytes > SIZE_MAX / 2)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found %s, which no memory holds", f->path, name,
                            describe(found, sizeof found, found_type, rank, dim));
    for (int i = 0; i < rank; i++) a->dim[i] = dim[i];
    return DAR_OK;
}

static dar_status expect(dar_h5 *f, const char *name, dar_h5_array *a, dar_err *e)
{
    dar_status s = DAR_OK;
    struct storage in;
    if (!has(f, name)) return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found nothing of this name", f->path, name);
    hid_t set = H5Dopen2(f->id, name, H5P_DEFAULT);
    if (set < 0) return refused(f, name, "cannot open", e);
    hid_t type = H5Dget_type(set), space = H5Dget_space(set), p = H5Dget_create_plist(set);

    if (type < 0 || space < 0 || p < 0) {
        s = refused(f, name, "cannot read the header", e);
    } else if ((s = compare(f, name, a, type, space, e)) != DAR_OK) {
        /* said */
    } else if (!storage_of(p, a, &in)) {
        s = dar_fail(e, DAR_ERR_FORMAT,
                     "%s: %s: found another file's data or an unknown filter, expected none but shuffle and deflate",
                     f->path, name);
    } else if (in.bytes > DAR_H5_CHUNK_MAX) {
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found chunks of %" PRIu64 " bytes, expected at most %" PRIu64, f->path,
                     name, in.bytes, DAR_H5_CHUNK_MAX);
    }
    if (p >= 0) H5Pclose(p);
    if (space >= 0) H5Sclose(space);
    if (type >= 0) H5Tclose(type);
    H5Dclose(set);
    return s;
}

dar_status dar_h5_expect(dar_h5 *f, const char *name, dar_h5_array *a, dar_err *e)
{
    check_array(name, a);
    enter();
    dar_status s = expect(f, name, a, e);
    leave();
    return s;
}

/* ---------------------------------------------------------------- reading and writing */

/* The most that a chunk takes in the file: 5 bytes for each block of 64 KiB that does not deflate, and then some. */
static size_t packed_bound(size_t size)
{
    return size + size / 64 + 1024;
}

static dar_status broken(const dar_h5 *f, const char *name, const hsize_t *at, dar_err *e)
{
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: the chunk of row %" PRIuHSIZE " is damaged", f->path, name, at[0]);
}

/* The chunk that begins at `at`, plain, in *out, which is in f->scratch. */
static dar_status read_chunk(dar_h5 *f, const char *name, hid_t set, const struct storage *s, const hsize_t *at,
                             const unsigned char **out, dar_err *e)
{
    unsigned char *packed = f->scratch, *plain = packed + packed_bound(s->bytes), *last = plain + s->bytes;
    haddr_t address = HADDR_UNDEF;
    hsize_t size = 0;
    unsigned mask = 0;
    uint32_t again;

    if (H5Dget_chunk_info_by_coord(set, at, &mask, &address, &size) < 0) return refused(f, name, "cannot read", e);
    if (address == HADDR_UNDEF) {
        *out = memset(last, 0, s->bytes);
        return DAR_OK;
    }
    bool shuffled = s->shuffle && !(mask & 1), deflated = s->deflate && !(mask >> s->shuffle & 1);
    if (deflated ? size > packed_bound(s->bytes) : size != s->bytes) return broken(f, name, at, e);
    if (H5Dread_chunk(set, H5P_DEFAULT, at, &again, packed) < 0) return refused(f, name, "cannot read", e);
    leave(); /* most of the time goes here */
    bool whole = !deflated || dar_inflate(packed, size, plain, s->bytes);
    if (!deflated) plain = packed;
    if (whole && shuffled) dar_unshuffle(plain, s->bytes, s->element, last);
    enter();
    *out = shuffled ? last : plain;
    return whole ? DAR_OK : broken(f, name, at, e);
}

/* Where a chunk and the rows that are wanted meet, innermost dimension first: indices, and their steps in bytes. */
struct meeting {
    uint64_t count[DAR_H5_RANK];
    size_t from[DAR_H5_RANK], to[DAR_H5_RANK];
};

static void copy_part(const struct meeting *m, int k, const unsigned char *from, unsigned char *to)
{
    if (k == 0) memcpy(to, from, m->count[0] * m->to[0]);
    else
        for (uint64_t i = 0; i < m->count[k]; i++) copy_part(m, k - 1, from + i * m->from[k], to + i * m->to[k]);
}

static void place(const struct storage *s, const dar_h5_array *a, const hsize_t *at, uint64_t first, uint64_t count,
                  const unsigned char *from, unsigned char *to)
{
    struct meeting m;
    size_t from_step = s->element, to_step = s->element;
    for (int k = 0; k < a->rank; k++) {
        int i = a->rank - 1 - k;
        uint64_t begin = i ? 0 : first, end = i ? a->dim[i] : first + count;
        uint64_t lo = at[i] > begin ? at[i] : begin, hi = at[i] + s->chunk[i] < end ? at[i] + s->chunk[i] : end;
        m.count[k] = hi - lo;
        m.from[k] = from_step;
        m.to[k] = to_step;
        from += (lo - at[i]) * from_step;
        to += (lo - begin) * to_step;
        from_step *= s->chunk[i];
        to_step *= end - begin;
    }
    copy_part(&m, a->rank - 1, from, to);
}

/* All chunks that meet these rows.  Scratch: one packed, shuffled, plain. */
static dar_status read_chunks(dar_h5 *f, const char *name, hid_t set, const struct storage *s, const dar_h5_array *a,
                              uint64_t first, uint64_t count, unsigned char *to, dar_err *e)
{
    size_t need = packed_bound(s->bytes) + 2 * s->bytes;
    hsize_t at[DAR_H5_RANK] = { first / s->chunk[0] * s->chunk[0] };
    const unsigned char *from = NULL;
    if (f->room < need) {
        free(f->scratch);
        f->scratch = malloc(need);
        f->room = f->scratch ? need : 0;
        if (!f->scratch)
            return dar_fail(e, DAR_ERR_NOMEM, "%s: %s: chunks of %" PRIu64 " bytes", f->path, name, s->bytes);
    }
    for (;;) {
        DAR_TRY(read_chunk(f, name, set, s, at, &from, e));
        place(s, a, at, first, count, from, to);
        int i = a->rank - 1;
        for (; i >= 0; i--) { /* the next chunk, last index fastest */
            at[i] += s->chunk[i];
            if (at[i] < (i ? a->dim[i] : first + count)) break;
            at[i] = 0;
        }
        if (i < 0) return DAR_OK;
    }
}

/* One of `to` and `from` is NULL. */
static dar_status transfer(dar_h5 *f, const char *name, const dar_h5_array *a, uint64_t first, uint64_t count, void *to,
                           const void *from, dar_err *e)
{
    hsize_t start[DAR_H5_RANK] = { first }, n[DAR_H5_RANK];
    check_array(name, a);
    DAR_ASSERT(count > 0 && first < a->dim[0] && count <= a->dim[0] - first,
               "%s: %" PRIu64 " from %" PRIu64 " of %" PRIu64, name, count, first, a->dim[0]);
    for (int i = 0; i < a->rank; i++) n[i] = i ? a->dim[i] : count;
    enter();
    hid_t set = H5Dopen2(f->id, name, H5P_DEFAULT), p = set < 0 ? set : H5Dget_create_plist(set),
          memory = space_of(a, count), space = set < 0 ? set : H5Dget_space(set);
    struct storage in = { 0 };
    dar_status s = DAR_OK;
    if (p < 0 || memory < 0 || space < 0 || H5Sselect_hyperslab(space, H5S_SELECT_SET, start, NULL, n, NULL) < 0 ||
        !storage_of(p, a, &in))
        s = refused(f, name, "cannot open", e);
    else if (from && H5Dwrite(set, stored_type(a->type), memory, space, H5P_DEFAULT, from) < 0)
        s = refused(f, name, "cannot write", e);
    else if (to && in.bytes) s = read_chunks(f, name, set, &in, a, first, count, to, e);
    else if (to && H5Dread(set, stored_type(a->type), memory, space, H5P_DEFAULT, to) < 0)
        s = refused(f, name, "cannot read", e);
    if (space >= 0) H5Sclose(space);
    if (memory >= 0) H5Sclose(memory);
    if (p >= 0) H5Pclose(p);
    if (set >= 0) H5Dclose(set);
    leave();
    return s;
}

dar_status dar_h5_write(dar_h5 *f, const char *name, const dar_h5_array *a, uint64_t first, uint64_t count,
                        const void *data, dar_err *e)
{
    return transfer(f, name, a, first, count, NULL, data, e);
}

dar_status dar_h5_read(dar_h5 *f, const char *name, const dar_h5_array *a, uint64_t first, uint64_t count, void *data,
                       dar_err *e)
{
    return transfer(f, name, a, first, count, data, NULL, e);
}

dar_status dar_h5_write_chunk(dar_h5 *f, const char *name, const dar_h5_array *a, uint64_t index, const void *data,
                              size_t size, dar_err *e)
{
    const hsize_t at[DAR_H5_RANK] = { index };
    check_array(name, a);
    DAR_ASSERT(a->chunk <= 1 && index < a->dim[0], "%s: chunk %" PRIu64 " of %" PRIu64, name, index, a->dim[0]);
    enter();
    hid_t set = H5Dopen2(f->id, name, H5P_DEFAULT);
    bool done = set >= 0 && H5Dwrite_chunk(set, H5P_DEFAULT, 0, at, size, data) >= 0;
    dar_status s = done ? DAR_OK : refused(f, name, "cannot write", e);
    if (set >= 0) H5Dclose(set);
    leave();
    return s;
}

/* ---------------------------------------------------------------- attributes */

static dar_status put(dar_h5 *f, const char *name, const char *key, hid_t type, hid_t space, const void *data,
                      dar_err *e)
{
    hid_t a = H5Acreate_by_name(f->id, name, key, type, space, H5P_DEFAULT, H5P_DEFAULT, H5P_DEFAULT);
    dar_status s = a < 0 || H5Awrite(a, type, data) < 0 ? refused(f, name, key, e) : DAR_OK;
    if (a >= 0) H5Aclose(a);
    H5Sclose(space);
    return s;
}

dar_status dar_h5_put_numbers(dar_h5 *f, const char *name, const char *key, const double *x, size_t n, dar_err *e)
{
    hsize_t dim = n;
    enter();
    hid_t space = n == 1 ? H5Screate(H5S_SCALAR) : H5Screate_simple(1, &dim, NULL);
    dar_status s = put(f, name, key, H5T_IEEE_F64LE, space, x, e);
    leave();
    return s;
}

static hid_t text_type(size_t size)
{
    hid_t type = H5Tcopy(H5T_C_S1);
    H5Tset_size(type, size);
    H5Tset_cset(type, H5T_CSET_UTF8);
    return type;
}

dar_status dar_h5_put_text(dar_h5 *f, const char *name, const char *key, const char *text, dar_err *e)
{
    enter();
    hid_t type = text_type(strlen(text) + 1);
    dar_status s = put(f, name, key, type, H5Screate(H5S_SCALAR), text, e);
    H5Tclose(type);
    leave();
    return s;
}

/* Open an attribute of n elements of a class. */
static dar_status get(hid_t *a, dar_h5 *f, const char *name, const char *key, H5T_class_t class, size_t n, dar_err *e)
{
    *a = H5Aopen_by_name(f->id, name, key, H5P_DEFAULT, H5P_DEFAULT);
    if (*a < 0) return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: attribute %s is missing", f->path, name, key);
    hid_t type = H5Aget_type(*a), space = H5Aget_space(*a);
    bool fits =
        type >= 0 && space >= 0 && H5Tget_class(type) == class && H5Sget_simple_extent_npoints(space) == (hssize_t)n;
    if (class == H5T_STRING && fits) fits = H5Tis_variable_str(type) == 0;
    if (type >= 0) H5Tclose(type);
    if (space >= 0) H5Sclose(space);
    if (fits) return DAR_OK;
    H5Aclose(*a);
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: attribute %s: expected %zu %s", f->path, name, key, n,
                    class == H5T_STRING ? "text of a fixed length" : "numbers");
}

dar_status dar_h5_get_numbers(dar_h5 *f, const char *name, const char *key, double *x, size_t n, dar_err *e)
{
    hid_t a;
    enter();
    dar_status s = get(&a, f, name, key, H5T_FLOAT, n, e);
    if (s == DAR_OK) {
        if (H5Aread(a, H5T_NATIVE_DOUBLE, x) < 0) s = refused(f, name, key, e);
        H5Aclose(a);
    }
    leave();
    return s;
}

static dar_status read_text(hid_t a, const dar_h5 *f, const char *name, const char *key, char *text, size_t size,
                            dar_err *e)
{
    dar_status s = DAR_OK;
    if (H5Aget_storage_size(a) > size)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: attribute %s: text of %" PRIuHSIZE " bytes, expected at most %zu",
                        f->path, name, key, H5Aget_storage_size(a), size);
    hid_t type = text_type(size);
    if (H5Aread(a, type, text) < 0) s = refused(f, name, key, e);
    else text[size - 1] = 0;
    H5Tclose(type);
    return s;
}

dar_status dar_h5_get_text(dar_h5 *f, const char *name, const char *key, char *text, size_t size, dar_err *e)
{
    hid_t a;
    enter();
    dar_status s = get(&a, f, name, key, H5T_STRING, 1, e);
    if (s == DAR_OK) {
        s = read_text(a, f, name, key, text, size, e);
        H5Aclose(a);
    }
    leave();
    return s;
}
