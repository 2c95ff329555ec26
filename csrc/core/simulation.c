/* SPDX-License-Identifier: MIT
 *
 * The simulated segment: machines, their hosts, virtual time. It keeps the driver's loop of machine.h for each port;
 * a port is served only when something is due for it, so that telegrams that all hear and nobody minds are cheap.
 */
#include <string.h>

#include "core/chance.h"
#include "core/simulation_private.h"
#include "dpmaster/error.h"

/* --- when a host notices -------------------------------------------------------------------------------------------- */

static bool is_exact(const dpm_sim_port *port) { return port->host.lateness == 0 && port->host.chunk == 0; }

/* An adapter hands over at multiples of its chunk only. */
static int64_t handed_over(const dpm_sim_port *port, int64_t time, bool up)
{
    const int64_t chunk = port->host.chunk;
    return chunk > 0 ? (time + (up ? chunk - 1 : 0)) / chunk * chunk : time;
}

static int64_t late(dpm_sim_port *port, int64_t time)
{
    return time == DPM_NEVER ? time : time + dpm_draw_up_to(&port->draws, port->host.lateness);
}

static void set_due(dpm_simulation *sim, unsigned i)
{
    const dpm_sim_port *port = &sim->port[i];
    const int64_t due = port->wake < port->feed ? port->wake : port->feed;
    sim->due[i] = due < port->stalled ? port->stalled : due;
}

static bool hears(const dpm_simulation *sim, unsigned i, const dpm_transmission *t)
{
    const dpm_sim_port *port = &sim->port[i];
    if (!port->on || t->side != port->side || (t->flags & DPM_TAP_LOST))
        return false;
    return t->port != (int)i || (port->host.echo && !(t->flags & DPM_TAP_INJECTED));
}

void dpm_sim_announce(dpm_simulation *sim, const dpm_carried *carried)
{
    for (unsigned i = 0; i < sim->ports; i++) {
        dpm_sim_port *port = &sim->port[i];
        if (port->feed != DPM_NEVER)
            continue;
        if (hears(sim, i, &carried->t)) {
            port->feed = late(port, handed_over(port, carried->t.wire_end, true));
            set_due(sim, i);
        } else {
            port->next = sim->sent;
            port->slot = 0;
        }
    }
}

/* --- reading --------------------------------------------------------------------------------------------------------- */

/* A driver tells only when it was read. */
static void give_backlog(dpm_simulation *sim, unsigned i)
{
    const dpm_sim_port *port = &sim->port[i];
    dpm_sim_backlog *late = &sim->backlog;
    const int64_t latest = sim->now - ((int64_t)late->n - 1) * sim->character;
    const dpm_span span = {late->octets, late->errors, late->n, latest - port->host.lateness - port->host.chunk, latest,
                           sim->character, late->echo};
    if (late->n)
        port->machine->octets(port->machine, &span);
    late->n = 0;
}

static void keep(dpm_simulation *sim, unsigned i, const dpm_span *span)
{
    dpm_sim_backlog *late = &sim->backlog;
    if (late->echo != span->echo)
        give_backlog(sim, i);
    late->echo = span->echo;
    for (size_t k = 0; k < span->n && late->n < DPM_SIM_BACKLOG; k++, late->n++) {
        late->octets[late->n] = span->octets[k];
        late->errors[late->n] = span->errors ? span->errors[k] : 0;
    }
}

/* Slots from..to as one span. */
static void give(dpm_simulation *sim, unsigned i, const dpm_carried *c, unsigned from, unsigned to)
{
    const dpm_sim_port *port = &sim->port[i];
    const uint8_t *octets = c->slotted ? c->heard : c->t.octets;
    const int64_t spread = (int64_t)(to - from - 1) * sim->character, first = c->t.start + sim->length[to] - spread;
    dpm_span span = {
        .octets = octets + from,
        .errors = c->slotted ? c->mark + from : NULL,
        .n = to - from,
        .earliest = first,
        .latest = first,
        .spacing = sim->character,
        .echo = c->t.port == (int)i,
    };
    if (!is_exact(port)) {
        const int64_t surely = sim->now - spread - port->host.lateness - port->host.chunk;
        span.latest = sim->now - spread;
        span.earliest = surely < first ? surely : first;
    }
    if (port->stalled)
        keep(sim, i, &span);
    else
        port->machine->octets(port->machine, &span);
}

/* A driver that is on hears its own octets or none. */
static bool deaf(const dpm_simulation *sim, const dpm_sim_port *port, const dpm_carried *c, unsigned slot)
{
    if (port->host.echo)
        return false;
    return c->t.start + sim->length[slot] < port->tx_end && c->t.start + sim->length[slot + 1] > port->tx_start;
}

static void give_slots(dpm_simulation *sim, unsigned i, const dpm_carried *c, unsigned from, unsigned to)
{
    const dpm_sim_port *port = &sim->port[i];
    if (!c->slotted && (c->t.wire_end <= port->tx_start || c->t.start >= port->tx_end || port->host.echo)) {
        give(sim, i, c, from, to);
        return;
    }
    for (unsigned slot = from; slot < to; slot++)
        if (!(c->slotted && c->mark[slot] == DPM_SIM_EMPTY) && !deaf(sim, port, c, slot))
            give(sim, i, c, slot, slot + 1);
}

/* Everything that ended up to `until`, in its order: what overlaps was made disjoint when it began. */
static void read_wire(dpm_simulation *sim, unsigned i, int64_t until)
{
    dpm_sim_port *port = &sim->port[i];
    if (sim->sent - port->next > sim->config.tap) {
        sim->statistics.overrun += sim->sent - port->next - sim->config.tap;
        port->next = sim->sent - sim->config.tap;
        port->slot = 0;
    }
    for (port->feed = DPM_NEVER; port->next < sim->sent; port->next++, port->slot = 0) {
        const dpm_carried *c = dpm_sim_carried(sim, port->next);
        if (!hears(sim, i, &c->t))
            continue;
        const unsigned ended = dpm_sim_ended(sim, c, until);
        if (ended > port->slot) {
            give_slots(sim, i, c, port->slot, ended);
            port->slot = (uint16_t)ended;
        }
        if (c->t.wire_end > until) {
            port->feed = late(port, handed_over(port, c->t.wire_end, true));
            return;
        }
    }
}

/* Begin to listen now: of what is on the wire, octets that begin from now on. */
static void attune(dpm_simulation *sim, unsigned i)
{
    dpm_sim_port *port = &sim->port[i];
    port->next = sim->sent;
    port->slot = 0;
    port->feed = DPM_NEVER;
    for (uint64_t k = 1; k <= sim->sent && k < sim->config.tap; k++) {
        const dpm_carried *c = dpm_sim_carried(sim, sim->sent - k);
        if (c->t.start + sim->length[DPM_SIM_SLOTS] <= sim->now)
            break;
        if (!hears(sim, i, &c->t) || c->t.wire_end <= sim->now)
            continue;
        port->next = c->t.number;
        port->slot = (uint16_t)(dpm_sim_ended(sim, c, sim->now) + 1);
        port->feed = late(port, handed_over(port, c->t.wire_end, true));
    }
}

/* --- serving one port ---------------------------------------------------------------------------------------------- */

/* Its transmission ends here, on the wire and for its driver. */
static void break_off(dpm_simulation *sim, unsigned i)
{
    dpm_sim_break_off(sim, (int)i);
    if (sim->port[i].tx_end > sim->now)
        sim->port[i].tx_end = sim->now;
}

static bool is_due(const dpm_simulation *sim, const dpm_sim_port *port, const dpm_offer *offer)
{
    return offer->n && offer->not_before <= sim->now && sim->now >= port->tx_end;
}

static void transmit(dpm_simulation *sim, unsigned i, const dpm_offer *offer)
{
    dpm_sim_port *port = &sim->port[i];
    if (offer->n > DPM_TELEGRAM_MAX) {
        port->machine->sent(port->machine, sim->now, sim->now, sim->now, DPM_SENT_FAILED);
        return;
    }
    port->tx_start = sim->now;
    port->tx_end = sim->now + sim->length[offer->n];
    dpm_sim_emit(sim, (int)i, port->side, 0, offer->octets, offer->n);
    port->machine->sent(port->machine, sim->now, port->tx_end, port->tx_end, DPM_SENT_WHOLE);
}

static void serve(dpm_simulation *sim, unsigned i)
{
    dpm_sim_port *port = &sim->port[i];
    dpm_machine *machine = port->machine;
    const int64_t heard = handed_over(port, sim->now, false);
    dpm_offer offer;
    if (port->stalled && port->asks)
        machine->ask(machine, sim->now, &offer);
    read_wire(sim, i, heard);
    give_backlog(sim, i);
    port->stalled = 0;
    machine->quiet(machine, heard); /* a read at once after that one is empty */
    machine->ask(machine, sim->now, &offer);
    if (is_due(sim, port, &offer)) {
        transmit(sim, i, &offer);
        machine->ask(machine, sim->now, &offer);
    }
    int64_t next = offer.n ? offer.not_before : offer.wake;
    if (offer.n && next < port->tx_end)
        next = port->tx_end;
    if (next <= sim->now) /* what it waits for has not been handed over yet */
        next = handed_over(port, sim->now + 1, true);
    port->wake = late(port, next);
    set_due(sim, i);
}

/* --- time ------------------------------------------------------------------------------------------------------------ */

int64_t dpm_simulation_now(const dpm_simulation *sim) { return sim->now; }

static int64_t next_event(const dpm_simulation *sim)
{
    int64_t next = sim->next_injection < sim->next_noise ? sim->next_injection : sim->next_noise;
    for (unsigned i = 0; i < sim->ports; i++)
        next = sim->due[i] < next ? sim->due[i] : next;
    return next;
}

static void wake_all(dpm_simulation *sim)
{
    for (unsigned i = 0; i < sim->ports; i++) {
        dpm_sim_port *port = &sim->port[i];
        const int64_t soon = late(port, sim->now);
        if (port->on && soon < port->wake)
            port->wake = soon;
        set_due(sim, i);
    }
}

static int reached(const dpm_simulation *sim, const dpm_simulation_stop *stop, const dpm_simulation_statistics *begin)
{
    const dpm_simulation_statistics *now = &sim->statistics;
    if (stop->violation && now->violations > begin->violations)
        return DPM_STOPPED_VIOLATION;
    if (stop->tokens && now->tokens - begin->tokens >= stop->tokens)
        return DPM_STOPPED_TOKENS;
    if (stop->transmissions && now->transmissions - begin->transmissions >= stop->transmissions)
        return DPM_STOPPED_TRANSMISSIONS;
    return DPM_STOPPED_TIME;
}

int dpm_simulation_run(dpm_simulation *sim, int64_t until, const dpm_simulation_stop *stop)
{
    const dpm_simulation_statistics begin = sim->statistics;
    wake_all(sim);
    for (int64_t next; (next = next_event(sim)) <= until;) {
        sim->now = next > sim->now ? next : sim->now;
        if (sim->next_injection <= sim->now || sim->next_noise <= sim->now)
            dpm_sim_inject_due(sim);
        for (unsigned i = 0; i < sim->ports; i++)
            if (sim->due[i] <= sim->now)
                serve(sim, i);
        const int why = stop ? reached(sim, stop, &begin) : DPM_STOPPED_TIME;
        if (why != DPM_STOPPED_TIME)
            return why;
    }
    sim->now = until > sim->now ? until : sim->now;
    return DPM_STOPPED_TIME;
}

/* --- set-up ---------------------------------------------------------------------------------------------------------- */

size_t dpm_simulation_size(const dpm_simulation_config *config)
{
    return sizeof(dpm_simulation) + config->tap * sizeof(dpm_carried);
}

int dpm_simulation_init(void *block, size_t size, const dpm_simulation_config *config, dpm_simulation **simulation)
{
    if (!config || !simulation || config->ports < 1 || config->ports > DPM_SIMULATION_PORTS ||
        config->tap < DPM_SIMULATION_TAP || config->grace < 0)
        return DPM_E_ARGUMENT;
    if (dpm_parameters_check(&config->parameters, 0, NULL) < 0)
        return DPM_E_PARAMETER;
    if (!block || (uintptr_t)block % 16 || size < dpm_simulation_size(config))
        return DPM_E_BLOCK;
    dpm_simulation *sim = block;
    memset(sim, 0, dpm_simulation_size(config));
    sim->config = *config;
    sim->last_fault = -1;
    sim->sides = 1;
    dpm_sim_wire_init(sim);
    dpm_sim_rules_init(sim);
    *simulation = sim;
    return DPM_OK;
}

int dpm_simulation_attach(dpm_simulation *sim, dpm_machine *machine, const dpm_simulation_host *host)
{
    if (!machine || (host && (host->lateness < 0 || host->chunk < 0)))
        return DPM_E_ARGUMENT;
    if (sim->ports == sim->config.ports)
        return DPM_E_FULL;
    dpm_sim_port *port = &sim->port[sim->ports];
    *port = (dpm_sim_port){.machine = machine, .on = true, .address = -1, .on_since = sim->now, .wake = sim->now};
    if (host)
        port->host = *host;
    port->draws = port->host.seed;
    sim->ports++;
    attune(sim, sim->ports - 1u);
    set_due(sim, sim->ports - 1u);
    return sim->ports - 1;
}

int dpm_simulation_power(dpm_simulation *sim, unsigned i, bool on)
{
    if (i >= sim->ports)
        return DPM_E_ARGUMENT;
    dpm_sim_port *port = &sim->port[i];
    if (on == port->on)
        return DPM_OK;
    if (!on)
        break_off(sim, i);
    port->on = on;
    port->wake = on ? sim->now : DPM_NEVER;
    port->feed = DPM_NEVER;
    port->on_since = sim->now;
    if (on)
        attune(sim, i);
    dpm_sim_forget(sim, port->address);
    set_due(sim, i);
    return DPM_OK;
}

int dpm_simulation_stall(dpm_simulation *sim, unsigned i, int64_t until, bool asks)
{
    if (i >= sim->ports || until <= sim->now)
        return DPM_E_ARGUMENT;
    sim->port[i].stalled = until;
    sim->port[i].asks = asks;
    set_due(sim, i);
    return DPM_OK;
}

int dpm_simulation_place(dpm_simulation *sim, unsigned i, unsigned side)
{
    if (i >= sim->ports || side >= DPM_SIMULATION_SIDES)
        return DPM_E_ARGUMENT;
    dpm_sim_port *port = &sim->port[i];
    if (port->side == side)
        return DPM_OK;
    break_off(sim, i);
    port->side = (uint8_t)side;
    sim->sides = sim->sides > side ? sim->sides : (uint8_t)(side + 1);
    sim->last_fault = sim->now;
    attune(sim, i);
    set_due(sim, i);
    return DPM_OK;
}

void dpm_simulation_clear(dpm_simulation *sim)
{
    memset(&sim->statistics, 0, sizeof sim->statistics);
    sim->statistics.since = sim->now;
    for (unsigned i = 0; i < 128; i++)
        memset(&sim->share[i].share, 0, sizeof sim->share[i].share);
    memset(sim->breach, 0, sizeof sim->breach);
}

int dpm_simulation_tap(const dpm_simulation *sim, unsigned back, dpm_transmission *transmission)
{
    if (back >= sim->sent || back >= sim->config.tap)
        return 0;
    *transmission = sim->tap[(sim->sent - 1 - back) % sim->config.tap].t;
    return 1;
}
