/* SPDX-License-Identifier: MIT
 *
 * The stream receiver: octets with times and line errors in, good telegrams out. After noise it takes up the next
 * good telegram, wherever that begins, and counts every octet that it threw away by reason. An unfinished telegram
 * holds the line until it is complete, proved bad, or the bus has been silent for `patience`: octets inside a
 * telegram are never taken for one of their own. A line error, a certain gap or silence breaks what is unfinished; good
 * telegrams among its octets lay behind noise and are found then. Spans marked as echo are not for the receiver.
 */
#ifndef DPMASTER_RECEIVER_H
#define DPMASTER_RECEIVER_H

#include "dpmaster/machine.h"
#include "dpmaster/telegram.h"

#define DPM_RECEIVER_OCTETS 512

typedef struct dpm_receiver {
    uint8_t octets[DPM_RECEIVER_OCTETS];
    int64_t earliest[DPM_RECEIVER_OCTETS]; /* end of each octet */
    int64_t latest[DPM_RECEIVER_OCTETS];
    uint16_t begin;       /* first octet not yet judged */
    uint16_t end;
    int64_t patience;     /* ns of silence that end an unfinished telegram */
    int64_t gap;          /* ns: a certain pause longer than this inside a telegram breaks it; 0: never judged */
    int64_t character;    /* ns of one character */
    uint32_t rejected[DPM_REJECT_COUNT]; /* octets thrown away, by enum dpm_reject; [0] counts good telegrams */
    uint32_t gaps_unknown; /* pauses that might have been too long, within what the port can tell */
} dpm_receiver;

/* A telegram and when it was on the wire. The telegram's data live until the next call on the receiver. */
typedef struct dpm_received {
    dpm_telegram telegram;
    const uint8_t *octets;
    uint16_t n;
    int64_t start_latest; /* the first start bit came not after this */
    int64_t end_earliest; /* the last stop bit ended within [end_earliest, end_latest] */
    int64_t end_latest;
} dpm_received;

DPM_API void dpm_receiver_init(dpm_receiver *receiver, int64_t character, int64_t patience, int64_t gap);

/* Take octets from `span`, which is advanced past what was taken, until one good telegram is found (1) or the span
 * is used up (0). Call it until it returns 0. */
DPM_API int dpm_receiver_take(dpm_receiver *receiver, dpm_span *span, dpm_received *received);

/* The bus was silent up to `until`. Gives up an unfinished telegram whose patience has run out and looks for good
 * ones among its octets: returns 1 with one, 0 when there is none (left). Call it until it returns 0. */
DPM_API int dpm_receiver_quiet(dpm_receiver *receiver, int64_t until, dpm_received *received);

/* Throw away what is unfinished, counted as incomplete: we are about to talk. */
DPM_API void dpm_receiver_flush(dpm_receiver *receiver);

/* When the silence that quiet() needs is over: the last octet's time plus patience, DPM_NEVER when nothing waits. */
DPM_API int64_t dpm_receiver_deadline(const dpm_receiver *receiver);

#endif
