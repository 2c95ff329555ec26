/* SPDX-License-Identifier: MIT
 *
 * A master and a slave, each on its own bus thread and pty, joined by a relay, exchanging data while every call of the
 * library to the allocator is counted (linked with --wrap). Prints "exchanges allocations" of the time after start.
 * With an argument it allocates once itself, to show that the count counts.
 */
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "dpmaster/bus.h"
#include "dpmaster/error.h"

enum { EXCHANGES = 3000 };
#define SECOND INT64_C(1000000000)

static atomic_uint allocations;
static atomic_bool ending;

void *__real_malloc(size_t size);
void *__real_calloc(size_t n, size_t size);
void *__real_realloc(void *block, size_t size);
void *__real_aligned_alloc(size_t alignment, size_t size);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t n, size_t size);
void *__wrap_realloc(void *block, size_t size);
void *__wrap_aligned_alloc(size_t alignment, size_t size);

void *__wrap_malloc(size_t size)
{
    allocations++;
    return __real_malloc(size);
}

void *__wrap_calloc(size_t n, size_t size)
{
    allocations++;
    return __real_calloc(n, size);
}

void *__wrap_realloc(void *block, size_t size)
{
    allocations++;
    return __real_realloc(block, size);
}

void *__wrap_aligned_alloc(size_t alignment, size_t size)
{
    allocations++;
    return __real_aligned_alloc(alignment, size);
}

static void *block(size_t size)
{
    void *memory = aligned_alloc(16, (size + 15) / 16 * 16);
    return memory ? memset(memory, 0, size) : NULL;
}

static void must(int code, const char *what)
{
    if (code < 0) {
        fprintf(stderr, "%s: %s\n", what, dpm_strerror(code));
        exit(1);
    }
}

static int far_ends[2];

static void *relay(void *context)
{
    struct pollfd fds[2] = {{far_ends[0], POLLIN, 0}, {far_ends[1], POLLIN, 0}};
    uint8_t octets[512];
    while (!ending && poll(fds, 2, 50) >= 0) {
        for (int i = 0; i < 2; i++) {
            ssize_t n = fds[i].revents & POLLIN ? read(far_ends[i], octets, sizeof octets) : 0;
            if (n > 0 && write(far_ends[!i], octets, (size_t)n) < 0)
                return context;
        }
    }
    return NULL;
}

static dpm_bus *open_bus(int *far)
{
    dpm_port_config config = {.rate_num = 500000, .rate_den = 1, .pace = DPM_PACE_NONE, .allowance = SECOND / 10};
    dpm_bus *bus;
    *far = posix_openpt(O_RDWR | O_NOCTTY);
    if (*far < 0 || grantpt(*far) < 0 || unlockpt(*far) < 0)
        must(DPM_E_SYSTEM, "pty");
    config.path = ptsname(*far);
    must(dpm_bus_open(block(dpm_bus_size()), dpm_bus_size(), &config, &bus), "dpm_bus_open");
    return bus;
}

static dpm_image *image(void)
{
    return dpm_image_init(block(dpm_image_size()), dpm_image_size());
}

static void start_slave(dpm_bus *bus, const dpm_parameters *parameters)
{
    dpm_port_traits traits;
    dpm_slaves *slaves;
    dpm_slave_config config = {.address = 5, .ident_number = 0x1234, .configurations = 1, .configuration_length = {1},
                               .configuration = {{0x31}}, .user_parameters_max = 237, .max_diagnosis = 32,
                               .min_tsdr = 11};
    dpm_bus_get_traits(bus, &traits);
    must(dpm_slaves_init(block(dpm_slaves_size(1)), dpm_slaves_size(1), parameters, &traits, 1, &slaves),
         "dpm_slaves_init");
    must(dpm_slaves_add(slaves, &config, image(), image()), "dpm_slaves_add");
    must(dpm_bus_start_slaves(bus, slaves), "dpm_bus_start_slaves");
}

static dpm_outputs *start_master(dpm_bus *bus, const dpm_parameters *parameters)
{
    dpm_master *master;
    dpm_master_config config = {.station = {.parameters = *parameters, .address = 1}, .slaves = 1,
                                .data_control_time = SECOND / 3, .data_retries = -1};
    dpm_slave_set set = {.address = 5, .ident_number = 0x1234, .configuration = {0x31}, .configuration_length = 1,
                         .active = true, .min_tsdr = 11, .min_slave_interval = 1};
    dpm_outputs *outputs = dpm_outputs_init(block(dpm_outputs_size()), dpm_outputs_size(), 2);
    dpm_bus_get_traits(bus, &config.station.traits);
    must(dpm_master_init(block(dpm_master_size(1)), dpm_master_size(1), &config, &master), "dpm_master_init");
    must(dpm_bus_start(bus, dpm_master_machine(master), master), "dpm_bus_start");
    must(dpm_bus_add(bus, &set, outputs, image()), "dpm_bus_add");
    return outputs;
}

/* What a program does: commits, waits, reads facts, takes events. */
static uint64_t exchange(dpm_bus *bus, dpm_outputs *outputs, dpm_ring *ring)
{
    dpm_slave_status status = {0};
    dpm_master_status master;
    dpm_bus_info info;
    dpm_event event;
    uint64_t lost;
    int64_t end = dpm_now() + 60 * SECOND;
    must(dpm_bus_set_mode(bus, DPM_MODE_OPERATE), "dpm_bus_set_mode");
    while (status.statistics.exchanges < EXCHANGES && dpm_now() < end) {
        uint32_t seen = dpm_bus_progress(bus);
        uint8_t octets[2] = {(uint8_t)seen, 0x55};
        (void)dpm_outputs_commit(outputs, 0, octets, 2, dpm_now());
        must(dpm_bus_get_slave(bus, 0, &status), "dpm_bus_get_slave");
        must(dpm_bus_get_status(bus, &master), "dpm_bus_get_status");
        must(dpm_bus_get_info(bus, &info), "dpm_bus_get_info");
        while (dpm_ring_take(ring, &event, &lost))
            continue;
        (void)dpm_bus_wait(bus, seen, SECOND / 10);
    }
    return status.statistics.exchanges;
}

int main(int argc, char **argv)
{
    (void)argv;
    dpm_parameters parameters;
    pthread_t thread;
    must(dpm_parameters_default(&parameters, 500000, 0), "dpm_parameters_default");
    dpm_bus *master_bus = open_bus(&far_ends[0]), *slave_bus = open_bus(&far_ends[1]);
    dpm_ring *ring = dpm_ring_init(block(dpm_ring_size(16)), dpm_ring_size(16), 16);
    int event_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    pthread_create(&thread, NULL, relay, NULL);
    start_slave(slave_bus, &parameters);
    dpm_outputs *outputs = start_master(master_bus, &parameters);

    allocations = 0;
    must(dpm_bus_subscribe(master_bus, ring, event_fd), "dpm_bus_subscribe");
    uint64_t exchanges = exchange(master_bus, outputs, ring);
    void *own = argc > 1 ? malloc(1) : NULL;
    /* The port goes as well: losing it and looking for it are part of a program's life. */
    ending = true;
    pthread_join(thread, NULL);
    close(far_ends[0]);
    struct pollfd events = {event_fd, POLLIN, 0};
    (void)poll(&events, 1, 5000);
    dpm_bus_close(master_bus);
    dpm_bus_close(slave_bus);
    printf("%llu %u\n", (unsigned long long)exchanges, allocations);
    free(own);
    return 0;
}
