/* SPDX-License-Identifier: MIT
 *
 * The wire inside the segment hub (wire.h): pure arithmetic on intervals and octets.
 */
#include "linux/wire.h"

#include <string.h>

#include "core/chance.h"

void dpm_wire_init(dpm_wire *wire, const dpm_parameters *rate, bool paced, dpm_lane *lane, uint16_t lanes)
{
    memset(wire, 0, sizeof *wire);
    wire->rate_num = rate->rate_num;
    wire->rate_den = rate->rate_den;
    wire->paced = paced;
    wire->lane = lane;
    wire->lanes = lanes;
}

void dpm_wire_set_faults(dpm_wire *wire, const dpm_segment_faults *faults)
{
    wire->faults = *faults;
    wire->faulty = faults->lose || faults->flip || faults->parity || faults->insert || faults->duplicate ||
                   faults->lose_telegram;
    wire->octet_draws = faults->seed;
    wire->telegram_draws = ~faults->seed;
}

int64_t dpm_wire_time(const dpm_wire *wire, size_t n)
{
    if (!wire->paced)
        return 0;
    /* Once for all characters, so that roundings do not add up. */
    return (int64_t)n * DPM_CHARACTER_BITS * 1000000000 * wire->rate_den / wire->rate_num;
}

bool dpm_wire_direct(const dpm_wire *wire)
{
    return !wire->paced && wire->waiting == 0 && wire->faults.delay == 0;
}

bool dpm_wire_room(const dpm_wire *wire, unsigned source)
{
    return wire->lane[source].count < DPM_WIRE_FLIGHTS;
}

size_t dpm_wire_damage(dpm_wire *wire, const uint8_t *octets, size_t n, uint8_t *out, uint8_t *errors)
{
    const dpm_segment_faults *faults = &wire->faults;
    size_t left = 0;
    if (dpm_hit(dpm_draw(&wire->telegram_draws), faults->lose_telegram)) {
        wire->touched++;
        return 0;
    }
    memset(errors, 0, 3 * n);
    for (size_t i = 0; i < n; i++) {
        /* Five draws for each octet, whatever they bring: the faults of one octet do not move those of the next. */
        uint64_t insert = dpm_draw(&wire->octet_draws), lose = dpm_draw(&wire->octet_draws);
        uint64_t flip = dpm_draw(&wire->octet_draws), parity = dpm_draw(&wire->octet_draws);
        uint64_t duplicate = dpm_draw(&wire->octet_draws);
        if (dpm_hit(insert, faults->insert)) {
            out[left++] = (uint8_t)insert;
            wire->touched++;
        }
        if (dpm_hit(lose, faults->lose)) {
            wire->touched++;
            continue;
        }
        out[left] = octets[i];
        if (dpm_hit(flip, faults->flip)) {
            out[left] ^= (uint8_t)(1u << (flip & 7));
            wire->touched++;
        }
        if (dpm_hit(parity, faults->parity)) {
            out[left] ^= (uint8_t)(1u << (parity & 7));
            errors[left] = DPM_LINE_PARITY;
            wire->touched++;
        }
        left++;
        if (dpm_hit(duplicate, faults->duplicate)) {
            out[left] = out[left - 1];
            errors[left] = errors[left - 1];
            left++;
            wire->touched++;
        }
    }
    return left;
}

static void collided(dpm_wire *wire, dpm_flight *flight)
{
    if (!flight->collided)
        wire->collisions++;
    flight->collided = flight->bad = true;
}

/* Octets `from`.. of `a` against all of `b`: where two octets share time, both are heard as what two drivers leave of
 * them, here the AND, which is the same whichever came first, with a line error. */
static void garble(dpm_wire *wire, dpm_flight *a, size_t from, dpm_flight *b)
{
    int64_t character = dpm_wire_time(wire, 1);
    if (a->start >= b->end || b->start >= a->end)
        return;
    for (size_t i = from; i < a->n; i++) {
        int64_t begin = a->start + dpm_wire_time(wire, i), end = a->start + dpm_wire_time(wire, i + 1);
        /* A character taken as too long: the index may be too small, never too large. */
        size_t j = begin > b->start ? (size_t)((begin - b->start) / (character + 1)) : 0;
        for (; j < b->n && b->start + dpm_wire_time(wire, j) < end; j++) {
            if (b->start + dpm_wire_time(wire, j + 1) <= begin)
                continue;
            a->heard[i] &= b->octets[j];
            b->heard[j] &= a->octets[i];
            a->errors[i] = b->errors[j] = DPM_LINE_PARITY;
            collided(wire, a);
            collided(wire, b);
        }
    }
}

static void collide(dpm_wire *wire, unsigned source, dpm_flight *flight, size_t from)
{
    for (unsigned other = 0; wire->paced && other < wire->lanes; other++) {
        dpm_lane *lane = &wire->lane[other];
        for (unsigned i = 0; other != source && i < lane->count; i++)
            garble(wire, flight, from, &lane->flights[(lane->first + i) % DPM_WIRE_FLIGHTS]);
    }
}

/* A write that came in two reads is one transmission while its first part is still on the wire. */
static bool continues(const dpm_wire *wire, const dpm_lane *lane, int64_t now, size_t n)
{
    if (!wire->paced || lane->count == 0 || now > lane->free)
        return false;
    return lane->flights[(lane->first + lane->count - 1) % DPM_WIRE_FLIGHTS].n + n <= DPM_WIRE_OCTETS;
}

int64_t dpm_wire_put(dpm_wire *wire, unsigned source, int64_t now, const uint8_t *octets, const uint8_t *errors, size_t n)
{
    dpm_lane *lane = &wire->lane[source];
    int64_t start = now > lane->free ? now : lane->free;
    if (n == 0)
        return start;
    bool more = continues(wire, lane, now, n);
    lane->count = (uint8_t)(lane->count + !more);
    dpm_flight *flight = &lane->flights[(lane->first + lane->count - 1) % DPM_WIRE_FLIGHTS];
    if (!more) {
        flight->start = start;
        flight->n = 0;
        flight->collided = flight->bad = false;
        wire->waiting++;
        wire->transmissions++;
    }
    size_t from = flight->n;
    memcpy(flight->octets + from, octets, n);
    memcpy(flight->heard + from, octets, n);
    memset(flight->errors + from, 0, n);
    for (size_t i = 0; errors && i < n; i++)
        flight->bad |= (flight->errors[from + i] = errors[i]);
    flight->n = (uint16_t)(from + n);
    flight->end = lane->free = flight->start + dpm_wire_time(wire, flight->n);
    flight->due = flight->end + wire->faults.delay;
    wire->octets += n;
    collide(wire, source, flight, from);
    return start;
}

static const dpm_flight *first(const dpm_lane *lane)
{
    return &lane->flights[lane->first];
}

int64_t dpm_wire_due(const dpm_wire *wire)
{
    int64_t due = DPM_NEVER;
    for (unsigned i = 0; wire->waiting && i < wire->lanes; i++)
        if (wire->lane[i].count && first(&wire->lane[i])->due < due)
            due = first(&wire->lane[i])->due;
    return due;
}

const dpm_flight *dpm_wire_take(dpm_wire *wire, int64_t now, unsigned *source)
{
    int64_t due = dpm_wire_due(wire);
    if (due > now)
        return NULL;
    for (*source = 0; !wire->lane[*source].count || first(&wire->lane[*source])->due != due;)
        ++*source;
    dpm_lane *lane = &wire->lane[*source];
    const dpm_flight *flight = first(lane);
    lane->first = (uint8_t)((lane->first + 1) % DPM_WIRE_FLIGHTS);
    lane->count--;
    wire->waiting--;
    return flight;
}

int64_t dpm_wire_heard(const dpm_wire *wire, int64_t now, unsigned listener)
{
    for (unsigned i = 0; wire->waiting && i < wire->lanes; i++)
        if (i != listener && wire->lane[i].count && first(&wire->lane[i])->start < now)
            now = first(&wire->lane[i])->start;
    return now;
}
