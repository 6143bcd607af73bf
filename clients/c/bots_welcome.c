/* `welcome` and `bots_started`: what is served. Everything in them is held against what the protocol allows, so that
 * what engines allocate by it is bounded. */
#include <float.h>
#include <math.h>
#include <string.h>

#include "bots_client.h"

#define MAX_COST_US 1e6
#define MAX_COUNT BOTS_MAX_FRAME

enum {
    CONNECTION, BUNDLE, FEATURES, ACTION, COST_MODEL, BUDGET_US, CONTEXT_LENGTH, MAX_BOTS, MAX_BODY_BYTES,
    TARGET_COST_US, COST_QUANTILE, DEADLINE_US, TARGET_RETURN, REPLAY_FRAMES, BUNDLE_VERSION, BUNDLE_SHA256, N_FIELDS
};
static const char *const FIELDS[N_FIELDS] = {
    "connection", "bundle", "features", "action", "cost_model", "budget_us", "context_length", "max_bots",
    "max_body_bytes", "target_cost_us", "cost_quantile", "deadline_us", "target_return", "replay_frames",
    "bundle_version", "bundle_sha256"};

static const char LOWER[] = "abcdefghijklmnopqrstuvwxyz0123456789_-";

/* A text of 1 to 64 of the characters that any name has. */
static int read_name(const uint8_t *at, const uint8_t *end, char name[65])
{
    botsp_item text;
    size_t i;
    if (!botsp_read(at, end, BOTSP_TEXT, &text) || text.length < 1 || text.length > 64)
        return 0;
    for (i = 0; i < text.length; i++)
        if (memchr(LOWER, text.bytes[i], sizeof LOWER - 1) == NULL)
            return 0;
    memcpy(name, text.bytes, text.length);
    name[text.length] = '\0';
    return 1;
}

static int read_number(const uint8_t *at, const uint8_t *end, double low, double high, double *number)
{
    botsp_reader reader;
    if (at == NULL)
        return 0;
    reader.at = at;
    reader.end = end;
    return botsp_number(&reader, number) && *number >= low && *number <= high;
}

static int is_absent(const uint8_t *at, const uint8_t *end)
{
    botsp_item item;
    return at == NULL || botsp_read(at, end, BOTSP_NIL, &item);
}

/* A number, or NaN where it is null or left out. */
static int read_optional(const uint8_t *at, const uint8_t *end, double low, double high, double *number)
{
    *number = NAN;
    return is_absent(at, end) || read_number(at, end, low, high, number);
}

static int read_integer(const uint8_t *at, const uint8_t *end, int64_t low, int64_t *integer)
{
    botsp_reader reader;
    if (at == NULL)
        return 0;
    reader.at = at;
    reader.end = end;
    return botsp_integer(&reader, low, MAX_COUNT, integer);
}

/* The array that is the only field of interest of a map, as `reader` past its head. */
static int open_array(const uint8_t *at, const uint8_t *end, const char *name, botsp_reader *reader, size_t *n)
{
    const uint8_t *found;
    botsp_item item;
    if (at == NULL)
        return 0;
    reader->at = at;
    reader->end = end;
    if (!botsp_index(reader, &name, 1, &found) || found == NULL)
        return 0;
    reader->at = found;
    if (!botsp_next(reader, &item) || item.kind != BOTSP_ARRAY || item.length > BOTS_MAX_FEATURES)
        return 0;
    *n = item.length;
    return 1;
}

/* Name and range, which features and components of actions have both. Their names are identifiers in most languages. */
static int read_range(const uint8_t *const *found, const uint8_t *end, char name[65], double *low, double *high)
{
    return read_name(found[0], end, name) && name[0] >= 'a' && name[0] <= 'z' && strchr(name, '-') == NULL
        && read_number(found[1], end, -FLT_MAX, FLT_MAX, low)
        && read_number(found[2], end, -FLT_MAX, FLT_MAX, high) && *low < *high;
}

static int is_new(const bots_feature *features, size_t n)
{
    size_t i;
    for (i = 0; i < n; i++)
        if (strcmp(features[i].name, features[n].name) == 0)
            return 0;
    return 1;
}

static bots_status read_features(bots_client *client, const uint8_t *at, const uint8_t *end)
{
    static const char *const names[] = {"name", "low", "high", "size", "cost_us"};
    bots_welcome *welcome = &client->welcome;
    bots_feature *features;
    uint32_t *costly;
    botsp_reader reader;
    const uint8_t *found[5];
    size_t i;
    if (!open_array(at, end, "features", &reader, &welcome->n_features) || welcome->n_features < 1)
        return BOTS_BAD_REPLY;
    if (!botsp_grow(&client->memory, &client->features, welcome->n_features * sizeof *features)
        || !botsp_grow(&client->memory, &client->costly, welcome->n_features * sizeof *costly))
        return BOTS_NO_MEMORY;
    features = client->features.bytes;
    costly = client->costly.bytes;
    for (i = 0; i < welcome->n_features; i++) {
        int64_t size;
        if (!botsp_index(&reader, names, 5, found)
            || !read_range(found, end, features[i].name, &features[i].low, &features[i].high) || !is_new(features, i)
            || !read_integer(found[3], end, 1, &size) || size > BOTS_MAX_FEATURE_SIZE
            || !read_number(found[4], end, 0.0, MAX_COST_US, &features[i].cost_us))
            return BOTS_BAD_REPLY;
        features[i].size = (uint32_t)size;
        if (features[i].cost_us == 0.0) {
            welcome->n_free += features[i].size;
        } else {
            costly[welcome->n_queries++] = (uint32_t)i;
            welcome->n_costly += features[i].size;
        }
    }
    welcome->features = features;
    welcome->costly = costly;
    return BOTS_OK;
}

static bots_status read_components(bots_client *client, const uint8_t *at, const uint8_t *end)
{
    static const char *const names[] = {"name", "low", "high", "safe"};
    bots_component *components;
    botsp_reader reader;
    const uint8_t *found[4];
    size_t i, n;
    if (!open_array(at, end, "components", &reader, &n) || n < 1)
        return BOTS_BAD_REPLY;
    if (!botsp_grow(&client->memory, &client->components, n * sizeof *components))
        return BOTS_NO_MEMORY;
    components = client->components.bytes;
    for (i = 0; i < n; i++)
        if (!botsp_index(&reader, names, 4, found)
            || !read_range(found, end, components[i].name, &components[i].low, &components[i].high)
            || !read_number(found[3], end, components[i].low, components[i].high, &components[i].safe))
            return BOTS_BAD_REPLY;
    client->welcome.components = components;
    client->welcome.n_actions = n;
    return BOTS_OK;
}

static bots_status read_costs(bots_client *client, const uint8_t *at, const uint8_t *end)
{
    static const char *const name = "call_us";
    const uint8_t *found;
    botsp_reader reader;
    double *feature_us;
    size_t i, n;
    if (!open_array(at, end, "feature_us", &reader, &n) || n != client->welcome.n_queries)
        return BOTS_BAD_REPLY;
    if (!botsp_grow(&client->memory, &client->feature_us, n * sizeof *feature_us))
        return BOTS_NO_MEMORY;
    feature_us = client->feature_us.bytes;
    for (i = 0; i < n; i++)
        if (!botsp_number(&reader, &feature_us[i]) || feature_us[i] < 0.0 || feature_us[i] > MAX_COST_US)
            return BOTS_BAD_REPLY;
    client->welcome.feature_us = feature_us;
    reader.at = at;
    return botsp_index(&reader, &name, 1, &found)
            && read_number(found, end, 0.0, MAX_COST_US, &client->welcome.call_us) ? BOTS_OK : BOTS_BAD_REPLY;
}

int botsp_read_version(bots_client *client, const uint8_t *version, const uint8_t *sha256, const uint8_t *end)
{
    client->welcome.bundle_version = 0;
    client->welcome.bundle_sha256[0] = '\0';
    return (is_absent(version, end) || read_integer(version, end, 1, &client->welcome.bundle_version))
        && (is_absent(sha256, end) || read_name(sha256, end, client->welcome.bundle_sha256));
}

static int read_limits(bots_welcome *welcome, const uint8_t *const *found, const uint8_t *end)
{
    welcome->has_target_costs = found[TARGET_COST_US] != NULL;
    welcome->has_deadlines = found[DEADLINE_US] != NULL;
    return read_number(found[BUDGET_US], end, 0.0, DBL_MAX, &welcome->budget_us)
        && read_integer(found[CONTEXT_LENGTH], end, 1, &welcome->context_length)
        && read_integer(found[MAX_BOTS], end, 0, &welcome->max_bots)
        && read_integer(found[MAX_BODY_BYTES], end, 0, &welcome->max_body_bytes)
        && read_optional(found[TARGET_COST_US], end, 0.0, DBL_MAX, &welcome->target_cost_us)
        && read_optional(found[COST_QUANTILE], end, 0.0, 1.0, &welcome->cost_quantile)
        && read_optional(found[DEADLINE_US], end, 0.0, DBL_MAX, &welcome->deadline_us)
        && read_optional(found[TARGET_RETURN], end, -DBL_MAX, DBL_MAX, &welcome->target_return)
        && (is_absent(found[REPLAY_FRAMES], end)
            || read_integer(found[REPLAY_FRAMES], end, 1, &welcome->replay_frames));
}

bots_status botsp_read_welcome(bots_client *client, botsp_reader reply)
{
    const uint8_t *found[N_FIELDS], *end = reply.end;
    bots_welcome *welcome = &client->welcome;
    bots_status status;
    memset(welcome, 0, sizeof *welcome);
    if (!botsp_index(&reply, FIELDS, N_FIELDS, found) || !read_name(found[CONNECTION], end, welcome->connection)
        || !read_name(found[BUNDLE], end, welcome->bundle) || !read_limits(welcome, found, end)
        || !botsp_read_version(client, found[BUNDLE_VERSION], found[BUNDLE_SHA256], end))
        return BOTS_BAD_REPLY;
    status = read_features(client, found[FEATURES], end);
    if (status == BOTS_OK)
        status = read_components(client, found[ACTION], end);
    return status == BOTS_OK ? read_costs(client, found[COST_MODEL], end) : status;
}
