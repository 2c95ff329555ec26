/* SPDX-License-Identifier: MIT
 *
 * The process image: frames between two threads through three buffers, and the epoch that keeps outputs safe.
 *
 * Touches only the caller's block. Each side owns one buffer, the third lies in `middle`, and both sides swap theirs
 * with it in one atomic step: nobody waits, nobody sees half of a frame, and the newest frame wins. Every atomic here
 * is an unsigned int, so no target needs libatomic, where an operation could hide a lock.
 */
#include <stdatomic.h>
#include <stdint.h>
#include <string.h>

#include "dpmaster/error.h"
#include "dpmaster/image.h"

_Static_assert(ATOMIC_INT_LOCK_FREE == 2, "the bus thread must never wait for a lock inside an atomic");
_Static_assert(sizeof(unsigned) >= sizeof(uint32_t), "numbers are split into halves of 32 bits");

#define FRESH 4u /* mark beside the buffer's index in `middle`: the reader has not had this one */
#define INDEX 3u

struct dpm_image {
    dpm_frame buffers[3];
    atomic_uint middle;
    unsigned back;   /* writer's */
    uint64_t number; /* writer's: of the last frame put */
    unsigned front;  /* reader's */
};

static bool block_fits(const void *block, size_t size, size_t needed)
{
    return block && size >= needed && (uintptr_t)block % 16 == 0;
}

static void image_clear(dpm_image *image)
{
    memset(image->buffers, 0, sizeof image->buffers);
    image->front = 0;
    image->back = 1;
    image->number = 0;
    atomic_init(&image->middle, 2);
}

size_t dpm_image_size(void)
{
    return sizeof(dpm_image);
}

dpm_image *dpm_image_init(void *block, size_t size)
{
    if (!block_fits(block, size, sizeof(dpm_image)))
        return NULL;
    dpm_image *image = block;
    image_clear(image);
    return image;
}

uint64_t dpm_image_put(dpm_image *image, const dpm_frame *frame)
{
    dpm_frame *buffer = &image->buffers[image->back];
    *buffer = *frame;
    buffer->number = ++image->number;
    image->back = atomic_exchange_explicit(&image->middle, image->back | FRESH, memory_order_acq_rel) & INDEX;
    return image->number;
}

const dpm_frame *dpm_image_get(dpm_image *image)
{
    if (atomic_load_explicit(&image->middle, memory_order_relaxed) & FRESH)
        image->front = atomic_exchange_explicit(&image->middle, image->front, memory_order_acq_rel) & INDEX;
    return &image->buffers[image->front];
}

void dpm_image_read(dpm_image *image, dpm_frame *frame)
{
    *frame = *dpm_image_get(image);
}

/* A 64-bit number of one writer in 32-bit atomics (Lamport 1977): the high half is written before and after the low
 * one and read in the opposite order, so equal high halves enclose a low half that belongs to them. A reader repeats
 * only when the high half changes under it, once in 2^32 numbers. */
typedef struct number64 {
    atomic_uint high_first, low, high_last;
} number64;

static void number_store(number64 *number, uint64_t value)
{
    atomic_store_explicit(&number->high_first, (uint32_t)(value >> 32), memory_order_release);
    atomic_store_explicit(&number->low, (uint32_t)value, memory_order_release);
    atomic_store_explicit(&number->high_last, (uint32_t)(value >> 32), memory_order_release);
}

static uint64_t number_load(const number64 *number)
{
    for (;;) {
        uint32_t last = (uint32_t)atomic_load_explicit(&number->high_last, memory_order_acquire);
        uint32_t low = (uint32_t)atomic_load_explicit(&number->low, memory_order_acquire);
        if (last == (uint32_t)atomic_load_explicit(&number->high_first, memory_order_acquire))
            return (uint64_t)last << 32 | low;
    }
}

/* Epoch and latch are one word, so that a commit learns both in one load: no commit can be stamped with the epoch
 * that begins latched. */
#define LATCH 1u
#define EPOCH 2u

struct dpm_outputs {
    dpm_image image;
    atomic_uint state;  /* epoch * EPOCH, | LATCH; written by the bus */
    number64 answered;  /* the last answered commit; written by the bus, and only in the epoch of that commit */

    /* The application's. */
    dpm_frame shadow;           /* what it committed last */
    uint64_t first;             /* the first number of the shadow's epoch */
    uint64_t previous_first;    /* of the epoch before that ... */
    uint64_t previous_answered; /* ... which is over, so this is final */

    /* The bus's. */
    dpm_frame zeros;
    uint64_t taken;  /* the highest number that was handed out */
    uint64_t barred; /* up to here the numbers are of epochs that are over */
};

static uint32_t epoch_of(const dpm_outputs *outputs)
{
    return (uint32_t)atomic_load_explicit(&outputs->state, memory_order_acquire) / EPOCH;
}

size_t dpm_outputs_size(void)
{
    return sizeof(dpm_outputs);
}

dpm_outputs *dpm_outputs_init(void *block, size_t size, uint16_t length)
{
    if (!block_fits(block, size, sizeof(dpm_outputs)) || length > DPM_IO_MAX)
        return NULL;
    dpm_outputs *outputs = block;
    memset(outputs, 0, sizeof *outputs);
    image_clear(&outputs->image);
    atomic_init(&outputs->state, 1 * EPOCH);
    number_store(&outputs->answered, 0);
    outputs->first = outputs->previous_first = 1;
    outputs->shadow.epoch = 1;
    outputs->shadow.valid = true;
    outputs->shadow.length = outputs->zeros.length = length;
    return outputs;
}

/* "In a new epoch they begin as zeros." The old epoch is over: nothing of it is counted as answered after the load
 * that showed us the new one. */
static void shadow_enter(dpm_outputs *outputs, uint32_t epoch)
{
    outputs->previous_first = outputs->first;
    outputs->previous_answered = number_load(&outputs->answered);
    outputs->first = outputs->image.number + 1;
    outputs->shadow.epoch = epoch;
    memset(outputs->shadow.octets, 0, sizeof outputs->shadow.octets);
}

int64_t dpm_outputs_commit(dpm_outputs *outputs, uint16_t offset, const uint8_t *octets, uint16_t n, int64_t now)
{
    return dpm_outputs_change(outputs, offset, NULL, octets, n, now);
}

int64_t dpm_outputs_change(dpm_outputs *outputs, uint16_t offset, const uint8_t *keep, const uint8_t *octets, uint16_t n,
                           int64_t now)
{
    if (offset + n > outputs->shadow.length)
        return DPM_E_LENGTH;
    unsigned state = atomic_load_explicit(&outputs->state, memory_order_acquire);
    if (state & LATCH)
        return DPM_E_LATCHED;
    /* Should the outputs be made safe from here on, the stamp is the old epoch's and no telegram carries the commit. */
    if (outputs->shadow.epoch != state / EPOCH)
        shadow_enter(outputs, (uint32_t)(state / EPOCH));
    uint8_t *shadow = outputs->shadow.octets + offset;
    for (uint16_t i = 0; i < n; i++)
        shadow[i] = (uint8_t)((keep ? shadow[i] & keep[i] : 0) | octets[i]);
    outputs->shadow.time = now;
    return (int64_t)dpm_image_put(&outputs->image, &outputs->shadow);
}

int dpm_outputs_was_sent(const dpm_outputs *outputs, uint64_t number)
{
    if (number == 0 || number > outputs->image.number)
        return DPM_E_ARGUMENT;
    if (number < outputs->first)
        return number >= outputs->previous_first && number <= outputs->previous_answered ? 1 : DPM_E_DISCARDED;
    /* The epoch before the answer: once the epoch is over, every answer that counts is there to be seen. */
    uint32_t epoch = epoch_of(outputs);
    if (number <= number_load(&outputs->answered))
        return 1;
    return epoch == outputs->shadow.epoch ? 0 : DPM_E_DISCARDED;
}

void dpm_outputs_peek(const dpm_outputs *outputs, uint8_t *octets)
{
    if (epoch_of(outputs) == outputs->shadow.epoch)
        memcpy(octets, outputs->shadow.octets, outputs->shadow.length);
    else
        memset(octets, 0, outputs->shadow.length);
}

const dpm_frame *dpm_outputs_take(dpm_outputs *outputs)
{
    const dpm_frame *frame = dpm_image_get(&outputs->image);
    uint32_t epoch = epoch_of(outputs);
    if (frame->number == 0 || frame->epoch != epoch) {
        outputs->zeros.epoch = epoch;
        return &outputs->zeros;
    }
    outputs->taken = frame->number;
    return frame;
}

/* An answer that comes after its epoch is over does not count: the commit may have been called discarded already, and
 * that answer must not change. */
void dpm_outputs_answered(dpm_outputs *outputs, uint64_t number)
{
    if (number > outputs->barred && number <= outputs->taken && number > number_load(&outputs->answered))
        number_store(&outputs->answered, number);
}

/* The latch first: a commit that sees the new epoch must see it too. */
void dpm_outputs_make_safe(dpm_outputs *outputs, bool latch)
{
    outputs->barred = outputs->taken;
    if (latch)
        atomic_fetch_or_explicit(&outputs->state, LATCH, memory_order_acq_rel);
    atomic_fetch_add_explicit(&outputs->state, EPOCH, memory_order_acq_rel);
}

void dpm_outputs_unlatch(dpm_outputs *outputs)
{
    atomic_fetch_and_explicit(&outputs->state, ~LATCH, memory_order_acq_rel);
}
