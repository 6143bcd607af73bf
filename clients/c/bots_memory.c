#include "bots_memory.h"

#include <stdint.h>
#include <stdlib.h>

#define LEAST_BYTES 256

void *botsp_resize(void *context, void *memory, size_t bytes)
{
    (void)context;
    if (bytes == 0) {
        free(memory);
        return NULL;
    }
    return realloc(memory, bytes);
}

int botsp_grow(const botsp_memory *memory, botsp_buffer *buffer, size_t bytes)
{
    size_t capacity = buffer->capacity > SIZE_MAX / 2 ? SIZE_MAX : 2 * buffer->capacity;
    void *grown;
    if (bytes <= buffer->capacity && buffer->bytes != NULL)
        return 1;
    if (capacity < bytes)
        capacity = bytes;
    if (capacity < LEAST_BYTES)
        capacity = LEAST_BYTES;
    grown = memory->resize(memory->context, buffer->bytes, capacity);
    if (grown == NULL)
        return 0;
    buffer->bytes = grown;
    buffer->capacity = capacity;
    return 1;
}

void botsp_free(const botsp_memory *memory, botsp_buffer *buffer)
{
    if (buffer->bytes != NULL)
        memory->resize(memory->context, buffer->bytes, 0);
    buffer->bytes = NULL;
    buffer->capacity = 0;
}
