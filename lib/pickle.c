/* pickle.c: a stack machine that builds values and calls nothing. */
#include "lib/pickle.h"

#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TEXT_MOST 4096
#define MEMO_MOST ((uint32_t)1 << 20)

/* ---------------------------------------------------------------- names */

static const dar_pickle_type types[] = {
    { "FloatStorage", "float32", "F32", 4 }, { "DoubleStorage", "float64", "F64", 8 },
    { "HalfStorage", "float16", "F16", 2 },  { "BFloat16Storage", "bfloat16", "BF16", 2 },
    { "ByteStorage", "uint8", "U8", 1 },     { "CharStorage", "int8", "I8", 1 },
    { "BoolStorage", "bool", "BOOL", 1 },    { "ShortStorage", "int16", "I16", 2 },
    { "IntStorage", "int32", "I32", 4 },     { "LongStorage", "int64", "I64", 8 },
};

enum { ORDERED_DICT, TENSOR_V2, TENSOR_V3, PARAMETER, UNTYPED, STORAGES, DTYPES = STORAGES + (int)DAR_COUNT(types) };

static const char *const globals[] = {
    [ORDERED_DICT] = "collections OrderedDict",      [TENSOR_V2] = "torch._utils _rebuild_tensor_v2",
    [TENSOR_V3] = "torch._utils _rebuild_tensor_v3", [PARAMETER] = "torch._utils _rebuild_parameter",
    [UNTYPED] = "torch.storage UntypedStorage",
};

/* ---------------------------------------------------------------- memory */

static dar_status wrong(const dar_pickle *p, const char *fmt, ...) __attribute__((format(printf, 2, 3)));

static dar_status wrong(const dar_pickle *p, const char *fmt, ...)
{
    char text[256];
    va_list ap;
    va_start(ap, fmt);
    vsnprintf(text, sizeof text, fmt, ap);
    va_end(ap);
    return dar_fail(p->e, DAR_ERR_FORMAT, "%s: byte %zu of the pickle: %s", p->name, p->at, text);
}

/* Room for one more in an array that doubles, up to `most`. */
static dar_status grow(const dar_pickle *p, void *array, size_t size, uint32_t count, uint32_t *room, uint32_t most)
{
    if (count < *room) return DAR_OK;
    uint32_t more = *room ? *room * 2 : 1024;
    if (more > most) return wrong(p, "more than %u values", (unsigned)most);
    void *old, *grown;
    memcpy(&old, array, sizeof old);
    grown = realloc(old, more * size);
    if (!grown) return dar_fail(p->e, DAR_ERR_NOMEM, "%s: out of memory", p->name);
    memcpy(array, &grown, sizeof grown);
    *room = more;
    return DAR_OK;
}

static dar_status push(dar_pickle *p, uint32_t v)
{
    if (p->height == DAR_PICKLE_STACK) return wrong(p, "more than %d values on the stack", DAR_PICKLE_STACK);
    p->stack[p->height++] = v;
    return DAR_OK;
}

static dar_status push_new(dar_pickle *p, dar_pickle_value v)
{
    DAR_TRY(grow(p, &p->value, sizeof *p->value, p->values, &p->values_room, DAR_PICKLE_VALUES));
    p->value[p->values] = v;
    return push(p, p->values++);
}

static dar_status push_number(dar_pickle *p, dar_pickle_kind kind, int64_t n)
{
    return push_new(p, (dar_pickle_value){ .kind = kind, .number = n });
}

static dar_status append(dar_pickle *p, uint32_t to, uint32_t item)
{
    DAR_TRY(grow(p, &p->cell, sizeof *p->cell, p->cells, &p->cells_room, DAR_PICKLE_VALUES));
    dar_pickle_value *v = &p->value[to];
    uint32_t c = p->cells++;
    p->cell[c] = (dar_pickle_cell){ item, 0 };
    if (v->count++) p->cell[v->last].next = c;
    else v->first = c;
    v->last = c;
    return DAR_OK;
}

static dar_pickle_kind kind_of(const dar_pickle *p, uint32_t v)
{
    return p->value[v].kind;
}

/* The value on top goes; nothing below a mark may be taken one by one. */
static dar_status pop(dar_pickle *p, uint32_t *v)
{
    if (!p->height || kind_of(p, p->stack[p->height - 1]) == DAR_PICKLE_MARK)
        return wrong(p, "a value is taken from an empty stack");
    *v = p->stack[--p->height];
    return DAR_OK;
}

/* The stack above the last mark: items stack[*from ..< height]. */
static dar_status to_mark(dar_pickle *p, uint32_t *from)
{
    for (uint32_t i = p->height; i-- > 0;)
        if (kind_of(p, p->stack[i]) == DAR_PICKLE_MARK) {
            *from = i + 1;
            return DAR_OK;
        }
    return wrong(p, "no mark on the stack");
}

/* ---------------------------------------------------------------- bytes */

static dar_status take(dar_pickle *p, size_t n, const unsigned char **at)
{
    if (n > p->size - p->at) return wrong(p, "the file ends, %zu bytes more are announced", n);
    *at = p->data + p->at;
    p->at += n;
    return DAR_OK;
}

/* n <= 8 bytes, little-endian. */
static dar_status take_number(dar_pickle *p, size_t n, uint64_t *x)
{
    const unsigned char *b = NULL;
    DAR_TRY(take(p, n, &b));
    *x = 0;
    for (size_t i = n; i-- > 0;) *x = *x << 8 | b[i];
    return DAR_OK;
}

static dar_status take_line(dar_pickle *p, char *line, size_t size)
{
    const unsigned char *end = memchr(p->data + p->at, '\n', p->size - p->at);
    size_t n = end ? (size_t)(end - (p->data + p->at)) : 0;
    if (!end || n >= size || memchr(p->data + p->at, 0, n)) return wrong(p, "a name that does not end");
    memcpy(line, p->data + p->at, n);
    line[n] = 0;
    p->at += n + 1;
    return DAR_OK;
}

/* ---------------------------------------------------------------- what opcodes do */

static dar_status global(dar_pickle *p)
{
    char module[64], name[64], whole[130];
    DAR_TRY(take_line(p, module, sizeof module));
    DAR_TRY(take_line(p, name, sizeof name));
    snprintf(whole, sizeof whole, "%s %s", module, name);
    for (int i = 0; i < STORAGES; i++)
        if (strcmp(globals[i], whole) == 0) return push_number(p, DAR_PICKLE_GLOBAL, i);
    for (int i = 0; i < (int)DAR_COUNT(types) && strcmp(module, "torch") == 0; i++) {
        if (strcmp(types[i].storage, name) == 0) return push_number(p, DAR_PICKLE_GLOBAL, STORAGES + i);
        if (strcmp(types[i].dtype, name) == 0) return push_number(p, DAR_PICKLE_GLOBAL, DTYPES + i);
    }
    return wrong(p, "names %s.%s, which is not part of a state dict", module, name);
}

static dar_status text(dar_pickle *p, size_t n)
{
    const unsigned char *b = NULL;
    if (n > TEXT_MOST) return wrong(p, "a text of %zu bytes, expected at most %d", n, TEXT_MOST);
    DAR_TRY(take(p, n, &b));
    return push_new(p, (dar_pickle_value){ .kind = DAR_PICKLE_TEXT, .text = (const char *)b, .size = n });
}

/* A new tuple of stack[from ..< height], which goes. */
static dar_status tuple(dar_pickle *p, uint32_t from, bool mark)
{
    uint32_t end = p->height;
    DAR_TRY(grow(p, &p->value, sizeof *p->value, p->values, &p->values_room, DAR_PICKLE_VALUES));
    uint32_t v = p->values++;
    p->value[v] = (dar_pickle_value){ .kind = DAR_PICKLE_TUPLE };
    for (uint32_t i = from; i < end; i++) DAR_TRY(append(p, v, p->stack[i]));
    p->height = from - mark;
    return push(p, v);
}

static dar_status small_tuple(dar_pickle *p, uint32_t n)
{
    for (uint32_t i = 1; i <= n; i++)
        if (p->height < i || kind_of(p, p->stack[p->height - i]) == DAR_PICKLE_MARK)
            return wrong(p, "a tuple of %u from a shorter stack", (unsigned)n);
    return tuple(p, p->height - n, false);
}

/* Append stack[from ..< height] to the list or dict below, `below` places under from. */
static dar_status extend(dar_pickle *p, uint32_t from, uint32_t below, dar_pickle_kind kind)
{
    uint32_t end = p->height;
    if (from < below || kind_of(p, p->stack[from - below]) != kind)
        return wrong(p, "items for what is no %s", kind == DAR_PICKLE_LIST ? "list" : "dict");
    if (kind == DAR_PICKLE_DICT && (end - from) % 2) return wrong(p, "a key without a value");
    for (uint32_t i = from; i < end; i++) DAR_TRY(append(p, p->stack[from - below], p->stack[i]));
    p->height = from - below + 1;
    return DAR_OK;
}

/* Up to n items of a tuple; false: it is none or has another number. */
static bool items(const dar_pickle *p, uint32_t v, uint32_t least, uint32_t most, uint32_t *out)
{
    const dar_pickle_value *t = &p->value[v];
    if (t->kind != DAR_PICKLE_TUPLE || t->count < least || t->count > most) return false;
    for (uint32_t c = dar_pickle_first(p, v); c; c = p->cell[c].next) *out++ = p->cell[c].value;
    return true;
}

/* ("storage", type, key, device, count), in older files with a sixth item, None. */
static dar_status storage(dar_pickle *p)
{
    uint32_t v = 0, x[6] = { 0 };
    DAR_TRY(pop(p, &v));
    bool good = items(p, v, 5, 6, x) && dar_pickle_is(p, x[0], "storage") && kind_of(p, x[1]) == DAR_PICKLE_GLOBAL &&
                kind_of(p, x[2]) == DAR_PICKLE_TEXT && kind_of(p, x[3]) == DAR_PICKLE_TEXT &&
                kind_of(p, x[4]) == DAR_PICKLE_INT && kind_of(p, x[5]) == DAR_PICKLE_NONE;
    int64_t type = good ? p->value[x[1]].number : 0, count = good ? p->value[x[4]].number : 0;
    if (!good || (type != UNTYPED && (type < STORAGES || type >= DTYPES)) || count < 0)
        return wrong(p, "a reference to what is no storage");
    return push_new(p, (dar_pickle_value){ .kind = DAR_PICKLE_STORAGE,
                                           .key = x[2],
                                           .element = type == UNTYPED ? NULL : &types[type - STORAGES],
                                           .elements = count });
}

static bool empty_dict_or_none(const dar_pickle *p, uint32_t v)
{
    return kind_of(p, v) == DAR_PICKLE_NONE || (kind_of(p, v) == DAR_PICKLE_DICT && p->value[v].count == 0);
}

/* (storage, offset, shape, stride, requires_grad, hooks[, dtype][, metadata]). */
static dar_status tensor(dar_pickle *p, uint32_t args, bool v3)
{
    uint32_t x[8] = { 0 };
    bool good = items(p, args, 6 + v3, 7 + v3, x) && kind_of(p, x[0]) == DAR_PICKLE_STORAGE &&
                kind_of(p, x[1]) == DAR_PICKLE_INT && p->value[x[1]].number >= 0 &&
                kind_of(p, x[2]) == DAR_PICKLE_TUPLE && kind_of(p, x[3]) == DAR_PICKLE_TUPLE &&
                kind_of(p, x[4]) == DAR_PICKLE_BOOL && empty_dict_or_none(p, x[5]) && empty_dict_or_none(p, x[6 + v3]);
    const dar_pickle_type *type = good ? p->value[x[0]].element : NULL;
    if (good && v3) {
        int64_t which = kind_of(p, x[6]) == DAR_PICKLE_GLOBAL ? p->value[x[6]].number : 0;
        good = which >= DTYPES && !type;
        type = good ? &types[which - DTYPES] : NULL;
    }
    if (!good || !type) return wrong(p, "a tensor is rebuilt in an unknown way");
    return push_new(p, (dar_pickle_value){ .kind = DAR_PICKLE_TENSOR,
                                           .storage = x[0],
                                           .shape = x[2],
                                           .stride = x[3],
                                           .offset = p->value[x[1]].number,
                                           .type = type });
}

/* OrderedDict(), or OrderedDict([[key, value], ...]). */
static dar_status ordered_dict(dar_pickle *p, uint32_t args)
{
    uint32_t list = 0, pair[2];
    if (!items(p, args, 0, 1, &list) || (list && kind_of(p, list) != DAR_PICKLE_LIST))
        return wrong(p, "a dict is made in an unknown way");
    DAR_TRY(push_new(p, (dar_pickle_value){ .kind = DAR_PICKLE_DICT }));
    uint32_t dict = p->stack[p->height - 1];
    for (uint32_t c = list ? dar_pickle_first(p, list) : 0; c; c = p->cell[c].next) {
        uint32_t v = p->cell[c].value, k = 0;
        dar_pickle_kind kind = kind_of(p, v);
        if ((kind != DAR_PICKLE_LIST && kind != DAR_PICKLE_TUPLE) || p->value[v].count != 2)
            return wrong(p, "a dict is made of what are no pairs");
        for (uint32_t d = dar_pickle_first(p, v); d; d = p->cell[d].next) pair[k++] = p->cell[d].value;
        DAR_TRY(append(p, dict, pair[0]));
        DAR_TRY(append(p, dict, pair[1]));
    }
    return DAR_OK;
}

static dar_status reduce(dar_pickle *p)
{
    uint32_t args = 0, function = 0, x[3];
    DAR_TRY(pop(p, &args));
    DAR_TRY(pop(p, &function));
    switch (kind_of(p, function) == DAR_PICKLE_GLOBAL ? p->value[function].number : -1) {
    case ORDERED_DICT: return ordered_dict(p, args);
    case TENSOR_V2: return tensor(p, args, false);
    case TENSOR_V3: return tensor(p, args, true);
    case PARAMETER:
        if (items(p, args, 3, 3, x) && kind_of(p, x[0]) == DAR_PICKLE_TENSOR) return push(p, x[0]);
        break;
    default: break;
    }
    return wrong(p, "a call of what is not part of a state dict");
}

/* Attributes of a dict (torch's _metadata) say nothing that is needed. */
static dar_status build(dar_pickle *p)
{
    uint32_t state = 0;
    DAR_TRY(pop(p, &state));
    if (!p->height || kind_of(p, p->stack[p->height - 1]) != DAR_PICKLE_DICT)
        return wrong(p, "attributes for what is no dict");
    return DAR_OK;
}

static dar_status memo_put(dar_pickle *p, uint64_t i)
{
    if (!p->height || kind_of(p, p->stack[p->height - 1]) == DAR_PICKLE_MARK) return wrong(p, "nothing to remember");
    if (i >= MEMO_MOST) return wrong(p, "memo %llu, expected less than %u", (unsigned long long)i, (unsigned)MEMO_MOST);
    while (p->memos <= i) {
        DAR_TRY(grow(p, &p->memo, sizeof *p->memo, p->memos, &p->memo_room, MEMO_MOST));
        p->memo[p->memos++] = UINT32_MAX;
    }
    p->memo[i] = p->stack[p->height - 1];
    return DAR_OK;
}

static dar_status memo_get(dar_pickle *p, uint64_t i)
{
    if (i >= p->memos || p->memo[i] == UINT32_MAX) return wrong(p, "memo %llu is not defined", (unsigned long long)i);
    return push(p, p->memo[i]);
}

/* ---------------------------------------------------------------- opcodes */

/* How many bytes of argument, little-endian, come first. */
static size_t argument(unsigned char op)
{
    switch (op) {
    case 0x80:
    case 'K':
    case 'q':
    case 'h':
    case 'U':
    case 0x8a: return 1;
    case 'M': return 2;
    case 'J':
    case 'X':
    case 'r':
    case 'j': return 4;
    default: return 0;
    }
}

static dar_status do_one(dar_pickle *p, unsigned char op)
{
    uint64_t n = 0;
    uint32_t from = 0;
    const unsigned char *bytes = NULL;
    if (argument(op)) DAR_TRY(take_number(p, argument(op), &n));

    switch (op) {
    case 0x80: return n == 2 ? DAR_OK : wrong(p, "protocol %d, expected 2", (int)n);
    case '(': return push_new(p, (dar_pickle_value){ .kind = DAR_PICKLE_MARK });
    case '}': return push_new(p, (dar_pickle_value){ .kind = DAR_PICKLE_DICT });
    case ']': return push_new(p, (dar_pickle_value){ .kind = DAR_PICKLE_LIST });
    case ')': return push_new(p, (dar_pickle_value){ .kind = DAR_PICKLE_TUPLE });
    case 't': DAR_TRY(to_mark(p, &from)); return tuple(p, from, true);
    case 0x85:
    case 0x86:
    case 0x87: return small_tuple(p, op - 0x84u);
    case 'N': return push(p, 0);
    case 0x88:
    case 0x89: return push_number(p, DAR_PICKLE_BOOL, op == 0x88);
    case 'J': return push_number(p, DAR_PICKLE_INT, (int32_t)(uint32_t)n);
    case 'K':
    case 'M': return push_number(p, DAR_PICKLE_INT, (int64_t)n);
    case 0x8a: { /* n bytes of two's complement */
        uint64_t x = 0, bits = 8 * n;
        if (n > 8) return wrong(p, "an integer of %d bytes", (int)n);
        DAR_TRY(take_number(p, n, &x));
        if (bits && bits < 64 && x >> (bits - 1)) x |= UINT64_MAX << bits;
        return push_number(p, DAR_PICKLE_INT, (int64_t)x);
    }
    case 'G': DAR_TRY(take(p, 8, &bytes)); return push_number(p, DAR_PICKLE_FLOAT, 0);
    case 'X':
    case 'U': return text(p, n);
    case 'c': return global(p);
    case 'q':
    case 'r': return memo_put(p, n);
    case 'h':
    case 'j': return memo_get(p, n);
    case 'Q': return storage(p);
    case 'R': return reduce(p);
    case 'b': return build(p);
    case 's': return p->height >= 3 ? extend(p, p->height - 2, 1, DAR_PICKLE_DICT) : wrong(p, "no item to set");
    case 'a': return p->height >= 2 ? extend(p, p->height - 1, 1, DAR_PICKLE_LIST) : wrong(p, "no item to append");
    case 'u': DAR_TRY(to_mark(p, &from)); return extend(p, from, 2, DAR_PICKLE_DICT);
    case 'e': DAR_TRY(to_mark(p, &from)); return extend(p, from, 2, DAR_PICKLE_LIST);
    default: return wrong(p, "opcode 0x%02x, which is not part of a state dict", op);
    }
}

dar_status dar_pickle_next(dar_pickle *p, uint32_t *top, dar_err *e)
{
    p->e = e;
    p->height = p->memos = 0;
    for (;;) {
        const unsigned char *op = NULL;
        DAR_TRY(take(p, 1, &op));
        if (*op == '.') break;
        DAR_TRY(do_one(p, *op));
    }
    if (p->height != 1 || kind_of(p, p->stack[0]) == DAR_PICKLE_MARK)
        return wrong(p, "ends with %u values on the stack, expected 1", (unsigned)p->height);
    *top = p->stack[0];
    return DAR_OK;
}

dar_status dar_pickle_init(dar_pickle *p, const char *name, const unsigned char *data, size_t size, dar_err *e)
{
    *p = (dar_pickle){ .name = name, .data = data, .size = size, .e = e };
    p->stack = malloc(DAR_PICKLE_STACK * sizeof *p->stack);
    if (!p->stack) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
    DAR_TRY(grow(p, &p->value, sizeof *p->value, 0, &p->values_room, DAR_PICKLE_VALUES));
    DAR_TRY(grow(p, &p->cell, sizeof *p->cell, 0, &p->cells_room, DAR_PICKLE_VALUES));
    p->value[p->values++] = (dar_pickle_value){ .kind = DAR_PICKLE_NONE };
    p->cell[p->cells++] = (dar_pickle_cell){ 0, 0 }; /* cell 0 is the end of every chain */
    return DAR_OK;
}

void dar_pickle_free(dar_pickle *p)
{
    free(p->value);
    free(p->cell);
    free(p->memo);
    free(p->stack);
    *p = (dar_pickle){ 0 };
}

uint32_t dar_pickle_first(const dar_pickle *p, uint32_t v)
{
    return p->value[v].count ? p->value[v].first : 0;
}

int dar_pickle_is(const dar_pickle *p, uint32_t v, const char *text)
{
    const dar_pickle_value *x = &p->value[v];
    return x->kind == DAR_PICKLE_TEXT && x->size == strlen(text) && memcmp(x->text, text, x->size) == 0;
}
