/* `queries`, `actions`, `bots_started` and `bots_stopped`, into arrays of the client's. */
#include <string.h>

#include "bots_client.h"

#define MAX_COUNT BOTS_MAX_FRAME

/* `reader` at the entries of an array of exactly n. */
static int open_array(const uint8_t *at, const uint8_t *end, size_t n, botsp_reader *reader)
{
    botsp_item item;
    if (at == NULL)
        return 0;
    reader->at = at;
    reader->end = end;
    return botsp_next(reader, &item) && item.kind == BOTSP_ARRAY && item.length == n;
}

static int read_frame(const uint8_t *at, const uint8_t *end, int64_t frame)
{
    botsp_item item;
    return botsp_read(at, end, BOTSP_INTEGER, &item) && item.integer == frame;
}

/* [n] reasons; all 0 where the field is null or left out and that is allowed. */
static int read_reasons(const uint8_t *at, const uint8_t *end, size_t n, int is_optional, uint8_t *reasons)
{
    botsp_reader reader;
    botsp_item item;
    int64_t reason;
    size_t i;
    memset(reasons, 0, n);
    if (is_optional && (at == NULL || botsp_read(at, end, BOTSP_NIL, &item)))
        return 1;
    if (!open_array(at, end, n, &reader))
        return 0;
    for (i = 0; i < n; i++) {
        if (!botsp_integer(&reader, 0, UINT8_MAX, &reason))
            return 0;
        reasons[i] = (uint8_t)reason;
    }
    return 1;
}

static int read_timing(const uint8_t *infer, const uint8_t *late, const uint8_t *end, double *infer_us, int *is_late)
{
    botsp_reader reader;
    botsp_item item;
    *is_late = 0;
    if (infer == NULL)
        return 0;
    reader.at = infer;
    reader.end = end;
    if (!botsp_number(&reader, infer_us) || *infer_us < 0.0)
        return 0;
    if (late == NULL || botsp_read(late, end, BOTSP_NIL, &item))
        return 1;
    if (!botsp_read(late, end, BOTSP_BOOL, &item))
        return 0;
    *is_late = item.integer != 0;
    return 1;
}

/* A binary of exactly so many bytes. */
static int open_binary(const uint8_t *at, const uint8_t *end, uint64_t bytes, botsp_item *item)
{
    return botsp_read(at, end, BOTSP_BINARY, item) && item->length == bytes;
}

/* Rows of bits to bytes 0 or 1; bits beyond the last column must be 0. */
static int read_bits(botsp_item item, size_t n, size_t columns, uint8_t *bits)
{
    size_t row_bytes = (columns + 7) / 8, row, column;
    for (row = 0; row < n; row++, item.bytes += row_bytes) {
        for (column = 0; column < columns; column++)
            *bits++ = item.bytes[column / 8] >> column % 8 & 1;
        if (columns % 8 != 0 && item.bytes[row_bytes - 1] >> columns % 8 != 0)
            return 0;
    }
    return 1;
}

bots_status botsp_read_queries(bots_client *client, botsp_reader reply, const bots_turn *turn, bots_queries *queries)
{
    static const char *const names[] = {"frame", "queries", "cost_us", "infer_us", "reasons", "late"};
    size_t n = turn->n_bots, n_queries = client->welcome.n_queries, i;
    const uint8_t *found[6], *end = reply.end;
    const botsp_memory *memory = &client->memory;
    botsp_item bits;
    double *cost_us;
    if (!botsp_index(&reply, names, 6, found) || !read_frame(found[0], end, turn->frame)
        || !open_binary(found[1], end, (uint64_t)n * ((n_queries + 7) / 8), &bits) || !open_array(found[2], end, n, &reply))
        return BOTS_BAD_REPLY;
    if (!botsp_grow(memory, &client->queries, n * n_queries)
        || !botsp_grow(memory, &client->cost_us, n * sizeof *cost_us) || !botsp_grow(memory, &client->query_reasons, n))
        return BOTS_NO_MEMORY;
    cost_us = client->cost_us.bytes;
    if (!read_bits(bits, n, n_queries, client->queries.bytes))
        return BOTS_BAD_REPLY;
    for (i = 0; i < n; i++)
        if (!botsp_number(&reply, &cost_us[i]) || cost_us[i] < 0.0)
            return BOTS_BAD_REPLY;
    if (!read_timing(found[3], found[5], end, &queries->infer_us, &queries->late)
        || !read_reasons(found[4], end, n, 1, client->query_reasons.bytes))
        return BOTS_BAD_REPLY;
    queries->frame = turn->frame;
    queries->queries = client->queries.bytes;
    queries->cost_us = cost_us;
    queries->reasons = client->query_reasons.bytes;
    return BOTS_OK;
}

/* Actions [n, A], each within its component's range as float32 has it: never NaN, never infinite. */
static int read_actions(const bots_welcome *welcome, botsp_item item, size_t n, float *actions)
{
    size_t row, column;
    for (row = 0; row < n; row++)
        for (column = 0; column < welcome->n_actions; column++, item.bytes += sizeof(float)) {
            const bots_component *component = &welcome->components[column];
            float action = botsp_float32(item.bytes);
            if (!(action >= (float)component->low && action <= (float)component->high))
                return 0;
            *actions++ = action;
        }
    return 1;
}

/* [n] turns; NULL where the field is null or left out. */
static int read_turns(const uint8_t *at, const uint8_t *end, size_t n, int64_t *numbers, const int64_t **turns)
{
    botsp_reader reader;
    botsp_item item;
    size_t i;
    *turns = NULL;
    if (at == NULL || botsp_read(at, end, BOTSP_NIL, &item))
        return 1;
    if (!open_array(at, end, n, &reader))
        return 0;
    for (i = 0; i < n; i++)
        if (!botsp_integer(&reader, 0, MAX_COUNT, &numbers[i]))
            return 0;
    *turns = numbers;
    return 1;
}

bots_status botsp_read_actions(bots_client *client, botsp_reader reply, const bots_turn *turn, bots_actions *actions)
{
    static const char *const names[] = {"frame", "actions", "reasons", "infer_us", "turns", "late"};
    size_t n = turn->n_bots;
    const uint8_t *found[6], *end = reply.end;
    const botsp_memory *memory = &client->memory;
    botsp_item blob;
    if (!botsp_index(&reply, names, 6, found) || !read_frame(found[0], end, turn->frame)
        || !open_binary(found[1], end, (uint64_t)n * client->welcome.n_actions * sizeof(float), &blob))
        return BOTS_BAD_REPLY;
    if (!botsp_grow(memory, &client->actions, blob.length)
        || !botsp_grow(memory, &client->action_reasons, n) || !botsp_grow(memory, &client->turns, n * sizeof(int64_t)))
        return BOTS_NO_MEMORY;
    if (!read_actions(&client->welcome, blob, n, client->actions.bytes)
        || !read_reasons(found[2], end, n, 0, client->action_reasons.bytes)
        || !read_timing(found[3], found[5], end, &actions->infer_us, &actions->late)
        || !read_turns(found[4], end, n, client->turns.bytes, &actions->turns))
        return BOTS_BAD_REPLY;
    actions->frame = turn->frame;
    actions->actions = client->actions.bytes;
    actions->reasons = client->action_reasons.bytes;
    return BOTS_OK;
}

bots_status botsp_read_started(bots_client *client, botsp_reader reply, size_t count, int64_t *bots)
{
    static const char *const names[] = {"bots", "bundle_version", "bundle_sha256"};
    const uint8_t *found[3], *end = reply.end;
    size_t i;
    if (!botsp_index(&reply, names, 3, found) || !open_array(found[0], end, count, &reply))
        return BOTS_BAD_REPLY;
    for (i = 0; i < count; i++)
        if (!botsp_integer(&reply, 0, INT64_MAX, &bots[i]))
            return BOTS_BAD_REPLY;
    return botsp_read_version(client, found[1], found[2], end) ? BOTS_OK : BOTS_BAD_REPLY;
}

bots_status botsp_read_stopped(botsp_reader reply, int64_t *n_stopped)
{
    static const char *const name = "count";
    const uint8_t *found, *end = reply.end;
    if (!botsp_index(&reply, &name, 1, &found) || found == NULL)
        return BOTS_BAD_REPLY;
    reply.at = found;
    reply.end = end;
    return botsp_integer(&reply, 0, BOTS_MAX_BOTS, n_stopped) ? BOTS_OK : BOTS_BAD_REPLY;
}
