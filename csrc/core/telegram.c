/* SPDX-License-Identifier: MIT
 *
 * Telegrams: octets to meaning and back. Pure functions on the caller's memory.
 *
 * The decoder judges strictly in the order of the octets, so that what it says of a telegram it says of every prefix
 * long enough to know: a receiver can resynchronise at the first octet that cannot be right.
 */
#include "dpmaster/telegram.h"

#include <string.h>

#include "dpmaster/error.h"

enum {
    EXTENDED = 0x80, /* in DA and SA: extension octets follow; in an extension octet: one more follows */
    SEGMENT = 0x40,  /* an extension octet with a region/segment address instead of a SAP */
    NUMBER = 0x3F,
    HEADER = 3,      /* DA SA FC: what LE counts besides extensions and data */
    FIXED_DATA = 8,  /* octets behind FC in an SD3 */
    LE_MIN = 3,
    LE_MAX = 249
};

static const char *const reject_names[DPM_REJECT_COUNT] = {
    "good", "delimiter", "length", "length twice", "second delimiter", "FCS", "end delimiter",
    "address", "extension", "line error", "gap", "incomplete",
};

const char *dpm_reject_name(int reason)
{
    return reason >= 0 && reason < DPM_REJECT_COUNT ? reject_names[reason] : "unknown";
}

/* The extensions of one side at body[*at]: a SAP, a segment, or a segment and then a SAP (one order only, so that a
 * telegram has one encoding). `others` octets of the other side must still fit behind them. 1 good, 0 more octets
 * needed, negative bad. */
static int decode_side(const uint8_t *body, size_t have, size_t le, size_t others, size_t *at,
                       int16_t *segment, int16_t *sap)
{
    uint8_t octet = EXTENDED;

    for (bool first = true; octet & EXTENDED; first = false) {
        if (*at + 1 + others > le)
            return -DPM_REJECT_EXTENSION;
        if (*at >= have)
            return 0;
        octet = body[(*at)++];
        if (octet & SEGMENT ? !first : octet & EXTENDED)
            return -DPM_REJECT_EXTENSION;
        *(octet & SEGMENT ? segment : sap) = octet & NUMBER;
    }
    return 1;
}

/* SD1, SD2 and SD3 from DA on; `le` octets lie between here and FCS. */
static int decode_body(const uint8_t *octets, size_t n, size_t head, size_t le, dpm_telegram *telegram)
{
    const uint8_t *body = octets + head;
    const size_t have = n > head ? n - head : 0;
    dpm_telegram t = {octets[0], 0, 0, 0, DPM_NO_SAP, DPM_NO_SAP, -1, -1, 0, NULL};
    size_t at = HEADER;
    uint8_t sum = 0;
    int verdict;

    if (have < 1)
        return 0;
    if (body[0] & EXTENDED && le < HEADER + 1)
        return -DPM_REJECT_EXTENSION;
    if (have < 2)
        return 0;
    if ((body[1] & 0x7F) == DPM_BROADCAST)
        return -DPM_REJECT_ADDRESS;
    const size_t source = body[1] >> 7;
    if (source && le < HEADER + 1 + (size_t)(body[0] >> 7))
        return -DPM_REJECT_EXTENSION;
    if (body[0] & EXTENDED && (verdict = decode_side(body, have, le, source, &at, &t.dsegment, &t.dsap)) <= 0)
        return verdict;
    if (source && (verdict = decode_side(body, have, le, 0, &at, &t.ssegment, &t.ssap)) <= 0)
        return verdict;
    if (have < le + 1)
        return 0;
    for (size_t i = 0; i < le; i++)
        sum = (uint8_t)(sum + body[i]);
    if (body[le] != sum)
        return -DPM_REJECT_FCS;
    if (have < le + 2)
        return 0;
    if (body[le + 1] != DPM_ED)
        return -DPM_REJECT_END;
    t.da = body[0] & 0x7F;
    t.sa = body[1] & 0x7F;
    t.fc = body[2];
    t.length = (uint8_t)(le - at);
    t.data = body + at;
    *telegram = t;
    return (int)(head + le + 2);
}

static int decode_sd2(const uint8_t *octets, size_t n, dpm_telegram *telegram)
{
    if (n < 2)
        return 0;
    if (octets[1] < LE_MIN || octets[1] > LE_MAX)
        return -DPM_REJECT_LENGTH;
    if (n < 3)
        return 0;
    if (octets[2] != octets[1])
        return -DPM_REJECT_LENGTH_TWICE;
    if (n < 4)
        return 0;
    if (octets[3] != DPM_SD2)
        return -DPM_REJECT_DELIMITER_2;
    return decode_body(octets, n, 4, octets[1], telegram);
}

/* SD4 and SC have no FC, no extensions, no FCS. A token has only its addresses to be checked by. */
static int decode_bare(const uint8_t *octets, size_t n, size_t addresses, dpm_telegram *telegram)
{
    for (size_t i = 1; i <= addresses; i++) {
        if (n <= i)
            return 0;
        if (octets[i] > DPM_ADDRESS_MAX)
            return -DPM_REJECT_ADDRESS;
    }
    *telegram = (dpm_telegram){octets[0], 0, 0, 0, DPM_NO_SAP, DPM_NO_SAP, -1, -1, 0, octets + 1 + addresses};
    if (addresses) {
        telegram->da = octets[1];
        telegram->sa = octets[2];
    }
    return (int)(1 + addresses);
}

int dpm_decode(const uint8_t *octets, size_t n, dpm_telegram *telegram)
{
    if (n == 0)
        return 0;
    switch (octets[0]) {
    case DPM_SD1:
        return decode_body(octets, n, 1, HEADER, telegram);
    case DPM_SD2:
        return decode_sd2(octets, n, telegram);
    case DPM_SD3:
        return decode_body(octets, n, 1, HEADER + FIXED_DATA, telegram);
    case DPM_SD4:
        return decode_bare(octets, n, 2, telegram);
    case DPM_SC:
        return decode_bare(octets, n, 0, telegram);
    default:
        return -DPM_REJECT_DELIMITER;
    }
}

/* How many extension octets one side has. */
static size_t side_length(int16_t segment, int16_t sap)
{
    return (size_t)(segment >= 0) + (size_t)(sap >= 0);
}

/* Writes them; returns where the next octet goes. */
static uint8_t *encode_side(int16_t segment, int16_t sap, uint8_t *out)
{
    if (segment >= 0)
        *out++ = (uint8_t)(segment | SEGMENT | (sap >= 0 ? EXTENDED : 0));
    if (sap >= 0)
        *out++ = (uint8_t)sap;
    return out;
}

static bool is_number(int16_t value)
{
    return value >= -1 && value <= NUMBER;
}

/* Token and SC carry nothing but addresses: a field that would be lost is refused, not ignored. */
static int encode_bare(const dpm_telegram *t, size_t behind, uint8_t *out, size_t size)
{
    const bool token = t->format == DPM_SD4;

    if (behind || t->fc || (!token && (t->da || t->sa)))
        return DPM_E_ARGUMENT;
    if (token && (t->da > DPM_ADDRESS_MAX || t->sa > DPM_ADDRESS_MAX))
        return DPM_E_ADDRESS;
    if (size < (token ? 3 : 1))
        return DPM_E_LENGTH;
    out[0] = t->format;
    if (token) {
        out[1] = t->da;
        out[2] = t->sa;
    }
    return token ? 3 : 1;
}

/* DA up to ED. */
static void encode_body(const dpm_telegram *t, size_t le, uint8_t *body)
{
    uint8_t *const source = encode_side(t->dsegment, t->dsap, body + HEADER);
    uint8_t *const data = encode_side(t->ssegment, t->ssap, source);
    uint8_t sum = 0;

    body[0] = (uint8_t)(t->da | (source > body + HEADER ? EXTENDED : 0));
    body[1] = (uint8_t)(t->sa | (data > source ? EXTENDED : 0));
    body[2] = t->fc;
    if (t->length)
        memcpy(data, t->data, t->length);
    for (size_t i = 0; i < le; i++)
        sum = (uint8_t)(sum + body[i]);
    body[le] = sum;
    body[le + 1] = DPM_ED;
}

/* How many octets may lie behind FC in each format. Nothing behind FC is an SD1: SD2 has LE 4 at least when sent. */
static bool fits(uint8_t format, size_t behind)
{
    switch (format) {
    case DPM_SD1:
        return behind == 0;
    case DPM_SD3:
        return behind == FIXED_DATA;
    default:
        return behind >= 1 && behind <= DPM_DATA_MAX;
    }
}

int dpm_encode(const dpm_telegram *t, uint8_t *out, size_t size)
{
    const size_t behind = side_length(t->dsegment, t->dsap) + side_length(t->ssegment, t->ssap) + t->length;
    const uint8_t format = t->format ? t->format : behind ? DPM_SD2 : DPM_SD1;
    const size_t head = format == DPM_SD2 ? 4 : 1;
    const size_t le = HEADER + behind;

    if (!is_number(t->dsap) || !is_number(t->ssap) || !is_number(t->dsegment) || !is_number(t->ssegment) ||
        (t->length && !t->data))
        return DPM_E_ARGUMENT;
    if (format == DPM_SD4 || format == DPM_SC)
        return encode_bare(t, behind, out, size);
    if (format != DPM_SD1 && format != DPM_SD2 && format != DPM_SD3)
        return DPM_E_ARGUMENT;
    if (t->da > DPM_BROADCAST || t->sa >= DPM_BROADCAST)
        return DPM_E_ADDRESS;
    if (!fits(format, behind) || size < head + le + 2)
        return DPM_E_LENGTH;
    out[0] = format;
    if (format == DPM_SD2) {
        out[1] = out[2] = (uint8_t)le;
        out[3] = DPM_SD2;
    }
    encode_body(t, le, out + head);
    return (int)(head + le + 2);
}
