/* SPDX-License-Identifier: MIT
 *
 * The simulated segment: machines on one wire of virtual time, and an onlooker who knows the rules of the bus. The
 * same thing as the segment hub (segment.h) without ptys, processes and a clock, so an hour of bus is minutes, a run
 * is repeated by its seed, and every timing rule is an assertion.
 *
 * An octet lasts 11 bit times and is heard when its stop bit has ended. A telegram travels as one span with implied
 * octet times and reaches an exact host at its end; a host that has something to do before that (an offer, a
 * deadline) is first given the octets that have ended by then. What has begun and not ended nobody can know of.
 *
 * Two that talk at once: the octets that share time are heard as what both drivers leave (the AND) with a line error,
 * once: a receiver that is inside a character sees no other begin.
 *
 * Times are ns; those of a rule are thousandths of a bit time.
 */
#ifndef DPMASTER_SIMULATION_H
#define DPMASTER_SIMULATION_H

#include "dpmaster/machine.h"
#include "dpmaster/parameters.h"
#include "dpmaster/telegram.h"

#define DPM_SIMULATION_PORTS 128
#define DPM_SIMULATION_SIDES 8  /* pieces the wire can be cut into */
#define DPM_SIMULATION_PLANS 16 /* planned faults, and transmissions that wait to be injected */
#define DPM_SIMULATION_TAP 64   /* the fewest transmissions that can be kept */

typedef struct dpm_simulation_config {
    dpm_parameters parameters; /* the bus's: pace and rules */
    uint16_t ports;            /* 1..128 */
    uint16_t tap;              /* transmissions kept for diagnosis and for hosts that are late, 64.. */
    int64_t grace;             /* what is broken within this time after a fault or a cut is excused: counted apart */
} dpm_simulation_config;

/* What a port's computer is like. All zero: exact. Octets of a host that is not exact get the times an honest port
 * would give: latest is the read, earliest no closer than the bounds allow. */
typedef struct dpm_simulation_host {
    uint64_t seed;
    int64_t lateness; /* from an event, or the time a machine asked for, to its being served: drawn from 0 to this */
    int64_t chunk;    /* octets are delivered at multiples of this only (USB adapters); 0: at once */
    bool echo;        /* hears its own transmissions */
} dpm_simulation_host;

/* Faults on the wire, the same for all who hear. Chances are per million. */
typedef struct dpm_simulation_faults {
    uint64_t seed;
    uint32_t lose;          /* an octet: its time stays empty */
    uint32_t flip;          /* one bit and the parity bit: no line error tells */
    uint32_t parity;        /* one bit: a line error tells */
    uint32_t insert;        /* a random octet before this one; what follows comes one character later */
    uint32_t duplicate;
    uint32_t lose_telegram;
    int64_t noise;          /* mean time between bursts of random octets, 0: none */
    uint8_t noise_octets;   /* a burst's longest, 1.. */
} dpm_simulation_faults;

enum dpm_traffic {
    DPM_TRAFFIC_OTHER = 0, /* no whole telegram */
    DPM_TRAFFIC_TOKEN,
    DPM_TRAFFIC_REQUEST,   /* one that wants an answer */
    DPM_TRAFFIC_SDN,
    DPM_TRAFFIC_ANSWER     /* SC too */
};

enum dpm_fault {
    DPM_FAULT_LOSE = 0,    /* nobody hears it */
    DPM_FAULT_GARBLE,      /* one octet comes with a line error */
    DPM_FAULT_DOUBLE,      /* comes once more, `after` its end */
    DPM_FAULT_DELAY,       /* comes `after` later than it was sent */
    DPM_FAULT_INJECT       /* `octets` are heard as well, `after` its start */
};

/* One planned fault: the nth telegram of a kind from now on. */
typedef struct dpm_simulation_plan {
    uint8_t traffic;       /* enum dpm_traffic */
    int16_t address;       /* of a token or a request the receiver's, of an answer the sender's; -1: any. SC has none */
    uint32_t nth;          /* 1.. */
    uint8_t fault;         /* enum dpm_fault */
    int64_t after;         /* ns */
    uint8_t n;             /* octets to inject */
    uint8_t octets[16];
} dpm_simulation_plan;

enum dpm_rule {
    DPM_RULE_SYN = 0,      /* less than 33 Tbit of idle before a request or token */
    DPM_RULE_TID1,         /* after an answer or a token */
    DPM_RULE_TID2,         /* after an SDN */
    DPM_RULE_SLOT,         /* repeated or gone on before the slot was over */
    DPM_RULE_MIN_TSDR,
    DPM_RULE_MAX_TSDR,     /* twice the host's lateness and its chunk are allowed on top */
    DPM_RULE_COLLISION,    /* began while the wire was busy; value: for how long it still was */
    DPM_RULE_BABBLING,     /* more than Tsyni without 33 Tbit of idle */
    DPM_RULE_HOLD,         /* a cycle begun past Ttr, other than the one of high priority; value: since the last token */
    DPM_RULE_WHOLE,        /* not one whole telegram without a gap; value and limit: octets */
    DPM_RULE_UNASKED,      /* an answer by a station that was not asked; value: its address, -1 for SC */
    DPM_RULE_TOKENS,       /* a token passed by who does not have it, or claimed before Tto; value: silence */
    DPM_RULE_RIGHT,        /* a request without the token; value: who holds it, -1 nobody */
    DPM_RULE_COUNT
};

typedef struct dpm_simulation_breach {
    uint8_t rule;          /* enum dpm_rule */
    int16_t port;
    int16_t address;       /* SA of the telegram, -1 */
    int64_t time;          /* start of the transmission */
    int64_t value;
    int64_t limit;
    uint64_t transmission; /* its number */
} dpm_simulation_breach;

enum dpm_tap_flags {
    DPM_TAP_LOST = 1,       /* by a fault: nobody heard it */
    DPM_TAP_TOUCHED = 2,    /* by a fault: heard otherwise than sent */
    DPM_TAP_COLLIDED = 4,
    DPM_TAP_INJECTED = 8,   /* noise, or the copy a fault made: no station's doing now */
    DPM_TAP_CUT = 16        /* its port lost power or was moved before the end */
};

typedef struct dpm_transmission {
    uint64_t number;       /* 0.. since init */
    int64_t start;         /* first start bit */
    int64_t end;           /* last stop bit, as its sender knows it */
    int64_t wire_end;      /* as it was heard: faults make it longer or shorter */
    int16_t port;          /* -1: noise */
    uint8_t side;
    uint8_t flags;         /* enum dpm_tap_flags */
    uint8_t traffic;       /* enum dpm_traffic */
    int16_t da;            /* -1: none */
    int16_t sa;
    uint8_t n;
    uint8_t octets[DPM_TELEGRAM_MAX]; /* as sent */
} dpm_transmission;

typedef struct dpm_simulation_statistics {
    int64_t since;         /* init, or the last clear */
    int64_t busy;          /* ns of octets sent: over the time since then, the bus load */
    uint64_t transmissions;
    uint64_t tokens;       /* telegrams */
    uint64_t collisions;
    uint64_t noise;        /* bursts */
    uint64_t touched;      /* octets and telegrams that faults touched */
    uint64_t overrun;      /* transmissions a late host never read since the tap had gone on */
    uint64_t violations;
    uint64_t excused[DPM_RULE_COUNT]; /* within the grace */
} dpm_simulation_statistics;

/* One master's share. A token counts when its receiver first uses or passes it. */
typedef struct dpm_simulation_share {
    uint64_t tokens;
    uint64_t requests;     /* SDN and repetitions too */
    uint64_t rotations;    /* measured; mean = sum / rotations */
    int64_t rotation_min;
    int64_t rotation_max;
    int64_t rotation_sum;
} dpm_simulation_share;

/* When a run ends before its time; 0 and false: never. Counts are of the run. */
typedef struct dpm_simulation_stop {
    bool violation;
    uint64_t tokens;
    uint64_t transmissions;
} dpm_simulation_stop;

enum dpm_simulation_stopped {
    DPM_STOPPED_TIME = 0,
    DPM_STOPPED_VIOLATION,
    DPM_STOPPED_TOKENS,
    DPM_STOPPED_TRANSMISSIONS
};

typedef struct dpm_simulation dpm_simulation;

DPM_API size_t dpm_simulation_size(const dpm_simulation_config *config);
/* DPM_E_ARGUMENT, DPM_E_PARAMETER, DPM_E_BLOCK. */
DPM_API int dpm_simulation_init(void *block, size_t size, const dpm_simulation_config *config, dpm_simulation **simulation);

/* Put a machine on the wire, powered, on side 0; NULL: an exact host. Returns its port, or DPM_E_FULL, DPM_E_ARGUMENT. */
DPM_API int dpm_simulation_attach(dpm_simulation *simulation, dpm_machine *machine, const dpm_simulation_host *host);
/* A machine without power is not called and hears nothing; its transmission breaks off. */
DPM_API int dpm_simulation_power(dpm_simulation *simulation, unsigned port, bool on);
/* The port's host stands still from now until `until`, a time to come. What came meanwhile is read at once then, and as a
 * serial port reads it: octets of which the last has just come, 4095 at the most. `asks`: it stood before its machine was
 * asked, so that is the first thing it does; else the first is the read. DPM_E_ARGUMENT. */
DPM_API int dpm_simulation_stall(dpm_simulation *simulation, unsigned port, int64_t until, bool asks);
/* Ports hear those on their own side, 0..7: two halves of a cut wire, one port alone, all joined again. */
DPM_API int dpm_simulation_place(dpm_simulation *simulation, unsigned port, unsigned side);

DPM_API void dpm_simulation_set_faults(dpm_simulation *simulation, const dpm_simulation_faults *faults);
/* Returns the plan's index, DPM_E_FULL, DPM_E_ARGUMENT. */
DPM_API int dpm_simulation_add_plan(dpm_simulation *simulation, const dpm_simulation_plan *plan);
/* When a plan came true, DPM_NEVER until then. */
DPM_API int64_t dpm_simulation_plan_time(const dpm_simulation *simulation, unsigned plan);
/* Octets (1..255) out of nowhere on a side at a time to come. DPM_E_FULL, DPM_E_ARGUMENT. */
DPM_API int dpm_simulation_inject(dpm_simulation *simulation, unsigned side, int64_t time, const uint8_t *octets, size_t n);

DPM_API int64_t dpm_simulation_now(const dpm_simulation *simulation);
/* Run to `until`, or to what `stop` (may be NULL) says; every machine is asked first, since its owner may have changed
 * it. Returns an enum dpm_simulation_stopped. */
DPM_API int dpm_simulation_run(dpm_simulation *simulation, int64_t until, const dpm_simulation_stop *stop);

/* The i-th rule broken, of the first 64: 1, or 0 when there were not so many. */
DPM_API int dpm_simulation_violation(const dpm_simulation *simulation, unsigned i, dpm_simulation_breach *breach);
/* "SYN", "Tid1", "min Tsdr", ... */
DPM_API const char *dpm_rule_name(int rule);
/* The transmission `back` before the latest (0), while the tap keeps it: 1 or 0. */
DPM_API int dpm_simulation_tap(const dpm_simulation *simulation, unsigned back, dpm_transmission *transmission);
DPM_API void dpm_simulation_get_statistics(const dpm_simulation *simulation, dpm_simulation_statistics *statistics);
DPM_API void dpm_simulation_get_share(const dpm_simulation *simulation, unsigned address, dpm_simulation_share *share);
/* Statistics, shares and violations begin anew; what the rules know of the bus stays. */
DPM_API void dpm_simulation_clear(dpm_simulation *simulation);

#endif
