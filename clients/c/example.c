/* Plays some frames of some bots with made-up rays, and prints what they ask for, what that costs and what they do.
 *
 *     python -m server --bundle bundles/hard --tcp-port 7777
 *     example tcp://127.0.0.1:7777 [bots [frames]]
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bots.h"

#define MAX_ARGUMENT 4096

/* Where a real engine would cast a ray: something within the feature's range, the same in every run. */
static float made_up(const bots_feature *feature, unsigned *state)
{
    *state = *state * 1664525u + 1013904223u;
    return (float)(feature->low + (feature->high - feature->low) * ((double)(*state >> 8) / (1 << 24)));
}

/* [N, F] numbers that cost nothing. */
static void look_around(const bots_welcome *welcome, size_t n_bots, float *free_numbers, unsigned *state)
{
    size_t bot, i;
    uint32_t j;
    for (bot = 0; bot < n_bots; bot++)
        for (i = 0; i < welcome->n_features; i++)
            for (j = 0; welcome->features[i].cost_us == 0.0 && j < welcome->features[i].size; j++)
                *free_numbers++ = made_up(&welcome->features[i], state);
}

/* [N, D] numbers, of which only those that were asked for are found out. */
static void acquire(const bots_welcome *welcome, const bots_queries *queries, size_t n_bots, float *costly, unsigned *state)
{
    const uint8_t *is_asked = queries->queries;
    size_t bot, m;
    uint32_t j;
    for (bot = 0; bot < n_bots; bot++)
        for (m = 0; m < welcome->n_queries; m++, is_asked++) {
            const bots_feature *feature = &welcome->features[welcome->costly[m]];
            for (j = 0; *is_asked && j < feature->size; j++)
                costly[j] = made_up(feature, state);
            costly += feature->size;
        }
}

static void show(const bots_welcome *welcome, const bots_queries *queries, const bots_actions *actions, size_t bot)
{
    size_t m, i, n_asked = 0;
    for (m = 0; m < welcome->n_queries; m++)
        n_asked += queries->queries[bot * welcome->n_queries + m];
    printf("frame %lld bot %u: %u of %u rays, %.2f of %.2f us,", (long long)actions->frame, (unsigned)bot,
           (unsigned)n_asked, (unsigned)welcome->n_queries, queries->cost_us[bot], welcome->budget_us);
    for (i = 0; i < welcome->n_actions; i++)
        printf(" %s %.3f", welcome->components[i].name, (double)actions->actions[bot * welcome->n_actions + i]);
    printf("%s\n", actions->reasons[bot] != 0 ? " (fallback)" : "");
}

static int failed(const bots_client *client, const char *what)
{
    const bots_error *error = bots_last_error(client);
    fprintf(stderr, "%s: %s %s\n", what, bots_status_name(error->status), error->detail);
    return 0;
}

static int play(bots_client *client, const bots_welcome *welcome, size_t n_bots, int64_t n_frames, int64_t *handles,
                float *free_numbers, float *costly)
{
    bots_start_fields start;
    bots_turn turn;
    unsigned state = 1;
    memset(&start, 0, sizeof start);
    start.count = n_bots;
    if (bots_start(client, &start, handles) != BOTS_OK)
        return failed(client, "start");
    memset(&turn, 0, sizeof turn);
    turn.bots = handles;
    turn.n_bots = n_bots;
    turn.free = free_numbers;
    turn.costly = costly;
    for (turn.frame = 0; turn.frame < n_frames; turn.frame++) {
        bots_queries queries;
        bots_actions actions;
        size_t bot;
        look_around(welcome, n_bots, free_numbers, &state);
        if (bots_query(client, &turn, &queries) != BOTS_OK)
            return failed(client, "query");
        acquire(welcome, &queries, n_bots, costly, &state);
        turn.acquired = queries.queries;
        if (bots_act(client, &turn, &actions) != BOTS_OK)
            return failed(client, "act");
        for (bot = 0; bot < n_bots; bot++)
            show(welcome, &queries, &actions, bot);
    }
    return bots_goodbye(client) == BOTS_OK || failed(client, "goodbye");
}

int main(int argc, char **argv)
{
    long n_bots = argc > 2 ? atol(argv[2]) : 2, n_frames = argc > 3 ? atol(argv[3]) : 5;
    const bots_welcome *welcome;
    bots_client *client;
    bots_status status;
    int is_played = 0;
    if (argc < 2 || n_bots < 1 || n_bots > MAX_ARGUMENT || n_frames < 1 || n_frames > MAX_ARGUMENT) {
        fprintf(stderr, "usage: example tcp://host:port|unix:///path [bots [frames]], each 1 to %d\n", MAX_ARGUMENT);
        return 2;
    }
    status = bots_connect(argv[1], NULL, &client);
    if (status != BOTS_OK) {
        fprintf(stderr, "connect to %s: %s\n", argv[1], bots_status_name(status));
        return 1;
    }
    if (bots_hello(client, NULL, &welcome) == BOTS_OK) {
        size_t n = (size_t)n_bots;
        int64_t *handles = calloc(n, sizeof *handles);
        float *free_numbers = calloc(n * welcome->n_free + 1, sizeof *free_numbers);
        float *costly = calloc(n * welcome->n_costly + 1, sizeof *costly);
        if (handles != NULL && free_numbers != NULL && costly != NULL)
            is_played = play(client, welcome, n, n_frames, handles, free_numbers, costly);
        free(handles);
        free(free_numbers);
        free(costly);
    } else {
        failed(client, "hello");
    }
    bots_close(client);
    return is_played ? 0 : 1;
}
