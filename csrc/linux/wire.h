/* SPDX-License-Identifier: MIT
 *
 * The wire inside the segment hub: who occupies it when, what is garbled where two talk at once, which faults are
 * made. No system calls and no clock: times are the caller's, so every rule can be tested one event at a time.
 * Private to csrc/linux.
 */
#ifndef DPM_LINUX_WIRE_H
#define DPM_LINUX_WIRE_H

#include "dpmaster/api.h"
#include "dpmaster/segment.h"

#define DPM_WIRE_PUT 255    /* octets of one put: the longest telegram */
#define DPM_WIRE_OCTETS 768 /* three puts, so that faults (an octet inserted and one doubled for each) always fit */
#define DPM_WIRE_FLIGHTS 4  /* transmissions of one source that wait for their end */

/* A transmission: octet i occupies the wire from start + i characters to start + (i + 1) characters. */
typedef struct dpm_flight {
    int64_t start;
    int64_t end;
    int64_t due;   /* when it is delivered: its end, later by the fault "delay" */
    uint16_t n;
    bool collided;
    bool bad;      /* any of `errors` */
    uint8_t octets[DPM_WIRE_OCTETS]; /* as they were sent */
    uint8_t heard[DPM_WIRE_OCTETS];  /* as everybody hears them */
    uint8_t errors[DPM_WIRE_OCTETS]; /* line errors with that, enum dpm_line_error */
} dpm_flight;

/* One source's transmissions, in their order: a source cannot talk over itself. */
typedef struct dpm_lane {
    int64_t free; /* end of its last transmission */
    uint8_t first;
    uint8_t count;
    dpm_flight flights[DPM_WIRE_FLIGHTS];
} dpm_lane;

typedef struct dpm_wire {
    uint32_t rate_num;
    uint32_t rate_den;
    bool paced;    /* else a character lasts 0 and nothing collides */
    bool faulty;   /* any chance above 0 */
    uint16_t lanes;
    uint16_t waiting; /* flights in all lanes */
    dpm_lane *lane;
    dpm_segment_faults faults;
    uint64_t octet_draws;    /* states of the two generators: of octets, so that how a telegram was cut into */
    uint64_t telegram_draws; /* writes does not matter to them, and of transmissions */
    uint64_t transmissions;
    uint64_t octets;
    uint64_t collisions;
    uint64_t touched;
} dpm_wire;

/* `lanes` sources; `lane` is theirs, zeroed, and the caller's. */
void dpm_wire_init(dpm_wire *wire, const dpm_parameters *rate, bool paced, dpm_lane *lane, uint16_t lanes);
void dpm_wire_set_faults(dpm_wire *wire, const dpm_segment_faults *faults);

/* ns that `n` characters last. */
int64_t dpm_wire_time(const dpm_wire *wire, size_t n);
/* Nothing waits and nothing needs to: what is put may be delivered at once. */
bool dpm_wire_direct(const dpm_wire *wire);
/* The source may put up to DPM_WIRE_PUT octets. */
bool dpm_wire_room(const dpm_wire *wire, unsigned source);

/* n <= DPM_WIRE_PUT octets as the faults leave them, at most 3 n, with their line errors; counts them. Returns how many are
 * left. */
size_t dpm_wire_damage(dpm_wire *wire, const uint8_t *octets, size_t n, uint8_t *out, uint8_t *errors);
/* Put n octets (after damage, with their line errors or NULL) of `source` on the wire at `now`: they follow its last
 * transmission, as part of it while that is still on the wire. Returns their start. Needs dpm_wire_room. */
int64_t dpm_wire_put(dpm_wire *wire, unsigned source, int64_t now, const uint8_t *octets, const uint8_t *errors, size_t n);

/* When the next transmission is to be delivered, DPM_NEVER. */
int64_t dpm_wire_due(const dpm_wire *wire);
/* The transmission due first, if that is not after `now`, and its source; else NULL. Valid until the next put. */
const dpm_flight *dpm_wire_take(dpm_wire *wire, int64_t now, unsigned *source);
/* Up to when everything that ended on the wire was delivered: a transmission in flight hides what came after its start. */
int64_t dpm_wire_heard(const dpm_wire *wire, int64_t now, unsigned listener);

#endif
