/* One request out, one reply in: what every message has in common, and what went wrong with it. */
#include <errno.h>
#include <math.h>
#include <string.h>

#include "bots_client.h"

#define PREFIX_BYTES 4
#define MAX_DETAIL_CHARS 300

static const struct {
    bots_status status;
    const char *name;
} NAMES[] = {
    {BOTS_OK, "OK"},
    {BOTS_BAD_ARGUMENT, "BAD_ARGUMENT"},
    {BOTS_UNSUPPORTED, "UNSUPPORTED"},
    {BOTS_NO_MEMORY, "NO_MEMORY"},
    {BOTS_SYSTEM, "SYSTEM"},
    {BOTS_TIMEOUT, "TIMEOUT"},
    {BOTS_CLOSED, "CLOSED"},
    {BOTS_BAD_REPLY, "BAD_REPLY"},
    {BOTS_BAD_MSGPACK, "BAD_MSGPACK"},
    {BOTS_TOO_DEEP, "TOO_DEEP"},
    {BOTS_UNAUTHORIZED, "UNAUTHORIZED"},
    {BOTS_NO_BOT, "NO_BOT"},
    {BOTS_NO_BUNDLE, "NO_BUNDLE"},
    {BOTS_NO_CONNECTION, "NO_CONNECTION"},
    {BOTS_FRAME_REUSED, "FRAME_REUSED"},
    {BOTS_NO_PENDING_QUERY, "NO_PENDING_QUERY"},
    {BOTS_STALE_FRAME, "STALE_FRAME"},
    {BOTS_TOO_LARGE, "TOO_LARGE"},
    {BOTS_BAD_SCHEMA, "BAD_SCHEMA"},
    {BOTS_BAD_SHAPE, "BAD_SHAPE"},
    {BOTS_MISSING_FEATURE, "MISSING_FEATURE"},
    {BOTS_NON_FINITE, "NON_FINITE"},
    {BOTS_OUT_OF_RANGE, "OUT_OF_RANGE"},
    {BOTS_OVER_BUDGET, "OVER_BUDGET"},
    {BOTS_UNREQUESTED_FEATURE, "UNREQUESTED_FEATURE"},
    {BOTS_TOO_MANY_BOTS, "TOO_MANY_BOTS"},
    {BOTS_TOO_MANY_CONNECTIONS, "TOO_MANY_CONNECTIONS"},
    {BOTS_NOT_READY, "NOT_READY"},
    {BOTS_INTERNAL, "INTERNAL"},
};

const char *bots_status_name(bots_status status)
{
    size_t i;
    for (i = 0; i < sizeof NAMES / sizeof *NAMES; i++)
        if (NAMES[i].status == status)
            return NAMES[i].name;
    return "UNKNOWN";
}

/* At most `size` - 1 bytes of a text that somebody else wrote, so that it can be logged. */
static void copy_printable(char *to, size_t size, const uint8_t *bytes, size_t length)
{
    size_t i;
    for (i = 0; i < length && i < size - 1; i++)
        to[i] = bytes[i] >= 0x20 && bytes[i] < 0x7f ? (char)bytes[i] : '?';
    to[i] = '\0';
}

bots_status botsp_fail(bots_client *client, bots_status status, const char *detail)
{
    bots_error *error = &client->error;
    int os_error = errno;
    memset(error, 0, sizeof *error);
    error->status = status;
    error->os_error = status == BOTS_SYSTEM ? os_error : 0;
    error->retry_after_s = -1.0;
    copy_printable(error->detail, sizeof error->detail, (const uint8_t *)detail, strlen(detail));
    return status;
}

bots_status botsp_break(bots_client *client, bots_status status, const char *detail)
{
    botsp_fail(client, status, detail);
    botsp_hang_up(&client->fd);
    client->is_welcome = 0;
    return status;
}

botsp_writer botsp_begin(bots_client *client, const char *type)
{
    botsp_writer writer;
    uint8_t *start;
    client->until_ns = botsp_now_ns(NULL) + client->timeout_ns;
    writer.buffer = &client->request;
    writer.memory = &client->memory;
    writer.size = 0;
    writer.is_full = 0;
    start = botsp_room(&writer, PREFIX_BYTES + 1);
    if (start != NULL)
        start[PREFIX_BYTES] = 0x80; /* a map, of as many fields as will come */
    botsp_field(&writer, "type");
    botsp_put_text(&writer, type);
    return writer;
}

void botsp_field(botsp_writer *writer, const char *name)
{
    if (!writer->is_full)
        ((uint8_t *)writer->buffer->bytes)[PREFIX_BYTES]++;
    botsp_put_text(writer, name);
}

void botsp_numbers_field(botsp_writer *writer, const char *name, const double *numbers, size_t n)
{
    if (numbers == NULL)
        return;
    botsp_field(writer, name);
    botsp_put_numbers(writer, numbers, n);
}

static int is_text(const botsp_item *item, const char *text)
{
    return item->length == strlen(text) && memcmp(item->bytes, text, item->length) == 0;
}

/* The server's `error`. One that is none is the server's fault, and closes the socket like any such reply. */
static bots_status refused(bots_client *client, const uint8_t *const *found, const uint8_t *end)
{
    botsp_item code, detail, retry;
    botsp_reader reader;
    bots_error *error = &client->error;
    double retry_after_s = -1.0;
    size_t i;
    if (!botsp_read(found[0], end, BOTSP_TEXT, &code) || !botsp_read(found[1], end, BOTSP_TEXT, &detail))
        return botsp_break(client, BOTS_BAD_REPLY, "an error without a code and a detail");
    if (found[2] != NULL && !botsp_read(found[2], end, BOTSP_NIL, &retry)) {
        reader.at = found[2];
        reader.end = end;
        if (!botsp_number(&reader, &retry_after_s) || retry_after_s < 0.0)
            return botsp_break(client, BOTS_BAD_REPLY, "an error whose retry_after_s is no time");
    }
    botsp_fail(client, BOTS_INTERNAL, "");
    for (i = 0; i < sizeof NAMES / sizeof *NAMES; i++)
        if (NAMES[i].status >= BOTS_BAD_MSGPACK && is_text(&code, NAMES[i].name))
            error->status = NAMES[i].status;
    error->retry_after_s = retry_after_s;
    copy_printable(error->code, sizeof error->code, code.bytes, code.length);
    copy_printable(error->detail, MAX_DETAIL_CHARS + 1, detail.bytes, detail.length);
    if (error->status == BOTS_NO_CONNECTION || error->status == BOTS_TOO_LARGE
        || error->status == BOTS_TOO_MANY_CONNECTIONS) { /* the server closes it too, or answers nothing else on it */
        botsp_hang_up(&client->fd);
        client->is_welcome = 0;
    }
    return error->status;
}

bots_status botsp_open_reply(
    bots_client *client, const uint8_t *body, size_t size, const char *expected, botsp_reader *reply)
{
    static const char *const names[] = {"code", "detail", "retry_after_s", "type"};
    const uint8_t *found[4];
    botsp_reader rest;
    botsp_item type;
    reply->at = body;
    reply->end = body + size;
    rest = *reply;
    if (!botsp_index(&rest, names, 4, found) || rest.at != rest.end)
        return botsp_break(client, BOTS_BAD_REPLY, "the reply is not one msgpack map");
    if (!botsp_read(found[3], reply->end, BOTSP_TEXT, &type))
        return botsp_break(client, BOTS_BAD_REPLY, "the reply has no type");
    if (is_text(&type, "error"))
        return refused(client, found, reply->end);
    if (!is_text(&type, expected))
        return botsp_break(client, BOTS_BAD_REPLY, "the reply is of a type that answers something else");
    return BOTS_OK;
}

static const char *why(bots_status status)
{
    switch (status) {
    case BOTS_TIMEOUT:
        return "the server did not answer in time";
    case BOTS_CLOSED:
        return "the server closed the socket";
    case BOTS_NO_MEMORY:
        return "no memory for the reply";
    case BOTS_BAD_REPLY:
        return "the reply is too long, or more follows it";
    default:
        return "the socket failed";
    }
}

bots_status botsp_exchange(bots_client *client, botsp_writer *writer, const char *expected, botsp_reader *reply)
{
    uint64_t until_ns = client->until_ns;
    size_t size = writer->size, body = size - PREFIX_BYTES, i;
    uint8_t *bytes = client->request.bytes;
    bots_status status;
    if (writer->is_full)
        return botsp_fail(client, BOTS_NO_MEMORY, "no memory for the request");
    if (body > UINT32_MAX || (client->is_welcome && (uint64_t)body > (uint64_t)client->welcome.max_body_bytes))
        return botsp_fail(client, BOTS_BAD_ARGUMENT, "the message is longer than the server reads");
    for (i = 0; i < PREFIX_BYTES; i++)
        bytes[i] = (uint8_t)((uint64_t)body >> (24 - 8 * i));
    status = botsp_send(client->fd, bytes, size, until_ns);
    if (status == BOTS_OK)
        status = botsp_receive(client->fd, &client->memory, &client->reply, &size, until_ns, client->spin_ns);
    if (status != BOTS_OK)
        return botsp_break(client, status, why(status));
    body = size - PREFIX_BYTES;
    return botsp_open_reply(client, (const uint8_t *)client->reply.bytes + PREFIX_BYTES, body, expected, reply);
}
