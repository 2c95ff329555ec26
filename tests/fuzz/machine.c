/* SPDX-License-Identifier: MIT
 *
 * Fuzz target for the state machines, a master in any role and two slaves on one wire, under the event contract
 * (dpmaster/machine.h): `make fuzz`. Without libFuzzer the same checks replay files:
 *   gcc -DREPLAY -g -fsanitize=address,undefined -Iinclude -Icsrc -o build/replay tests/fuzz/machine.c csrc/core/[a-z]*.c && \
 *       build/replay FILE...
 *
 * An input is a list of steps: what happens next, to whom, for how long, with which octets. Oracles: an offer is one whole
 * telegram of the machine's own and in time; asking again without an event changes nothing; a Data_Exchange carries zeros
 * or one commit, newer than whatever made the outputs safe last, Clear by order included; Offline nothing is sent, and
 * the station is off the bus; a passive one sends nothing ever; a slave's outputs are zeros unless it is in Data_Exchange.
 */
#include <string.h>

#include "dpmaster/error.h"
#include "dpmaster/master.h"
#include "dpmaster/slave.h"
#include "target.h"

enum { MASTER = 2, FIRST = 8, KNOWN = 3, PRESENT = 2, IDENT = 0x0A35, GRANULARITY = 20000, ALLOWANCE = 50000 };
#define WATCHDOG INT64_C(50000000)

typedef struct {
    const uint8_t *at, *end;
    dpm_parameters parameters;
    int64_t now, character;
    dpm_master *master;
    uint8_t role;
    dpm_slaves *slaves;
    dpm_machine *machine[2]; /* of the master, of the slaves */
    dpm_outputs *outputs[KNOWN];
    dpm_image *terminals[PRESENT];
    uint8_t newest[KNOWN], safe[KNOWN]; /* the last commit, and the last one that is void */
    bool was_in_data[KNOWN], operated;
    void *blocks[2 * KNOWN + 2 * PRESENT + 2];
    size_t n_blocks;
    dpm_raw raw;
    dpm_control order;
} bench;

static uint8_t next(bench *b) { return b->at < b->end ? *b->at++ : 0; }

static void *block(bench *b, size_t size)
{
    return b->blocks[b->n_blocks++] = aligned_alloc(16, (size + 15) & ~(size_t)15);
}

static dpm_image *image(bench *b)
{
    return dpm_image_init(block(b, dpm_image_size()), dpm_image_size());
}

static void make_master(bench *b, const dpm_parameters *parameters)
{
    dpm_master_config config = {.slaves = KNOWN, .output_watchdog = WATCHDOG, .data_control_time = 60000000, .data_retries = -1};
    dpm_slave_set set = {.ident_number = IDENT, .configuration = {0x31}, .configuration_length = 1, .wd_fact_1 = 1,
                         .wd_fact_2 = 2, .min_tsdr = 11, .active = true};
    config.station.parameters = *parameters;
    config.station.parameters.tsl = (uint16_t)dpm_ring_tsl(parameters, ALLOWANCE);
    config.station.role = b->role;
    config.station.address = MASTER;
    config.station.traits = (dpm_port_traits){.allowance = ALLOWANCE, .granularity = GRANULARITY};
    MUST(dpm_master_init(block(b, dpm_master_size(KNOWN)), dpm_master_size(KNOWN), &config, &b->master) == DPM_OK);
    for (uint8_t i = 0; i < KNOWN; i++) {
        set.address = (uint8_t)(FIRST + i);
        b->outputs[i] = dpm_outputs_init(block(b, dpm_outputs_size()), dpm_outputs_size(), 2);
        MUST(dpm_master_add(b->master, &set, b->outputs[i], image(b)) == i);
    }
    b->machine[0] = dpm_master_machine(b->master);
}

static void make_slaves(bench *b, const dpm_parameters *parameters)
{
    const dpm_port_traits traits = {.allowance = ALLOWANCE, .granularity = GRANULARITY};
    dpm_slave_config config = {.ident_number = IDENT, .configurations = 2, .configuration_length = {1, 1},
                               .configuration = {{0x31}, {0x21}}, .user_parameters_max = 237, .fail_safe = true,
                               .sync_supported = true, .freeze_supported = true, .max_diagnosis = 32, .min_tsdr = 11,
                               .set_address = true, .min_slave_interval = 1, .baud_control = 1};
    const uint8_t habits = next(b);
    config.wrong_length_ue = habits & 1;
    config.prm_keeps_exchange = habits & 2;
    config.foreign_sc = habits & 4;
    config.announce = (habits >> 3 & 3) % (DPM_ANNOUNCE_NEVER + 1);
    config.control_feeds = habits & 32;
    config.cfg_fault_keeps_master = config.prm_open_takes_user = habits & 64;
    config.auto_baud = habits & 128;
    MUST(dpm_slaves_init(block(b, dpm_slaves_size(PRESENT)), dpm_slaves_size(PRESENT), parameters, &traits, PRESENT,
                         &b->slaves) == DPM_OK);
    for (uint8_t i = 0; i < PRESENT; i++) {
        config.address = (uint8_t)(FIRST + i);
        b->terminals[i] = image(b);
        MUST(dpm_slaves_add(b->slaves, &config, b->terminals[i], image(b)) == i);
    }
    b->machine[1] = dpm_slaves_machine(b->slaves);
}

/* --- oracles ------------------------------------------------------------------------------------------------------ */

/* What made outputs safe since the last look: leaving Operate (the output watchdog does too) and leaving Data_Exchange. */
static void note_safe(bench *b)
{
    dpm_master_status status;
    dpm_slave_status slave;
    dpm_master_get_status(b->master, &status);
    const bool operates = status.mode == DPM_MODE_OPERATE;
    MUST(status.mode != DPM_MODE_OFFLINE || status.fdl_state == DPM_FDL_OFFLINE);
    for (int i = 0; i < KNOWN; i++) {
        MUST(dpm_master_get_slave(b->master, i, &slave) == DPM_OK);
        const bool in_data = slave.state == DPM_ST_DATA;
        if ((b->operated && !operates) || (b->was_in_data[i] && !in_data) || status.latched)
            b->safe[i] = b->newest[i];
        b->was_in_data[i] = in_data;
    }
    b->operated = operates;
}

static void check_slaves(const bench *b)
{
    static const uint8_t zeros[DPM_IO_MAX];
    dpm_slave_state_report report;
    for (int i = 0; i < PRESENT; i++) {
        const dpm_frame *frame = dpm_image_get(b->terminals[i]);
        MUST(dpm_slaves_get(b->slaves, i, &report) == DPM_OK && frame->length <= DPM_IO_MAX);
        if (report.state == DPM_SL_WAIT_PRM || report.state == DPM_SL_WAIT_CFG)
            MUST(!frame->valid);
        if (!frame->valid)
            MUST(memcmp(frame->octets, zeros, frame->length) == 0);
    }
}

static void check_data(const bench *b, const dpm_telegram *t)
{
    const int i = t->da - FIRST;
    if (i < 0 || i >= KNOWN || t->dsap != DPM_NO_SAP || t->length == 0 || (b->raw.length && b->raw.da == t->da))
        return;
    MUST(t->length == 2 && t->data[0] == t->data[1]); /* of one commit */
    MUST(!t->data[0] || (uint8_t)(t->data[0] - b->safe[i] - 1) < (uint8_t)(b->newest[i] - b->safe[i]));
}

/* Set_Slave_Add may have moved it. */
static bool is_slaves(const bench *b, uint8_t address)
{
    dpm_slave_state_report report;
    for (int i = 0; i < PRESENT; i++)
        if (dpm_slaves_get(b->slaves, i, &report) == 0 && report.address == address)
            return true;
    return false;
}

static void check_offer(bench *b, int side, const dpm_offer *offer)
{
    dpm_telegram t;
    dpm_master_status status;
    MUST(dpm_decode(offer->octets, offer->n, &t) == (int)offer->n);
    MUST(b->now <= offer->not_after);
    dpm_master_get_status(b->master, &status);
    if (side == 0) {
        MUST(b->role != DPM_ROLE_PASSIVE);
        MUST(t.sa == MASTER && status.mode + status.fdl_state != 0 && status.fdl_state != DPM_FDL_OFFLINE);
        check_data(b, &t);
    } else {
        MUST(t.format == DPM_SC || (is_slaves(b, t.sa) && !(t.fc & DPM_FC_REQUEST)));
    }
}

/* --- steps -------------------------------------------------------------------------------------------------------- */

static void hear(bench *b, int side, const uint8_t *octets, size_t n, bool exact)
{
    /* In memory of exactly its size, so that a sanitizer sees one octet too many. */
    uint8_t *copy = malloc(n + 1), *errors = calloc(n + 1, 1);
    const int64_t first = b->now - (int64_t)(n ? n - 1 : 0) * b->character;
    memcpy(copy, octets, n);
    if (!exact && n)
        errors[next(b) % n] = next(b) & 1 ? DPM_LINE_PARITY : 0;
    const dpm_span span = {copy, exact ? NULL : errors, n, first, first, b->character, false};
    b->machine[side]->octets(b->machine[side], &span);
    free(copy);
    free(errors);
}

static dpm_offer ask(bench *b, int side)
{
    dpm_offer offer = {.wake = DPM_NEVER}, again = {.wake = DPM_NEVER};
    b->machine[side]->ask(b->machine[side], b->now, &offer);
    for (int i = 0; i < 3; i++) /* Use_Token may pass on to its token */
        b->machine[side]->ask(b->machine[side], b->now, &offer);
    b->machine[side]->ask(b->machine[side], b->now, &again);
    MUST(offer.n == again.n && offer.not_before == again.not_before);
    note_safe(b);
    return again;
}

/* The machine sends what is due; the other one hears it, whole or hurt. */
static void send(bench *b, int side, uint8_t how)
{
    uint8_t copy[DPM_TELEGRAM_MAX];
    const dpm_offer offer = ask(b, side);
    if (!offer.n || offer.not_before > b->now)
        return;
    check_offer(b, side, &offer);
    const int64_t start = b->now, end = start + (int64_t)offer.n * b->character;
    memcpy(copy, offer.octets, offer.n);
    b->machine[side]->sent(b->machine[side], start, end, end, how == 1 ? DPM_SENT_CUT : how == 2 ? DPM_SENT_FAILED : 0);
    b->now = end;
    if (how == 3)
        copy[next(b) % offer.n] ^= (uint8_t)(1 << (next(b) & 7));
    if (how != 2 && how != 4)
        hear(b, 1 - side, copy, how == 1 ? offer.n / 2 : offer.n, true);
}

/* Both run by the contract for a while, as they would on a quiet wire. */
static void run(bench *b, unsigned rounds)
{
    while (rounds--) {
        const dpm_offer a = ask(b, 0), c = ask(b, 1);
        const int64_t first = a.n ? a.not_before : a.wake, second = c.n ? c.not_before : c.wake;
        const int64_t due = first < second ? first : second;
        b->now = due > b->now && due < b->now + WATCHDOG ? due : b->now + 1;
        b->machine[0]->quiet(b->machine[0], b->now);
        b->machine[1]->quiet(b->machine[1], b->now);
        send(b, 0, 0);
        send(b, 1, 0);
    }
}

/* A telegram with any fields, its sum right: what a hostile station would say. */
static void say(bench *b)
{
    uint8_t out[DPM_TELEGRAM_MAX], data[DPM_DATA_MAX];
    dpm_telegram t = {.dsegment = -1, .ssegment = -1};
    t.da = next(b) & 0x7F;
    t.sa = next(b) & 0x7F;
    t.fc = next(b);
    const uint8_t saps = next(b);
    t.dsap = saps & 1 ? (saps & 2 ? DPM_SAP_MASTER : next(b) & 0x3F) : DPM_NO_SAP;
    t.ssap = saps & 1 ? (saps & 4 ? DPM_SAP_MASTER : next(b) & 0x3F) : DPM_NO_SAP;
    t.length = next(b) % DPM_DATA_MAX;
    for (size_t i = 0; i < t.length; i++)
        data[i] = i < 16 ? next(b) : 0;
    t.data = data;
    const int n = dpm_encode(&t, out, sizeof out);
    b->now += n > 0 ? n * b->character : 0;
    if (n > 0) {
        hear(b, 0, out, (size_t)n, true);
        hear(b, 1, out, (size_t)n, true);
    }
}

static void say_token(bench *b, uint8_t da, uint8_t sa)
{
    const uint8_t octets[3] = {DPM_SD4, da, sa};
    b->now += b->character * 3 + dpm_bits_up(&b->parameters, 33);
    hear(b, 0, octets, sizeof octets, true);
}

/* Two masters of a ring: their tokens, at whose end ours may be polled, or meant, or heard with its own address. */
static void ring(bench *b, unsigned rotations)
{
    const uint8_t how = next(b);
    uint8_t poll[6];
    const dpm_telegram status = {.da = MASTER, .sa = how & 1 ? 1 : 9, .fc = DPM_FC_REQUEST | DPM_FDL_STATUS,
                                 .dsap = DPM_NO_SAP, .ssap = DPM_NO_SAP, .dsegment = -1, .ssegment = -1};
    while (rotations--) {
        say_token(b, 9, 1);
        say_token(b, 1, 9);
    }
    if (how & 2) {
        MUST(dpm_encode(&status, poll, sizeof poll) == sizeof poll);
        b->now += b->character * 6 + dpm_bits_up(&b->parameters, 33);
        hear(b, 0, poll, sizeof poll, true);
        b->now += dpm_bits_up(&b->parameters, 11);
        send(b, 0, 0);
    }
    if (how & 4)
        say_token(b, MASTER, how & 8 ? 1 : 9);
    if (how & 16)
        say_token(b, how >> 5, MASTER);
}

static void noise(bench *b)
{
    size_t n = next(b) % 64;
    n = n < (size_t)(b->end - b->at) ? n : (size_t)(b->end - b->at);
    const uint8_t *octets = b->at;
    b->at += n;
    b->now += (int64_t)n * b->character;
    for (int side = 0; n && side < 2; side++)
        hear(b, side, octets, n, false);
}

static void commit(bench *b, unsigned i)
{
    const uint8_t value = (uint8_t)(b->newest[i] + 1);
    const uint8_t octets[2] = {value, value};
    if (value == 0 || (uint8_t)(value - b->safe[i]) > 200)
        return; /* the numbers are used up */
    if (dpm_outputs_commit(b->outputs[i], 0, octets, 2, b->now) > 0)
        b->newest[i] = value;
    dpm_master_feed(b->master, b->now, DPM_FED_COMMIT);
}

static void request(bench *b)
{
    if (b->raw.length && !b->raw.done) {
        dpm_master_cancel(b->master, &b->raw);
        return;
    }
    b->raw = (dpm_raw){.da = next(b)};
    b->raw.function = next(b);
    b->raw.dsap = (int16_t)(next(b) - 1);
    b->raw.ssap = (int16_t)(next(b) - 1);
    b->raw.length = next(b) | 1;
    (void)dpm_master_request(b->master, &b->raw);
}

static void touch_slave(bench *b)
{
    static const uint8_t octets[64];
    const uint8_t what = next(b), n = next(b) & 63;
    const int i = what & 1;
    switch (what >> 1 & 3) {
    case 0: (void)dpm_slaves_connect(b->slaves, i, what & 8); break;
    case 1: (void)dpm_slaves_reset(b->slaves, i, b->now); break;
    case 2: (void)dpm_slaves_diagnosis(b->slaves, i, octets, n, what & 8, what & 16, what & 32); break;
    default:
        (void)dpm_slaves_ready(b->slaves, i, what & 8);
        if (what & 16)
            (void)dpm_slaves_set_address(b->slaves, i, n, what & 32, b->now);
        break;
    }
}

/* Stations come, go and change, and Global_Control is ordered. */
static void manage(bench *b)
{
    const uint8_t what = next(b), i = what % KNOWN;
    switch (what >> 4 & 3) {
    case 0: (void)dpm_master_activate(b->master, i, what & 0x40, b->now); break;
    case 1: (void)dpm_master_new_prm(b->master, i, b->now); break;
    case 2: dpm_master_revoke(b->master, &b->order); break;
    default:
        dpm_master_revoke(b->master, &b->order);
        b->order = (dpm_control){.da = what & 0x40 ? (uint8_t)(FIRST + i) : DPM_BROADCAST, .command = next(b) & 0x3C,
                                 .clear = (int8_t)(next(b) % 3 - 1)};
        if (dpm_master_order(b->master, &b->order, b->now) == DPM_OK && b->order.clear == 1)
            for (int j = 0; j < KNOWN; j++)
                if (b->order.da == DPM_BROADCAST || j == i)
                    b->safe[j] = b->newest[j];
        break;
    }
}

static void step(bench *b)
{
    static const int modes[] = {DPM_MODE_OFFLINE, DPM_MODE_STOP, DPM_MODE_CLEAR, DPM_MODE_OPERATE};
    const uint8_t what = next(b), with = what >> 4;
    switch (what & 15) {
    case 0: case 1: run(b, 1u + with); break;
    case 2: run(b, 20u * (1u + with)); break;
    case 3: send(b, with & 1, with >> 1); break;
    case 4: noise(b); break;
    case 5: say(b); break;
    case 6: commit(b, with % KNOWN); break;
    case 7: (void)dpm_master_set_mode(b->master, modes[with & 3], b->now); break;
    case 8: b->now += INT64_C(1) << (12 + with); break; /* the host was away */
    case 9: b->machine[with & 1]->quiet(b->machine[with & 1], b->now); break;
    case 10: request(b); break;
    case 11: touch_slave(b); break;
    case 12: dpm_master_port(b->master, with & 1, b->now); break;
    case 13:
        dpm_master_feed(b->master, b->now, DPM_FED_PROGRAM);
        ring(b, with);
        break;
    case 14: manage(b); break;
    default: (void)dpm_master_set_mode(b->master, DPM_MODE_OPERATE, b->now); commit(b, 0); run(b, 40); break;
    }
    note_safe(b);
    check_slaves(b);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static bench b;
    if (size < 2 || size > 1024)
        return 0;
    b = (bench){.at = data + 1, .end = data + size, .role = data[0] / 11 % 3};
    MUST(dpm_parameters_default(&b.parameters, dpm_parameters_rate(data[0] % 11u), 0) == DPM_OK);
    b.character = dpm_bits_up(&b.parameters, DPM_CHARACTER_BITS);
    make_master(&b, &b.parameters);
    make_slaves(&b, &b.parameters);
    while (b.at < b.end)
        step(&b);
    while (b.n_blocks)
        free(b.blocks[--b.n_blocks]);
    return 0;
}
