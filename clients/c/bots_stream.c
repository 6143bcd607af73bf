#ifdef __APPLE__
#define _DARWIN_C_SOURCE /* SO_NOSIGPIPE */
#else
#define _POSIX_C_SOURCE 200809L
#endif

#include "bots_stream.h"

#include <errno.h>
#include <poll.h>
#include <sched.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define FIRST_BYTES 4096
#define PREFIX_BYTES 4
#ifdef MSG_NOSIGNAL
#define SEND_FLAGS MSG_NOSIGNAL /* a server that is gone must not raise SIGPIPE in an engine */
#else
#define SEND_FLAGS 0 /* SO_NOSIGPIPE says it there */
#endif

uint64_t botsp_now_ns(void *context)
{
    struct timespec now = {0, 0};
    (void)context;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

void botsp_hang_up(int *fd)
{
    if (*fd >= 0)
        close(*fd);
    *fd = -1;
}

bots_status botsp_wait(int fd, short events, uint64_t until_ns)
{
    struct pollfd polled;
    polled.fd = fd;
    polled.events = events;
    for (;;) {
        uint64_t now_ns = botsp_now_ns(NULL);
        int n;
        if (now_ns >= until_ns)
            return BOTS_TIMEOUT;
        n = poll(&polled, 1, (int)((until_ns - now_ns + 999999u) / 1000000u));
        if (n > 0)
            return BOTS_OK;
        if (n < 0 && errno != EINTR)
            return BOTS_SYSTEM;
    }
}

static bots_status failed(void)
{
    return errno == EPIPE || errno == ECONNRESET ? BOTS_CLOSED : BOTS_SYSTEM;
}

bots_status botsp_send(int fd, const uint8_t *bytes, size_t size, uint64_t until_ns)
{
    while (size > 0) {
        ssize_t n = send(fd, bytes, size, SEND_FLAGS);
        if (n >= 0) {
            bytes += n;
            size -= (size_t)n;
        } else if (errno == EAGAIN || errno == EWOULDBLOCK) {
            bots_status status = botsp_wait(fd, POLLOUT, until_ns);
            if (status != BOTS_OK)
                return status;
        } else if (errno != EINTR) {
            return failed();
        }
    }
    return BOTS_OK;
}

/* Of how many bytes the frame is, its length included, as far as the first `size` of them say: 0 while they do not. */
static uint64_t frame_size(const uint8_t *bytes, size_t size)
{
    if (size < PREFIX_BYTES)
        return 0;
    return PREFIX_BYTES + ((uint64_t)bytes[0] << 24 | (uint64_t)bytes[1] << 16 | (uint64_t)bytes[2] << 8 | bytes[3]);
}

/* Until there may be something to read. A thread that stays awake offers its core to the server, which may have no
 * other, and looks again. */
static bots_status wait_to_read(int fd, uint64_t awake_until_ns, uint64_t until_ns)
{
    if (botsp_now_ns(NULL) >= awake_until_ns)
        return botsp_wait(fd, POLLIN, until_ns);
    sched_yield();
    return BOTS_OK;
}

bots_status botsp_receive(int fd, const botsp_memory *memory, botsp_buffer *buffer, size_t *size, uint64_t until_ns,
                          uint64_t spin_ns)
{
    uint64_t whole, awake_until_ns = botsp_now_ns(NULL) + spin_ns;
    if (awake_until_ns > until_ns)
        awake_until_ns = until_ns;
    *size = 0;
    while ((whole = frame_size(buffer->bytes, *size)) == 0 || *size < whole) {
        bots_status status;
        ssize_t n;
        if (whole > PREFIX_BYTES + BOTS_MAX_REPLY_BYTES)
            return BOTS_BAD_REPLY;
        if (!botsp_grow(memory, buffer, *size < FIRST_BYTES ? FIRST_BYTES : *size + 1))
            return BOTS_NO_MEMORY;
        status = wait_to_read(fd, awake_until_ns, until_ns);
        if (status != BOTS_OK)
            return status;
        n = recv(fd, (uint8_t *)buffer->bytes + *size, buffer->capacity - *size, 0);
        if (n == 0)
            return BOTS_CLOSED;
        if (n > 0)
            *size += (size_t)n;
        else if (errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR)
            return failed();
    }
    return *size == whole ? BOTS_OK : BOTS_BAD_REPLY; /* one reply a request: nothing may follow it */
}
