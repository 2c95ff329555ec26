/* SPDX-License-Identifier: MIT
 *
 * The event contract between the core's state machines and whatever drives them: the bus thread, the segment hub, a
 * test. A machine does no I/O, reads no clock, sleeps and allocates never. All calls on one machine come from one
 * thread at a time, with times that do not run backwards.
 *
 * The driver's loop, which is the whole of the contract:
 *
 *   1. ask(now). Nothing offered: wait until `wake` or until octets come.
 *   2. An offer that lies ahead (now < not_before): wait until then or until octets come, and ask again; octets may
 *      revoke it.
 *   3. An offer whose time has come: read once more; if that brought octets, report them and ask again. Else put it
 *      on the wire at once and report sent(). The machine drops by itself what is past `not_after`, and counts it.
 *   4. Whatever a read brings goes to octets(); a read begun after h that came back empty goes to quiet(h). Only
 *      quiet() lets a machine judge that something did not come: octets that lie in a FIFO are never called missing.
 */
#ifndef DPMASTER_MACHINE_H
#define DPMASTER_MACHINE_H

#include "dpmaster/api.h"

enum dpm_line_error {
    DPM_LINE_PARITY = 1,
    DPM_LINE_FRAMING = 2,
    DPM_LINE_OVERRUN = 4,
    DPM_LINE_BREAK = 8
};

/* Octets with the times of their last stop bit. The first ended within [earliest, latest]; octet i ended within
 * [earliest + i * spacing, latest + i * spacing]. A port that delivers in chunks widens the interval by its
 * granularity, so that what a machine concludes from times is certain. */
typedef struct dpm_span {
    const uint8_t *octets;
    const uint8_t *errors; /* enum dpm_line_error bits for each octet, or NULL: none */
    size_t n;
    int64_t earliest;
    int64_t latest;
    int64_t spacing;       /* ns per octet; 0 on an unpaced pty */
    bool echo;             /* our own transmission heard back, as it was heard: who has sent it compares */
} dpm_span;

/* What a machine wants to send now or soon, and when it wants to be asked again at the latest. */
typedef struct dpm_offer {
    const uint8_t *octets; /* valid until the next call on the machine */
    size_t n;              /* 0: nothing */
    int64_t not_before;
    int64_t not_after;
    int64_t wake;          /* DPM_NEVER: only octets can change anything */
} dpm_offer;

enum dpm_sent {
    DPM_SENT_WHOLE = 0,
    DPM_SENT_CUT = 1,    /* only a part left the port */
    DPM_SENT_FAILED = 2  /* nothing left the port */
};

typedef struct dpm_machine dpm_machine;
struct dpm_machine {
    void (*octets)(dpm_machine *, const dpm_span *);
    /* Everything that arrived up to `until` has been reported. */
    void (*quiet)(dpm_machine *, int64_t until);
    /* The last offer went out: it began at `start`, its last stop bit ends within [end_earliest, end_latest] (one
     * value where the driver measures or paces, an interval where the pace of a pty is unknown). */
    void (*sent)(dpm_machine *, int64_t start, int64_t end_earliest, int64_t end_latest, int result);
    void (*ask)(dpm_machine *, int64_t now, dpm_offer *);
    /* Counts what an onlooker may wait for (a cycle done, new outputs, a state change); wraps round. */
    uint32_t progress;
};

/* What a machine must know about the port it sits on (see csrc/linux/port.c for the measured defaults). */
typedef struct dpm_port_traits {
    int64_t allowance;   /* ns the host, ours or the other one, may be late in all, to hear a telegram and then to wake for its
                          * own: added to every slot time. In a ring of hosts that may be late by L at any wake, 8/3 L */
    int64_t granularity; /* ns of silence after which an unfinished telegram is given up */
    int64_t delivery;    /* ns from a telegram's first octet until it is handed over, where that is done only when it is whole */
    bool echo;           /* it is known to hear itself; else the first echo tells */
} dpm_port_traits;

#endif
