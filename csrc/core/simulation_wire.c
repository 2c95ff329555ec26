/* SPDX-License-Identifier: MIT
 *
 * The simulated segment: what is on the wire. Transmissions, what faults and overlaps make of them, what faults send
 * of their own. Times come from simulation.c; what it means is for simulation_rules.c.
 */
#include <string.h>

#include "core/chance.h"
#include "core/simulation_private.h"
#include "dpmaster/error.h"

void dpm_sim_wire_init(dpm_simulation *sim)
{
    for (unsigned n = 0; n <= DPM_SIM_SLOTS; n++)
        sim->length[n] = dpm_bits_up(&sim->config.parameters, (int64_t)n * DPM_CHARACTER_BITS);
    sim->character = sim->length[1];
    sim->next_injection = sim->next_noise = DPM_NEVER;
    for (unsigned i = 0; i < 2 * DPM_SIMULATION_PLANS; i++)
        sim->injection[i].time = DPM_NEVER;
}

unsigned dpm_sim_ended(const dpm_simulation *sim, const dpm_carried *carried, int64_t time)
{
    const int64_t since = time - carried->t.start;
    if (time >= carried->t.wire_end)
        return carried->slots;
    unsigned n = since > 0 ? (unsigned)(since / sim->character) : 0;
    while (n < carried->slots && sim->length[n + 1] <= since)
        n++;
    return n;
}

/* --- what is heard ------------------------------------------------------------------------------------------------ */

static void touch(dpm_simulation *sim, dpm_carried *c)
{
    c->t.flags |= DPM_TAP_TOUCHED;
    sim->statistics.touched++;
    sim->last_fault = sim->now;
}

static void cut_into_slots(dpm_carried *c)
{
    if (c->slotted)
        return;
    c->slotted = true;
    memcpy(c->heard, c->t.octets, c->slots);
    memset(c->mark, 0, c->slots);
}

static void put_slot(dpm_carried *c, uint8_t octet, uint8_t mark)
{
    if (c->slots == DPM_SIM_SLOTS)
        return;
    c->heard[c->slots] = octet;
    c->mark[c->slots++] = mark;
}

static void lose(dpm_simulation *sim, dpm_carried *c)
{
    touch(sim, c);
    c->t.flags |= DPM_TAP_LOST;
    c->slots = 0;
}

/* As the segment hub's dpm_wire_damage, but on a wire that has time: the place of an octet lost stays empty. */
static void damage(dpm_simulation *sim, dpm_carried *c)
{
    const dpm_simulation_faults *faults = &sim->faults;
    const uint64_t before = sim->statistics.touched;
    if (dpm_hit(dpm_draw(&sim->telegram_draws), faults->lose_telegram)) {
        lose(sim, c);
        return;
    }
    c->slots = 0;
    for (size_t i = 0; i < c->t.n; i++) {
        /* Five draws for each octet, whatever they bring: the faults of one octet do not move those of the next. */
        const uint64_t insert = dpm_draw(&sim->octet_draws), gone = dpm_draw(&sim->octet_draws);
        const uint64_t flip = dpm_draw(&sim->octet_draws), parity = dpm_draw(&sim->octet_draws);
        const uint64_t duplicate = dpm_draw(&sim->octet_draws);
        const bool inserts = dpm_hit(insert, faults->insert), loses = dpm_hit(gone, faults->lose);
        const bool flips = dpm_hit(flip, faults->flip), errs = dpm_hit(parity, faults->parity);
        const bool duplicates = dpm_hit(duplicate, faults->duplicate);
        const uint8_t octet = (uint8_t)(c->t.octets[i] ^ (flips ? 1u << (flip & 7) : 0) ^ (errs ? 1u << (parity & 7) : 0));
        const uint8_t mark = errs ? DPM_LINE_PARITY : 0;
        if (inserts)
            put_slot(c, (uint8_t)insert, 0);
        put_slot(c, octet, loses ? DPM_SIM_EMPTY : mark);
        if (duplicates && !loses)
            put_slot(c, octet, mark);
        if (inserts || loses || flips || errs || duplicates)
            touch(sim, c);
    }
    c->slotted = sim->statistics.touched != before;
}

/* Characters nobody sends at the end do not occupy the wire. */
static void trim(dpm_carried *c)
{
    while (c->slotted && c->slots && c->mark[c->slots - 1] == DPM_SIM_EMPTY)
        c->slots--;
    if (c->slots == 0)
        c->t.flags |= DPM_TAP_LOST;
}

/* --- what faults send of their own -------------------------------------------------------------------------------- */

static void schedule(dpm_simulation *sim)
{
    sim->next_injection = DPM_NEVER;
    for (unsigned i = 0; i < 2 * DPM_SIMULATION_PLANS; i++)
        if (sim->injection[i].time < sim->next_injection)
            sim->next_injection = sim->injection[i].time;
}

static void put_injection(dpm_simulation *sim, unsigned i, int64_t time, int port, unsigned side, const uint8_t *octets, size_t n)
{
    dpm_sim_injection *injection = &sim->injection[i];
    injection->time = time;
    injection->port = (int16_t)port;
    injection->side = (uint8_t)side;
    injection->n = (uint8_t)n;
    memcpy(injection->octets, octets, n);
    schedule(sim);
}

int dpm_simulation_inject(dpm_simulation *sim, unsigned side, int64_t time, const uint8_t *octets, size_t n)
{
    if (side >= DPM_SIMULATION_SIDES || time < sim->now || !octets || n < 1 || n > DPM_TELEGRAM_MAX)
        return DPM_E_ARGUMENT;
    for (unsigned i = 0; i < DPM_SIMULATION_PLANS; i++)
        if (sim->injection[i].time == DPM_NEVER) {
            put_injection(sim, i, time, -1, side, octets, n);
            return DPM_OK;
        }
    return DPM_E_FULL;
}

static void make_noise(dpm_simulation *sim)
{
    uint8_t octets[DPM_TELEGRAM_MAX];
    const size_t n = 1 + (size_t)dpm_draw_up_to(&sim->noise_draws, sim->faults.noise_octets - 1);
    for (size_t i = 0; i < n; i++)
        octets[i] = (uint8_t)(dpm_draw(&sim->noise_draws) >> 56);
    const unsigned side = (unsigned)dpm_draw_up_to(&sim->noise_draws, sim->sides - 1);
    sim->next_noise = sim->now + 1 + dpm_draw_up_to(&sim->noise_draws, 2 * sim->faults.noise);
    sim->statistics.noise++;
    sim->last_fault = sim->now;
    dpm_sim_emit(sim, -1, side, DPM_TAP_INJECTED, octets, n);
}

void dpm_sim_inject_due(dpm_simulation *sim)
{
    for (unsigned i = 0; i < 2 * DPM_SIMULATION_PLANS; i++) {
        dpm_sim_injection *injection = &sim->injection[i];
        if (injection->time > sim->now)
            continue;
        injection->time = DPM_NEVER;
        sim->last_fault = sim->now;
        sim->statistics.noise += injection->port < 0;
        dpm_sim_emit(sim, injection->port, injection->side, DPM_TAP_INJECTED, injection->octets, injection->n);
    }
    schedule(sim);
    if (sim->next_noise <= sim->now)
        make_noise(sim);
}

void dpm_simulation_set_faults(dpm_simulation *sim, const dpm_simulation_faults *faults)
{
    sim->faults = *faults;
    sim->faulty = faults->lose || faults->flip || faults->parity || faults->insert || faults->duplicate || faults->lose_telegram;
    sim->octet_draws = faults->seed;
    sim->telegram_draws = ~faults->seed;
    sim->noise_draws = faults->seed ^ 0x5555555555555555u;
    sim->next_noise = DPM_NEVER;
    if (faults->noise > 0)
        sim->next_noise = sim->now + 1 + dpm_draw_up_to(&sim->noise_draws, 2 * faults->noise);
}

/* --- planned faults ------------------------------------------------------------------------------------------------ */

int dpm_simulation_add_plan(dpm_simulation *sim, const dpm_simulation_plan *plan)
{
    if (plan->traffic > DPM_TRAFFIC_ANSWER || plan->nth < 1 || plan->fault > DPM_FAULT_INJECT || plan->after < 0 ||
        (plan->fault == DPM_FAULT_INJECT && (plan->n < 1 || plan->n > sizeof plan->octets)))
        return DPM_E_ARGUMENT;
    if (sim->plans == DPM_SIMULATION_PLANS)
        return DPM_E_FULL;
    sim->plan[sim->plans] = (dpm_sim_planned){.plan = *plan, .time = DPM_NEVER};
    return (int)sim->plans++;
}

int64_t dpm_simulation_plan_time(const dpm_simulation *sim, unsigned plan)
{
    return plan < sim->plans ? sim->plan[plan].time : DPM_NEVER;
}

static bool comes_true(dpm_sim_planned *planned, const dpm_transmission *t)
{
    const dpm_simulation_plan *plan = &planned->plan;
    const int16_t address = t->traffic == DPM_TRAFFIC_ANSWER ? t->sa : t->da;
    if (planned->time != DPM_NEVER || plan->traffic != t->traffic || (plan->address >= 0 && plan->address != address))
        return false;
    return ++planned->seen == plan->nth;
}

static void garble_one(dpm_simulation *sim, dpm_carried *c)
{
    if (c->slots == 0)
        return;
    cut_into_slots(c);
    const size_t i = (size_t)dpm_draw_up_to(&sim->octet_draws, c->slots - 1);
    c->heard[i] ^= 0x10;
    c->mark[i] |= DPM_LINE_PARITY;
    touch(sim, c);
}

static void come_true(dpm_simulation *sim, unsigned i, dpm_carried *c)
{
    const dpm_simulation_plan *plan = &sim->plan[i].plan;
    const dpm_transmission *t = &c->t;
    sim->plan[i].time = sim->last_fault = sim->now;
    switch (plan->fault) {
    case DPM_FAULT_LOSE:
        lose(sim, c);
        break;
    case DPM_FAULT_GARBLE:
        garble_one(sim, c);
        break;
    case DPM_FAULT_DELAY:
        lose(sim, c);
        put_injection(sim, DPM_SIMULATION_PLANS + i, t->start + plan->after, t->port, t->side, t->octets, t->n);
        break;
    case DPM_FAULT_DOUBLE:
        put_injection(sim, DPM_SIMULATION_PLANS + i, t->end + plan->after, t->port, t->side, t->octets, t->n);
        break;
    default:
        put_injection(sim, DPM_SIMULATION_PLANS + i, t->start + plan->after, -1, t->side, plan->octets, plan->n);
        break;
    }
}

/* --- overlap ------------------------------------------------------------------------------------------------------- */

/* Octets of `a` that share time with `b`, which began later. */
static void garble_overlap(const dpm_simulation *sim, dpm_carried *a, const dpm_carried *b)
{
    cut_into_slots(a);
    for (unsigned i = dpm_sim_ended(sim, a, b->t.start); i < a->slots; i++) {
        const int64_t begin = a->t.start + sim->length[i] - b->t.start;
        const size_t j = begin > 0 ? (size_t)(begin / sim->character) : 0;
        if (begin >= b->t.wire_end - b->t.start)
            return;
        if (a->mark[i] == DPM_SIM_EMPTY)
            continue;
        a->heard[i] &= b->heard[j < b->slots ? j : b->slots - 1u];
        a->mark[i] |= DPM_LINE_PARITY;
    }
}

/* Everything that is on the wire when `b` begins is garbled by it; of `b` itself is heard what begins afterwards. */
static void collide(dpm_simulation *sim, dpm_carried *b)
{
    const int64_t busy_to = sim->side[b->t.side].busy_to;
    bool stations = !(b->t.flags & DPM_TAP_INJECTED), others = false;
    cut_into_slots(b);
    for (uint64_t k = 1; k <= b->t.number && k < sim->config.tap; k++) {
        dpm_carried *a = dpm_sim_carried(sim, b->t.number - k);
        if (a->t.start + sim->length[DPM_SIM_SLOTS] <= sim->now)
            break;
        if (a->t.side != b->t.side || a->t.wire_end <= sim->now)
            continue;
        garble_overlap(sim, a, b);
        a->t.flags |= DPM_TAP_COLLIDED;
        others |= !(a->t.flags & DPM_TAP_INJECTED);
        dpm_sim_disregard(sim, &a->t, false);
    }
    for (unsigned i = 0; i < b->slots && b->t.start + sim->length[i] < busy_to; i++)
        b->mark[i] = DPM_SIM_EMPTY;
    b->t.flags |= DPM_TAP_COLLIDED;
    sim->statistics.collisions++;
    if (stations && others)
        dpm_sim_breached(sim, &b->t, DPM_RULE_COLLISION, busy_to - sim->now, 0);
}

/* --- the wire ------------------------------------------------------------------------------------------------------ */

static dpm_carried *begin(dpm_simulation *sim, int port, unsigned side, uint8_t flags, const uint8_t *octets, size_t n)
{
    dpm_carried *c = dpm_sim_carried(sim, sim->sent);
    dpm_transmission *t = &c->t;
    t->number = sim->sent++;
    t->start = sim->now;
    t->end = sim->now + sim->length[n];
    t->port = (int16_t)port;
    t->side = (uint8_t)side;
    t->flags = flags;
    t->n = (uint8_t)n;
    memcpy(t->octets, octets, n);
    c->slotted = false;
    c->slots = (uint16_t)n;
    return c;
}

int64_t dpm_sim_emit(dpm_simulation *sim, int port, unsigned side, uint8_t flags, const uint8_t *octets, size_t n)
{
    dpm_carried *c = begin(sim, port, side, flags, octets, n);
    const uint8_t fc = dpm_sim_classify(&c->t);
    if (!(flags & DPM_TAP_INJECTED)) {
        if (sim->faulty)
            damage(sim, c);
        for (unsigned i = 0; i < sim->plans; i++)
            if (comes_true(&sim->plan[i], &c->t))
                come_true(sim, i, c);
        trim(c);
    }
    c->t.wire_end = c->t.start + sim->length[c->slots];
    if (c->slots && sim->side[side].busy_to > sim->now)
        collide(sim, c);
    dpm_sim_watch(sim, c, fc);
    sim->statistics.transmissions++;
    sim->statistics.busy += sim->length[c->slots];
    dpm_sim_announce(sim, c);
    return c->t.end;
}

void dpm_sim_break_off(dpm_simulation *sim, int port)
{
    for (uint64_t k = 1; k <= sim->sent && k < sim->config.tap; k++) {
        dpm_carried *c = dpm_sim_carried(sim, sim->sent - k);
        dpm_sim_side *side = &sim->side[c->t.side];
        if (c->t.start + sim->length[DPM_SIM_SLOTS] <= sim->now)
            return;
        if (c->t.port != port || c->t.wire_end <= sim->now || (c->t.flags & DPM_TAP_INJECTED))
            continue;
        if (side->busy_to == c->t.wire_end)
            side->busy_to = sim->now;
        c->slots = (uint16_t)dpm_sim_ended(sim, c, sim->now);
        if (side->quiet_from == (c->t.end < c->t.wire_end ? c->t.end : c->t.wire_end)) /* of half a character nobody knows */
            side->quiet_from = c->slots ? c->t.start + sim->length[c->slots] : side->quiet_before;
        dpm_sim_disregard(sim, &c->t, c->slots == 0);
        c->t.flags |= DPM_TAP_CUT;
        c->t.wire_end = sim->now;
    }
}
