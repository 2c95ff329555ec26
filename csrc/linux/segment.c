/* SPDX-License-Identifier: MIT
 *
 * The segment hub: ptys, the wire between them (wire.c) and the machine of the attached slaves, driven by one thread
 * under the contract of machine.h. It may touch its ptys, its worker and the machine; what is on the wire when, and what
 * becomes of it, is the wire's business.
 *
 * The hub keeps the slave end of every pty open, so a client that dies leaves neither a hang-up nor an EIO loop. inotify
 * tells it which ports have a client: one without hears nothing, so nobody who opens a port reads what was said before.
 */
#include "dpmaster/segment.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/inotify.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <termios.h>
#include <unistd.h>

#include "dpmaster/port.h"
#include "linux/marks.h"
#include "linux/wire.h"
#include "linux/worker.h"

#define HELD 1024  /* octets that an adapter gathers between two deliveries */
#define SPIN 60000 /* ns before a due time that are watched awake: longer than most wake-ups take */

enum { POLL_WAKE, POLL_PRESENCE, POLL_PORTS };

struct hub_port {
    int master;
    int slave;
    int watch;         /* inotify's name for it */
    unsigned clients;  /* open descriptions of the slave end besides ours */
    bool cut;
    char path[32];
    /* What an adapter has gathered; its reader has it at `due`. */
    int64_t due;
    size_t held;
    uint8_t octets[HELD];
};

struct dpm_segment {
    dpm_worker worker;
    dpm_segment_config config;
    dpm_segment_info info;
    struct hub_port ports[DPM_SEGMENT_PORTS];
    struct pollfd polls[POLL_PORTS + DPM_SEGMENT_PORTS];
    int presence; /* inotify */
    dpm_wire wire;
    dpm_slaves *slaves;
    dpm_machine *machine; /* NULL: no room for slaves */
    int64_t looked;       /* begin of the last look at the ports that found nothing */
    int64_t told;         /* latest time the machine was told of: its times never run backwards */
};

/* The attached slaves talk as the source behind the last port. */
static unsigned slaves_source(const dpm_segment *segment)
{
    return segment->config.ports;
}

/* ---- The ptys ---- */

static int make_raw(int fd)
{
    struct termios settings;
    if (tcgetattr(fd, &settings))
        return -1;
    cfmakeraw(&settings);
    return tcsetattr(fd, TCSANOW, &settings);
}

static int open_port(dpm_segment *segment, struct hub_port *port)
{
    port->master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (port->master < 0 || grantpt(port->master) || unlockpt(port->master) ||
        ptsname_r(port->master, port->path, sizeof port->path))
        return DPM_E_SYSTEM;
    port->slave = open(port->path, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (port->slave < 0 || make_raw(port->slave))
        return DPM_E_SYSTEM;
    (void)dpm_pty_claim(port->slave, DPM_PTY_WRITES_MARKS, true); /* a sandbox may have no such locks: nobody marks then */
    port->watch = inotify_add_watch(segment->presence, port->path, IN_OPEN | IN_CLOSE);
    return port->watch < 0 ? DPM_E_SYSTEM : DPM_OK;
}

/* The master first: that is what hangs up the clients. */
static void close_port(struct hub_port *port)
{
    if (port->master >= 0)
        close(port->master);
    if (port->slave >= 0)
        close(port->slave);
    port->master = port->slave = port->watch = -1;
    port->clients = 0;
    port->held = 0;
}

/* The last client has gone, perhaps killed: what it would have undone itself is undone here. TIOCEXCL would outlive it,
 * since the slave end stays open. */
static void vacate(struct hub_port *port)
{
    port->held = 0;
    (void)ioctl(port->slave, TIOCNXCL);
    (void)tcflush(port->slave, TCIFLUSH);
    (void)make_raw(port->slave);
}

static void note_presence(dpm_segment *segment, const struct inotify_event *event)
{
    for (unsigned i = 0; i < segment->config.ports; i++) {
        struct hub_port *port = &segment->ports[i];
        if (event->mask & IN_Q_OVERFLOW)
            port->clients++; /* who closed is lost: rather talk to nobody than leave a client out */
        else if (event->wd == port->watch && event->mask & IN_OPEN)
            port->clients++;
        else if (event->wd == port->watch && event->mask & IN_CLOSE && port->clients && --port->clients == 0)
            vacate(port);
    }
}

static void take_presence(dpm_segment *segment)
{
    _Alignas(struct inotify_event) char events[1024];
    ssize_t n;
    while ((n = read(segment->presence, events, sizeof events)) > 0)
        for (char *at = events; at < events + n;) {
            const struct inotify_event *event = (const struct inotify_event *)(void *)at;
            note_presence(segment, event);
            at += sizeof *event + event->len;
        }
}

/* ---- What is heard ---- */

static void write_now(dpm_segment *segment, struct hub_port *port, const uint8_t *octets, size_t n)
{
    /* A wire waits for nobody: what the reader's buffer does not take is lost. */
    ssize_t written = write(port->master, octets, n);
    if (written < (ssize_t)n)
        segment->info.undelivered += n - (written > 0 ? (size_t)written : 0);
}

/* `errors`, or NULL: a reader that knows no marks has the octets alone, as from a UART whose INPCK is off. */
static void write_port(dpm_segment *segment, struct hub_port *port, const uint8_t *octets, const uint8_t *errors, size_t n)
{
    const int64_t chunk = segment->wire.faults.chunk;
    uint8_t marked[3 * DPM_WIRE_OCTETS];
    if (!port->clients || port->cut)
        return;
    if ((errors || memchr(octets, 0xFF, n)) && dpm_pty_claimed(port->slave, DPM_PTY_READS_MARKS)) {
        n = dpm_mark(octets, errors, n, marked);
        octets = marked;
    }
    if (!chunk) {
        write_now(segment, port, octets, n);
        return;
    }
    if (!port->held)
        port->due = (dpm_now() / chunk + 1) * chunk;
    size_t taken = n < HELD - port->held ? n : HELD - port->held;
    memcpy(port->octets + port->held, octets, taken);
    port->held += taken;
    segment->info.undelivered += n - taken;
}

/* When the next adapter hands over what it has, DPM_NEVER. */
static int64_t chunk_due(const dpm_segment *segment)
{
    int64_t due = DPM_NEVER;
    for (unsigned i = 0; i < segment->config.ports; i++)
        if (segment->ports[i].held && segment->ports[i].due < due)
            due = segment->ports[i].due;
    return due;
}

static void hand_over(dpm_segment *segment)
{
    for (unsigned i = 0; i < segment->config.ports; i++) {
        struct hub_port *port = &segment->ports[i];
        if (port->held && port->due <= dpm_now()) {
            write_now(segment, port, port->octets, port->held);
            port->held = 0;
        }
    }
}

/* Octets that ended at `first` .. `last` reach everybody but their source. */
static void deliver(dpm_segment *segment, unsigned source, const uint8_t *octets, const uint8_t *errors, size_t n,
                    int64_t first, int64_t last)
{
    segment->info.deliveries++;
    if (segment->machine && source != slaves_source(segment)) {
        dpm_span span = {.octets = octets, .errors = errors, .n = n};
        /* Of transmissions that overlapped, the second one began before the first was told. */
        span.earliest = span.latest = first > segment->told ? first : segment->told;
        span.spacing = n > 1 && last > span.latest ? (last - span.latest) / (int64_t)(n - 1) : 0;
        segment->told = last > segment->told ? last : segment->told;
        segment->machine->octets(segment->machine, &span);
    }
    for (unsigned i = 0; i < segment->config.ports; i++)
        if (i != source || segment->config.echo)
            write_port(segment, &segment->ports[i], octets, errors, n);
}

/* A source whose flights are all under way is not read: its octets wait in the pty, as in a UART's buffer. */
static void admit(dpm_segment *segment, unsigned source)
{
    segment->polls[POLL_PORTS + source].events = dpm_wire_room(&segment->wire, source) ? POLLIN : 0;
}

static void deliver_due(dpm_segment *segment)
{
    const dpm_flight *flight;
    unsigned source;
    int64_t now = 0;
    while (segment->wire.waiting && (flight = dpm_wire_take(&segment->wire, now = dpm_now(), &source))) {
        if (source != slaves_source(segment))
            admit(segment, source);
        int64_t late = now - flight->due;
        segment->info.late_max = late > segment->info.late_max ? late : segment->info.late_max;
        segment->info.late_sum += late;
        int64_t first = flight->due - dpm_wire_time(&segment->wire, flight->n - 1u);
        deliver(segment, source, flight->heard, flight->bad ? flight->errors : NULL, flight->n, first, flight->due);
    }
}

/* Puts octets on the wire and returns when they begin. */
static int64_t talk(dpm_segment *segment, unsigned source, int64_t now, const uint8_t *octets, size_t n)
{
    uint8_t damaged[3 * DPM_WIRE_PUT], marks[3 * DPM_WIRE_PUT];
    const uint8_t *errors = NULL;
    dpm_wire *wire = &segment->wire;
    if (wire->faulty) {
        n = dpm_wire_damage(wire, octets, n, damaged, marks);
        octets = damaged;
        errors = marks;
    }
    if (!dpm_wire_direct(wire)) {
        now = dpm_wire_put(wire, source, now, octets, errors, n);
        if (source != slaves_source(segment))
            admit(segment, source);
    } else if (n) {
        wire->transmissions++;
        wire->octets += n;
        deliver(segment, source, octets, errors, n, now, now);
    }
    return now;
}

static void read_port(dpm_segment *segment, unsigned source)
{
    uint8_t octets[DPM_WIRE_PUT];
    struct hub_port *port = &segment->ports[source];
    if (!port->clients)
        take_presence(segment); /* it opened the port since the last look */
    ssize_t n = read(port->master, octets, sizeof octets);
    if (n > 0 && port->cut)
        segment->info.undelivered += (uint64_t)n;
    else if (n > 0)
        (void)talk(segment, source, dpm_now(), octets, (size_t)n);
    else if (n < 0 && errno != EAGAIN && errno != EINTR)
        segment->polls[POLL_PORTS + source].fd = -1; /* cannot be while we hold both ends; a loop would be worse */
}

/* ---- The attached slaves ---- */

static dpm_offer ask(dpm_segment *segment)
{
    dpm_offer offer = {.wake = DPM_NEVER};
    if (segment->machine)
        segment->machine->ask(segment->machine, dpm_now(), &offer);
    return offer;
}

static void quiet(dpm_segment *segment)
{
    int64_t until = dpm_wire_heard(&segment->wire, segment->looked, slaves_source(segment));
    if (!segment->machine || until <= segment->told)
        return;
    segment->told = until;
    segment->machine->quiet(segment->machine, until);
}

static void send_offer(dpm_segment *segment, const dpm_offer *offer)
{
    unsigned source = slaves_source(segment);
    int64_t now = dpm_now();
    if (!dpm_wire_room(&segment->wire, source)) {
        segment->machine->sent(segment->machine, now, now, now, DPM_SENT_FAILED);
        return;
    }
    size_t n = offer->n;
    int64_t start = talk(segment, source, now, offer->octets, n);
    int64_t end = segment->wire.paced ? start + dpm_wire_time(&segment->wire, n) : dpm_now();
    segment->machine->sent(segment->machine, start, end, end, DPM_SENT_WHOLE);
}

/* ---- The thread ---- */

/* Wait until a descriptor is readable (their number), or `due` or `wake` has passed and a look begun after that found
 * nothing (0). The last microseconds before `due` are watched awake; `wake` is no matter of microseconds. */
static int wait_ready(dpm_segment *segment, int64_t due, int64_t wake)
{
    int64_t end = due < wake ? due : wake, sleep_until = due - SPIN < wake ? due - SPIN : wake;
    for (;;) {
        int64_t now = dpm_now(), left = sleep_until > now ? sleep_until - now : 0;
        struct timespec timeout = {(time_t)(left / 1000000000), (long)(left % 1000000000)};
        int ready = ppoll(segment->polls, POLL_PORTS + segment->config.ports, end == DPM_NEVER ? NULL : &timeout, NULL);
        segment->looked = now;
        if (ready > 0 || (ready == 0 && now >= end))
            return ready;
    }
}

static void serve(dpm_segment *segment, int ready)
{
    const struct pollfd *polls = segment->polls;
    if (polls[POLL_PRESENCE].revents)
        take_presence(segment);
    if (polls[POLL_WAKE].revents)
        dpm_worker_serve(&segment->worker); /* after presence: a call made behind an open finds the client there */
    ready -= !!polls[POLL_WAKE].revents + !!polls[POLL_PRESENCE].revents;
    for (unsigned i = 0; ready > 0 && i < segment->config.ports; i++)
        if (polls[POLL_PORTS + i].revents) {
            read_port(segment, i);
            ready--;
        }
}

/* One round of the contract in machine.h. */
static void turn(dpm_segment *segment)
{
    dpm_offer offer = ask(segment);
    int64_t due = dpm_wire_due(&segment->wire), chunk = chunk_due(segment);
    if (chunk < due)
        due = chunk;
    if (offer.n && offer.not_before < due)
        due = offer.not_before;
    /* While something is under way nothing can be called missing before it was delivered (quiet below). */
    int64_t wake = segment->wire.waiting && offer.wake < due ? due : offer.wake;
    int ready = wait_ready(segment, due, wake);
    if (ready > 0)
        serve(segment, ready);
    deliver_due(segment);
    hand_over(segment);
    if (ready == 0 && segment->machine) {
        quiet(segment);
        offer = ask(segment);
        if (offer.n && offer.not_before <= segment->looked)
            send_offer(segment, &offer);
    }
    if (segment->machine)
        dpm_worker_publish(&segment->worker, segment->machine->progress);
}

static void *run(void *context)
{
    dpm_segment *segment = context;
    (void)prctl(PR_SET_TIMERSLACK, 1);
    while (!dpm_worker_stopping(&segment->worker))
        turn(segment);
    return NULL;
}

/* ---- Life ---- */

static size_t round_up(size_t n)
{
    return (n + 15) & ~(size_t)15;
}

static size_t lanes_size(const dpm_segment_config *config)
{
    return round_up((config->ports + 1u) * sizeof(dpm_lane));
}

size_t dpm_segment_size(const dpm_segment_config *config)
{
    return round_up(sizeof(dpm_segment)) + lanes_size(config) + (config->slaves ? dpm_slaves_size(config->slaves) : 0);
}

static int lay_out(dpm_segment *segment, size_t size)
{
    const dpm_segment_config *config = &segment->config;
    uint8_t *lanes = (uint8_t *)segment + round_up(sizeof *segment), *slaves = lanes + lanes_size(config);
    dpm_wire_init(&segment->wire, &config->parameters, config->paced, (dpm_lane *)(void *)lanes,
                  (uint16_t)(config->ports + 1));
    if (!config->slaves)
        return DPM_OK;
    dpm_port_traits traits; /* the attached slaves' port is like any pty */
    dpm_profile_traits(DPM_PROFILE_PTY, &traits);
    int code = dpm_slaves_init(slaves, size - (size_t)(slaves - (uint8_t *)segment), &config->parameters, &traits,
                               config->slaves, &segment->slaves);
    if (!code)
        segment->machine = dpm_slaves_machine(segment->slaves);
    return code;
}

static int open_ports(dpm_segment *segment)
{
    segment->presence = inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
    int code = segment->presence < 0 ? DPM_E_SYSTEM : DPM_OK;
    for (unsigned i = 0; !code && i < segment->config.ports; i++) {
        code = open_port(segment, &segment->ports[i]);
        segment->polls[POLL_PORTS + i] = (struct pollfd){segment->ports[i].master, POLLIN, 0};
    }
    segment->polls[POLL_WAKE] = (struct pollfd){segment->worker.wake_fd, POLLIN, 0};
    segment->polls[POLL_PRESENCE] = (struct pollfd){segment->presence, POLLIN, 0};
    return code;
}

static void release(dpm_segment *segment)
{
    int saved = errno;
    for (unsigned i = 0; i < segment->config.ports; i++)
        close_port(&segment->ports[i]);
    if (segment->presence >= 0)
        close(segment->presence);
    errno = saved;
}

int dpm_segment_open(void *block, size_t size, const dpm_segment_config *config, dpm_segment **out)
{
    if (config->ports > DPM_SEGMENT_PORTS || config->slaves > DPM_BROADCAST - 1 || !config->parameters.rate_num ||
        !config->parameters.rate_den)
        return DPM_E_ARGUMENT;
    if ((uintptr_t)block % 16 || size < dpm_segment_size(config))
        return DPM_E_BLOCK;
    memset(block, 0, dpm_segment_size(config));
    dpm_segment *segment = block;
    segment->config = *config;
    segment->presence = -1;
    for (unsigned i = 0; i < DPM_SEGMENT_PORTS; i++)
        segment->ports[i].master = segment->ports[i].slave = segment->ports[i].watch = -1;
    int code = lay_out(segment, size);
    if (!code)
        code = dpm_worker_init(&segment->worker);
    if (code)
        return code;
    code = open_ports(segment);
    if (code) {
        (void)dpm_worker_stop(&segment->worker);
        release(segment);
        return code;
    }
    *out = segment;
    return DPM_OK;
}

const char *dpm_segment_path(const dpm_segment *segment, unsigned port)
{
    return port < segment->config.ports ? segment->ports[port].path : NULL;
}

int dpm_segment_start(dpm_segment *segment)
{
    return dpm_worker_start(&segment->worker, run, segment);
}

void dpm_segment_close(dpm_segment *segment)
{
    if (dpm_worker_stop(&segment->worker))
        release(segment);
}

uint32_t dpm_segment_progress(const dpm_segment *segment)
{
    return atomic_load(&segment->worker.progress);
}

int dpm_segment_wait(dpm_segment *segment, uint32_t seen, int64_t timeout)
{
    return dpm_worker_wait(&segment->worker, seen, timeout);
}

int dpm_segment_realtime(dpm_segment *segment, const dpm_realtime *wish, dpm_refusals *refusals)
{
    return dpm_worker_realtime(&segment->worker, wish, refusals);
}

/* ---- Calls that run on the thread ---- */

struct slave_call {
    int (*fn)(dpm_segment *, const struct slave_call *);
    const dpm_slave_config *config;
    dpm_image *outputs, *inputs;
    dpm_slave_state_report *report;
    const uint8_t *octets;
    int index;
    uint8_t n;
    bool flag, ext_diag, static_diag;
};

static int run_slave_call(void *object, void *argument)
{
    dpm_segment *segment = object;
    const struct slave_call *call = argument;
    return segment->slaves ? call->fn(segment, call) : DPM_E_ARGUMENT;
}

static int slave_call(dpm_segment *segment, struct slave_call call)
{
    return dpm_worker_call(&segment->worker, run_slave_call, segment, &call);
}

static int do_attach(dpm_segment *segment, const struct slave_call *call)
{
    return dpm_slaves_add(segment->slaves, call->config, call->outputs, call->inputs);
}

static int do_get(dpm_segment *segment, const struct slave_call *call)
{
    return dpm_slaves_get(segment->slaves, call->index, call->report);
}

static int do_connect(dpm_segment *segment, const struct slave_call *call)
{
    return dpm_slaves_connect(segment->slaves, call->index, call->flag);
}

static int do_reset(dpm_segment *segment, const struct slave_call *call)
{
    return dpm_slaves_reset(segment->slaves, call->index, dpm_now());
}

static int do_set_address(dpm_segment *segment, const struct slave_call *call)
{
    return dpm_slaves_set_address(segment->slaves, call->index, call->n, call->flag, dpm_now());
}

static int do_diagnosis(dpm_segment *segment, const struct slave_call *call)
{
    return dpm_slaves_diagnosis(segment->slaves, call->index, call->octets, call->n, call->flag, call->ext_diag,
                                call->static_diag);
}

static int do_ready(dpm_segment *segment, const struct slave_call *call)
{
    return dpm_slaves_ready(segment->slaves, call->index, call->flag);
}

int dpm_segment_attach(dpm_segment *segment, const dpm_slave_config *config, dpm_image *outputs, dpm_image *inputs)
{
    return slave_call(segment, (struct slave_call){do_attach, .config = config, .outputs = outputs, .inputs = inputs});
}

int dpm_segment_slave_get(dpm_segment *segment, int index, dpm_slave_state_report *report)
{
    return slave_call(segment, (struct slave_call){do_get, .index = index, .report = report});
}

int dpm_segment_slave_connect(dpm_segment *segment, int index, bool connected)
{
    return slave_call(segment, (struct slave_call){do_connect, .index = index, .flag = connected});
}

int dpm_segment_slave_reset(dpm_segment *segment, int index)
{
    return slave_call(segment, (struct slave_call){do_reset, .index = index});
}

int dpm_segment_slave_set_address(dpm_segment *segment, int index, uint8_t address, bool locked)
{
    return slave_call(segment, (struct slave_call){do_set_address, .index = index, .n = address, .flag = locked});
}

int dpm_segment_slave_diagnosis(dpm_segment *segment, int index, const uint8_t *octets, uint8_t n, bool announce,
                                bool ext_diag, bool static_diag)
{
    return slave_call(segment, (struct slave_call){do_diagnosis, .index = index, .octets = octets, .n = n,
                                                   .flag = announce, .ext_diag = ext_diag, .static_diag = static_diag});
}

int dpm_segment_slave_ready(dpm_segment *segment, int index, bool ready)
{
    return slave_call(segment, (struct slave_call){do_ready, .index = index, .flag = ready});
}

static int do_faults(void *object, void *argument)
{
    dpm_wire_set_faults(&((dpm_segment *)object)->wire, argument);
    return DPM_OK;
}

int dpm_segment_set_faults(dpm_segment *segment, const dpm_segment_faults *faults)
{
    dpm_segment_faults copy = *faults;
    const uint32_t chances[] = {copy.lose, copy.flip, copy.parity, copy.insert, copy.duplicate, copy.lose_telegram};
    for (size_t i = 0; i < sizeof chances / sizeof *chances; i++)
        if (chances[i] > 1000000)
            return DPM_E_ARGUMENT;
    if (copy.delay < 0 || copy.delay > 10000000000 || copy.chunk < 0 || copy.chunk > 10000000000)
        return DPM_E_ARGUMENT;
    return dpm_worker_call(&segment->worker, do_faults, segment, &copy);
}

struct cut_call {
    unsigned port;
    bool cut;
};

static int do_cut(void *object, void *argument)
{
    dpm_segment *segment = object;
    const struct cut_call *call = argument;
    segment->ports[call->port].cut = call->cut;
    return DPM_OK;
}

int dpm_segment_cut(dpm_segment *segment, unsigned port, bool cut)
{
    struct cut_call call = {port, cut};
    if (port >= segment->config.ports)
        return DPM_E_ARGUMENT;
    return dpm_worker_call(&segment->worker, do_cut, segment, &call);
}

/* As an adapter that is pulled out: its client sees the line hang up. Back in it is another pty. */
static int do_plug(void *object, void *argument)
{
    dpm_segment *segment = object;
    const struct cut_call *call = argument;
    struct hub_port *port = &segment->ports[call->port];
    struct pollfd *poll = &segment->polls[POLL_PORTS + call->port];
    close_port(port);
    poll->fd = -1;
    if (call->cut)
        return DPM_OK;
    int code = open_port(segment, port);
    if (code)
        close_port(port);
    poll->fd = port->master;
    return code;
}

int dpm_segment_plug(dpm_segment *segment, unsigned port, bool in)
{
    struct cut_call call = {port, !in};
    if (port >= segment->config.ports)
        return DPM_E_ARGUMENT;
    return dpm_worker_call(&segment->worker, do_plug, segment, &call);
}

static int do_info(void *object, void *argument)
{
    const dpm_segment *segment = object;
    dpm_segment_info *info = argument;
    *info = segment->info;
    info->transmissions = segment->wire.transmissions;
    info->octets = segment->wire.octets;
    info->collisions = segment->wire.collisions;
    info->faults = segment->wire.touched;
    return DPM_OK;
}

int dpm_segment_get_info(dpm_segment *segment, dpm_segment_info *info)
{
    return dpm_worker_call(&segment->worker, do_info, segment, info);
}
