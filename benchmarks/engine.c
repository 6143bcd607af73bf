/* An engine's thread that plays recorded frames by clients/c and times each turn: what an engine in C or C++ waits for.
 *
 * Arrays are dense and row by row, letters as in bots.h; T recorded frames. Bot n is n frames ahead, as in
 * benchmarks/recorded.py. The clock stands while the engine looks up what was asked for.
 */
#define _POSIX_C_SOURCE 200809L

#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "bots.h"

/* Recorded frames, [T, F] and [T, D]. */
typedef struct engine_rows {
    const float *free_rows, *costly_rows;
    size_t n_rows, n_free, n_costly; /* T, F, D */
} engine_rows;

typedef struct engine {
    bots_client *client;
    const bots_welcome *welcome;
    engine_rows recorded;
    size_t n_bots;
    int64_t *bots;
    float *free_numbers, *costly; /* [N, F], [N, D] */
    int64_t frame;
} engine;

static double now_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return 1e6 * (double)now.tv_sec + 1e-3 * (double)now.tv_nsec;
}

static void look(const engine *played, const float *rows, size_t n_numbers, float *out)
{
    size_t bot;
    for (bot = 0; bot < played->n_bots; bot++) {
        size_t row = ((size_t)played->frame + bot) % played->recorded.n_rows;
        memcpy(out + bot * n_numbers, rows + row * n_numbers, n_numbers * sizeof *out);
    }
}

void engine_close(engine *played)
{
    if (played == NULL)
        return;
    bots_close(played->client);
    free(played->bots);
    free(played->free_numbers);
    free(played->costly);
    free(played);
}

/* NULL: no server there, it refused, or its features are others than were recorded. The rows are read until the engine
 * is closed. */
engine *engine_open(const char *url, int spin_us, size_t n_bots, engine_rows recorded)
{
    bots_options options;
    bots_start_fields start;
    engine *played = calloc(1, sizeof *played);
    memset(&options, 0, sizeof options);
    memset(&start, 0, sizeof start);
    options.spin_us = spin_us;
    start.count = n_bots;
    if (played == NULL || bots_connect(url, &options, &played->client) != BOTS_OK
        || bots_hello(played->client, NULL, &played->welcome) != BOTS_OK
        || played->welcome->n_free != recorded.n_free || played->welcome->n_costly != recorded.n_costly)
        goto failed;
    played->recorded = recorded;
    played->n_bots = n_bots;
    played->bots = malloc(n_bots * sizeof *played->bots);
    played->free_numbers = calloc(n_bots * recorded.n_free + 1, sizeof(float));
    played->costly = calloc(n_bots * recorded.n_costly + 1, sizeof(float));
    if (played->bots == NULL || played->free_numbers == NULL || played->costly == NULL
        || bots_start(played->client, &start, played->bots) != BOTS_OK)
        goto failed;
    return played;
failed:
    engine_close(played);
    return NULL;
}

/* The next frame: µs of its two calls together, and of the model in them, into us[2]. Returns a bots_status. */
int engine_turn(engine *played, double *us)
{
    bots_turn turn;
    bots_queries queries;
    bots_actions actions;
    bots_status status;
    double begun_us;
    memset(&turn, 0, sizeof turn);
    turn.frame = played->frame;
    turn.n_bots = played->n_bots;
    turn.bots = played->bots;
    turn.free = played->free_numbers;
    turn.costly = played->costly;
    look(played, played->recorded.free_rows, played->recorded.n_free, played->free_numbers);
    begun_us = now_us();
    status = bots_query(played->client, &turn, &queries);
    us[0] = now_us() - begun_us;
    if (status != BOTS_OK)
        return (int)status;
    turn.acquired = queries.queries;
    look(played, played->recorded.costly_rows, played->recorded.n_costly, played->costly);
    begun_us = now_us();
    status = bots_act(played->client, &turn, &actions);
    us[0] += now_us() - begun_us;
    if (status != BOTS_OK)
        return (int)status;
    us[1] = queries.infer_us + actions.infer_us;
    played->frame++;
    return (int)BOTS_OK;
}
