/* Buffers that only grow, through the engine's own allocator where it gave one. Internal. */
#ifndef BOTS_MEMORY_H
#define BOTS_MEMORY_H

#include <stddef.h>

typedef struct botsp_memory {
    void *(*resize)(void *context, void *memory, size_t bytes);
    void *context;
} botsp_memory;

typedef struct botsp_buffer {
    void *bytes;
    size_t capacity;
} botsp_buffer;

/* At least so many bytes, what was there kept. 0: there is no memory, and the buffer is as it was. */
int botsp_grow(const botsp_memory *memory, botsp_buffer *buffer, size_t bytes);
void botsp_free(const botsp_memory *memory, botsp_buffer *buffer);
/* The C library's. */
void *botsp_resize(void *context, void *memory, size_t bytes);

#endif
