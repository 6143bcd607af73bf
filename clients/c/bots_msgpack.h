/* As much msgpack as the protocol needs: one item at a time, in place, no recursion, no allocation by what is claimed.
 * This file knows nothing about messages or sockets. Internal: engines include bots.h alone. */
#ifndef BOTS_MSGPACK_H
#define BOTS_MSGPACK_H

#include <stddef.h>
#include <stdint.h>

#include "bots_memory.h"

typedef enum botsp_kind {
    BOTSP_NIL,
    BOTSP_BOOL,
    BOTSP_INTEGER, /* what int64_t holds */
    BOTSP_FLOAT,
    BOTSP_TEXT,
    BOTSP_BINARY,
    BOTSP_ARRAY,
    BOTSP_MAP,
    BOTSP_OTHER /* integers beyond, ext */
} botsp_kind;

typedef struct botsp_item {
    botsp_kind kind;
    int64_t integer; /* of BOOL and INTEGER */
    double number;   /* of INTEGER and FLOAT */
    size_t length;   /* bytes of TEXT and BINARY, entries of ARRAY and MAP */
    const uint8_t *bytes;
} botsp_item;

typedef struct botsp_reader {
    const uint8_t *at, *end;
} botsp_reader;

/* The next item, of an array or a map its head alone. 0: malformed, truncated, or claims more than there are bytes. */
int botsp_next(botsp_reader *reader, botsp_item *item);
/* The next item with all that is in it. 0 as above. */
int botsp_skip(botsp_reader *reader);
/* Where in the map at `reader` the values of these names begin: `found` [n], NULL for what is absent. Moves past the
 * map. Unknown names are ignored, of a name that comes twice the last counts. 0: no well-formed map with text keys. */
int botsp_index(botsp_reader *reader, const char *const *names, size_t n, const uint8_t **found);
/* One item of one kind, at `at` before `end`. 0: absent or something else. */
int botsp_read(const uint8_t *at, const uint8_t *end, botsp_kind kind, botsp_item *item);
/* A finite number, float or integer. 0: something else. */
int botsp_number(botsp_reader *reader, double *number);
/* An integer within low to high. 0: something else. */
int botsp_integer(botsp_reader *reader, int64_t low, int64_t high, int64_t *integer);
/* A little-endian float32. */
float botsp_float32(const uint8_t *bytes);

/* Grows its buffer; once it could not, `is_full` stays set and nothing more is written. */
typedef struct botsp_writer {
    botsp_buffer *buffer;
    const botsp_memory *memory;
    size_t size;
    int is_full;
} botsp_writer;

/* Room for so many bytes, already counted as written; NULL where there is none. */
uint8_t *botsp_room(botsp_writer *writer, size_t bytes);
void botsp_put_text(botsp_writer *writer, const char *text);
void botsp_put_integer(botsp_writer *writer, int64_t integer); /* not negative */
void botsp_put_number(botsp_writer *writer, double number);
void botsp_put_integers(botsp_writer *writer, const int64_t *integers, size_t n);
void botsp_put_numbers(botsp_writer *writer, const double *numbers, size_t n);
/* The head of a binary of so many bytes, which are to follow. */
void botsp_put_binary(botsp_writer *writer, size_t bytes);
void botsp_put_float32(uint8_t *bytes, float number);

#endif
