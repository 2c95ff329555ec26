/* SPDX-License-Identifier: MIT
 *
 * The stream receiver: octets and their times in, good telegrams out. It owns nothing but its block.
 *
 * There is one question at the first octet not yet judged, put to dpm_decode: good, bad or unfinished. Bad costs one
 * octet and the question is put again, so the next good telegram is found wherever it begins. Unfinished waits. What
 * ends the waiting is more octets, or a barrier: a line error, a certain pause or silence, across which no telegram
 * can go on. A barrier throws away what is unfinished, except for the good telegrams among its octets: they lay
 * behind noise that looked like a beginning.
 *
 * Spans marked as echo are not for the receiver: the machine that has sent compares them with what it sent.
 */
#include "dpmaster/receiver.h"

#include <string.h>

void dpm_receiver_init(dpm_receiver *receiver, int64_t character, int64_t patience, int64_t gap)
{
    memset(receiver, 0, sizeof *receiver);
    receiver->character = character;
    receiver->patience = patience;
    receiver->gap = gap;
}

/* A pause that the port's times allow but do not prove is no reason to drop a telegram, only to say so. */
static void count_unknown(dpm_receiver *r, size_t first, size_t last)
{
    for (size_t i = first; i < last; i++)
        if (r->latest[i + 1] - r->character - r->earliest[i] > r->gap)
            r->gaps_unknown++;
}

static void deliver(dpm_receiver *r, int n, const dpm_telegram *telegram, dpm_received *received)
{
    const size_t first = r->begin;
    const size_t last = first + (size_t)n - 1;

    if (r->gap)
        count_unknown(r, first, last);
    received->telegram = *telegram;
    received->octets = r->octets + first;
    received->n = (uint16_t)n;
    received->start_latest = r->latest[first] - r->character;
    received->end_earliest = r->earliest[last];
    received->end_latest = r->latest[last];
    r->begin = (uint16_t)(last + 1);
    r->rejected[0]++;
}

/* Judge what is stored: 1 with the next good telegram, else 0. Without a barrier an unfinished telegram stays; with one
 * (an enum dpm_reject) nothing stays, and every octet given up counts under that reason. */
static int judge(dpm_receiver *r, int barrier, dpm_received *received)
{
    dpm_telegram telegram;

    while (r->begin < r->end) {
        const int verdict = dpm_decode(r->octets + r->begin, (size_t)(r->end - r->begin), &telegram);

        if (verdict > 0) {
            deliver(r, verdict, &telegram, received);
            return 1;
        }
        if (verdict == 0 && !barrier)
            return 0;
        r->rejected[barrier ? barrier : -verdict]++;
        r->begin++;
    }
    return 0;
}

static bool pauses(const dpm_receiver *r, int64_t latest, int64_t next_earliest)
{
    return r->gap && next_earliest - r->character - latest > r->gap;
}

/* What stands between the octets stored and the first of the span: 0, or the reason why no telegram holds both. */
static int barrier_before(const dpm_receiver *r, const dpm_span *span)
{
    if (span->errors && span->errors[0])
        return DPM_REJECT_LINE;
    if (r->begin < r->end && pauses(r, r->latest[r->end - 1], span->earliest))
        return DPM_REJECT_GAP;
    return 0;
}

static void advance(dpm_span *span, size_t n)
{
    span->octets += n;
    span->errors = span->errors ? span->errors + n : NULL;
    span->n -= n;
    span->earliest += (int64_t)n * span->spacing;
    span->latest += (int64_t)n * span->spacing;
}

/* Room at the end. What is unfinished has at most 254 octets, so there is always some to make. */
static void make_room(dpm_receiver *r)
{
    const size_t kept = (size_t)(r->end - r->begin);

    if (kept && r->end < DPM_RECEIVER_OCTETS)
        return;
    memmove(r->octets, r->octets + r->begin, kept);
    memmove(r->earliest, r->earliest + r->begin, kept * sizeof *r->earliest);
    memmove(r->latest, r->latest + r->begin, kept * sizeof *r->latest);
    r->begin = 0;
    r->end = (uint16_t)kept;
}

/* Octets of the span up to the next barrier, at least one. */
static void store(dpm_receiver *r, dpm_span *span)
{
    /* Inside a span the pause between two octets is always the same. */
    const bool single = pauses(r, span->latest, span->earliest + span->spacing);
    size_t n = 1;

    make_room(r);
    if (!single) {
        n = (size_t)(DPM_RECEIVER_OCTETS - r->end);
        n = n < span->n ? n : span->n;
    }
    for (size_t i = 1; span->errors && i < n; i++)
        if (span->errors[i])
            n = i;
    memcpy(r->octets + r->end, span->octets, n);
    for (size_t i = 0; i < n; i++) {
        r->earliest[r->end + i] = span->earliest + (int64_t)i * span->spacing;
        r->latest[r->end + i] = span->latest + (int64_t)i * span->spacing;
    }
    r->end = (uint16_t)(r->end + n);
    advance(span, n);
}

int dpm_receiver_take(dpm_receiver *receiver, dpm_span *span, dpm_received *received)
{
    for (;;) {
        if (judge(receiver, 0, received))
            return 1;
        if (span->n == 0)
            return 0;
        const int barrier = barrier_before(receiver, span);
        if (barrier && judge(receiver, barrier, received))
            return 1;
        if (barrier == DPM_REJECT_LINE) {
            receiver->rejected[DPM_REJECT_LINE]++;
            advance(span, 1);
        } else {
            store(receiver, span);
        }
    }
}

int dpm_receiver_quiet(dpm_receiver *receiver, int64_t until, dpm_received *received)
{
    if (judge(receiver, 0, received))
        return 1;
    return until >= dpm_receiver_deadline(receiver) && judge(receiver, DPM_REJECT_INCOMPLETE, received);
}

void dpm_receiver_flush(dpm_receiver *receiver)
{
    receiver->rejected[DPM_REJECT_INCOMPLETE] += (uint32_t)(receiver->end - receiver->begin);
    receiver->begin = receiver->end;
}

int64_t dpm_receiver_deadline(const dpm_receiver *receiver)
{
    return receiver->begin < receiver->end ? receiver->latest[receiver->end - 1] + receiver->patience : DPM_NEVER;
}
