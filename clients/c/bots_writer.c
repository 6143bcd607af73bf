/* Writing msgpack, each integer and length as short as it goes: byte for byte what protocol/client.py sends. */
#include <string.h>

#include "bots_msgpack.h"

uint8_t *botsp_room(botsp_writer *writer, size_t bytes)
{
    uint8_t *room;
    if (writer->is_full || bytes > SIZE_MAX - writer->size
        || !botsp_grow(writer->memory, writer->buffer, writer->size + bytes)) {
        writer->is_full = 1;
        return NULL;
    }
    room = (uint8_t *)writer->buffer->bytes + writer->size;
    writer->size += bytes;
    return room;
}

static void put(botsp_writer *writer, uint8_t head, uint64_t value, size_t n)
{
    uint8_t *room = botsp_room(writer, n + 1);
    if (room == NULL)
        return;
    room[0] = head;
    for (; n > 0; n--) {
        room[n] = (uint8_t)value;
        value >>= 8;
    }
}

void botsp_put_text(botsp_writer *writer, const char *text)
{
    size_t length = strlen(text);
    uint8_t *room;
    if (length < 32)
        put(writer, (uint8_t)(0xa0 | length), 0, 0);
    else if (length < 256)
        put(writer, 0xd9, length, 1);
    else if (length < 65536)
        put(writer, 0xda, length, 2);
    else
        put(writer, 0xdb, length, 4);
    room = botsp_room(writer, length);
    if (room != NULL)
        memcpy(room, text, length);
}

void botsp_put_integer(botsp_writer *writer, int64_t integer)
{
    uint64_t value = (uint64_t)integer;
    if (value < 128)
        put(writer, (uint8_t)value, 0, 0);
    else if (value < 256)
        put(writer, 0xcc, value, 1);
    else if (value < 65536)
        put(writer, 0xcd, value, 2);
    else if (value <= UINT32_MAX)
        put(writer, 0xce, value, 4);
    else
        put(writer, 0xcf, value, 8);
}

void botsp_put_number(botsp_writer *writer, double number)
{
    uint64_t bits;
    memcpy(&bits, &number, sizeof bits);
    put(writer, 0xcb, bits, 8);
}

static void put_array(botsp_writer *writer, size_t n)
{
    if (n < 16)
        put(writer, (uint8_t)(0x90 | n), 0, 0);
    else if (n < 65536)
        put(writer, 0xdc, n, 2);
    else
        put(writer, 0xdd, n, 4);
}

void botsp_put_integers(botsp_writer *writer, const int64_t *integers, size_t n)
{
    size_t i;
    put_array(writer, n);
    for (i = 0; i < n; i++)
        botsp_put_integer(writer, integers[i]);
}

void botsp_put_numbers(botsp_writer *writer, const double *numbers, size_t n)
{
    size_t i;
    put_array(writer, n);
    for (i = 0; i < n; i++)
        botsp_put_number(writer, numbers[i]);
}

void botsp_put_binary(botsp_writer *writer, size_t bytes)
{
    if (bytes < 256)
        put(writer, 0xc4, bytes, 1);
    else if (bytes < 65536)
        put(writer, 0xc5, bytes, 2);
    else
        put(writer, 0xc6, bytes, 4);
}

void botsp_put_float32(uint8_t *bytes, float number)
{
    uint32_t bits;
    memcpy(&bits, &number, sizeof bits);
    bytes[0] = (uint8_t)bits;
    bytes[1] = (uint8_t)(bits >> 8);
    bytes[2] = (uint8_t)(bits >> 16);
    bytes[3] = (uint8_t)(bits >> 24);
}
