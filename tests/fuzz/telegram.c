/* SPDX-License-Identifier: MIT
 *
 * Fuzz target for decoder, encoder and receiver: `make fuzz`. Without libFuzzer the same checks replay files:
 *   gcc -DREPLAY -g -fsanitize=address,undefined -Iinclude -o build/replay tests/fuzz/telegram.c csrc/core/telegram.c \
 *       csrc/core/receiver.c && build/replay FILE...
 *
 * The first two octets of an input steer, the rest is the wire. Oracles: a verdict never changes as octets arrive; a
 * good telegram is encoded to the same octets and its sum, addresses and end are checked here once more; the receiver
 * takes every octet exactly once, cut or whole, and delivers nothing that held a line error.
 */
#include <string.h>

#include "dpmaster/error.h"
#include "dpmaster/receiver.h"
#include "target.h"

enum { CHARACTER = 1000, PATIENCE = 3000, GAP = 400, STEERING = 2 };

/* Octets of the telegram whose head is at wire[0], 0 when there is no head. */
static size_t claimed(const uint8_t *wire, size_t n)
{
    if (wire[0] == DPM_SD1)
        return 6;
    if (wire[0] == DPM_SD3)
        return 14;
    if (n >= 2 && wire[0] == DPM_SD2 && wire[1] >= 3 && wire[1] <= 249)
        return wire[1] + (size_t)6;
    return 0;
}

static uint8_t sum(const uint8_t *wire, size_t telegram)
{
    uint8_t total = 0;

    for (size_t i = wire[0] == DPM_SD2 ? 4 : 1; i < telegram - 2; i++)
        total = (uint8_t)(total + wire[i]);
    return total;
}

/* Random octets hardly ever have a good sum: give it to whatever has a head. */
static void repair(uint8_t *wire, size_t n)
{
    for (size_t at = 0, telegram; at < n; at += telegram ? telegram : 1) {
        telegram = claimed(wire + at, n - at);
        if (!telegram || telegram > n - at) {
            telegram = 0;
            continue;
        }
        if (wire[at] == DPM_SD2) {
            wire[at + 2] = wire[at + 1];
            wire[at + 3] = DPM_SD2;
        }
        wire[at + telegram - 2] = sum(wire + at, telegram);
        wire[at + telegram - 1] = DPM_ED;
    }
}

static void check_good(const uint8_t *wire, const dpm_telegram *telegram, size_t n)
{
    uint8_t again[DPM_TELEGRAM_MAX];
    const int encoded = dpm_encode(telegram, again, sizeof again);

    if (wire[0] == DPM_SD2 && wire[1] == 3) {
        MUST(encoded == DPM_E_LENGTH);
    } else {
        MUST(encoded == (int)n && memcmp(again, wire, n) == 0);
    }
    MUST(telegram->sa < DPM_BROADCAST && telegram->length <= DPM_DATA_MAX);
    MUST(!telegram->length || telegram->data + telegram->length <= wire + n);
    if (claimed(wire, n)) {
        MUST(n == claimed(wire, n) && wire[n - 1] == DPM_ED && wire[n - 2] == sum(wire, n));
    }
}

/* Every prefix in memory of exactly its size, so that a sanitizer sees one octet too many. */
static void decode(const uint8_t *wire, size_t n)
{
    int known = 0;

    for (size_t i = 0; i <= n && i <= DPM_TELEGRAM_MAX + 1; i++) {
        uint8_t *prefix = malloc(i ? i : 1);
        dpm_telegram telegram;

        memcpy(prefix, wire, i);
        const int verdict = dpm_decode(prefix, i, &telegram);
        MUST(verdict > -DPM_REJECT_COUNT && verdict <= (int)i);
        MUST(!known || verdict == known);
        MUST(verdict <= 0 || known || verdict == (int)i);
        MUST(verdict != 0 || i < DPM_TELEGRAM_MAX);
        if (verdict > 0)
            check_good(prefix, &telegram, (size_t)verdict);
        known = verdict;
        free(prefix);
    }
}

typedef struct {
    dpm_receiver receiver;
    const uint8_t *wire;
    const uint8_t *errors;
    size_t good; /* octets delivered */
    uint32_t hash;
} bench;

static size_t thrown_away(const dpm_receiver *receiver)
{
    size_t n = 0;

    for (int reason = 1; reason < DPM_REJECT_COUNT; reason++)
        n += receiver->rejected[reason];
    return n;
}

/* What was delivered lies where the counters say, and nothing in it was spoiled. */
static void note(bench *b, const dpm_received *received)
{
    const size_t at = b->good + thrown_away(&b->receiver);

    MUST(memcmp(b->wire + at, received->octets, received->n) == 0);
    for (size_t i = 0; i < received->n; i++)
        MUST(!b->errors[at + i]);
    b->good += received->n;
    b->hash = (b->hash * 31 + (uint32_t)at) * 31 + received->n;
}

static void feed(bench *b, size_t first, size_t n, int64_t pause, bool gap)
{
    const int64_t end = (int64_t)(first + 1) * CHARACTER + pause;
    dpm_span span = {b->wire + first, b->errors + first, n, end, end, CHARACTER, false};
    dpm_received received;

    b->receiver.gap = gap ? GAP : 0;
    while (dpm_receiver_take(&b->receiver, &span, &received))
        note(b, &received);
    MUST(span.n == 0);
    MUST(b->good + thrown_away(&b->receiver) + (size_t)(b->receiver.end - b->receiver.begin) == first + n);
    MUST(b->receiver.end - b->receiver.begin < DPM_TELEGRAM_MAX);
}

static void receive(const uint8_t *wire, const uint8_t *errors, size_t n, size_t chunk, bool gap)
{
    static bench whole, cut;
    dpm_received received;
    int64_t pause = 0;

    whole = cut = (bench){.wire = wire, .errors = errors};
    dpm_receiver_init(&whole.receiver, CHARACTER, PATIENCE, 0);
    dpm_receiver_init(&cut.receiver, CHARACTER, PATIENCE, 0);
    feed(&whole, 0, n, 0, false);
    for (size_t at = 0; at < n; at += chunk, pause += gap ? GAP + 1 : GAP)
        feed(&cut, at, chunk < n - at ? chunk : n - at, pause, gap);
    if (!gap) {
        MUST(cut.hash == whole.hash);
        MUST(memcmp(cut.receiver.rejected, whole.receiver.rejected, sizeof cut.receiver.rejected) == 0);
    }
    while (dpm_receiver_quiet(&cut.receiver, DPM_NEVER - 1, &received))
        note(&cut, &received);
    MUST(cut.good + thrown_away(&cut.receiver) == n && dpm_receiver_deadline(&cut.receiver) == DPM_NEVER);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size < STEERING || size > 4096)
        return 0;
    const size_t n = size - STEERING;
    uint8_t *wire = malloc(n + 1);
    uint8_t *errors = calloc(n + 1, 1);

    memcpy(wire, data + STEERING, n);
    if (data[0] & 1)
        repair(wire, n);
    if (data[0] & 2 && n)
        errors[data[1] % n] = DPM_LINE_PARITY;
    decode(wire, n);
    receive(wire, errors, n, (size_t)(data[0] >> 3) * 17 + 1, data[0] & 4);
    free(wire);
    free(errors);
    return 0;
}
