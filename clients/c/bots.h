/* A client of the bot server for engines written in C or C++: protocol version 1 over TCP and Unix sockets.
 *
 * protocol/PROTOCOL.md says what every field means. Letters of shapes: N bots in a message, F free numbers a bot,
 * M costly features, D numbers of all costly features, A numbers of an action; all arrays are dense and row by row.
 *
 * Nothing here prints, aborts, or keeps anything outside the client that it was handed. A client is for one thread at
 * a time; different clients share nothing. Calls block, each for at most its client's timeout.
 */
#ifndef BOTS_H
#define BOTS_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define BOTS_MAX_BOTS 65536   /* in one message */
#define BOTS_MAX_FEATURES 1024
#define BOTS_MAX_FEATURE_SIZE 4096
#define BOTS_MAX_FRAME ((int64_t)1 << 53)
#define BOTS_MAX_REPLY_BYTES ((size_t)64 << 20)
#define BOTS_MAX_TIMEOUT_MS 3600000
#define BOTS_MAX_SPIN_US 10000

typedef enum bots_status {
    BOTS_OK = 0,
    /* This side's. After the first three the connection is as it was; after the others its socket is closed and its
     * bots have ended: say hello again, which dials again. */
    BOTS_BAD_ARGUMENT = 1, /* an argument that this file does not allow; nothing was sent */
    BOTS_UNSUPPORTED = 2,  /* the server is older than an argument that was given; nothing was sent */
    BOTS_NO_MEMORY = 3,    /* before anything was sent; while a reply came, the socket is closed */
    BOTS_SYSTEM = 4,       /* the system refused: bots_error.os_error is its errno */
    BOTS_TIMEOUT = 5,
    BOTS_CLOSED = 6,       /* the server closed the socket */
    BOTS_BAD_REPLY = 7,    /* the answer is not one that the protocol allows here */
    /* The server's, under the protocol's names. A refused request has changed nothing. */
    BOTS_BAD_MSGPACK = 100,
    BOTS_TOO_DEEP,
    BOTS_UNAUTHORIZED,
    BOTS_NO_BOT,
    BOTS_NO_BUNDLE,
    BOTS_NO_CONNECTION, /* from this side too, before hello and after the socket was closed */
    BOTS_FRAME_REUSED,
    BOTS_NO_PENDING_QUERY,
    BOTS_STALE_FRAME,
    BOTS_TOO_LARGE,
    BOTS_BAD_SCHEMA,
    BOTS_BAD_SHAPE,
    BOTS_MISSING_FEATURE,
    BOTS_NON_FINITE,
    BOTS_OUT_OF_RANGE,
    BOTS_OVER_BUDGET,
    BOTS_UNREQUESTED_FEATURE,
    BOTS_TOO_MANY_BOTS,
    BOTS_TOO_MANY_CONNECTIONS,
    BOTS_NOT_READY,
    BOTS_INTERNAL /* and any code that this client does not know; bots_error.code has its text */
} bots_status;

typedef struct bots_client bots_client;

/* What the last call that failed said. Texts are printable ASCII: what a server sends otherwise becomes '?'. */
typedef struct bots_error {
    bots_status status;
    int os_error;         /* errno of BOTS_SYSTEM, else 0 */
    double retry_after_s; /* negative where the server named none */
    char code[64];        /* the server's code; empty where the failure is this side's */
    char detail[304];
} bots_error;

/* Zeroed means all defaults. */
typedef struct bots_options {
    int timeout_ms; /* of a whole call, 1 to BOTS_MAX_TIMEOUT_MS. 0: 5000. Not of looking up a host's name */
    /* Monotonic ns that decide what came late. NULL: the system's. */
    uint64_t (*clock_ns)(void *context);
    void *clock_context;
    /* As realloc; with 0 bytes as free, returning NULL. NULL: the C library's. */
    void *(*resize)(void *context, void *memory, size_t bytes);
    void *resize_context;
    /* How long to poll for an answer before the thread sleeps until it comes, 0 to BOTS_MAX_SPIN_US: for a thread that
     * has a core. 0: sleep at once. */
    int spin_us;
} bots_options;

typedef struct bots_feature {
    char name[65];
    uint32_t size;
    double cost_us; /* 0: free, sent every frame */
    double low, high;
} bots_feature;

typedef struct bots_component {
    char name[65];
    double low, high, safe;
} bots_component;

/* What the server answers to hello. It lives in the client: until the next hello, and bots_close, pointers hold. */
typedef struct bots_welcome {
    char connection[65];
    char bundle[65];
    const bots_feature *features; /* [n_features], in wire order */
    size_t n_features;
    const uint32_t *costly; /* [M], where in `features` those are that cost something */
    const bots_component *components; /* [A] */
    size_t n_free;                    /* F */
    size_t n_queries;                 /* M */
    size_t n_costly;                  /* D */
    size_t n_actions;                 /* A */
    double call_us;
    const double *feature_us; /* [M] */
    double budget_us;
    int64_t context_length;
    int64_t max_bots;
    int64_t max_body_bytes;
    double target_cost_us;  /* NaN: the bundle reads none */
    double cost_quantile;   /* NaN: the server takes no measurements */
    double deadline_us;     /* NaN: requests that name none have none */
    double target_return;   /* NaN: the server is older than the field */
    int64_t replay_frames;  /* 0: the server knows no bots_take */
    int64_t bundle_version; /* of the bots that were started last; 0: none */
    char bundle_sha256[65]; /* the same; empty where an older server names none */
    int has_target_costs;   /* whether the server knows target_costs_us, and budgets_us of one frame */
    int has_deadlines;      /* whether it knows deadline_us of one request */
} bots_welcome;

/* Pointers that are NULL leave their field out. */
typedef struct bots_hello_fields {
    const char *token;
    const char *bundle; /* NAME or NAME@VERSION */
    const double *call_us; /* a cost model that the engine measured: this and `feature_us`, or neither */
    const double *feature_us;
    size_t n_feature_us; /* M */
} bots_hello_fields;

typedef struct bots_start_fields {
    size_t count; /* 1 to BOTS_MAX_BOTS; each array below is [count], or NULL */
    const int64_t *seeds;
    const double *target_returns;
    const double *budgets_us;
    const double *target_costs_us;
} bots_start_fields;

/* One frame of N bots, for bots_query and then bots_act, or for bots_take, which reads all of it. NULL: left out. */
typedef struct bots_turn {
    int64_t frame; /* 0 to BOTS_MAX_FRAME, growing */
    size_t n_bots; /* N, 1 to BOTS_MAX_BOTS */
    const int64_t *bots; /* [N] */
    const double *deadline_us;
    /* bots_query, bots_take */
    const float *free; /* [N, F]; may be NULL where F is 0 */
    const double *rewards; /* [N] */
    const double *frame_budget_us;
    const double *budgets_us; /* [N] */
    const double *target_costs_us; /* [N] */
    /* bots_act, bots_take */
    const uint8_t *acquired; /* [N, M], 0 or not */
    const float *costly; /* [N, D], of which only what was acquired is read and sent */
    const uint8_t *failed; /* [N, M] */
    const double *acquire_us;
} bots_turn;

/* Arrays live in the client until its next bots_query; they may be handed to bots_act as they are. */
typedef struct bots_queries {
    int64_t frame;
    const uint8_t *queries; /* [N, M], 0 or 1 */
    const double *cost_us; /* [N], predicted */
    const uint8_t *reasons; /* [N], 0: decided by the network */
    double infer_us;
    int late; /* after its deadline, by the server's clock or by this side's */
} bots_queries;

/* Arrays live in the client until its next bots_act or bots_take. */
typedef struct bots_actions {
    int64_t frame;
    const float *actions; /* [N, A], finite and within each component's bounds */
    const uint8_t *reasons; /* [N], 0: learned. Take any other that you do not know for a fallback */
    const int64_t *turns; /* [N]; NULL from an older server */
    double infer_us;
    int late;
} bots_actions;

/* Dial `tcp://host:port`, `tcp://[v6]:port` or `unix:///path`. `options` may be NULL. On failure *client is NULL, and
 * errno says why where the status is BOTS_SYSTEM. A server waits 2 s for hello. */
bots_status bots_connect(const char *url, const bots_options *options, bots_client **client);

/* `fields` and `welcome` may be NULL. Dials again where the socket was closed. */
bots_status bots_hello(bots_client *client, const bots_hello_fields *fields, const bots_welcome **welcome);

/* Writes [count] handles to `bots`. A reply that is lost may have started bots, which end with the connection. */
bots_status bots_start(bots_client *client, const bots_start_fields *fields, int64_t *bots);

bots_status bots_query(bots_client *client, const bots_turn *turn, bots_queries *queries);
bots_status bots_act(bots_client *client, const bots_turn *turn, bots_actions *actions);

/* A whole turn in one message, where the engine decided itself what to acquire. */
bots_status bots_take(bots_client *client, const bots_turn *turn, bots_actions *actions);

/* `n_stopped` may be NULL. */
bots_status bots_stop(bots_client *client, const int64_t *bots, size_t n_bots, int64_t *n_stopped);

/* End the connection and its bots, wait for the server to say so, and close the socket. */
bots_status bots_goodbye(bots_client *client);

/* Close the socket without a word, which ends the connection too, and free the client. NULL is allowed. */
void bots_close(bots_client *client);

/* Of the last call that failed; valid until the next call. */
const bots_error *bots_last_error(const bots_client *client);

/* How many queries and actions came late. */
uint64_t bots_n_late(const bots_client *client);

/* The name of a status, `NO_BOT` for BOTS_NO_BOT. */
const char *bots_status_name(bots_status status);

#ifdef __cplusplus
}
#endif

#endif
