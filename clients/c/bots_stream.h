/* One socket, its frames of a 4-byte length and a body, and how long either may take. This file knows nothing about
 * what a frame says. Internal. */
#ifndef BOTS_STREAM_H
#define BOTS_STREAM_H

#include <stdint.h>

#include "bots.h"
#include "bots_memory.h"

typedef struct botsp_address {
    int is_unix;
    char host[256]; /* or the path of a Unix socket */
    char port[6];
} botsp_address;

/* BOTS_OK or BOTS_BAD_ARGUMENT. */
bots_status botsp_parse(const char *url, botsp_address *address);
/* Monotonic ns. */
uint64_t botsp_now_ns(void *context);
/* Until the socket is ready for these events of poll, or has failed, which the next call on it says. */
bots_status botsp_wait(int fd, short events, uint64_t until_ns);
/* All until `until_ns`: BOTS_OK, BOTS_TIMEOUT, BOTS_CLOSED, BOTS_SYSTEM (see errno). */
bots_status botsp_dial(const botsp_address *address, uint64_t until_ns, int *fd);
bots_status botsp_send(int fd, const uint8_t *bytes, size_t size, uint64_t until_ns);
/* One frame into `buffer`, its length first, `size` bytes in all; BOTS_BAD_REPLY and BOTS_NO_MEMORY too. Memory grows
 * with what has come, not with what is announced. For the first `spin_ns` the thread does not sleep. */
bots_status botsp_receive(int fd, const botsp_memory *memory, botsp_buffer *buffer, size_t *size, uint64_t until_ns,
                          uint64_t spin_ns);
void botsp_hang_up(int *fd);

#endif
