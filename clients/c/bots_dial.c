/* Addresses, and sockets that are connected to them. */
#ifdef __APPLE__
#define _DARWIN_C_SOURCE /* SO_NOSIGPIPE */
#else
#define _POSIX_C_SOURCE 200809L
#endif

#include "bots_stream.h"

#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/un.h>
#include <unistd.h>

static bots_status parse_tcp(const char *name, botsp_address *address)
{
    const char *host = name, *end, *port;
    size_t length, digits;
    long number = 0;
    if (*name == '[') {
        host = name + 1;
        end = strchr(host, ']');
        port = end == NULL ? NULL : end + 1;
    } else {
        end = port = strchr(name, ':');
    }
    if (port == NULL || *port != ':')
        return BOTS_BAD_ARGUMENT;
    port++;
    length = (size_t)(end - host);
    digits = strspn(port, "0123456789");
    if (length == 0 || length >= sizeof address->host || digits == 0 || digits >= sizeof address->port
        || (port[digits] != '\0' && strcmp(port + digits, "/") != 0))
        return BOTS_BAD_ARGUMENT;
    memcpy(address->host, host, length);
    memcpy(address->port, port, digits);
    for (; digits > 0; digits--)
        number = 10 * number + (*port++ - '0');
    return number >= 1 && number <= 65535 ? BOTS_OK : BOTS_BAD_ARGUMENT;
}

bots_status botsp_parse(const char *url, botsp_address *address)
{
    size_t length;
    memset(address, 0, sizeof *address);
    if (strncmp(url, "tcp://", 6) == 0)
        return parse_tcp(url + 6, address);
    if (strncmp(url, "unix:///", 8) != 0)
        return BOTS_BAD_ARGUMENT;
    length = strlen(url + 7);
    if (length < 2 || length >= sizeof ((struct sockaddr_un *)0)->sun_path || length >= sizeof address->host)
        return BOTS_BAD_ARGUMENT;
    address->is_unix = 1;
    memcpy(address->host, url + 7, length);
    return BOTS_OK;
}

/* A socket that blocks nobody, is not handed on to other programs, and raises no signal. */
static int open_socket(int family, int is_blocking)
{
    int fd = socket(family, SOCK_STREAM, 0), flags;
    if (fd < 0)
        return -1;
    flags = fcntl(fd, F_GETFL);
    if (fcntl(fd, F_SETFD, FD_CLOEXEC) < 0 || flags < 0
        || (!is_blocking && fcntl(fd, F_SETFL, flags | O_NONBLOCK) < 0)) {
        botsp_hang_up(&fd);
        return -1;
    }
#ifdef SO_NOSIGPIPE
    {
        int on = 1;
        setsockopt(fd, SOL_SOCKET, SO_NOSIGPIPE, &on, sizeof on);
    }
#endif
    return fd;
}

/* Blocking while it connects: one that does not block is refused where the server's queue is full, and cannot wait. */
static bots_status dial_unix(const botsp_address *address, uint64_t until_ns, int *fd)
{
    struct sockaddr_un name;
    struct timeval left;
    uint64_t now_ns = botsp_now_ns(NULL), left_us = until_ns > now_ns ? (until_ns - now_ns) / 1000u + 1 : 1;
    int flags, rc;
    memset(&name, 0, sizeof name);
    name.sun_family = AF_UNIX;
    memcpy(name.sun_path, address->host, strlen(address->host));
    *fd = open_socket(AF_UNIX, 1);
    if (*fd < 0)
        return BOTS_SYSTEM;
    left.tv_sec = (time_t)(left_us / 1000000u);
    left.tv_usec = (suseconds_t)(left_us % 1000000u);
    setsockopt(*fd, SOL_SOCKET, SO_SNDTIMEO, &left, sizeof left);
    do {
        rc = connect(*fd, (struct sockaddr *)&name, sizeof name);
    } while (rc < 0 && errno == EINTR && botsp_now_ns(NULL) < until_ns);
    if (rc < 0 && errno != EISCONN)
        return errno == EAGAIN || errno == EINTR ? BOTS_TIMEOUT : BOTS_SYSTEM;
    flags = fcntl(*fd, F_GETFL);
    return flags < 0 || fcntl(*fd, F_SETFL, flags | O_NONBLOCK) < 0 ? BOTS_SYSTEM : BOTS_OK;
}

static bots_status dial_one(const struct addrinfo *found, uint64_t until_ns, int *fd)
{
    int on = 1, error = 0;
    socklen_t size = sizeof error;
    bots_status status;
    *fd = open_socket(found->ai_family, 0);
    if (*fd < 0)
        return BOTS_SYSTEM;
    setsockopt(*fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on); /* a turn is two small packets, and waits for both */
    if (connect(*fd, found->ai_addr, found->ai_addrlen) == 0)
        return BOTS_OK;
    if (errno != EINPROGRESS && errno != EINTR)
        return BOTS_SYSTEM;
    status = botsp_wait(*fd, POLLOUT, until_ns);
    if (status != BOTS_OK)
        return status;
    if (getsockopt(*fd, SOL_SOCKET, SO_ERROR, &error, &size) < 0)
        return BOTS_SYSTEM;
    errno = error;
    return error == 0 ? BOTS_OK : BOTS_SYSTEM;
}

static bots_status dial_tcp(const botsp_address *address, uint64_t until_ns, int *fd)
{
    struct addrinfo hints, *found = NULL, *each;
    bots_status status = BOTS_SYSTEM;
    int rc;
    memset(&hints, 0, sizeof hints);
    hints.ai_socktype = SOCK_STREAM;
    rc = getaddrinfo(address->host, address->port, &hints, &found);
    if (rc != 0) {
        if (rc != EAI_SYSTEM)
            errno = EHOSTUNREACH; /* the resolver has numbers of its own */
        return BOTS_SYSTEM;
    }
    for (each = found; each != NULL; each = each->ai_next) {
        int saved;
        status = dial_one(each, until_ns, fd);
        if (status == BOTS_OK)
            break;
        saved = errno;
        botsp_hang_up(fd);
        errno = saved;
    }
    freeaddrinfo(found);
    return status;
}

bots_status botsp_dial(const botsp_address *address, uint64_t until_ns, int *fd)
{
    bots_status status = address->is_unix ? dial_unix(address, until_ns, fd) : dial_tcp(address, until_ns, fd);
    if (status != BOTS_OK) {
        int saved = errno;
        botsp_hang_up(fd);
        errno = saved;
    }
    return status;
}
