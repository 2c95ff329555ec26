/* SPDX-License-Identifier: MIT
 *
 * A putter and a taker at one ring, as fast as they can. Built and judged by tests/test_event.py, under the thread
 * sanitizer where there is one.
 */
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>

#include "../../csrc/core/event.c"

#define REQUIRE(condition) \
    ((condition) ? (void)0 : (printf("%s:%d: %s\n", __FILE__, __LINE__, #condition), exit(1)))

#define PUTS 100000

static void *putter(void *ring)
{
    for (uint32_t n = 1; n <= PUTS; n++) {
        dpm_event event = {.time = n, .kind = (uint16_t)n, .address = (int16_t)n, .a = (int32_t)n, .b = (int32_t)n, .value = n};
        dpm_ring_put(ring, &event);
        if (n % 64 == 0)
            sched_yield();
    }
    return NULL;
}

static void *taker(void *ring)
{
    uint64_t lost = 0, taken = 0;
    dpm_event event = {0};
    while (event.number < PUTS) {
        uint64_t last = event.number;
        if (!dpm_ring_take(ring, &event, &lost))
            continue;
        taken++;
        uint64_t n = event.number;
        REQUIRE(n > last && n == taken + lost);
        REQUIRE(event.time == (int64_t)n && event.value == (int64_t)n && event.a == (int32_t)n && event.b == (int32_t)n);
        REQUIRE(event.kind == (uint16_t)n && event.address == (int16_t)n);
    }
    printf("%llu taken, %llu lost\n", (unsigned long long)taken, (unsigned long long)lost);
    REQUIRE(taken + lost == PUTS);
    return NULL;
}

int main(int argc, char **argv)
{
    REQUIRE(argc == 2);
    uint32_t events = (uint32_t)strtoul(argv[1], NULL, 10);
    size_t size = (dpm_ring_size(events) + 15) / 16 * 16;
    dpm_ring *ring = dpm_ring_init(aligned_alloc(16, size), size, events);
    REQUIRE(ring);
    pthread_t threads[2];
    REQUIRE(!pthread_create(&threads[0], NULL, putter, ring) && !pthread_create(&threads[1], NULL, taker, ring));
    REQUIRE(!pthread_join(threads[0], NULL) && !pthread_join(threads[1], NULL));
    return 0;
}
