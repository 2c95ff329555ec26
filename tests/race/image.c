/* SPDX-License-Identifier: MIT
 *
 * Two threads at one image and at one dpm_outputs, as fast as they can. Built and judged by tests/test_image.py, under
 * the thread sanitizer where there is one. The source is included, so that a commit's epoch can be read beside it.
 */
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>

#include "../../csrc/core/image.c"

#define REQUIRE(condition) \
    ((condition) ? (void)0 : (printf("%s:%d: %s\n", __FILE__, __LINE__, #condition), exit(1)))

#define PUTS 100000
#define COMMITS 200000
#define EPOCHS 2000

static uint32_t draw(uint32_t *seed)
{
    *seed ^= *seed << 13;
    *seed ^= *seed >> 17;
    return *seed ^= *seed << 5;
}

static void require_uniform(const dpm_frame *frame, uint8_t octet)
{
    for (unsigned i = 0; i < frame->length; i++)
        REQUIRE(frame->octets[i] == octet);
}

/* Frames of octets that all equal the number: the reader never sees a mix, numbers never run backwards, the last
 * frame arrives. */
static void *image_writer(void *image)
{
    dpm_frame frame = {0};
    for (uint64_t n = 1; n <= PUTS; n++) {
        frame.length = DPM_IO_MAX;
        frame.time = (int64_t)n;
        memset(frame.octets, (uint8_t)n, sizeof frame.octets);
        REQUIRE(dpm_image_put(image, &frame) == n);
        if (n % 64 == 0)
            sched_yield();
    }
    return NULL;
}

static void *image_reader(void *image)
{
    for (uint64_t last = 0; last < PUTS;) {
        const dpm_frame *frame = dpm_image_get(image);
        REQUIRE(frame->number >= last && frame->time == (int64_t)frame->number);
        require_uniform(frame, (uint8_t)frame->number);
        last = frame->number;
    }
    return NULL;
}

static dpm_outputs *outputs;
static atomic_bool over;
static uint32_t seeds[2];

/* What happened, per commit; each array has one writer and is compared when both threads are gone. */
static uint32_t committed[COMMITS + 1]; /* epoch; application */
static int verdict[COMMITS + 1];        /* of was_sent while its epoch was the last or the one before; application */
static uint32_t answered[COMMITS + 1];  /* epoch, 0 none; bus */
static unsigned zeros;                  /* frames sent without a commit; bus */

static void ask(uint64_t number)
{
    int now = dpm_outputs_was_sent(outputs, number);
    REQUIRE(now == 0 || now == 1 || now == DPM_E_DISCARDED);
    REQUIRE(verdict[number] == 0 || verdict[number] == now); /* what was said once stays */
    verdict[number] = now;
}

static void *application(void *unused)
{
    uint64_t last = 0;
    while (!atomic_load(&over)) {
        uint8_t octets[8];
        memset(octets, (uint8_t)(last + 1), sizeof octets);
        int64_t number = last < COMMITS ? dpm_outputs_commit(outputs, 0, octets, sizeof octets, 0) : DPM_E_LATCHED;
        if (number > 0) {
            REQUIRE(number == (int64_t)++last);
            committed[last] = outputs->shadow.epoch;
        } else {
            REQUIRE(number == DPM_E_LATCHED);
        }
        if (last)
            ask(last);
        uint64_t back = last ? last - draw(&seeds[0]) % (last < 20 ? last : 20) : 0;
        if (back && committed[back] + 1 >= outputs->shadow.epoch)
            ask(back);
        if (draw(&seeds[0]) % 8 == 0)
            sched_yield();
    }
    return unused;
}

/* The answer to what is under way comes in time, or too late to count. */
static void make_safe(uint32_t epoch, bool latch)
{
    uint64_t under_way = dpm_outputs_take(outputs)->number;
    if (draw(&seeds[1]) % 2) {
        dpm_outputs_answered(outputs, under_way);
        answered[under_way] = epoch;
    }
    dpm_outputs_make_safe(outputs, latch);
    dpm_outputs_answered(outputs, under_way);
}

static void *bus(void *unused)
{
    uint64_t highest = 0;
    bool latched = false;
    for (uint32_t epoch = 1; epoch < EPOCHS; epoch++) {
        for (unsigned left = draw(&seeds[1]) % 20; left; left--) {
            const dpm_frame *frame = dpm_outputs_take(outputs);
            REQUIRE(frame->epoch == epoch && frame->length == 8); /* nothing stale once make_safe has returned */
            REQUIRE(!latched || !frame->number);
            require_uniform(frame, (uint8_t)frame->number);
            zeros += frame->number == 0;
            if (frame->number) {
                REQUIRE(frame->number >= highest);
                highest = frame->number;
            }
            if (draw(&seeds[1]) % 4) {
                dpm_outputs_answered(outputs, frame->number);
                answered[frame->number] = epoch;
            }
            sched_yield();
        }
        if (latched)
            dpm_outputs_unlatch(outputs);
        latched = draw(&seeds[1]) % 4 == 0;
        make_safe(epoch, latched);
    }
    atomic_store(&over, true);
    return unused;
}

static void *block(size_t size)
{
    void *memory = aligned_alloc(16, (size + 15) / 16 * 16);
    REQUIRE(memory);
    return memory;
}

static void run(void *(*one)(void *), void *(*other)(void *), void *argument)
{
    pthread_t threads[2];
    REQUIRE(!pthread_create(&threads[0], NULL, one, argument));
    REQUIRE(!pthread_create(&threads[1], NULL, other, argument));
    REQUIRE(!pthread_join(threads[0], NULL) && !pthread_join(threads[1], NULL));
}

/* Nothing was wrong, but on a busy machine one thread may be through before the other has begun: run it again. */
#define TOO_LITTLE 75

int main(int argc, char **argv)
{
    REQUIRE(argc == 2);
    seeds[0] = (uint32_t)strtoul(argv[1], NULL, 10) | 1;
    seeds[1] = ~seeds[0] | 2;
    run(image_writer, image_reader, dpm_image_init(block(dpm_image_size()), dpm_image_size()));

    outputs = dpm_outputs_init(block(dpm_outputs_size()), dpm_outputs_size(), 8);
    run(application, bus, NULL);
    /* The truth, from the back: the last answered epoch seen at or after a commit decides it, as numbers rise with
     * epochs. */
    uint32_t carried = 0;
    unsigned sent = 0, discarded = 0;
    for (uint64_t n = outputs->image.number; n; n--) {
        if (answered[n])
            carried = answered[n];
        if (verdict[n])
            REQUIRE((verdict[n] == 1) == (carried == committed[n]));
        sent += verdict[n] == 1;
        discarded += verdict[n] < 0;
    }
    printf("%llu commits, %u sent, %u discarded, %u times zeros\n", (unsigned long long)outputs->image.number, sent,
           discarded, zeros);
    return sent && discarded && zeros ? 0 : TOO_LITTLE;
}
