/* SPDX-License-Identifier: MIT
 *
 * The bus thread: the loop of the event contract (dpmaster/machine.h) around one machine and one port. It may touch its
 * worker and its port; of the machines it knows their public functions.
 *
 * A port that vanishes ends nothing: the machine is told, and the thread looks twice a second whether the port is back.
 */
#include "dpmaster/bus.h"

#include <errno.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include "linux/port.h"
#include "linux/worker.h"

enum {
    SUBSCRIBERS = 7,       /* a station has eight rings, and one is ours */
    TAP_EVENTS = 4         /* whether there was one is all that counts */
};

#define RETRY INT64_C(500000000)
/* A machine whose wake lies in the past is asked again after this time only, so that nothing makes the thread spin. */
#define PATIENCE INT64_C(100000)
/* The same while there is no port. */
#define ABSENCE INT64_C(10000000)
/* Clear and unlock at the end may take so long; a second is promised for the whole close. */
#define LEAVE INT64_C(600000000)

typedef struct subscriber {
    dpm_ring *ring;
    int event_fd;
} subscriber;

struct dpm_bus {
    dpm_worker worker;
    dpm_port *port;
    dpm_machine *machine;
    dpm_master *master;      /* NULL: the machine is something else */
    dpm_slaves *slaves;
    dpm_port_traits traits;
    int port_error;
    int64_t end;             /* DPM_NEVER, or when the thread is gone at the latest */
    int64_t retry;           /* while the port is gone: when to look for it */
    bool clean;              /* the last read came back empty, and nothing was done since */
    uint32_t changes;        /* progress of our own, besides the machine's */
    uint64_t wakeups;
    /* Our own ring hears every event too: it tells when the subscribers' descriptors are due, without a look into
     * theirs, which another thread empties. NULL while nobody subscribes. */
    dpm_ring *tap;
    size_t subscribers;
    subscriber subscriber[SUBSCRIBERS];
    _Alignas(16) uint8_t tap_block[512];
    _Alignas(16) uint8_t port_block[];
};

/* ---- events ---- */

static void signal_subscribers(const dpm_bus *bus)
{
    uint64_t one = 1;
    for (size_t i = 0; i < bus->subscribers; i++) {
        /* It fails only when the counter is full, and then the descriptor is readable anyway. */
        ssize_t written = write(bus->subscriber[i].event_fd, &one, sizeof one);
        (void)written;
    }
}

static void pass_events(dpm_bus *bus)
{
    dpm_event event;
    uint64_t lost = 0;
    bool any = false;
    while (dpm_ring_take(bus->tap, &event, &lost))
        any = true;
    if (any)
        signal_subscribers(bus);
}

/* Everybody learns what became of the port. */
static void report_port(dpm_bus *bus, int error, int64_t now)
{
    dpm_event event = {.time = now, .kind = DPM_EV_PORT, .address = -1, .a = error};
    bus->port_error = error;
    bus->changes++;
    if (bus->master)
        dpm_master_port(bus->master, error == DPM_OK, now);
    for (size_t i = 0; i < bus->subscribers; i++)
        dpm_ring_put(bus->subscriber[i].ring, &event);
    signal_subscribers(bus);
}

/* ---- the loop ---- */

static void lose_port(dpm_bus *bus)
{
    int64_t now = dpm_now();
    dpm_port_lose(bus->port);
    bus->retry = now + RETRY;
    report_port(bus, DPM_E_GONE, now);
}

static void read_port(dpm_bus *bus)
{
    int n = dpm_port_read(bus->port, bus->machine);
    bus->clean = n == 0;
    if (n < 0)
        lose_port(bus);
}

static void wait_until(dpm_bus *bus, int64_t deadline)
{
    int mask = dpm_port_wait(bus->port, bus->worker.wake_fd, deadline < bus->end ? deadline : bus->end);
    bus->wakeups++;
    bus->clean = false;
    if (mask & 2)
        dpm_worker_serve(&bus->worker);
}

/* One turn with a port. A telegram goes out only straight after an empty read and a second question: what the machine
 * learns from the silence may change its mind. */
static void turn(dpm_bus *bus)
{
    dpm_offer offer = {.wake = DPM_NEVER};
    int64_t now = dpm_now();
    bus->machine->ask(bus->machine, now, &offer);
    if (offer.n && offer.not_before <= now) {
        if (!bus->clean) {
            read_port(bus);
            return;
        }
        bus->clean = false;
        if (dpm_now() > offer.not_after)
            return; /* the host went away just now: asked again, the machine drops it and says so */
        if (dpm_port_write(bus->port, bus->machine, offer.octets, offer.n) == DPM_E_GONE)
            lose_port(bus);
        return;
    }
    int64_t deadline = offer.n && offer.not_before < offer.wake ? offer.not_before : offer.wake;
    if (deadline <= now) {
        if (!bus->clean) {
            read_port(bus);
            return;
        }
        /* It waits for a silence that a port with a FIFO can vouch for only later. */
        deadline = now + PATIENCE;
    }
    wait_until(bus, deadline);
    read_port(bus);
}

/* One turn without a port: nothing comes, nothing goes, but the machine's clocks run on. */
static void turn_without_port(dpm_bus *bus)
{
    dpm_offer offer = {.wake = DPM_NEVER};
    int64_t now = dpm_now();
    if (now >= bus->retry) {
        bus->retry = now + RETRY;
        if (dpm_port_reopen(bus->port) == DPM_OK) {
            report_port(bus, DPM_OK, dpm_now());
            return;
        }
    }
    bus->machine->quiet(bus->machine, now);
    bus->machine->ask(bus->machine, now, &offer);
    int64_t deadline = offer.wake > now + ABSENCE ? offer.wake : now + ABSENCE;
    wait_until(bus, deadline < bus->retry ? deadline : bus->retry);
}

static void step(dpm_bus *bus)
{
    if (bus->port_error)
        turn_without_port(bus);
    else
        turn(bus);
    /* A machine that is never without work must not keep callers out. */
    if (atomic_load_explicit(&bus->worker.pending, memory_order_relaxed)) {
        dpm_worker_serve(&bus->worker);
        bus->clean = false;
    }
    if (bus->tap)
        pass_events(bus);
    dpm_worker_publish(&bus->worker, bus->machine->progress + bus->changes);
}

static bool online(dpm_master *master)
{
    dpm_master_status status;
    dpm_master_get_status(master, &status);
    return status.mode != DPM_MODE_OFFLINE;
}

/* Clear and unlock, whoever closes, however: a program that a second Ctrl-C hurries, or that has lost its last reference. */
static void leave(dpm_bus *bus)
{
    if (!bus->master || bus->port_error)
        return;
    bus->end = dpm_now() + LEAVE;
    dpm_master_set_mode(bus->master, DPM_MODE_OFFLINE, dpm_now());
    while (!bus->port_error && online(bus->master) && dpm_now() < bus->end)
        step(bus);
}

static void *run(void *context)
{
    dpm_bus *bus = context;
    (void)prctl(PR_SET_NAME, "dpm-bus");
    (void)prctl(PR_SET_TIMERSLACK, 1UL); /* ns; the default of 50 us would be longer than a slot time */
    while (!dpm_worker_stopping(&bus->worker))
        step(bus);
    leave(bus);
    return NULL;
}

/* ---- life ---- */

size_t dpm_bus_size(void)
{
    return sizeof(dpm_bus) + dpm_port_size();
}

int dpm_bus_open(void *block, size_t size, const dpm_port_config *config, dpm_bus **out)
{
    dpm_bus *bus = block;
    dpm_port_info info;
    if (!block || size < dpm_bus_size() || (uintptr_t)block % 16)
        return DPM_E_BLOCK;
    memset(bus, 0, sizeof *bus);
    int code = dpm_port_open(bus->port_block, dpm_port_size(), config, &bus->port);
    if (code)
        return code;
    code = dpm_worker_init(&bus->worker);
    if (code) {
        int why = errno;
        dpm_port_close(bus->port);
        errno = why;
        return code;
    }
    dpm_port_get_info(bus->port, &info);
    bus->traits = info.traits;
    bus->end = DPM_NEVER;
    *out = bus;
    return DPM_OK;
}

void dpm_bus_get_traits(const dpm_bus *bus, dpm_port_traits *traits)
{
    *traits = bus->traits;
}

static int start(dpm_bus *bus, dpm_machine *machine, dpm_master *master, dpm_slaves *slaves)
{
    if (bus->machine)
        return DPM_E_MODE;
    bus->machine = machine;
    bus->master = master;
    bus->slaves = slaves;
    int code = dpm_worker_start(&bus->worker, run, bus);
    if (code)
        bus->machine = NULL;
    return code;
}

int dpm_bus_start(dpm_bus *bus, dpm_machine *machine, dpm_master *master)
{
    return start(bus, machine, master, NULL);
}

int dpm_bus_start_slaves(dpm_bus *bus, dpm_slaves *slaves)
{
    return start(bus, dpm_slaves_machine(slaves), NULL, slaves);
}

void dpm_bus_close(dpm_bus *bus)
{
    if (!dpm_worker_stop(&bus->worker))
        return;
    dpm_port_close(bus->port);
    signal_subscribers(bus);
}

uint32_t dpm_bus_progress(const dpm_bus *bus)
{
    return atomic_load(&bus->worker.progress);
}

int dpm_bus_wait(dpm_bus *bus, uint32_t seen, int64_t timeout)
{
    return dpm_worker_wait(&bus->worker, seen, timeout);
}

int dpm_bus_realtime(dpm_bus *bus, const dpm_realtime *wish, dpm_refusals *refusals)
{
    return dpm_worker_realtime(&bus->worker, wish, refusals);
}

/* ---- calls about the bus: each runs on its thread, between two events ---- */

static int64_t thread_time(void)
{
    struct timespec time;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
    return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

static int do_info(void *object, void *argument)
{
    dpm_bus *bus = object;
    dpm_bus_info *info = argument;
    dpm_port_get_info(bus->port, &info->port);
    info->port_error = bus->port_error;
    info->cpu_time = bus->machine ? thread_time() : 0;
    info->wakeups = bus->wakeups;
    return DPM_OK;
}

int dpm_bus_get_info(dpm_bus *bus, dpm_bus_info *info)
{
    return dpm_worker_call(&bus->worker, do_info, bus, info);
}

/* The tap joins with the first subscriber and leaves with the last. */
static int tap_events(dpm_bus *bus, bool on)
{
    dpm_station *station = dpm_master_station(bus->master);
    if (!on) {
        int code = dpm_station_remove_ring(station, bus->tap);
        bus->tap = NULL;
        return code;
    }
    bus->tap = dpm_ring_init(bus->tap_block, sizeof bus->tap_block, TAP_EVENTS);
    int code = bus->tap ? dpm_station_add_ring(station, bus->tap) : DPM_E_BLOCK;
    if (code)
        bus->tap = NULL;
    return code;
}

static int do_subscribe(void *object, void *argument)
{
    dpm_bus *bus = object;
    const subscriber *new = argument;
    int code = DPM_OK;
    if (!bus->machine)
        return DPM_E_MODE;
    if (bus->subscribers == SUBSCRIBERS)
        return DPM_E_FULL;
    if (bus->master && !bus->tap)
        code = tap_events(bus, true);
    if (!code && bus->master)
        code = dpm_station_add_ring(dpm_master_station(bus->master), new->ring);
    if (!code)
        bus->subscriber[bus->subscribers++] = *new;
    return code;
}

int dpm_bus_subscribe(dpm_bus *bus, dpm_ring *ring, int event_fd)
{
    subscriber new = {ring, event_fd};
    return dpm_worker_call(&bus->worker, do_subscribe, bus, &new);
}

static int do_unsubscribe(void *object, void *argument)
{
    dpm_bus *bus = object;
    size_t i = 0;
    while (i < bus->subscribers && bus->subscriber[i].ring != argument)
        i++;
    if (i == bus->subscribers)
        return DPM_E_ARGUMENT;
    bus->subscriber[i] = bus->subscriber[--bus->subscribers];
    if (!bus->master)
        return DPM_OK;
    int code = dpm_station_remove_ring(dpm_master_station(bus->master), argument);
    if (!bus->subscribers && bus->tap)
        tap_events(bus, false);
    return code;
}

int dpm_bus_unsubscribe(dpm_bus *bus, dpm_ring *ring)
{
    return dpm_worker_call(&bus->worker, do_unsubscribe, bus, ring);
}

/* ---- calls to the master or the slaves ---- */

/* What a call carries; each uses what it needs. */
typedef struct arguments {
    int number;            /* an index or a mode */
    const void *in;
    void *out;
    dpm_outputs *outputs;
    dpm_image *inputs;
    size_t n;
    uint64_t after;
    bool flag;
    bool ext_diag;
    bool static_diag;
} arguments;

/* Whom a bus drives is settled before its thread begins, so any thread may look. */
static int on_master(dpm_bus *bus, int (*fn)(void *master, void *arguments), arguments a)
{
    return bus->master ? dpm_worker_call(&bus->worker, fn, bus->master, &a) : DPM_E_MODE;
}

static int on_slaves(dpm_bus *bus, int (*fn)(void *slaves, void *arguments), arguments a)
{
    return bus->slaves ? dpm_worker_call(&bus->worker, fn, bus->slaves, &a) : DPM_E_MODE;
}

static int do_add(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_add(master, a->in, a->outputs, a->inputs);
}

int dpm_bus_add(dpm_bus *bus, const dpm_slave_set *set, dpm_outputs *outputs, dpm_image *inputs)
{
    return on_master(bus, do_add, (arguments){.in = set, .outputs = outputs, .inputs = inputs});
}

static int do_change(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_change(master, a->number, a->in);
}

int dpm_bus_change(dpm_bus *bus, int index, const dpm_slave_set *set)
{
    return on_master(bus, do_change, (arguments){.number = index, .in = set});
}

static int do_new_prm(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_new_prm(master, a->number, dpm_now());
}

int dpm_bus_new_prm(dpm_bus *bus, int index)
{
    return on_master(bus, do_new_prm, (arguments){.number = index});
}

static int do_activate(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_activate(master, a->number, a->flag, dpm_now());
}

int dpm_bus_activate(dpm_bus *bus, int index, bool active)
{
    return on_master(bus, do_activate, (arguments){.number = index, .flag = active});
}

static int do_remove(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_remove(master, a->number);
}

int dpm_bus_remove(dpm_bus *bus, int index)
{
    return on_master(bus, do_remove, (arguments){.number = index});
}

static int do_set_mode(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_set_mode(master, a->number, dpm_now());
}

int dpm_bus_set_mode(dpm_bus *bus, int mode)
{
    return on_master(bus, do_set_mode, (arguments){.number = mode});
}

static int do_request(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_request(master, a->out);
}

int dpm_bus_request(dpm_bus *bus, dpm_raw *raw)
{
    return on_master(bus, do_request, (arguments){.out = raw});
}

static int do_cancel(void *master, void *data)
{
    const arguments *a = data;
    dpm_master_cancel(master, a->out);
    return DPM_OK;
}

int dpm_bus_cancel(dpm_bus *bus, dpm_raw *raw)
{
    return on_master(bus, do_cancel, (arguments){.out = raw});
}

static int do_order(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_order(master, a->out, dpm_now());
}

int dpm_bus_order(dpm_bus *bus, dpm_control *control)
{
    return on_master(bus, do_order, (arguments){.out = control});
}

static int do_revoke(void *master, void *data)
{
    const arguments *a = data;
    dpm_master_revoke(master, a->out);
    return DPM_OK;
}

int dpm_bus_revoke(dpm_bus *bus, dpm_control *control)
{
    return on_master(bus, do_revoke, (arguments){.out = control});
}

static int do_get_status(void *master, void *data)
{
    const arguments *a = data;
    dpm_master_get_status(master, a->out);
    return DPM_OK;
}

int dpm_bus_get_status(dpm_bus *bus, dpm_master_status *status)
{
    return on_master(bus, do_get_status, (arguments){.out = status});
}

static int do_get_ring(void *master, void *data)
{
    const arguments *a = data;
    dpm_station_get_ring(dpm_master_station(master), a->out);
    return DPM_OK;
}

int dpm_bus_get_ring(dpm_bus *bus, dpm_ring_view *view)
{
    return on_master(bus, do_get_ring, (arguments){.out = view});
}

static int do_get_slave(void *master, void *data)
{
    const arguments *a = data;
    return dpm_master_get_slave(master, a->number, a->out);
}

int dpm_bus_get_slave(dpm_bus *bus, int index, dpm_slave_status *status)
{
    return on_master(bus, do_get_slave, (arguments){.number = index, .out = status});
}

static int do_get_history(void *master, void *data)
{
    const arguments *a = data;
    (void)master;
    return (int)dpm_history_get(a->in, a->after, a->out, a->n);
}

int dpm_bus_get_history(dpm_bus *bus, const dpm_history *history, uint64_t after, dpm_diagnosis *records, size_t n)
{
    return on_master(bus, do_get_history, (arguments){.in = history, .after = after, .out = records, .n = n});
}

static int do_record(void *master, void *data)
{
    const arguments *a = data;
    dpm_master_record(master, a->out, a->n);
    return DPM_OK;
}

int dpm_bus_record(dpm_bus *bus, int64_t *durations, size_t n)
{
    return on_master(bus, do_record, (arguments){.out = durations, .n = n});
}

static int do_slave_get(void *slaves, void *data)
{
    const arguments *a = data;
    return dpm_slaves_get(slaves, a->number, a->out);
}

int dpm_bus_slave_get(dpm_bus *bus, int index, dpm_slave_state_report *report)
{
    return on_slaves(bus, do_slave_get, (arguments){.number = index, .out = report});
}

static int do_slave_connect(void *slaves, void *data)
{
    const arguments *a = data;
    return dpm_slaves_connect(slaves, a->number, a->flag);
}

int dpm_bus_slave_connect(dpm_bus *bus, int index, bool connected)
{
    return on_slaves(bus, do_slave_connect, (arguments){.number = index, .flag = connected});
}

static int do_slave_reset(void *slaves, void *data)
{
    const arguments *a = data;
    return dpm_slaves_reset(slaves, a->number, dpm_now());
}

int dpm_bus_slave_reset(dpm_bus *bus, int index)
{
    return on_slaves(bus, do_slave_reset, (arguments){.number = index});
}

static int do_slave_set_address(void *slaves, void *data)
{
    const arguments *a = data;
    return dpm_slaves_set_address(slaves, a->number, (uint8_t)a->n, a->flag, dpm_now());
}

int dpm_bus_slave_set_address(dpm_bus *bus, int index, uint8_t address, bool locked)
{
    return on_slaves(bus, do_slave_set_address, (arguments){.number = index, .n = address, .flag = locked});
}

static int do_slave_diagnosis(void *slaves, void *data)
{
    const arguments *a = data;
    return dpm_slaves_diagnosis(slaves, a->number, a->in, (uint8_t)a->n, a->flag, a->ext_diag, a->static_diag);
}

int dpm_bus_slave_diagnosis(dpm_bus *bus, int index, const uint8_t *octets, uint8_t n, bool announce, bool ext_diag,
                            bool static_diag)
{
    return on_slaves(bus, do_slave_diagnosis, (arguments){.number = index, .in = octets, .n = n, .flag = announce,
                                                      .ext_diag = ext_diag, .static_diag = static_diag});
}

static int do_slave_ready(void *slaves, void *data)
{
    const arguments *a = data;
    return dpm_slaves_ready(slaves, a->number, a->flag);
}

int dpm_bus_slave_ready(dpm_bus *bus, int index, bool ready)
{
    return on_slaves(bus, do_slave_ready, (arguments){.number = index, .flag = ready});
}
