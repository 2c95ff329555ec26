/* SPDX-License-Identifier: MIT
 *
 * The simulated segment: the onlooker. It knows what every station sent, even what a fault kept from being heard, and
 * judges each transmission at its start by the rules of protocol page D and E. It changes nothing on the wire.
 */
#include <string.h>

#include "core/simulation_private.h"
#include "dpmaster/error.h"

static const char *const names[DPM_RULE_COUNT] = {
    "SYN", "Tid1", "Tid2", "slot", "min Tsdr", "max Tsdr", "collision", "babbling", "token hold", "whole telegram",
    "unasked answer", "two tokens", "request without token",
};

const char *dpm_rule_name(int rule)
{
    return rule >= 0 && rule < DPM_RULE_COUNT ? names[rule] : "unknown rule";
}

void dpm_sim_rules_init(dpm_simulation *sim)
{
    const dpm_parameters *p = &sim->config.parameters;
    sim->limits = (dpm_sim_limits){
        .syn = dpm_bits_down(p, DPM_TSYN),
        .tid1 = dpm_bits_down(p, dpm_tid1(p)),
        .tid2 = dpm_bits_down(p, dpm_tid2(p)),
        .tsl = dpm_bits_down(p, p->tsl),
        .min_tsdr = dpm_bits_down(p, p->min_tsdr),
        .max_tsdr = dpm_bits_up(p, p->max_tsdr),
        .tsyni = dpm_bits_up(p, DPM_TSYNI),
        .ttr = dpm_bits_up(p, p->ttr),
    };
    for (unsigned i = 0; i <= DPM_ADDRESS_MAX; i++)
        sim->limits.tto[i] = dpm_bits_down(p, dpm_tto(p, (uint8_t)i));
    for (unsigned i = 0; i < DPM_SIMULATION_SIDES; i++)
        sim->side[i] = (dpm_sim_side){.busy_to = -1, .last_port = -1, .token = {-1, -1, false}, .before = -1};
    for (int i = 0; i < 128; i++)
        dpm_sim_forget(sim, i);
}

void dpm_sim_forget(dpm_simulation *sim, int address)
{
    if (address >= 0)
        sim->share[address].last = -1;
}

/* --- breaches ------------------------------------------------------------------------------------------------------ */

static void put_breach(dpm_simulation *sim, const dpm_transmission *t, int rule, int64_t value, int64_t limit)
{
    if (sim->last_fault >= 0 && t->start - sim->last_fault < sim->config.grace) {
        sim->statistics.excused[rule]++;
        return;
    }
    if (sim->statistics.violations++ >= DPM_SIM_BREACHES)
        return;
    sim->breach[sim->statistics.violations - 1] = (dpm_simulation_breach){
        .rule = (uint8_t)rule, .port = t->port, .address = t->sa, .time = t->start,
        .value = value, .limit = limit, .transmission = t->number,
    };
}

/* Whole ms are split off, so that no product leaves 64 bits. */
static int64_t millibits(const dpm_simulation *sim, int64_t ns)
{
    const int64_t ms = ns / 1000000, num = sim->config.parameters.rate_num, den = sim->config.parameters.rate_den;
    return ms * num / den + ns % 1000000 * num / den / 1000000;
}

void dpm_sim_breached(dpm_simulation *sim, const dpm_transmission *t, int rule, int64_t value, int64_t limit)
{
    put_breach(sim, t, rule, millibits(sim, value), millibits(sim, limit));
}

int dpm_simulation_violation(const dpm_simulation *sim, unsigned i, dpm_simulation_breach *breach)
{
    if (i >= sim->statistics.violations || i >= DPM_SIM_BREACHES)
        return 0;
    *breach = sim->breach[i];
    return 1;
}

/* --- what it is ---------------------------------------------------------------------------------------------------- */

uint8_t dpm_sim_classify(dpm_transmission *t)
{
    dpm_telegram telegram;
    t->traffic = DPM_TRAFFIC_OTHER;
    t->da = t->sa = -1;
    if (dpm_decode(t->octets, t->n, &telegram) != t->n)
        return 0;
    t->traffic = DPM_TRAFFIC_ANSWER;
    if (telegram.format == DPM_SC)
        return 0;
    t->da = telegram.da;
    t->sa = telegram.sa;
    if (telegram.format == DPM_SD4) {
        t->traffic = DPM_TRAFFIC_TOKEN;
        return 0;
    }
    const uint8_t function = telegram.fc & 0x0F;
    if (telegram.fc & DPM_FC_REQUEST)
        t->traffic = function == DPM_SDN_LOW || function == DPM_SDN_HIGH ? DPM_TRAFFIC_SDN : DPM_TRAFFIC_REQUEST;
    return telegram.fc;
}

static bool initiates(uint8_t traffic)
{
    return traffic == DPM_TRAFFIC_TOKEN || traffic == DPM_TRAFFIC_REQUEST || traffic == DPM_TRAFFIC_SDN;
}

/* --- idle times ------------------------------------------------------------------------------------------------------ */

/* The rule for the idle time before an initiator's telegram, and from when it counts. */
static void judge_idle(dpm_simulation *sim, const dpm_sim_side *side, const dpm_transmission *t)
{
    const dpm_sim_limits *limits = &sim->limits;
    const int64_t since = t->start - side->last_end;
    const bool own = side->last_port == t->port;
    int rule = DPM_RULE_SYN;
    int64_t limit = 0;
    if (side->busy_to >= 0 && t->start - side->quiet_from < limits->syn) {
        if (t->start >= side->busy_to) /* else it is a collision, and that was said */
            dpm_sim_breached(sim, t, DPM_RULE_SYN, t->start - side->quiet_from, limits->syn);
        return;
    }
    if (side->last == DPM_TRAFFIC_SDN) {
        rule = DPM_RULE_TID2;
        limit = limits->tid2;
    } else if (own && (side->last == DPM_TRAFFIC_REQUEST || (side->last == DPM_TRAFFIC_TOKEN && side->last_da != side->last_sa))) {
        rule = DPM_RULE_SLOT;
        limit = limits->tsl;
    } else if (side->last == DPM_TRAFFIC_ANSWER || side->last == DPM_TRAFFIC_TOKEN) {
        rule = DPM_RULE_TID1;
        limit = limits->tid1;
    }
    if (limit && since < limit)
        dpm_sim_breached(sim, t, rule, since, limit);
}

/* --- the token ------------------------------------------------------------------------------------------------------ */

/* How long a station that begins now can have heard nothing. */
static int64_t silence(const dpm_simulation *sim, const dpm_sim_side *side, const dpm_transmission *t)
{
    const int64_t listening = sim->port[t->port].on_since;
    return t->start - (side->busy_to >= 0 && side->quiet_from > listening ? side->quiet_from : listening);
}

/* "After Tto of silence: token TS to TS, twice" (page E.1); the second one is its holder's. */
static bool claims(const dpm_simulation *sim, const dpm_sim_side *side, const dpm_transmission *t)
{
    return t->da == t->sa && silence(sim, side, t) >= sim->limits.tto[t->sa];
}

/* A pass that its receiver did not use leaves the token with the passer, which may repeat it, pass it to another or
 * go on itself; that it waits for Tsl first is the rule "slot". */
static bool has_token(const dpm_sim_side *side, const dpm_transmission *t)
{
    return side->token.holder == t->sa || (side->token.passer == t->sa && !side->token.taken);
}

/* The holder's first telegram shows that it took the token: TRR ends where that token ended. */
static void take(dpm_simulation *sim, dpm_sim_side *side)
{
    dpm_sim_share *station = &sim->share[side->token.holder];
    dpm_simulation_share *share = &station->share;
    side->token.taken = true;
    side->cycled = false;
    side->before = station->last;
    side->hold_until = DPM_NEVER;
    if (station->last >= 0) {
        const int64_t rotation = side->token_end - station->last;
        side->hold_until = station->last + sim->limits.ttr;
        share->rotation_min = share->rotations && share->rotation_min < rotation ? share->rotation_min : rotation;
        share->rotation_max = share->rotation_max > rotation ? share->rotation_max : rotation;
        share->rotation_sum += rotation;
        share->rotations++;
    }
    station->last = side->token_end;
    share->tokens++;
}

static void judge_token(dpm_simulation *sim, dpm_sim_side *side, const dpm_transmission *t)
{
    if (claims(sim, side, t)) {
        for (int i = 0; i < 128; i++) /* the ring begins anew, and with it TRR */
            dpm_sim_forget(sim, i);
        side->token.holder = side->token.passer = -1;
    } else if (!has_token(side, t)) {
        dpm_sim_breached(sim, t, DPM_RULE_TOKENS, silence(sim, side, t), sim->limits.tto[t->sa]);
    } else if (side->token.holder == t->sa && !side->token.taken) {
        take(sim, side);
    }
}

static bool repeats(dpm_simulation *sim, const dpm_sim_side *side, const dpm_transmission *t)
{
    const dpm_transmission *last = &dpm_sim_carried(sim, side->request)->t;
    return side->cycled && last->number == side->request && last->n == t->n && !memcmp(last->octets, t->octets, t->n);
}

/* "ONE high-priority message cycle is always allowed; further cycles only while TTH > 0; a started cycle, with its
 * retries, is finished" (page D.3). */
static void judge_hold(dpm_simulation *sim, const dpm_sim_side *side, const dpm_transmission *t, uint8_t fc)
{
    const dpm_simulation_host *host = &sim->port[t->port].host;
    const uint8_t function = fc & 0x0F;
    const bool high = function == DPM_SRD_HIGH || function == DPM_SDA_HIGH || function == DPM_SDN_HIGH;
    if (side->hold_until == DPM_NEVER || t->start <= side->hold_until + host->lateness + host->chunk)
        return;
    if (!(high && !side->cycled) && !repeats(sim, side, t))
        dpm_sim_breached(sim, t, DPM_RULE_HOLD, t->start - side->before, sim->limits.ttr);
}

static void judge_request(dpm_simulation *sim, dpm_sim_side *side, const dpm_transmission *t, uint8_t fc)
{
    if (!has_token(side, t)) {
        put_breach(sim, t, DPM_RULE_RIGHT, side->token.holder, t->sa);
        return;
    }
    if (side->token.holder == t->sa && !side->token.taken)
        take(sim, side);
    judge_hold(sim, side, t, fc);
}

/* --- answers --------------------------------------------------------------------------------------------------------- */

static void judge_answer(dpm_simulation *sim, const dpm_sim_side *side, const dpm_transmission *t)
{
    const dpm_simulation_host *host = &sim->port[t->port].host;
    const int64_t most = sim->limits.max_tsdr + 2 * host->lateness + host->chunk; /* to hear it, and to wake for its own */
    if (!side->pending || (t->sa >= 0 && (t->sa != side->asked || t->da != side->asker)))
        put_breach(sim, t, DPM_RULE_UNASKED, t->sa, side->pending ? side->asked : -1);
    else if (t->start - side->asked_earliest < sim->limits.min_tsdr)
        dpm_sim_breached(sim, t, DPM_RULE_MIN_TSDR, t->start - side->asked_earliest, sim->limits.min_tsdr);
    else if (t->start - side->asked_latest > most)
        dpm_sim_breached(sim, t, DPM_RULE_MAX_TSDR, t->start - side->asked_latest, most);
}

/* --- what it means from now on --------------------------------------------------------------------------------------- */

static int64_t earlier(int64_t a, int64_t b) { return a < b ? a : b; }

static int64_t later(int64_t a, int64_t b) { return a > b ? a : b; }

/* What a receiver and what the sender take for the end differ where a fault touched it: minima count from the
 * earlier, maxima from the later. */
static void occupy(dpm_simulation *sim, dpm_sim_side *side, const dpm_carried *c)
{
    const dpm_transmission *t = &c->t;
    if (c->slots == 0)
        return;
    if (side->busy_to < 0 || t->start - side->busy_to >= sim->limits.syn) {
        side->busy_since = t->start;
        side->babbled = false;
    }
    side->quiet_before = side->quiet_from;
    side->quiet_from = later(side->quiet_from, earlier(t->end, t->wire_end));
    side->busy_to = later(side->busy_to, t->wire_end);
    if (!side->babbled && t->port >= 0 && t->wire_end - side->busy_since > sim->limits.tsyni) {
        side->babbled = true;
        dpm_sim_breached(sim, t, DPM_RULE_BABBLING, t->wire_end - side->busy_since, sim->limits.tsyni);
    }
}

static void remember_request(dpm_sim_side *side, const dpm_transmission *t)
{
    side->pending = t->traffic == DPM_TRAFFIC_REQUEST;
    side->asker = t->sa;
    side->asked = t->da;
    side->asked_earliest = earlier(t->end, t->wire_end);
    side->asked_latest = later(t->end, t->wire_end);
}

static void remember_token(dpm_simulation *sim, dpm_sim_side *side, const dpm_transmission *t)
{
    sim->statistics.tokens++;
    side->pending = false;
    side->token.holder = t->da;
    side->token.passer = t->sa;
    side->token.taken = false;
    side->token_end = t->end;
}

/* An FDL status "master, not in the ring": its next token is the first of a new membership. */
static bool is_outside(const dpm_transmission *t, uint8_t fc)
{
    const uint8_t type = fc & DPM_TYPE_MASTER_IN_RING;
    return t->traffic == DPM_TRAFFIC_ANSWER && t->sa >= 0 && (type == DPM_TYPE_MASTER_NOT_READY || type == DPM_TYPE_MASTER_READY);
}

static void remember(dpm_simulation *sim, dpm_sim_side *side, const dpm_transmission *t, uint8_t fc)
{
    const bool lost = t->flags & DPM_TAP_LOST, spoilt = t->flags & (DPM_TAP_TOUCHED | DPM_TAP_COLLIDED);
    if (t->sa >= 0)
        sim->port[t->port].address = t->sa;
    if (is_outside(t, fc))
        dpm_sim_forget(sim, t->sa);
    if (t->traffic == DPM_TRAFFIC_TOKEN)
        remember_token(sim, side, t);
    if (t->traffic == DPM_TRAFFIC_REQUEST || t->traffic == DPM_TRAFFIC_SDN) {
        remember_request(side, t);
        sim->share[t->sa].share.requests++;
        side->request = t->number;
        side->cycled = true;
    }
    if (lost && !initiates(t->traffic))
        return;
    side->pending &= t->traffic != DPM_TRAFFIC_ANSWER;
    /* Whoever hears an answer that is spoilt may go on after 33 Tbit; whoever sent a request knows that it did. */
    side->last = spoilt && !initiates(t->traffic) ? DPM_TRAFFIC_OTHER : t->traffic;
    side->last_port = t->port;
    side->last_sa = t->sa;
    side->last_da = t->da;
    side->last_number = t->number;
    side->last_end = lost ? t->end : earlier(t->end, t->wire_end);
}

void dpm_sim_disregard(dpm_simulation *sim, const dpm_transmission *t, bool unheard)
{
    dpm_sim_side *side = &sim->side[t->side];
    if (side->last_number != t->number)
        return;
    side->last = DPM_TRAFFIC_OTHER;
    if (unheard)
        side->token = side->token_before;
}

/* --- the whole ---------------------------------------------------------------------------------------------------- */

static void judge(dpm_simulation *sim, dpm_sim_side *side, const dpm_transmission *t, uint8_t fc)
{
    dpm_telegram telegram;
    if (initiates(t->traffic))
        judge_idle(sim, side, t);
    switch (t->traffic) {
    case DPM_TRAFFIC_TOKEN:
        judge_token(sim, side, t);
        break;
    case DPM_TRAFFIC_REQUEST:
    case DPM_TRAFFIC_SDN:
        judge_request(sim, side, t, fc);
        break;
    case DPM_TRAFFIC_ANSWER:
        judge_answer(sim, side, t);
        break;
    default: {
        const int whole = dpm_decode(t->octets, t->n, &telegram);
        put_breach(sim, t, DPM_RULE_WHOLE, whole > 0 ? whole : 0, t->n);
        break;
    }
    }
}

void dpm_sim_watch(dpm_simulation *sim, const dpm_carried *carried, uint8_t fc)
{
    const dpm_transmission *t = &carried->t;
    dpm_sim_side *side = &sim->side[t->side];
    if (!(t->flags & DPM_TAP_INJECTED)) {
        side->token_before = side->token;
        judge(sim, side, t, fc);
        remember(sim, side, t, fc);
    } else {
        /* Noise, or a copy: whoever it meets may go on after 33 Tbit, and a request's copy may be answered. */
        side->last = DPM_TRAFFIC_OTHER;
        if (t->port >= 0 && t->traffic == DPM_TRAFFIC_REQUEST)
            remember_request(side, t);
    }
    occupy(sim, side, carried);
}

/* --- what a test reads ------------------------------------------------------------------------------------------------ */

void dpm_simulation_get_statistics(const dpm_simulation *sim, dpm_simulation_statistics *statistics)
{
    *statistics = sim->statistics;
}

void dpm_simulation_get_share(const dpm_simulation *sim, unsigned address, dpm_simulation_share *share)
{
    *share = sim->share[address & 0x7F].share;
}
