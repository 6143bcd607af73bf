/* Calls the C client as its standard input says, one command a line, and prints what it returns.
 *
 * Arguments are hex of the bytes of an array or a text, `-` is NULL; each is memory of exactly its size, so that a
 * sanitizer sees the client read beyond it. A line of output is a status and then arrays as hex, or the error. */
#define _POSIX_C_SOURCE 200809L
#include <inttypes.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "bots.h"

#define MAX_ARGUMENTS 16

static bots_client *client;
static const bots_welcome *welcome;
static uint64_t clock_step_ns, ticks_ns;
static long n_allocations, n_allowed;
static uint64_t look_step_ns, looked_ns; /* how much faster than the system's the client's own clock goes, a look */
static long n_yields, n_polls;

/* What the linker puts in the place of the library's calls. */
int __real_sched_yield(void);
int __real_poll(struct pollfd *polled, nfds_t n, int timeout_ms);
int __real_clock_gettime(clockid_t clock, struct timespec *now);

int __wrap_sched_yield(void)
{
    n_yields++;
    return __real_sched_yield();
}

int __wrap_poll(struct pollfd *polled, nfds_t n, int timeout_ms)
{
    n_polls++;
    return __real_poll(polled, n, timeout_ms);
}

int __wrap_clock_gettime(clockid_t clock, struct timespec *now)
{
    int rc = __real_clock_gettime(clock, now);
    uint64_t ns = (uint64_t)now->tv_nsec + (looked_ns += look_step_ns);
    now->tv_sec += (time_t)(ns / 1000000000u);
    now->tv_nsec = (long)(ns % 1000000000u);
    return rc;
}

static uint64_t clock_ns(void *context)
{
    (void)context;
    return ticks_ns += clock_step_ns;
}

static void *resize(void *context, void *memory, size_t bytes)
{
    (void)context;
    if (bytes == 0) {
        free(memory);
        return NULL;
    }
    return n_allocations++ < n_allowed ? realloc(memory, bytes) : NULL;
}

static void *decoded(const char *hex, size_t *size)
{
    size_t i;
    uint8_t *bytes;
    *size = strcmp(hex, "-") == 0 ? 0 : strlen(hex) / 2;
    if (strcmp(hex, "-") == 0)
        return NULL;
    bytes = malloc(*size + (*size == 0));
    for (i = 0; i < *size; i++) {
        unsigned byte = 0;
        sscanf(hex + 2 * i, "%2x", &byte);
        bytes[i] = (uint8_t)byte;
    }
    return bytes;
}

static void print_hex(const void *memory, size_t size)
{
    static const char digits[] = "0123456789abcdef";
    const uint8_t *bytes = memory;
    size_t i;
    putchar(' ');
    if (memory == NULL)
        putchar('-');
    for (i = 0; memory != NULL && i < size; i++) {
        putchar(digits[bytes[i] >> 4]);
        putchar(digits[bytes[i] & 15]);
    }
}

static int is_ok(bots_status status)
{
    const bots_error *error;
    printf("%s", bots_status_name(status));
    if (status == BOTS_OK || client == NULL)
        return status == BOTS_OK;
    error = bots_last_error(client);
    print_hex(error->code, strlen(error->code));
    print_hex(error->detail, strlen(error->detail));
    printf(" %g", error->retry_after_s);
    return 0;
}

static void connect_to(void **in)
{
    bots_options options;
    memset(&options, 0, sizeof options);
    options.timeout_ms = (int)*(int64_t *)in[1];
    clock_step_ns = *(uint64_t *)in[2];
    options.clock_ns = clock_step_ns == 0 ? NULL : clock_ns;
    options.resize = resize;
    n_allowed = (long)*(int64_t *)in[3];
    options.spin_us = (int)*(int64_t *)in[4];
    n_allocations = 0;
    look_step_ns = 0;
    bots_close(client);
    is_ok(bots_connect(in[0], &options, &client));
    look_step_ns = *(uint64_t *)in[5];
    n_yields = n_polls = 0;
}

static void hello(void **in, const size_t *sizes)
{
    bots_hello_fields fields = {0};
    fields.token = in[0];
    fields.bundle = in[1];
    fields.call_us = in[2];
    fields.feature_us = in[3];
    fields.n_feature_us = sizes[3] / sizeof(double);
    if (is_ok(bots_hello(client, &fields, &welcome))) {
        size_t i;
        printf(" %s %s %zu %zu %zu %zu %.17g %.17g %" PRId64 " %" PRId64 " %" PRId64 " %.17g %.17g %.17g %.17g %" PRId64
               " %" PRId64 " %s.",
               welcome->connection, welcome->bundle, welcome->n_free, welcome->n_queries, welcome->n_costly,
               welcome->n_actions, welcome->call_us, welcome->budget_us, welcome->context_length, welcome->max_bots,
               welcome->max_body_bytes, welcome->target_cost_us, welcome->cost_quantile, welcome->deadline_us,
               welcome->target_return, welcome->replay_frames, welcome->bundle_version, welcome->bundle_sha256);
        for (i = 0; i < welcome->n_features; i++)
            printf(" %s:%u:%.17g:%.17g:%.17g", welcome->features[i].name, (unsigned)welcome->features[i].size,
                   welcome->features[i].cost_us, welcome->features[i].low, welcome->features[i].high);
        for (i = 0; i < welcome->n_actions; i++)
            printf(" %s:%.17g:%.17g:%.17g", welcome->components[i].name, welcome->components[i].low,
                   welcome->components[i].high, welcome->components[i].safe);
        print_hex(welcome->feature_us, welcome->n_queries * sizeof(double));
    }
}

static void start(void **in)
{
    bots_start_fields fields = {0};
    int64_t *bots;
    fields.count = (size_t)*(int64_t *)in[0];
    fields.seeds = in[1];
    fields.target_returns = in[2];
    fields.budgets_us = in[3];
    fields.target_costs_us = in[4];
    bots = malloc(fields.count * sizeof *bots + 1);
    if (is_ok(bots_start(client, &fields, bots)))
        print_hex(bots, fields.count * sizeof *bots);
    free(bots);
}

static void turn(const char *name, void **in, const size_t *sizes)
{
    bots_turn played = {0};
    bots_queries queries;
    bots_actions actions;
    bots_status status;
    size_t n = sizes[1] / sizeof(int64_t);
    played.frame = *(int64_t *)in[0];
    played.bots = in[1];
    played.n_bots = n;
    played.deadline_us = in[2];
    played.free = in[3];
    played.rewards = in[4];
    played.frame_budget_us = in[5];
    played.budgets_us = in[6];
    played.target_costs_us = in[7];
    played.acquired = in[8];
    played.costly = in[9];
    played.failed = in[10];
    played.acquire_us = in[11];
    if (strcmp(name, "query") == 0) {
        if (is_ok(bots_query(client, &played, &queries))) {
            print_hex(queries.queries, n * welcome->n_queries);
            print_hex(queries.cost_us, n * sizeof(double));
            print_hex(queries.reasons, n);
            printf(" %.17g %d", queries.infer_us, queries.late);
        }
        return;
    }
    status = strcmp(name, "act") == 0 ? bots_act(client, &played, &actions) : bots_take(client, &played, &actions);
    if (is_ok(status)) {
        print_hex(actions.actions, n * welcome->n_actions * sizeof(float));
        print_hex(actions.turns, n * sizeof(int64_t));
        print_hex(actions.reasons, n);
        printf(" %.17g %d", actions.infer_us, actions.late);
    }
}

static void stop(void **in, const size_t *sizes)
{
    int64_t n_stopped;
    if (is_ok(bots_stop(client, in[0], sizes[0] / sizeof(int64_t), &n_stopped)))
        printf(" %" PRId64, n_stopped);
}

static void obey(const char *name, void **in, const size_t *sizes)
{
    if (strcmp(name, "connect") == 0)
        connect_to(in);
    else if (strcmp(name, "hello") == 0)
        hello(in, sizes);
    else if (strcmp(name, "start") == 0)
        start(in);
    else if (strcmp(name, "stop") == 0)
        stop(in, sizes);
    else if (strcmp(name, "goodbye") == 0)
        is_ok(bots_goodbye(client));
    else if (strcmp(name, "counts") == 0)
        printf("OK %" PRIu64 " %ld %ld %ld", bots_n_late(client), n_allocations, n_yields, n_polls);
    else
        turn(name, in, sizes);
}

int main(void)
{
    char *line = NULL;
    size_t capacity = 0;
    while (getline(&line, &capacity, stdin) > 0) {
        void *in[MAX_ARGUMENTS] = {NULL};
        size_t sizes[MAX_ARGUMENTS] = {0}, n = 0;
        char *name = strtok(line, " \n"), *word;
        while ((word = strtok(NULL, " \n")) != NULL && n < MAX_ARGUMENTS) {
            in[n] = decoded(word, &sizes[n]);
            n++;
        }
        obey(name, in, sizes);
        putchar('\n');
        fflush(stdout);
        while (n > 0)
            free(in[--n]);
    }
    bots_close(client);
    free(line);
    return 0;
}
