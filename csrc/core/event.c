/* SPDX-License-Identifier: MIT
 *
 * A ring of events between one putting and one taking thread, in the caller's block.
 *
 * The putter never looks at the taker: it overwrites the oldest event. Every slot tells by a sequence which event it
 * holds and whether that is whole, so the taker notices that it was overrun, before or while it copied, and goes on
 * with the next one. Whoever fails to copy an event has lost it for good; nobody waits.
 */
#include <stdatomic.h>
#include <stdint.h>
#include <string.h>

#include "dpmaster/event.h"

#define WORDS (sizeof(dpm_event) / sizeof(uint32_t))

_Static_assert(sizeof(dpm_event) % sizeof(uint32_t) == 0, "an event is copied in words");
_Static_assert(ATOMIC_INT_LOCK_FREE == 2 && sizeof(unsigned) == sizeof(uint32_t), "an event is copied in words");

/* The words are atomic because the two threads may meet in a slot. Each is released and acquired, so whoever reads
 * a word of a newer event also sees the sequence that announced it. */
typedef struct slot {
    atomic_uint sequence; /* 2 n: event n is whole; 2 n - 1: it is being written; modulo 2^32 */
    atomic_uint words[WORDS];
} slot;

struct dpm_ring {
    uint32_t events;
    atomic_uint put;      /* number of the last event, modulo 2^32 */
    uint64_t last_put;    /* putter's: the same, whole */
    uint64_t last_taken;  /* taker's: number of the last event it has seen or skipped */
    slot slots[];
};

size_t dpm_ring_size(uint32_t events)
{
    if (events < 2 || events > 65536 || (events & (events - 1)))
        return 0;
    return sizeof(dpm_ring) + events * sizeof(slot);
}

dpm_ring *dpm_ring_init(void *block, size_t size, uint32_t events)
{
    size_t needed = dpm_ring_size(events);
    if (!block || !needed || size < needed || (uintptr_t)block % 16)
        return NULL;
    dpm_ring *ring = block;
    memset(ring, 0, needed);
    ring->events = events;
    return ring;
}

void dpm_ring_put(dpm_ring *ring, const dpm_event *event)
{
    uint32_t words[WORDS];
    dpm_event numbered = *event;
    numbered.number = ++ring->last_put;
    memcpy(words, &numbered, sizeof words);

    uint32_t n = (uint32_t)ring->last_put;
    slot *place = &ring->slots[n & (ring->events - 1)];
    atomic_store_explicit(&place->sequence, 2 * n - 1, memory_order_relaxed);
    for (size_t i = 0; i < WORDS; i++)
        atomic_store_explicit(&place->words[i], words[i], memory_order_release);
    atomic_store_explicit(&place->sequence, 2 * n, memory_order_release);
    atomic_store_explicit(&ring->put, n, memory_order_release);
}

/* Copy event n, unless its slot holds, or comes to hold, another one. */
static bool slot_copy(const dpm_ring *ring, uint32_t n, dpm_event *event)
{
    const slot *place = &ring->slots[n & (ring->events - 1)];
    uint32_t words[WORDS];
    if (atomic_load_explicit(&place->sequence, memory_order_acquire) != 2 * n)
        return false;
    for (size_t i = 0; i < WORDS; i++)
        words[i] = atomic_load_explicit(&place->words[i], memory_order_acquire);
    if (atomic_load_explicit(&place->sequence, memory_order_relaxed) != 2 * n)
        return false;
    memcpy(event, words, sizeof words);
    return true;
}

int dpm_ring_take(dpm_ring *ring, dpm_event *event, uint64_t *lost)
{
    for (uint32_t n = (uint32_t)ring->last_taken + 1;; n++) {
        uint32_t left = atomic_load_explicit(&ring->put, memory_order_acquire) - (n - 1);
        if (left == 0)
            return 0;
        if (left > ring->events)
            n += left - ring->events;
        if (slot_copy(ring, n, event)) {
            *lost += event->number - ring->last_taken - 1;
            ring->last_taken = event->number;
            return 1;
        }
    }
}
