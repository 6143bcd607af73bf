/* What a client holds, and what its files share. Internal. */
#ifndef BOTS_CLIENT_H
#define BOTS_CLIENT_H

#include "bots.h"
#include "bots_memory.h"
#include "bots_msgpack.h"
#include "bots_stream.h"

struct bots_client {
    botsp_memory memory;
    uint64_t (*clock_ns)(void *context);
    void *clock_context;
    uint64_t timeout_ns, spin_ns, until_ns; /* the last: when the call that is under way ends */
    botsp_address address;
    int fd; /* -1: closed */
    int is_welcome; /* between hello and whatever ended the connection */
    bots_welcome welcome;
    botsp_buffer features, costly, components, feature_us; /* the welcome's arrays */
    botsp_buffer request, reply; /* whole frames, 4 bytes of length first */
    botsp_buffer queries, cost_us, query_reasons; /* the last bots_queries */
    botsp_buffer actions, action_reasons, turns;  /* the last bots_actions */
    uint64_t n_late;
    bots_error error;
};

/* --- messages: bots_message.c --- */

/* Keep `status` and what it means as the last error, and return it. */
bots_status botsp_fail(bots_client *client, bots_status status, const char *detail);
/* The same for what leaves no connection behind: the socket is closed. */
bots_status botsp_break(bots_client *client, bots_status status, const char *detail);
/* A message of this type in the client's request buffer; fields follow, at most 14. From now on its call has its time. */
botsp_writer botsp_begin(bots_client *client, const char *type);
/* A field's name; its value follows. */
void botsp_field(botsp_writer *writer, const char *name);
/* A whole field of [n] numbers, or nothing where they are NULL. */
void botsp_numbers_field(botsp_writer *writer, const char *name, const double *numbers, size_t n);
/* Send what was written and wait for the reply, of type `expected`: `reply` is then its map. Fails with the server's
 * code where it refused, and whenever the connection is lost. */
bots_status botsp_exchange(bots_client *client, botsp_writer *writer, const char *expected, botsp_reader *reply);
/* The same for a reply that is here. */
bots_status botsp_open_reply(
    bots_client *client, const uint8_t *body, size_t size, const char *expected, botsp_reader *reply);

/* --- replies: bots_welcome.c, bots_reply.c --- */

/* BOTS_OK, BOTS_BAD_REPLY, BOTS_NO_MEMORY; `reply` is the message's map, as from botsp_exchange. */
bots_status botsp_read_welcome(bots_client *client, botsp_reader reply);
/* What `bots_started` and `welcome` say of versions, into the welcome. 0: something else than the protocol says. */
int botsp_read_version(bots_client *client, const uint8_t *version, const uint8_t *sha256, const uint8_t *end);
bots_status botsp_read_started(bots_client *client, botsp_reader reply, size_t count, int64_t *bots);
bots_status botsp_read_queries(bots_client *client, botsp_reader reply, const bots_turn *turn, bots_queries *queries);
bots_status botsp_read_actions(bots_client *client, botsp_reader reply, const bots_turn *turn, bots_actions *actions);
bots_status botsp_read_stopped(botsp_reader reply, int64_t *n_stopped);

#endif
