/* SPDX-License-Identifier: MIT
 *
 * A machine for tests of the bus thread, far simpler than a master: it sends one request again and again, counts whole
 * answers and time-outs, and can be told to be silent. Built as a shared object by the test that uses it.
 */
#include <stdlib.h>
#include <string.h>

#include "dpmaster/machine.h"

typedef struct probe {
    dpm_machine machine;
    int64_t pause;       /* ns between two exchanges; -1: silent */
    int64_t patience;    /* ns for an answer; 0: none is awaited, the next request is due at once; -1: it offers too late */
    uint8_t request[32];
    uint64_t n;
    uint64_t answer;     /* octets of an answer */
    /* Results. */
    uint64_t asks;
    uint64_t exchanges;
    uint64_t timeouts;
    uint64_t failed;
    uint64_t early;      /* requests that went out before their time */
    uint64_t hasty;      /* requests that went out otherwise than straight after an empty read and a question */
    /* State. */
    int64_t next;
    int64_t deadline;    /* 0: no answer is awaited */
    uint64_t got;
    int64_t questions;   /* since the last empty read; -1: something came or went since */
} probe;

static void finish(probe *p, uint64_t *count, int64_t now)
{
    ++*count;
    p->deadline = 0;
    p->next = now + p->pause;
    p->machine.progress++;
}

static void octets(dpm_machine *machine, const dpm_span *span)
{
    probe *p = (probe *)machine;
    p->questions = -1;
    if (!p->deadline)
        return;
    p->got += span->n;
    if (p->got >= p->answer)
        finish(p, &p->exchanges, span->latest);
}

static void quiet(dpm_machine *machine, int64_t until)
{
    probe *p = (probe *)machine;
    p->questions = 0;
    if (p->deadline && until >= p->deadline)
        finish(p, &p->timeouts, until);
}

static void sent(dpm_machine *machine, int64_t start, int64_t end_earliest, int64_t end_latest, int result)
{
    probe *p = (probe *)machine;
    (void)end_earliest;
    p->early += start < p->next;
    p->hasty += p->questions != 1;
    p->questions = -1;
    p->got = 0;
    if (result == DPM_SENT_FAILED)
        finish(p, &p->failed, end_latest);
    else if (p->patience)
        p->deadline = end_latest + p->patience;
    else
        finish(p, &p->exchanges, end_latest);
}

static void ask(dpm_machine *machine, int64_t now, dpm_offer *offer)
{
    probe *p = (probe *)machine;
    p->asks++;
    if (p->questions >= 0)
        p->questions++;
    memset(offer, 0, sizeof *offer);
    offer->wake = p->deadline ? p->deadline : DPM_NEVER;
    if (p->deadline || p->pause < 0)
        return;
    offer->octets = p->request;
    offer->n = p->n;
    offer->not_before = p->next;
    offer->not_after = p->patience < 0 ? now - 1 : DPM_NEVER;
}

probe *probe_new(const uint8_t *request, size_t n, size_t answer, int64_t pause, int64_t patience)
{
    probe *p = calloc(1, sizeof *p);
    p->machine = (dpm_machine){octets, quiet, sent, ask, 0};
    memcpy(p->request, request, n);
    p->n = n;
    p->answer = answer;
    p->pause = pause;
    p->patience = patience;
    p->questions = -1;
    return p;
}

uint64_t probe_count(const probe *p, int which)
{
    const uint64_t counts[] = {p->asks, p->exchanges, p->timeouts, p->failed, p->early, p->hasty};
    return counts[which];
}
