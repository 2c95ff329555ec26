/* SPDX-License-Identifier: MIT
 *
 * The simulated segment's memory, for its three files: simulation.c (machines, hosts, time), simulation_wire.c (what
 * is on the wire, faults) and simulation_rules.c (the onlooker).
 */
#ifndef DPM_CORE_SIMULATION_PRIVATE_H
#define DPM_CORE_SIMULATION_PRIVATE_H

#include "dpmaster/simulation.h"

#define DPM_SIM_SLOTS 320   /* characters of the longest transmission as faults leave it */
#define DPM_SIM_EMPTY 0x80  /* mark of a slot in which nobody hears a character begin; else enum dpm_line_error */
#define DPM_SIM_BREACHES 64
#define DPM_SIM_BACKLOG 4095 /* octets that a serial port keeps for a host that does not read */

/* A transmission on the wire. As sent, until a fault or an overlap touches it: then `slots` say what is heard. */
typedef struct dpm_carried {
    dpm_transmission t;
    bool slotted;
    uint16_t slots;              /* characters its time on the wire is made of */
    uint8_t heard[DPM_SIM_SLOTS];
    uint8_t mark[DPM_SIM_SLOTS];
} dpm_carried;

typedef struct dpm_sim_port {
    dpm_machine *machine;
    dpm_simulation_host host;
    uint64_t draws;
    int64_t wake;     /* the machine's own next time */
    int64_t feed;     /* its host notices what was not read yet; DPM_NEVER: all was read */
    uint64_t next;    /* first transmission not read whole */
    uint16_t slot;    /* slots of it that were read */
    uint8_t side;
    bool on;
    int16_t address;  /* SA it was heard with last, -1 */
    int64_t on_since;
    int64_t stalled;  /* its host stands still until then, or has: its next read is the first since; 0: it runs */
    bool asks;        /* and its machine is asked before that */
    int64_t tx_start; /* its own last transmission: what others send meanwhile it does not hear */
    int64_t tx_end;
} dpm_sim_port;

/* What a host that stood still reads at once. */
typedef struct dpm_sim_backlog {
    size_t n;
    bool echo;
    uint8_t octets[DPM_SIM_BACKLOG];
    uint8_t errors[DPM_SIM_BACKLOG];
} dpm_sim_backlog;

typedef struct dpm_sim_token {
    int16_t holder; /* who it was passed to, -1 */
    int16_t passer; /* may repeat the pass until `taken` */
    bool taken;
} dpm_sim_token;

/* What an onlooker knows of one piece of wire. */
typedef struct dpm_sim_side {
    int64_t busy_to;     /* the wire is occupied until then; -1: nothing was ever heard */
    int64_t quiet_from;  /* the earliest that anybody may take for the end of the last octet */
    int64_t quiet_before; /* that without the last transmission */
    int64_t busy_since;  /* the first octet behind the last 33 Tbit of idle */
    bool babbled;
    /* the last transmission of a station */
    uint8_t last;        /* enum dpm_traffic; OTHER when it was not heard as sent: then only SYN holds */
    int16_t last_port;
    int16_t last_sa, last_da;
    uint64_t last_number;
    int64_t last_end;
    uint64_t request;    /* number of the last request, to know a repetition */
    /* the request that waits for its answer */
    bool pending;
    int16_t asker, asked;
    int64_t asked_earliest, asked_latest;
    /* the token */
    dpm_sim_token token;
    dpm_sim_token token_before; /* the last transmission */
    int64_t token_end;
    int64_t hold_until;  /* Ttr after the holder's token before */
    int64_t before;      /* that token's end, -1 */
    bool cycled;         /* a message cycle was begun under this token */
} dpm_sim_side;

typedef struct dpm_sim_share {
    dpm_simulation_share share;
    int64_t last; /* end of the token taken last; -1: out of the ring since */
} dpm_sim_share;

typedef struct dpm_sim_planned {
    dpm_simulation_plan plan;
    uint32_t seen;
    int64_t time;
} dpm_sim_planned;

typedef struct dpm_sim_injection {
    int64_t time; /* DPM_NEVER: free */
    int16_t port;
    uint8_t side;
    uint8_t n;
    uint8_t octets[DPM_TELEGRAM_MAX];
} dpm_sim_injection;

/* Limits in ns: minima rounded down and maxima up, so that a station's own rounding never breaks them. */
typedef struct dpm_sim_limits {
    int64_t syn, tid1, tid2, tsl, min_tsdr, max_tsdr, tsyni, ttr;
    int64_t tto[DPM_ADDRESS_MAX + 1];
} dpm_sim_limits;

struct dpm_simulation {
    dpm_simulation_config config;
    dpm_sim_limits limits;
    int64_t character;                 /* rounded up: how many fit is never over-estimated */
    int64_t length[DPM_SIM_SLOTS + 1]; /* ns of so many characters, rounded once */
    int64_t now;
    int64_t last_fault;  /* -1: none */
    uint16_t ports;
    uint8_t sides;       /* in use */
    uint64_t sent;       /* transmissions since init: the next one's number */
    int64_t next_injection;
    int64_t next_noise;
    bool faulty;
    dpm_simulation_faults faults;
    uint64_t octet_draws, telegram_draws, noise_draws;
    unsigned plans;
    dpm_sim_planned plan[DPM_SIMULATION_PLANS];
    dpm_sim_injection injection[2 * DPM_SIMULATION_PLANS]; /* the caller's; then one for each plan */
    dpm_sim_side side[DPM_SIMULATION_SIDES];
    dpm_sim_share share[128];
    dpm_simulation_statistics statistics;
    dpm_simulation_breach breach[DPM_SIM_BREACHES];
    int64_t due[DPM_SIMULATION_PORTS]; /* the earlier of wake and feed, for each port; together, to be looked through fast */
    dpm_sim_port port[DPM_SIMULATION_PORTS];
    dpm_sim_backlog backlog; /* empty but while a port reads */
    dpm_carried tap[];
};

/* --- simulation.c --- */

/* A transmission has begun: those who will hear it are woken by its end. */
void dpm_sim_announce(dpm_simulation *sim, const dpm_carried *carried);

/* --- simulation_wire.c --- */

static inline dpm_carried *dpm_sim_carried(dpm_simulation *sim, uint64_t number)
{
    return &sim->tap[number % sim->config.tap];
}

void dpm_sim_wire_init(dpm_simulation *sim);
/* A port (-1: noise) begins to send now. Returns the end as the sender knows it. */
int64_t dpm_sim_emit(dpm_simulation *sim, int port, unsigned side, uint8_t flags, const uint8_t *octets, size_t n);
/* The port's transmission under way ends here. */
void dpm_sim_break_off(dpm_simulation *sim, int port);
/* What faults have to send of their own, when its time has come. */
void dpm_sim_inject_due(dpm_simulation *sim);
/* Slots of a transmission that have ended by `time`. */
unsigned dpm_sim_ended(const dpm_simulation *sim, const dpm_carried *carried, int64_t time);

/* --- simulation_rules.c --- */

void dpm_sim_rules_init(dpm_simulation *sim);
/* Name what was sent: traffic, da, sa. Returns FC, 0 of a token or SC. */
uint8_t dpm_sim_classify(dpm_transmission *t);
/* A transmission begins now: judge it by what is known of its side, then remember it. What faults and overlaps made
 * of it is known by then. */
void dpm_sim_watch(dpm_simulation *sim, const dpm_carried *carried, uint8_t fc);
/* It is not what was meant any more: it was garbled by one that began later, or broke off, before any octet was heard
 * perhaps: then nobody can know of it. */
void dpm_sim_disregard(dpm_simulation *sim, const dpm_transmission *t, bool unheard);
/* A rule about times in ns was broken. */
void dpm_sim_breached(dpm_simulation *sim, const dpm_transmission *t, int rule, int64_t value, int64_t limit);
/* The station is out of the ring: its next rotation is not measured from its last token. */
void dpm_sim_forget(dpm_simulation *sim, int address);

#endif
