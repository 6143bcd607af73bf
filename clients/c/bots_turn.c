/* One frame of some bots: what the engine tells of it as a message, and what comes back. */
#include <math.h>
#include <string.h>

#include "bots_client.h"

enum { ASKS = 1, ANSWERS = 2 }; /* which halves of a turn a message has */

/* Whether everything is there that these halves need, in a turn that this server understands. */
static bots_status check(bots_client *client, const bots_turn *turn, const void *result, int halves)
{
    const bots_welcome *welcome;
    int asks = (halves & ASKS) != 0, answers = (halves & ANSWERS) != 0;
    if (client == NULL)
        return BOTS_BAD_ARGUMENT;
    welcome = &client->welcome;
    if (!client->is_welcome)
        return botsp_fail(client, BOTS_NO_CONNECTION, "say hello first");
    if (result == NULL)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "a place for the reply is expected");
    if (turn == NULL || turn->bots == NULL || turn->n_bots < 1 || turn->n_bots > BOTS_MAX_BOTS)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "bots: 1 to 65536 are expected");
    if (turn->frame < 0 || turn->frame > BOTS_MAX_FRAME)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "frame: 0 to 2^53 is expected");
    if (asks && turn->free == NULL && welcome->n_free > 0)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "free: [N, F] numbers are expected");
    if (answers && (turn->acquired == NULL || turn->costly == NULL) && welcome->n_queries > 0)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "acquired and costly: [N, M] and [N, D] are expected");
    if (turn->deadline_us != NULL && !welcome->has_deadlines)
        return botsp_fail(client, BOTS_UNSUPPORTED, "the server knows no deadline_us");
    if (asks && (turn->budgets_us != NULL || turn->target_costs_us != NULL) && !welcome->has_target_costs)
        return botsp_fail(client, BOTS_UNSUPPORTED, "the server knows no budgets of one frame");
    if (answers && turn->acquire_us != NULL && isnan(welcome->cost_quantile))
        return botsp_fail(client, BOTS_UNSUPPORTED, "the server takes no measurements");
    if (asks && answers && welcome->replay_frames == 0)
        return botsp_fail(client, BOTS_UNSUPPORTED, "the server knows no take_turn");
    return BOTS_OK;
}

static void put_number(botsp_writer *writer, const char *name, const double *number)
{
    if (number == NULL)
        return;
    botsp_field(writer, name);
    botsp_put_number(writer, *number);
}

/* A field that is one binary; where to write its bytes, or NULL. No message has as many as 32 bits count. */
static uint8_t *put_binary(botsp_writer *writer, const char *name, uint64_t bytes)
{
    if (bytes > UINT32_MAX || bytes > SIZE_MAX)
        writer->is_full = 1;
    botsp_field(writer, name);
    botsp_put_binary(writer, (size_t)bytes);
    return botsp_room(writer, (size_t)bytes);
}

static void put_free(botsp_writer *writer, const bots_turn *turn, size_t n_free)
{
    uint64_t n = (uint64_t)turn->n_bots * n_free, i;
    uint8_t *bytes = put_binary(writer, "free", n * sizeof(float));
    for (i = 0; bytes != NULL && i < n; i++)
        botsp_put_float32(bytes + i * sizeof(float), turn->free[i]);
}

static void put_bits(botsp_writer *writer, const char *name, const uint8_t *mask, size_t n, size_t columns)
{
    size_t row_bytes = (columns + 7) / 8, row, column;
    uint8_t *bytes = put_binary(writer, name, (uint64_t)n * row_bytes);
    if (bytes == NULL)
        return;
    memset(bytes, 0, n * row_bytes);
    for (row = 0; row < n; row++, bytes += row_bytes)
        for (column = 0; column < columns; column++)
            if (*mask++)
                bytes[column / 8] |= (uint8_t)(1u << column % 8);
}

/* How many numbers of the acquired features of all bots there are. */
static uint64_t count_values(const bots_turn *turn, const bots_welcome *welcome)
{
    const uint8_t *mask = turn->acquired;
    uint64_t n = 0;
    size_t bot, m;
    for (bot = 0; bot < turn->n_bots; bot++)
        for (m = 0; m < welcome->n_queries; m++)
            n += *mask++ ? welcome->features[welcome->costly[m]].size : 0;
    return n;
}

/* For each bot in order, for each acquired feature in order, its numbers. */
static void put_values(botsp_writer *writer, const bots_turn *turn, const bots_welcome *welcome)
{
    uint8_t *bytes = put_binary(writer, "values", count_values(turn, welcome) * sizeof(float));
    const uint8_t *mask = turn->acquired;
    const float *costly = turn->costly;
    size_t bot, m, i;
    for (bot = 0; bytes != NULL && bot < turn->n_bots; bot++)
        for (m = 0; m < welcome->n_queries; m++) {
            size_t size = welcome->features[welcome->costly[m]].size;
            if (*mask++)
                for (i = 0; i < size; i++, bytes += sizeof(float))
                    botsp_put_float32(bytes, costly[i]);
            costly += size;
        }
}

static void put_acquired(botsp_writer *writer, const bots_turn *turn, const bots_welcome *welcome)
{
    put_bits(writer, "acquired", turn->acquired, turn->n_bots, welcome->n_queries);
    put_values(writer, turn, welcome);
    if (turn->failed != NULL)
        put_bits(writer, "failed", turn->failed, turn->n_bots, welcome->n_queries);
}

/* The order of fields is that of protocol/client.py, so that the bytes are the golden ones. */
static botsp_writer written(bots_client *client, const bots_turn *turn, const char *type, int halves)
{
    botsp_writer writer = botsp_begin(client, type);
    size_t n = turn->n_bots;
    botsp_field(&writer, "frame");
    botsp_put_integer(&writer, turn->frame);
    botsp_field(&writer, "bots");
    botsp_put_integers(&writer, turn->bots, n);
    if (halves & ASKS)
        put_free(&writer, turn, client->welcome.n_free);
    if (halves & ANSWERS)
        put_acquired(&writer, turn, &client->welcome);
    if (halves & ASKS)
        botsp_numbers_field(&writer, "rewards", turn->rewards, n);
    if (halves & ANSWERS)
        put_number(&writer, "acquire_us", turn->acquire_us);
    if (halves & ASKS) {
        put_number(&writer, "frame_budget_us", turn->frame_budget_us);
        botsp_numbers_field(&writer, "budgets_us", turn->budgets_us, n);
        botsp_numbers_field(&writer, "target_costs_us", turn->target_costs_us, n);
    }
    put_number(&writer, "deadline_us", turn->deadline_us);
    return writer;
}

/* From before the request is made until after its reply is read: what took longer is late, whatever the server says,
 * who cannot know when this was sent or came. */
static void count_late(bots_client *client, const bots_turn *turn, uint64_t asked_ns, int *late)
{
    double deadline_us = turn->deadline_us == NULL ? client->welcome.deadline_us : *turn->deadline_us;
    double took_ns = (double)(client->clock_ns(client->clock_context) - asked_ns);
    if (took_ns > 1e3 * deadline_us) /* false for NaN, which is none */
        *late = 1;
    client->n_late += *late != 0;
}

static bots_status finished(bots_client *client, bots_status status)
{
    if (status == BOTS_NO_MEMORY)
        return botsp_break(client, status, "no memory for what the reply says");
    return status == BOTS_OK ? status : botsp_break(client, status, "the reply is not what this turn may be answered");
}

bots_status bots_query(bots_client *client, const bots_turn *turn, bots_queries *queries)
{
    bots_status status = check(client, turn, queries, ASKS);
    botsp_writer writer;
    botsp_reader reply;
    uint64_t asked_ns;
    if (status != BOTS_OK)
        return status;
    asked_ns = client->clock_ns(client->clock_context);
    writer = written(client, turn, "request_queries", ASKS);
    status = botsp_exchange(client, &writer, "queries", &reply);
    if (status != BOTS_OK)
        return status;
    status = botsp_read_queries(client, reply, turn, queries);
    if (status == BOTS_OK)
        count_late(client, turn, asked_ns, &queries->late);
    return finished(client, status);
}

static bots_status acted(
    bots_client *client, const bots_turn *turn, const char *type, int halves, bots_actions *actions)
{
    bots_status status = check(client, turn, actions, halves);
    botsp_writer writer;
    botsp_reader reply;
    uint64_t asked_ns;
    if (status != BOTS_OK)
        return status;
    asked_ns = client->clock_ns(client->clock_context);
    writer = written(client, turn, type, halves);
    status = botsp_exchange(client, &writer, "actions", &reply);
    if (status != BOTS_OK)
        return status;
    status = botsp_read_actions(client, reply, turn, actions);
    if (status == BOTS_OK)
        count_late(client, turn, asked_ns, &actions->late);
    return finished(client, status);
}

bots_status bots_act(bots_client *client, const bots_turn *turn, bots_actions *actions)
{
    return acted(client, turn, "submit_features", ANSWERS, actions);
}

bots_status bots_take(bots_client *client, const bots_turn *turn, bots_actions *actions)
{
    return acted(client, turn, "take_turn", ASKS | ANSWERS, actions);
}
