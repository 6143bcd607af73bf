/* Reading msgpack. Every length is held against the bytes that are left before anything is done with it. */
#include <math.h>
#include <string.h>

#include "bots_msgpack.h"

static int take(botsp_reader *reader, size_t n, const uint8_t **bytes)
{
    if ((size_t)(reader->end - reader->at) < n)
        return 0;
    *bytes = reader->at;
    reader->at += n;
    return 1;
}

static int take_big_endian(botsp_reader *reader, size_t n, uint64_t *value)
{
    const uint8_t *bytes;
    size_t i;
    if (!take(reader, n, &bytes))
        return 0;
    *value = 0;
    for (i = 0; i < n; i++)
        *value = *value << 8 | bytes[i];
    return 1;
}

static float float_of(uint32_t bits)
{
    float number;
    memcpy(&number, &bits, sizeof number);
    return number;
}

float botsp_float32(const uint8_t *bytes)
{
    return float_of((uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24);
}

static int integer(botsp_item *item, int64_t value)
{
    item->kind = BOTSP_INTEGER;
    item->integer = value;
    item->number = (double)value;
    return 1;
}

/* Sign-extends the n low bytes without shifting anything negative. */
static int64_t signed_of(uint64_t value, size_t n)
{
    uint64_t sign = (uint64_t)1 << (8 * n - 1);
    if (!(value & sign))
        return (int64_t)value;
    return -(int64_t)(~value & (sign - 1)) - 1;
}

/* 0xca to 0xd3: numbers. */
static int next_number(botsp_reader *reader, uint8_t head, botsp_item *item)
{
    static const uint8_t widths[] = {4, 8, 1, 2, 4, 8, 1, 2, 4, 8};
    size_t n = widths[head - 0xca];
    uint64_t value;
    if (!take_big_endian(reader, n, &value))
        return 0;
    if (head >= 0xd0)
        return integer(item, signed_of(value, n));
    if (head >= 0xcc) {
        if (value <= INT64_MAX)
            return integer(item, (int64_t)value);
        item->kind = BOTSP_OTHER;
        return 1;
    }
    item->kind = BOTSP_FLOAT;
    if (n == 4)
        item->number = float_of((uint32_t)value);
    else
        memcpy(&item->number, &value, sizeof value);
    return 1;
}

static int with_bytes(botsp_reader *reader, botsp_kind kind, uint64_t length, botsp_item *item)
{
    if (length > (uint64_t)(reader->end - reader->at)) /* before it is narrowed to size_t, which may have 32 bits */
        return 0;
    item->kind = kind;
    item->length = (size_t)length;
    return take(reader, item->length, &item->bytes);
}

static int with_entries(const botsp_reader *reader, botsp_kind kind, uint64_t length, botsp_item *item)
{
    uint64_t items = kind == BOTSP_MAP ? 2 * length : length; /* length has 32 bits; each item takes a byte or more */
    if (items > (uint64_t)(reader->end - reader->at))
        return 0;
    item->kind = kind;
    item->length = (size_t)length;
    return 1;
}

/* 0xc4 to 0xc9 and 0xd9 to 0xdf: lengths of their own. */
static int next_long(botsp_reader *reader, uint8_t head, botsp_item *item)
{
    static const uint8_t widths[] = {1, 2, 4, 2, 4, 2, 4}; /* from 0xd9 */
    size_t n = head >= 0xd9 ? widths[head - 0xd9] : (size_t)1 << (head - 0xc4) % 3;
    uint64_t length;
    if (!take_big_endian(reader, n, &length))
        return 0;
    if (head <= 0xc6)
        return with_bytes(reader, BOTSP_BINARY, length, item);
    if (head <= 0xc9)
        return with_bytes(reader, BOTSP_OTHER, length + 1, item);
    if (head <= 0xdb)
        return with_bytes(reader, BOTSP_TEXT, length, item);
    return with_entries(reader, head <= 0xdd ? BOTSP_ARRAY : BOTSP_MAP, length, item);
}

int botsp_next(botsp_reader *reader, botsp_item *item)
{
    const uint8_t *at;
    uint8_t head;
    memset(item, 0, sizeof *item);
    if (!take(reader, 1, &at))
        return 0;
    head = *at;
    if (head <= 0x7f)
        return integer(item, head);
    if (head <= 0x8f)
        return with_entries(reader, BOTSP_MAP, head & 0x0f, item);
    if (head <= 0x9f)
        return with_entries(reader, BOTSP_ARRAY, head & 0x0f, item);
    if (head <= 0xbf)
        return with_bytes(reader, BOTSP_TEXT, head & 0x1f, item);
    if (head >= 0xe0)
        return integer(item, (int64_t)head - 256);
    if (head == 0xc0)
        return 1;
    if (head == 0xc1)
        return 0;
    if (head <= 0xc3) {
        item->kind = BOTSP_BOOL;
        item->integer = head == 0xc3;
        return 1;
    }
    if (head >= 0xca && head <= 0xd3)
        return next_number(reader, head, item);
    if (head >= 0xd4 && head <= 0xd8)
        return with_bytes(reader, BOTSP_OTHER, ((uint64_t)1 << (head - 0xd4)) + 1, item);
    return next_long(reader, head, item);
}

/* No recursion, so no depth is too deep. Each item takes a byte, so it ends, and the count cannot overflow. */
int botsp_skip(botsp_reader *reader)
{
    uint64_t pending = 1;
    botsp_item item;
    for (; pending > 0; pending--) {
        if (!botsp_next(reader, &item))
            return 0;
        if (item.kind == BOTSP_ARRAY)
            pending += item.length;
        else if (item.kind == BOTSP_MAP)
            pending += 2 * (uint64_t)item.length;
        if (pending - 1 > (uint64_t)(reader->end - reader->at))
            return 0;
    }
    return 1;
}

int botsp_index(botsp_reader *reader, const char *const *names, size_t n, const uint8_t **found)
{
    botsp_item map, key;
    size_t entry, i;
    for (i = 0; i < n; i++)
        found[i] = NULL;
    if (!botsp_next(reader, &map) || map.kind != BOTSP_MAP)
        return 0;
    for (entry = 0; entry < map.length; entry++) {
        if (!botsp_next(reader, &key) || key.kind != BOTSP_TEXT)
            return 0;
        for (i = 0; i < n; i++)
            if (strlen(names[i]) == key.length && memcmp(names[i], key.bytes, key.length) == 0)
                found[i] = reader->at;
        if (!botsp_skip(reader))
            return 0;
    }
    return 1;
}

int botsp_read(const uint8_t *at, const uint8_t *end, botsp_kind kind, botsp_item *item)
{
    botsp_reader reader;
    if (at == NULL)
        return 0;
    reader.at = at;
    reader.end = end;
    return botsp_next(&reader, item) && item->kind == kind;
}

int botsp_number(botsp_reader *reader, double *number)
{
    botsp_item item;
    if (!botsp_next(reader, &item) || (item.kind != BOTSP_FLOAT && item.kind != BOTSP_INTEGER))
        return 0;
    *number = item.number;
    return isfinite(item.number);
}

int botsp_integer(botsp_reader *reader, int64_t low, int64_t high, int64_t *value)
{
    botsp_item item;
    if (!botsp_next(reader, &item) || item.kind != BOTSP_INTEGER)
        return 0;
    *value = item.integer;
    return low <= item.integer && item.integer <= high;
}
