/* Reads replies as the C client would that they were sent to, and prints one letter for each.
 *
 * Standard input: for each, the letter of what was asked (h s q a t g), 4 bytes of length, little-endian, and that many
 * bytes of body. Each lies in memory of exactly its size, so that a sanitizer sees any read beyond. The first must be a
 * welcome that can be read; turns are of its two bots in frame 7. Output: `.` read, `r` refused, `x` no such reply. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bots_client.h"

/* Reads each number of what came out: whatever it is, it must be there. */
static double summed(const bots_client *client, const bots_queries *queries, const bots_actions *actions)
{
    const bots_welcome *welcome = &client->welcome;
    double sum = 0.0;
    size_t i;
    for (i = 0; queries != NULL && i < 2 * welcome->n_queries; i++)
        sum += queries->queries[i];
    for (i = 0; actions != NULL && i < 2 * welcome->n_actions; i++)
        sum += (double)actions->actions[i];
    for (i = 0; i < 2; i++)
        sum += queries != NULL ? queries->cost_us[i] : actions->reasons[i];
    return sum;
}

static bots_status judged(bots_client *client, int kind, const uint8_t *body, size_t size)
{
    static const int64_t bots[2] = {1, 2};
    const char *expected = kind == 'h'   ? "welcome"
                           : kind == 's' ? "bots_started"
                           : kind == 'q' ? "queries"
                           : kind == 'a' ? "actions"
                           : kind == 't' ? "bots_stopped"
                                         : "farewell";
    bots_turn turn = {0};
    bots_queries queries;
    bots_actions actions;
    botsp_reader reply;
    int64_t started[2], n_stopped;
    bots_status status = botsp_open_reply(client, body, size, expected, &reply);
    turn.frame = 7;
    turn.bots = bots;
    turn.n_bots = 2;
    if (status != BOTS_OK)
        return status;
    if (kind == 'h')
        return botsp_read_welcome(client, reply);
    if (kind == 's')
        return botsp_read_started(client, reply, 2, started);
    if (kind == 't')
        return botsp_read_stopped(reply, &n_stopped);
    if (kind == 'q' && (status = botsp_read_queries(client, reply, &turn, &queries)) == BOTS_OK)
        return summed(client, &queries, NULL) >= 0.0 ? BOTS_OK : BOTS_INTERNAL;
    if (kind == 'a' && (status = botsp_read_actions(client, reply, &turn, &actions)) == BOTS_OK)
        return summed(client, NULL, &actions) >= -1e9 ? BOTS_OK : BOTS_INTERNAL;
    return status;
}

static bots_client *made(void)
{
    bots_client *client = calloc(1, sizeof *client);
    client->memory.resize = botsp_resize;
    client->fd = -1;
    return client;
}

int main(void)
{
    bots_client *served = made(), *greeted = made();
    uint8_t head[5];
    while (fread(head, 1, 5, stdin) == 5) {
        size_t size = (size_t)head[1] | (size_t)head[2] << 8 | (size_t)head[3] << 16 | (size_t)head[4] << 24;
        uint8_t *body = malloc(size + (size == 0));
        bots_client *client = head[0] == 'h' && served->welcome.n_actions > 0 ? greeted : served;
        bots_status status;
        if (fread(body, 1, size, stdin) != size)
            return 2;
        status = judged(client, head[0], body, size);
        putchar(status == BOTS_OK ? '.' : status >= BOTS_BAD_MSGPACK ? 'r' : 'x');
        free(body);
    }
    bots_close(served);
    bots_close(greeted);
    return 0;
}
