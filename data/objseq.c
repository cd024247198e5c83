/* objseq.c: which files, in which order; their vertices as morph targets.
 *
 * A vertex of the mesh is a pair of a vertex and a normal as the first file pairs them: its hard edges stay hard.
 * Writers number normals anew in each frame, so later frames are asked through the corner where a pair was first met.
 */
#include "data/objseq.h"

#include <dirent.h>
#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/affine.h"
#include "data/obj.h"
#include "lib/file.h"

/* ---------------------------------------------------------------- names */

static bool is_digit(char c)
{
    return c >= '0' && c <= '9';
}

int dar_objseq_order(const char *a, const char *b)
{
    while (*a && *b) {
        if (is_digit(*a) && is_digit(*b)) {
            const char *sa = a + strspn(a, "0"), *sb = b + strspn(b, "0");
            size_t na = strspn(sa, "0123456789"), nb = strspn(sb, "0123456789");
            int order = na != nb ? (na < nb ? -1 : 1) : strncmp(sa, sb, na);
            if (order) return order;
            a = sa + na;
            b = sb + nb;
        } else if (*a == *b) {
            a++, b++;
        } else {
            break;
        }
    }
    return (unsigned char)*a - (unsigned char)*b;
}

/* "%d" or "%04d" at p: the least number of digits, and *after behind it; 0: neither. */
static size_t digits_wanted(const char *p, const char **after)
{
    size_t n = 1;
    if (*p++ != '%') return 0;
    if (p[0] == '0' && is_digit(p[1])) {
        n = (size_t)(p[1] - '0');
        p += 2;
    }
    *after = p + 1;
    return *p == 'd' ? n : 0;
}

bool dar_objseq_fits(const char *pattern, const char *name)
{
    const char *star = NULL, *retry = NULL; /* behind the last star, and where the name may go on */
    while (*name || *pattern) {
        const char *after;
        size_t n = digits_wanted(pattern, &after), run = n ? strspn(name, "0123456789") : 0;
        if (*pattern == '*') {
            star = ++pattern;
            retry = name;
        } else if (n && run >= n) {
            pattern = after;
            name += run;
        } else if (!n && *name && (*pattern == '?' || *pattern == *name)) {
            pattern++, name++;
        } else if (star && *retry) {
            pattern = star;
            name = ++retry;
        } else {
            return false;
        }
    }
    return true;
}

struct names {
    char **at;
    size_t n, capacity;
};

static void free_names(struct names *l)
{
    for (size_t i = 0; i < l->n; i++) free(l->at[i]);
    free(l->at);
}

static dar_status add_name(struct names *l, const char *dir, const char *name, dar_err *e)
{
    size_t size = strlen(dir) + strlen(name) + 2;
    if (l->n == l->capacity) {
        size_t capacity = l->n ? 2 * l->n : 64;
        char **at = realloc(l->at, capacity * sizeof *at);
        if (!at) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", dir);
        l->at = at;
        l->capacity = capacity;
    }
    char *path = malloc(size);
    if (!path) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", dir);
    snprintf(path, size, "%s%s%s", dir, *dir ? "/" : "", name);
    l->at[l->n++] = path;
    return DAR_OK;
}

static int by_order(const void *a, const void *b)
{
    const char *x = *(char *const *)a, *y = *(char *const *)b;
    int order = dar_objseq_order(x, y);
    return order ? order : strcmp(x, y); /* 1 and 01 */
}

/* Files of `dir` ("": here) that fit. */
static dar_status list_names(struct names *l, const char *dir, const char *pattern, dar_err *e)
{
    DIR *d = opendir(*dir ? dir : ".");
    dar_status s = DAR_OK;

    if (!d) return dar_fail(e, DAR_ERR_IO, "%s: %s", dir, strerror(errno));
    for (struct dirent *x = readdir(d); x && s == DAR_OK; x = readdir(d))
        if (x->d_name[0] != '.' && dar_objseq_fits(pattern, x->d_name)) s = add_name(l, dir, x->d_name, e);
    closedir(d);
    if (s == DAR_OK && !l->n) s = dar_fail(e, DAR_ERR_IO, "%s%s%s: no such files", dir, *dir ? "/" : "", pattern);
    if (s == DAR_OK && l->n > DAR_OBJSEQ_MAX_FRAMES)
        s = dar_fail(e, DAR_ERR_USAGE, "%s%s%s: %zu files, at most %d are read", dir, *dir ? "/" : "", pattern, l->n,
                     DAR_OBJSEQ_MAX_FRAMES);
    if (s == DAR_OK) qsort(l->at, l->n, sizeof *l->at, by_order);
    return s;
}

static dar_status find_names(struct names *l, const char *what, dar_err *e)
{
    struct stat st;
    char dir[PATH_MAX];
    const char *slash = strrchr(what, '/'), *last = slash ? slash + 1 : what;

    if (strlen(what) >= sizeof dir) return dar_fail(e, DAR_ERR_USAGE, "%s: %s", what, strerror(ENAMETOOLONG));
    if (stat(what, &st) == 0) return S_ISDIR(st.st_mode) ? list_names(l, what, "*.obj", e) : add_name(l, "", what, e);
    if (!strpbrk(last, "*?%")) return dar_fail(e, DAR_ERR_IO, "%s: %s", what, strerror(errno));
    snprintf(dir, sizeof dir, "%.*s", slash == what ? 1 : (int)(last - what), what);
    if (slash > what) dir[slash - what] = 0;
    return list_names(l, dir, last, e);
}

/* ---------------------------------------------------------------- one frame */

/* What all frames share. */
struct build {
    dar_scene *scene;
    dar_mesh *mesh;
    size_t frames;
    dar_obj first;
    uint32_t *pair;   /* [corners of the first file] vertices of the mesh */
    uint32_t *corner; /* [vertices of the mesh] corners where each was first met */
    dar_arena scratch;
};

static size_t table_size(size_t corners)
{
    size_t n = 16;
    while (n < 2 * corners) n *= 2;
    return n;
}

/* Number the pairs of vertex and normal in the order in which they are met, by a table with open addresses. */
static size_t number_pairs(struct build *b)
{
    const dar_obj *o = &b->first;
    dar_mark mark = dar_arena_mark(&b->scratch);
    size_t n = 0, size = table_size(o->corners);
    uint32_t *table = dar_arena_push(&b->scratch, size * sizeof *table);

    memset(table, 0xff, size * sizeof *table);
    for (size_t i = 0; i < o->corners; i++) {
        uint32_t v = o->corner[i], normal = o->has_normals ? o->corner_normal[i] : 0, first = 0;
        size_t at = ((uint64_t)v * 0x9e3779b97f4a7c15u + (uint64_t)normal * 0xc2b2ae3d27d4eb4fu) >> 32 & (size - 1);
        for (; table[at] != DAR_OBJ_NONE; at = (at + 1) & (size - 1)) {
            first = b->corner[table[at]];
            if (o->corner[first] == v && (!o->has_normals || o->corner_normal[first] == normal)) break;
        }
        if (table[at] == DAR_OBJ_NONE) {
            b->corner[n] = (uint32_t)i;
            table[at] = (uint32_t)n++;
        }
        b->pair[i] = table[at];
    }
    dar_arena_reset(&b->scratch, mark);
    return n;
}

/* Normals weighted by area, over the vertices of the file. */
static void smooth_normals(struct build *b, const dar_obj *o, float *normal)
{
    dar_mark mark = dar_arena_mark(&b->scratch);
    double *sum = dar_arena_push(&b->scratch, o->vertices * 3 * sizeof *sum);
    const dar_mesh *m = b->mesh;

    memset(sum, 0, o->vertices * 3 * sizeof *sum);
    for (size_t t = 0; t < m->triangles; t++) {
        size_t at[3];
        double u[3], w[3];
        for (int k = 0; k < 3; k++) at[k] = 3 * (size_t)o->corner[b->corner[m->index[3 * t + k]]];
        for (int k = 0; k < 3; k++) {
            u[k] = (double)o->vertex[at[1] + k] - o->vertex[at[0] + k];
            w[k] = (double)o->vertex[at[2] + k] - o->vertex[at[0] + k];
        }
        for (int k = 0; k < 3; k++) {
            double area = u[(k + 1) % 3] * w[(k + 2) % 3] - u[(k + 2) % 3] * w[(k + 1) % 3];
            for (int c = 0; c < 3; c++) sum[at[c] + k] += area;
        }
    }
    for (size_t v = 0; v < m->vertices; v++) {
        const double *n = sum + 3 * (size_t)o->corner[b->corner[v]];
        for (int k = 0; k < 3; k++) normal[3 * v + k] = (float)n[k];
    }
    dar_arena_reset(&b->scratch, mark);
}

static void make_unit(float *normal, size_t n)
{
    for (size_t v = 0; v < n; v++) {
        float *x = normal + 3 * v;
        double r = sqrt((double)x[0] * x[0] + (double)x[1] * x[1] + (double)x[2] * x[2]);
        for (int k = 0; k < 3 && r > 0; k++) x[k] = (float)(x[k] / r);
    }
}

/* Positions and normals of one file, in the numbering of the first. */
static void take_frame(struct build *b, const dar_obj *o, float *position, float *normal)
{
    const dar_mesh *m = b->mesh;
    for (size_t v = 0; v < m->vertices; v++) {
        uint32_t c = b->corner[v];
        memcpy(position + 3 * v, o->vertex + 3 * (size_t)o->corner[c], 3 * sizeof *position);
        if (o->has_normals) memcpy(normal + 3 * v, o->normal + 3 * (size_t)o->corner_normal[c], 3 * sizeof *normal);
    }
    if (!o->has_normals) smooth_normals(b, o, normal);
    make_unit(normal, m->vertices);
    b->scene->notes.normals_made += !o->has_normals;
}

/* ---------------------------------------------------------------- the scene */

static void triangulate(struct build *b)
{
    const dar_obj *o = &b->first;
    dar_mark mark = dar_arena_mark(&b->scratch);
    uint32_t *left = dar_arena_push(&b->scratch, o->corners * sizeof *left), *out = b->mesh->index;

    for (size_t f = 0, begin = 0; f < o->faces; begin = o->face_end[f++]) {
        size_t n = o->face_end[f] - begin;
        dar_obj_triangulate(o->vertex, o->corner + begin, n, left, out);
        for (size_t i = 0; i < 3 * (n - 2); i++) out[i] = b->pair[begin + out[i]];
        out += 3 * (n - 2);
    }
    dar_arena_reset(&b->scratch, mark);
}

static char *copy_text(dar_arena *a, const char *text)
{
    size_t n = strlen(text) + 1;
    return memcpy(dar_arena_push(a, n), text, n);
}

/* Frame k of the animation has weight 1 at key k, all others 0. */
static void add_animation(struct build *b, double fps)
{
    dar_scene *s = b->scene;
    size_t n = b->frames;
    double *time = dar_arena_push(&s->memory, n * sizeof *time);
    float *value = dar_arena_push(&s->memory, n * n * sizeof *value);

    for (size_t i = 0; i < n; i++) {
        time[i] = (double)i / fps;
        value[i * n + i] = 1;
    }
    s->animation = dar_arena_push(&s->memory, sizeof *s->animation);
    s->animation->channel = dar_arena_push(&s->memory, sizeof *s->animation->channel);
    *s->animation->channel = (dar_channel){
        .path = DAR_WEIGHTS, .interpolation = DAR_LINEAR, .keys = n, .width = n, .time = time, .value = value
    };
    s->animation->channels = s->animations = 1;
    s->animation->name = "sequence";
    s->animation->end = time[n - 1];
}

/* Everything but the frames; the arena is fresh, so it is zero. */
static dar_status start_scene(struct build *b, const char *path, double fps, dar_err *e)
{
    const dar_obj *o = &b->first;
    dar_scene *s = b->scene;
    size_t n = b->frames, targets = n > 1 ? n : 0, triangles = o->corners - 2 * o->faces;
    size_t scratch = 8 * o->corners + 4 * table_size(o->corners) + 24 * o->vertices + 8 * DAR_ALIGN;

    DAR_TRY(dar_arena_init(&b->scratch, "OBJ scratch", scratch, e));
    b->pair = dar_arena_push(&b->scratch, o->corners * sizeof *b->pair);
    b->corner = dar_arena_push(&b->scratch, o->corners * sizeof *b->corner);
    size_t vertices = number_pairs(b);
    size_t bytes = dar_mul_size(vertices, 24 * (1 + targets)) + 12 * triangles + 4 * n * n + 16 * n + 2 * strlen(path);
    DAR_TRY(dar_arena_init(&s->memory, "scene", bytes + ((size_t)64 << 10), e));

    s->path = copy_text(&s->memory, path);
    s->node = dar_arena_push(&s->memory, sizeof *s->node);
    s->order = dar_arena_push(&s->memory, sizeof *s->order);
    s->mesh = b->mesh = dar_arena_push(&s->memory, sizeof *s->mesh);
    s->instance = dar_arena_push(&s->memory, sizeof *s->instance);
    s->nodes = s->meshes = s->instances = 1;
    s->notes.points_and_lines = o->points_and_lines;

    dar_mesh *m = s->mesh;
    *m = (dar_mesh){ .name = "", .vertices = vertices, .triangles = triangles, .primitives = 1, .targets = targets };
    m->primitive = dar_arena_push(&s->memory, sizeof *m->primitive);
    *m->primitive = (dar_primitive){ .vertices = vertices, .triangles = triangles, .material = DAR_NONE };
    m->position = dar_arena_push(&s->memory, vertices * 12);
    m->normal = dar_arena_push(&s->memory, vertices * 12);
    m->index = dar_arena_push(&s->memory, triangles * 12);
    triangulate(b);
    if (targets) {
        m->target_position = dar_arena_push(&s->memory, targets * vertices * 12);
        m->target_normal = dar_arena_push(&s->memory, targets * vertices * 12);
        m->target_weight = dar_arena_push(&s->memory, targets * sizeof *m->target_weight);
        m->target_weight[0] = 1;
        add_animation(b, fps);
    }
    *s->node = (dar_node){ .name = "", .parent = DAR_NONE, .skin = DAR_NONE, .camera = DAR_NONE, .in_scene = true };
    s->node->rotation[3] = s->node->scale[0] = s->node->scale[1] = s->node->scale[2] = 1;
    memcpy(s->node->matrix, dar_affine_identity, sizeof s->node->matrix);
    s->node->weight = m->target_weight;
    s->weights = targets;
    *s->instance = (dar_instance){ .skin = DAR_NONE };
    s->vertices = vertices;
    return DAR_OK;
}

static dar_status same_topology(const dar_obj *a, const dar_obj *b, const char *first, const char *path, dar_err *e)
{
    if (a->vertices != b->vertices || a->faces != b->faces || a->corners != b->corners)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu vertices, %zu faces, %zu corners, expected %zu, %zu, %zu as in %s",
                        path, b->vertices, b->faces, b->corners, a->vertices, a->faces, a->corners, first);
    if (memcmp(a->face_end, b->face_end, a->faces * 4) != 0 || memcmp(a->corner, b->corner, a->corners * 4) != 0)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: faces join other vertices than in %s, expected the same", path, first);
    return DAR_OK;
}

/* Frame k, 0 coming first. */
static dar_status add_frame(struct build *b, size_t k, const char *path, const char *first, const void *data,
                            size_t size, double fps, dar_err *e)
{
    dar_obj own, *o = k ? &own : &b->first;
    dar_status s = dar_obj_parse(o, path, data, size, e);

    if (s == DAR_OK && !o->faces) s = dar_fail(e, DAR_ERR_FORMAT, "%s: no faces", path);
    if (s == DAR_OK) s = k ? same_topology(&b->first, o, first, path, e) : start_scene(b, path, fps, e);
    if (s == DAR_OK) {
        dar_mesh *m = b->mesh;
        size_t at = 3 * k * m->vertices;
        if (m->targets) take_frame(b, o, m->target_position + at, m->target_normal + at);
        else take_frame(b, o, m->position, m->normal);
    }
    if (k) dar_obj_free(o);
    return s;
}

static dar_status finish(struct build *b, dar_status s)
{
    dar_obj_free(&b->first);
    dar_arena_free(&b->scratch);
    if (s != DAR_OK) dar_scene_free(b->scene);
    return s;
}

dar_status dar_objseq_parse(dar_scene *s, const char *path, const void *data, size_t size, dar_err *e)
{
    struct build b = { .scene = s, .frames = 1 };
    *s = (dar_scene){ 0 };
    return finish(&b, add_frame(&b, 0, path, path, data, size, 1, e));
}

dar_status dar_objseq_load(dar_scene *s, const char *what, double fps, dar_err *e)
{
    struct build b = { .scene = s };
    struct names names = { 0 };
    DAR_ASSERT(fps > 0 && isfinite(fps), "objseq: %g frames per second", fps);

    *s = (dar_scene){ 0 };
    dar_status status = find_names(&names, what, e);
    b.frames = names.n;
    for (size_t k = 0; k < names.n && status == DAR_OK; k++) {
        dar_file_map map;
        status = dar_file_map_open(&map, names.at[k], e);
        if (status != DAR_OK) break;
        status = add_frame(&b, k, names.at[k], names.at[0], map.data, map.size, fps, e);
        dar_file_map_close(&map);
    }
    free_names(&names);
    return finish(&b, status);
}
