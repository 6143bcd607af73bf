/* A connection from its beginning to its end, and the bots that start and stop in it. */
#include "bots.h"

#include <errno.h>
#include <string.h>

#include "bots_client.h"

#define DEFAULT_TIMEOUT_MS 5000
#define MAX_HELLO_TEXT 4096 /* 1,024 characters at their longest */

/* What is sent has 64-bit integers and 4-byte floats; an engine on a machine without them cannot be compiled. */
typedef char botsp_float_has_4_bytes[sizeof(float) == 4 ? 1 : -1];
typedef char botsp_double_has_8_bytes[sizeof(double) == 8 ? 1 : -1];

static bots_status dial(bots_client *client)
{
    return botsp_dial(&client->address, client->until_ns, &client->fd);
}

bots_status bots_connect(const char *url, const bots_options *options, bots_client **client)
{
    static const bots_options defaults;
    botsp_memory memory = {botsp_resize, NULL};
    botsp_address address;
    bots_client *made;
    bots_status status;
    int timeout_ms, saved;
    if (client == NULL)
        return BOTS_BAD_ARGUMENT;
    *client = NULL;
    options = options == NULL ? &defaults : options;
    timeout_ms = options->timeout_ms == 0 ? DEFAULT_TIMEOUT_MS : options->timeout_ms;
    if (url == NULL || timeout_ms < 1 || timeout_ms > BOTS_MAX_TIMEOUT_MS || options->spin_us < 0
        || options->spin_us > BOTS_MAX_SPIN_US || botsp_parse(url, &address) != BOTS_OK)
        return BOTS_BAD_ARGUMENT;
    if (options->resize != NULL) {
        memory.resize = options->resize;
        memory.context = options->resize_context;
    }
    made = memory.resize(memory.context, NULL, sizeof *made);
    if (made == NULL)
        return BOTS_NO_MEMORY;
    memset(made, 0, sizeof *made);
    made->memory = memory;
    made->clock_ns = options->clock_ns == NULL ? botsp_now_ns : options->clock_ns;
    made->clock_context = options->clock_context;
    made->timeout_ns = (uint64_t)timeout_ms * 1000000u;
    made->spin_ns = (uint64_t)options->spin_us * 1000u;
    made->address = address;
    made->fd = -1;
    made->until_ns = botsp_now_ns(NULL) + made->timeout_ns;
    status = dial(made);
    if (status == BOTS_OK) {
        *client = made;
        return BOTS_OK;
    }
    saved = errno;
    bots_close(made);
    errno = saved;
    return status;
}

static void put_text(botsp_writer *writer, const char *name, const char *text)
{
    if (text == NULL)
        return;
    botsp_field(writer, name);
    botsp_put_text(writer, text);
}

static int is_too_long(const char *text)
{
    return text != NULL && strlen(text) > MAX_HELLO_TEXT;
}

/* A map within the message: its head, and names that are not the message's. */
static void put_cost_model(botsp_writer *writer, const bots_hello_fields *fields)
{
    uint8_t *head;
    botsp_field(writer, "cost_model");
    head = botsp_room(writer, 1);
    if (head != NULL)
        *head = 0x82;
    botsp_put_text(writer, "call_us");
    botsp_put_number(writer, *fields->call_us);
    botsp_put_text(writer, "feature_us");
    botsp_put_numbers(writer, fields->feature_us, fields->n_feature_us);
}

static bots_status check_hello(bots_client *client, const bots_hello_fields *fields)
{
    if (client->is_welcome)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "a connection says hello once: goodbye first");
    if (is_too_long(fields->token) || is_too_long(fields->bundle))
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "token and bundle: at most 4096 bytes are expected");
    if ((fields->call_us == NULL) != (fields->feature_us == NULL) || fields->n_feature_us > BOTS_MAX_FEATURES)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "call_us and feature_us: both or neither are expected");
    return BOTS_OK;
}

bots_status bots_hello(bots_client *client, const bots_hello_fields *fields, const bots_welcome **welcome)
{
    static const bots_hello_fields none;
    botsp_writer writer;
    botsp_reader reply;
    bots_status status;
    if (client == NULL)
        return BOTS_BAD_ARGUMENT;
    fields = fields == NULL ? &none : fields;
    status = check_hello(client, fields);
    if (status != BOTS_OK)
        return status;
    writer = botsp_begin(client, "hello");
    if (client->fd < 0 && (status = dial(client)) != BOTS_OK)
        return botsp_fail(client, status, "no socket to the server");
    botsp_field(&writer, "protocol");
    botsp_put_integer(&writer, 1);
    if (fields->call_us != NULL)
        put_cost_model(&writer, fields);
    put_text(&writer, "token", fields->token);
    put_text(&writer, "bundle", fields->bundle);
    status = botsp_exchange(client, &writer, "welcome", &reply);
    if (status != BOTS_OK)
        return status;
    status = botsp_read_welcome(client, reply);
    if (status != BOTS_OK)
        return botsp_break(client, status, "the welcome is not what the protocol says");
    client->is_welcome = 1;
    if (welcome != NULL)
        *welcome = &client->welcome;
    return BOTS_OK;
}

static bots_status check_start(bots_client *client, const bots_start_fields *fields, const int64_t *bots)
{
    size_t i;
    if (!client->is_welcome)
        return botsp_fail(client, BOTS_NO_CONNECTION, "say hello first");
    if (fields == NULL || bots == NULL || fields->count < 1 || fields->count > BOTS_MAX_BOTS)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "count: 1 to 65536 is expected, and room for as many handles");
    for (i = 0; fields->seeds != NULL && i < fields->count; i++)
        if (fields->seeds[i] < 0)
            return botsp_fail(client, BOTS_BAD_ARGUMENT, "seeds: 0 to 2^63 - 1 are expected");
    if (fields->target_costs_us != NULL && !client->welcome.has_target_costs)
        return botsp_fail(client, BOTS_UNSUPPORTED, "the server knows no target_costs_us");
    return BOTS_OK;
}

bots_status bots_start(bots_client *client, const bots_start_fields *fields, int64_t *bots)
{
    botsp_writer writer;
    botsp_reader reply;
    bots_status status;
    if (client == NULL)
        return BOTS_BAD_ARGUMENT;
    status = check_start(client, fields, bots);
    if (status != BOTS_OK)
        return status;
    writer = botsp_begin(client, "start_bots");
    botsp_field(&writer, "count");
    botsp_put_integer(&writer, (int64_t)fields->count);
    if (fields->seeds != NULL) {
        botsp_field(&writer, "seeds");
        botsp_put_integers(&writer, fields->seeds, fields->count);
    }
    botsp_numbers_field(&writer, "target_returns", fields->target_returns, fields->count);
    botsp_numbers_field(&writer, "budgets_us", fields->budgets_us, fields->count);
    botsp_numbers_field(&writer, "target_costs_us", fields->target_costs_us, fields->count);
    status = botsp_exchange(client, &writer, "bots_started", &reply);
    if (status != BOTS_OK)
        return status;
    status = botsp_read_started(client, reply, fields->count, bots);
    return status == BOTS_OK ? status : botsp_break(client, status, "bots_started is not what the protocol says");
}

bots_status bots_stop(bots_client *client, const int64_t *bots, size_t n_bots, int64_t *n_stopped)
{
    botsp_writer writer;
    botsp_reader reply;
    bots_status status;
    int64_t count;
    if (client == NULL)
        return BOTS_BAD_ARGUMENT;
    if (!client->is_welcome)
        return botsp_fail(client, BOTS_NO_CONNECTION, "say hello first");
    if (bots == NULL || n_bots < 1 || n_bots > BOTS_MAX_BOTS)
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "bots: 1 to 65536 are expected");
    writer = botsp_begin(client, "stop_bots");
    botsp_field(&writer, "bots");
    botsp_put_integers(&writer, bots, n_bots);
    status = botsp_exchange(client, &writer, "bots_stopped", &reply);
    if (status != BOTS_OK)
        return status;
    status = botsp_read_stopped(reply, n_stopped == NULL ? &count : n_stopped);
    return status == BOTS_OK ? status : botsp_break(client, status, "bots_stopped is not what the protocol says");
}

bots_status bots_goodbye(bots_client *client)
{
    botsp_writer writer;
    botsp_reader reply;
    bots_status status;
    if (client == NULL)
        return BOTS_BAD_ARGUMENT;
    if (!client->is_welcome)
        return botsp_fail(client, BOTS_NO_CONNECTION, "say hello first");
    writer = botsp_begin(client, "goodbye");
    status = botsp_exchange(client, &writer, "farewell", &reply);
    botsp_hang_up(&client->fd);
    client->is_welcome = 0;
    return status;
}

void bots_close(bots_client *client)
{
    botsp_memory memory;
    botsp_buffer *buffers[12];
    size_t i = 0;
    if (client == NULL)
        return;
    memory = client->memory;
    botsp_hang_up(&client->fd);
    buffers[i++] = &client->features;
    buffers[i++] = &client->costly;
    buffers[i++] = &client->components;
    buffers[i++] = &client->feature_us;
    buffers[i++] = &client->request;
    buffers[i++] = &client->reply;
    buffers[i++] = &client->queries;
    buffers[i++] = &client->cost_us;
    buffers[i++] = &client->query_reasons;
    buffers[i++] = &client->actions;
    buffers[i++] = &client->action_reasons;
    buffers[i++] = &client->turns;
    while (i > 0)
        botsp_free(&memory, buffers[--i]);
    memory.resize(memory.context, client, 0);
}

const bots_error *bots_last_error(const bots_client *client)
{
    static const bots_error no_client = {.status = BOTS_BAD_ARGUMENT, .retry_after_s = -1.0, .detail = "there is no client"};

    return client ? &client->error : &no_client;
}

uint64_t bots_n_late(const bots_client *client)
{
    return client ? client->n_late : 0;
}
