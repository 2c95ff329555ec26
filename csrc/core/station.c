/* SPDX-License-Identifier: MIT
 *
 * The active FDL station (IEC 61158-4-3 clause 8): exchanges, and what is done with the token; how it comes and goes is
 * token.c's. To be read beside the standard's diagram: each state has its reaction to a telegram (receive), to silence
 * (station_quiet) and to "what now?" (station_ask).
 */
#include "core/station_private.h"

#include <string.h>

#include "dpmaster/error.h"

#define FC_CODE(fc) ((fc) & 0x8F) /* "bit 7 = 1 only for Clock Value": with it no function is one of ours */
#define TURNS_FOR_ONE 8 /* of the first user, when it leaves no time to the others */
#define LOOKS 4         /* in a slot, of a host that may be late */

void dpm_station_event(dpm_station *station, const dpm_event *event)
{
    for (unsigned i = 0; i < DPM_STATION_RINGS; i++)
        if (station->rings[i])
            dpm_ring_put(station->rings[i], event);
    station->machine.progress++;
}

static void put_event(dpm_station *st, int64_t time, uint16_t kind, int32_t a, int32_t b, int64_t value)
{
    const dpm_event event = {.time = time, .kind = kind, .address = -1, .a = a, .b = b, .value = value};
    dpm_station_event(st, &event);
}

/* --- small facts ------------------------------------------------------------------------------------------------ */

bool dpm_station_talks(const dpm_station *st)
{
    return st->state >= DPM_FDL_CLAIM_TOKEN && st->state != DPM_FDL_CHECK_TOKEN_PASS;
}

static bool in_ring(uint8_t state) { return state >= DPM_FDL_ACTIVE_IDLE && state != DPM_FDL_CLAIM_TOKEN; }

/* Alone on the bus, by choice or since nobody else is there: then a slot has room for a host that wakes late
 * and for a wire that hands over whole telegrams. */
static int64_t slot_of(const dpm_station *st)
{
    return st->tsl + (dpm_token_alone(st) ? st->config.traits.allowance + st->config.traits.delivery : 0);
}

static bool is_sdn(uint8_t function) { return function == DPM_SDN_LOW || function == DPM_SDN_HIGH; }

static bool counts_frames(uint8_t function)
{
    return function == DPM_SRD_LOW || function == DPM_SRD_HIGH || function == DPM_SDA_LOW || function == DPM_SDA_HIGH;
}

static bool wants_answer(uint8_t function)
{
    return counts_frames(function) || function == DPM_FDL_STATUS || function == DPM_IDENT || function == DPM_LSAP_STATUS;
}

/* Inside the ring the state changes with every telegram; onlookers care for being in it. */
void dpm_station_enter(dpm_station *st, uint8_t state, int64_t now)
{
    const uint8_t old = st->state;
    st->state = state;
    if (old != state && !(in_ring(old) && in_ring(state)))
        put_event(st, now, DPM_EV_FDL, state, old, 0);
}

/* Something was on the bus until `end`: nothing of ours begins before `idle` has passed. */
static void bus_busy(dpm_station *st, int64_t end, int64_t idle)
{
    st->last_activity = max_of(st->last_activity, end);
    st->not_before = max_of(st->not_before, end + idle);
}

/* When silence has lasted for Tto. */
static int64_t silence_ends(const dpm_station *st)
{
    return st->last_activity + st->tto + st->config.traits.allowance + st->config.traits.delivery;
}

/* When silence allows to claim the token. A sole master that has heard another does not know its Tsl, nor what silence is
 * nothing new in its ring: as many slots of hosts like ours as Tto has at the least, and four times the longest heard there. */
static int64_t claim_at(const dpm_station *st)
{
    if (st->config.role != DPM_ROLE_SOLE || st->foreign < 0)
        return silence_ends(st);
    return max_of(silence_ends(st), st->last_activity + max_of(6 * st->late_slot, 4 * st->foreign_gap));
}

int64_t dpm_station_patience(const dpm_station *station) { return claim_at(station) - station->last_activity; }

/* The latest moment at which our right to talk still stands. In the ring the predecessor sends its token again when we
 * do not begin within its slot; later, and whenever we are alone, others may take the token for lost after Tto. */
static int64_t right_ends(const dpm_station *st)
{
    /* A port's late word of silence, and of what came last before it, is not our own silence. */
    const int64_t late = 2 * st->config.traits.granularity;
    if (st->state == DPM_FDL_CLAIM_TOKEN) /* then the next higher address claims */
        return claim_at(st) + 2 * st->tsl + st->config.traits.allowance + late;
    if (dpm_token_alone(st))
        return silence_ends(st) + late;
    return st->spoke ? st->last_activity + 6 * st->tsl : st->speak_until;
}

/* --- the exchange under way ------------------------------------------------------------------------------------- */

static void finish(dpm_station *st, int64_t now, dpm_confirm *confirm)
{
    dpm_fdl_user *user = st->user;
    st->user = NULL;
    if (st->tx_kind == DPM_TX_REQUEST)
        st->tx_kind = DPM_TX_NONE;
    if (st->state == DPM_FDL_AWAIT_DATA_RESPONSE)
        st->state = DPM_FDL_USE_TOKEN;
    confirm->tries = st->tries;
    confirm->start = st->tx_start;
    confirm->time = now;
    user->confirm(user->context, now, confirm);
}

/* Ended without an answer. Whether the responder took it is unknown, so its FCB starts anew (EN 50170 part 4: after
 * max_retry_limit the station is "not operational" and the next request to it is a first contact). */
static void finish_unanswered(dpm_station *st, int64_t now, uint8_t status)
{
    dpm_confirm confirm = {.status = status, .tsdr = -1};
    st->fcb[st->da] = DPM_FCB_UNKNOWN;
    if (status == DPM_CONF_NA) {
        st->statistics.unanswered++;
        st->given_up = st->da;
        st->late_sc = st->sc_fits;
        dpm_token_live(st, st->da, DPM_LIVE_NONE, now);
    } else {
        st->statistics.abandoned += st->tries > 0;
    }
    finish(st, now, &confirm);
}

void dpm_station_withdraw(dpm_station *station, int64_t now)
{
    if (station->tx_kind == DPM_TX_REQUEST)
        finish_unanswered(station, now, DPM_CONF_DS);
    else
        station->withdrawn = true;
}

static void finish_answered(dpm_station *st, const dpm_received *rx, uint8_t status)
{
    const dpm_telegram *t = &rx->telegram;
    const bool sc = t->format == DPM_SC;
    dpm_confirm confirm = {
        .status = status,
        .fc = sc ? 0 : t->fc,
        .short_ack = sc,
        .length = sc ? 0 : t->length,
        .data = t->data,
        .tsdr = max_of(rx->start_latest - st->tx_end_latest, 0),
    };
    st->statistics.answers++;
    st->given_up = -1;
    if (counts_frames(st->function))
        st->fcb[st->da] = st->fcb[st->da] == DPM_FCB_NEXT_0 ? DPM_FCB_NEXT_1 : DPM_FCB_NEXT_0;
    /* Each try may have been answered: what a slow responder still sends for an earlier one must not meet the next
     * exchange, so the slot of the last try runs out first. */
    if (st->tries > 1)
        st->not_before = max_of(st->not_before, st->tx_end_latest + st->tsl);
    finish(st, rx->end_latest, &confirm);
}

/* The token is not ours any more. With the bus `lost` to a foreign master the users forget all that was going on. */
void dpm_station_drop_token(dpm_station *st, uint8_t state, int64_t now, bool lost)
{
    if (st->user)
        finish_unanswered(st, now, DPM_CONF_DS);
    st->tx_kind = DPM_TX_NONE;
    st->passes = 0;
    dpm_station_enter(st, state, now);
    for (unsigned i = 0; lost && i < st->n_users; i++)
        if (st->users[i].token)
            st->users[i].token(st->users[i].context, now, false);
}

/* --- telegrams received ------------------------------------------------------------------------------------------ */

/* A host that wakes late cannot tell when a telegram came, only that it was not there at the last look. */
int64_t dpm_station_came(const dpm_station *st, const dpm_received *rx)
{
    return st->config.traits.allowance ? min_of(rx->end_earliest, st->looked) : rx->end_earliest;
}

/* A sole master gives way: it is silent until the bus has been so for Tto. */
static void give_way(dpm_station *st, uint8_t address, int64_t now)
{
    const bool lost = st->state != DPM_FDL_LISTEN_TOKEN || st->paused;
    st->paused = false;
    if (lost) {
        put_event(st, now, DPM_EV_FOREIGN, address, 0, 0);
        st->foreign_gap = 0;
        st->own_heard = 0;
    }
    dpm_station_drop_token(st, DPM_FDL_LISTEN_TOKEN, now, lost);
}

static void heard_token(dpm_station *st, uint8_t sa, uint8_t da, const dpm_received *rx)
{
    const bool ours = sa == st->config.address && st->config.role != DPM_ROLE_PASSIVE;
    st->statistics.foreign += !ours;
    st->foreign = ours ? st->foreign : sa;
    if (st->config.role != DPM_ROLE_SOLE || (ours && st->echoes)) { /* no echo: those are marked */
        dpm_token_heard(st, sa, da, rx);
    } else if (ours) {
        st->statistics.stray++; /* heard back through a port that does not know its echo */
    } else {
        dpm_token_live(st, sa, DPM_LIVE_MASTER_IN_RING, rx->end_latest);
        give_way(st, sa, rx->end_latest);
    }
}

/* Whoever sends a request has the token. */
static void heard_request(dpm_station *st, const dpm_telegram *t, int64_t now)
{
    st->statistics.foreign++;
    st->foreign = t->sa;
    if (st->config.role == DPM_ROLE_SOLE)
        give_way(st, t->sa, now);
    else if (dpm_station_talks(st))
        dpm_station_drop_token(st, DPM_FDL_ACTIVE_IDLE, now, false);
}

/* Requests to us: FDL status is answered in every state, Ident with who we are (four lengths: vendor, controller, hardware
 * and software release, then the texts); no SAP is open, so SRD, SDA and LSAP status get RS. */
static void reply(dpm_station *st, const dpm_received *rx)
{
    static const uint8_t identity[] = {8, 3, 0, 0, 'd', 'p', 'm', 'a', 's', 't', 'e', 'r', 'F', 'D', 'L'};
    const dpm_telegram *t = &rx->telegram;
    const bool status = FC_CODE(t->fc) == DPM_FDL_STATUS, ident = FC_CODE(t->fc) == DPM_IDENT;
    const uint8_t type = st->config.role == DPM_ROLE_SOLE ? DPM_TYPE_MASTER_NOT_READY : dpm_token_status(st, t->sa);
    const dpm_telegram answer = {
        .da = t->sa,
        .sa = st->config.address,
        .fc = (uint8_t)(type | (status ? DPM_RES_OK : ident ? DPM_RES_DL : DPM_RES_RS)),
        .dsap = DPM_NO_SAP, .ssap = DPM_NO_SAP, .dsegment = -1, .ssegment = -1,
        .length = ident ? sizeof identity : 0,
        .data = identity,
    };
    const int n = dpm_encode(&answer, st->tx, sizeof st->tx);
    if (n < 0)
        return;
    st->ready_told &= status;
    st->tx_n = (uint16_t)n;
    st->tx_kind = DPM_TX_REPLY;
    st->tx_not_before = rx->end_latest + st->min_tsdr;
    st->tx_not_after = dpm_station_came(st, rx) + st->max_tsdr + st->config.traits.allowance;
}

/* An answer mirrors the request's SAPs; one without data (RS, UE, RR, NR) may leave them out. */
static bool mirrors_saps(const dpm_station *st, const dpm_telegram *t)
{
    return (t->dsap == st->ssap && t->ssap == st->dsap) || t->format == DPM_SD1;
}

static bool awaits_answer(const dpm_station *st)
{
    return st->state == DPM_FDL_AWAIT_DATA_RESPONSE && st->tx_kind == DPM_TX_NONE;
}

/* Whether a response or SC belongs to the exchange under way; else it belongs to nobody: late, doubled, foreign. SC has no
 * address: behind a request to another station that was given up, it may be that one's, so it is not believed before it has
 * come for the repetition, too. */
static bool is_answer(const dpm_station *st, const dpm_received *rx)
{
    const dpm_telegram *t = &rx->telegram;
    if (!awaits_answer(st) || rx->end_latest <= st->tx_end_earliest)
        return false;
    if (t->format == DPM_SC && st->given_up >= 0 && st->given_up != st->da && st->late_sc && st->tries <= st->retries)
        return false;
    if (t->format == DPM_SC)
        return counts_frames(st->function);
    return t->sa == st->da && t->da == st->config.address;
}

static void receive(dpm_station *st, const dpm_received *rx)
{
    const dpm_telegram *t = &rx->telegram;
    const bool token = t->format == DPM_SD4;
    const bool request = !token && t->format != DPM_SC && (t->fc & DPM_FC_REQUEST);
    const bool ours = t->sa == st->config.address && st->config.role != DPM_ROLE_PASSIVE;
    if (st->state == DPM_FDL_OFFLINE)
        return; /* left by what came before it in the same octets */
    if (!token && !request && !ours && t->format != DPM_SC)
        dpm_token_live(st, t->sa, DPM_LIVE_OF(t->fc), rx->end_latest);
    if (token && !ours && awaits_answer(st)) {
        /* SD4 has no check sequence: three octets of noise before an answer can look like one. If it was a token, no
         * answer comes, and the end of the slot says so. */
        st->suspect = t->sa;
        st->suspect_da = t->da;
    } else if (token) {
        heard_token(st, t->sa, t->da, rx);
    } else if (request && !ours && t->sa <= DPM_ADDRESS_MAX) { /* 126 asks nobody: it waits for its address */
        heard_request(st, t, rx->end_latest);
        if (t->da == st->config.address && wants_answer(FC_CODE(t->fc)) && st->state > DPM_FDL_PASSIVE_IDLE)
            reply(st, rx);
    } else if (!request && is_answer(st, rx)) {
        const bool fits = t->format == DPM_SC || mirrors_saps(st, t);
        if (!fits && st->given_up == st->da)
            st->statistics.stray++; /* it answers the exchange that was given up, too late */
        else
            finish_answered(st, rx, fits ? DPM_CONF_ANSWER : DPM_CONF_INVALID);
    } else if (!request && t->format == DPM_SD1 && t->da == st->config.address && st->tx_kind == DPM_TX_NONE &&
               st->state == DPM_FDL_AWAIT_STATUS_RESPONSE) {
        dpm_token_poll_answered(st, t->sa, t->fc);
    } else {
        st->statistics.stray++;
    }
}

/* --- our own transmission heard back ----------------------------------------------------------------------------- */

static void echo_is_over(dpm_station *st, bool right, int64_t now)
{
    const uint8_t kind = st->echo_kind;
    st->echo_kind = DPM_TX_NONE;
    if (kind == DPM_TX_TOKEN)
        dpm_token_echoed(st, right, now);
}

static void hear_echo(dpm_station *st, const dpm_span *span, int64_t end)
{
    st->echoes = true;
    if (st->echo_kind == DPM_TX_NONE)
        return;
    for (size_t i = 0; i < span->n; i++, st->echo_n++)
        st->echo_spoilt |= st->echo_n >= st->tx_n || span->octets[i] != st->tx[st->echo_n] || (span->errors && span->errors[i]);
    if (st->echo_n >= st->tx_n)
        echo_is_over(st, !st->echo_spoilt, end);
}

/* While it may still come nothing else is sent: the standard's station hears its frame while it sends it. */
static int64_t echo_due(const dpm_station *st)
{
    return st->tx_end_latest + st->config.traits.allowance + st->config.traits.delivery;
}

/* --- the machine's inputs --------------------------------------------------------------------------------------- */

/* The silence that a span ends. The host was away for no more of it than it ever is, or it is not the bus's. */
static int64_t silence_before(const dpm_station *st, const dpm_span *span)
{
    const int64_t seen = st->config.traits.allowance ? min_of(span->latest, st->looked + st->late_slot) : span->latest;
    return seen - st->last_activity;
}

static void station_octets(dpm_machine *machine, const dpm_span *given)
{
    dpm_station *st = (dpm_station *)machine;
    dpm_span span = *given;
    dpm_received rx;
    if (span.n == 0 || st->state == DPM_FDL_OFFLINE)
        return;
    const int64_t end = span.latest + (int64_t)(span.n - 1) * span.spacing;
    if (span.echo) { /* when ours ended is known better */
        hear_echo(st, &span, end);
        return;
    }
    if (st->foreign >= 0 && st->state == DPM_FDL_LISTEN_TOKEN && st->last_activity >= 0)
        st->foreign_gap = max_of(st->foreign_gap, silence_before(st, &span));
    bus_busy(st, end, st->tid1);
    st->heard = end;
    if (st->tx_kind == DPM_TX_REPLY)
        st->tx_kind = DPM_TX_NONE; /* the bus went on without it */
    if (st->state == DPM_FDL_CHECK_TOKEN_PASS) { /* activity: the successor has it */
        st->passes = st->spoilt = 0;
        st->echo_kind = DPM_TX_NONE;
        st->state = DPM_FDL_ACTIVE_IDLE;
    }
    while (dpm_receiver_take(&st->receiver, &span, &rx))
        receive(st, &rx);
    st->looked = end;
}

/* The slot is over when nothing has begun in it; what has begun may end, but a babbler is not waited for. */
static bool slot_is_over(const dpm_station *st, int64_t until)
{
    if (until < st->deadline)
        return false;
    if (st->heard < 0 || until >= st->deadline + st->tsyni)
        return true;
    return until >= st->heard + st->tsyn + st->config.traits.granularity;
}

static void slot_ran_out(dpm_station *st, int64_t until)
{
    if (st->suspect >= 0) {
        const dpm_received token = {.end_earliest = until, .end_latest = until};
        heard_token(st, (uint8_t)st->suspect, st->suspect_da, &token);
        return;
    }
    if (st->withdrawn || st->tries > st->retries) {
        finish_unanswered(st, until, st->withdrawn ? DPM_CONF_DS : DPM_CONF_NA);
        return;
    }
    /* The repetition is the first try octet for octet: tx still holds it. */
    st->tx_kind = DPM_TX_REQUEST;
    st->tx_not_before = st->not_before;
}

static void station_quiet(dpm_machine *machine, int64_t until)
{
    dpm_station *st = (dpm_station *)machine;
    dpm_received rx;
    while (dpm_receiver_quiet(&st->receiver, until, &rx))
        receive(st, &rx);
    st->looked = until;
    if (st->echo_kind != DPM_TX_NONE && until >= echo_due(st))
        echo_is_over(st, false, until);
    if (st->tx_kind != DPM_TX_NONE)
        return;
    switch (st->state) {
    case DPM_FDL_LISTEN_TOKEN:
    case DPM_FDL_ACTIVE_IDLE:
        /* EN 50170 part 4: after Tto of silence the station with the lowest address claims the token. */
        if (st->last_activity >= 0 && until >= claim_at(st))
            dpm_token_claim(st, until);
        break;
    case DPM_FDL_AWAIT_DATA_RESPONSE:
        if (slot_is_over(st, until))
            slot_ran_out(st, until);
        break;
    case DPM_FDL_CHECK_TOKEN_PASS:
    case DPM_FDL_AWAIT_STATUS_RESPONSE:
        if (slot_is_over(st, until))
            dpm_token_slot_over(st, until);
        break;
    default:
        break;
    }
}

void dpm_station_begin_turn(dpm_station *st, int64_t now)
{
    st->worked = false;
    st->served = 0;
    st->passed_over = (uint8_t)(st->passed_over + (st->passed_over <= TURNS_FOR_ONE));
    st->users_wake = 0;
    dpm_station_enter(st, DPM_FDL_USE_TOKEN, now);
    for (unsigned i = 0; i < st->n_users; i++)
        if (st->users[i].token)
            st->users[i].token(st->users[i].context, now, true);
}

static void request_sent(dpm_station *st, int result)
{
    st->tries++;
    st->worked = true;
    st->spoke = true;
    st->users_wake = 0;
    if (is_sdn(st->function)) {
        dpm_confirm confirm = {.status = result == DPM_SENT_WHOLE ? DPM_CONF_SENT : DPM_CONF_DS, .tsdr = -1};
        st->statistics.sdn += result == DPM_SENT_WHOLE;
        bus_busy(st, st->tx_end_latest, st->tid2);
        finish(st, st->tx_end_latest, &confirm);
        return;
    }
    st->statistics.requests += st->tries == 1;
    st->statistics.repetitions += st->tries > 1;
    st->heard = -1;
    st->suspect = -1;
    st->deadline = st->tx_end_latest + slot_of(st);
    st->state = DPM_FDL_AWAIT_DATA_RESPONSE;
}

static void station_sent(dpm_machine *machine, int64_t start, int64_t end_earliest, int64_t end_latest, int result)
{
    dpm_station *st = (dpm_station *)machine;
    const uint8_t kind = st->tx_kind;
    st->tx_kind = DPM_TX_NONE;
    st->tx_start = start;
    st->tx_end_earliest = end_earliest;
    st->tx_end_latest = end_latest;
    dpm_receiver_flush(&st->receiver);
    bus_busy(st, end_latest, st->tid1);
    st->statistics.send_failed += result != DPM_SENT_WHOLE;
    st->echo_kind = st->echoes && result == DPM_SENT_WHOLE ? kind : DPM_TX_NONE;
    st->echo_n = 0;
    st->echo_spoilt = false;
    if (kind == DPM_TX_REQUEST)
        request_sent(st, result); /* one that did not leave whole is repeated when its slot runs out */
    else if (kind == DPM_TX_STATUS)
        dpm_token_poll_sent(st);
    else if (kind == DPM_TX_REPLY && result == DPM_SENT_WHOLE)
        dpm_token_status_told(st, end_latest);
    else if (kind == DPM_TX_TOKEN && result == DPM_SENT_WHOLE) {
        st->statistics.tokens++;
        dpm_token_sent(st, end_latest);
    }
}

/* --- what to send ------------------------------------------------------------------------------------------------ */

static bool request_is_valid(const dpm_station *st, const dpm_request *r)
{
    if (r->da == st->config.address || r->da > DPM_BROADCAST || (r->da == DPM_BROADCAST && !is_sdn(r->function)))
        return false;
    return wants_answer(r->function) || is_sdn(r->function);
}

/* FC of a request (EN 50170 part 4): first contact FCB 1, FCV 0; then FCV 1 and a toggling FCB; others neither. */
static uint8_t request_fc(const dpm_station *st, const dpm_request *r)
{
    const uint8_t fc = (uint8_t)(DPM_FC_REQUEST | r->function);
    if (!counts_frames(r->function))
        return fc;
    switch (st->fcb[r->da]) {
    case DPM_FCB_NEXT_0:
        return fc | DPM_FC_FCV;
    case DPM_FCB_NEXT_1:
        return fc | DPM_FC_FCV | DPM_FC_FCB;
    default:
        return fc | DPM_FC_FCB;
    }
}

static void take_request(dpm_station *st, dpm_fdl_user *user, const dpm_request *r)
{
    const bool valid = request_is_valid(st, r);
    const dpm_telegram t = {
        .da = r->da, .sa = st->config.address, .fc = valid ? request_fc(st, r) : 0,
        .dsap = r->dsap, .ssap = r->ssap, .dsegment = -1, .ssegment = -1,
        .length = r->length, .data = r->data,
    };
    const int n = valid ? dpm_encode(&t, st->tx, sizeof st->tx) : DPM_E_ARGUMENT;
    const bool repeatable = valid && counts_frames(r->function) && st->fcb[r->da] != DPM_FCB_UNKNOWN;
    st->user = user;
    st->da = r->da & 0x7F;
    st->function = r->function;
    st->dsap = r->dsap;
    st->ssap = r->ssap;
    st->sc_fits = counts_frames(r->function) && (r->length > 0 || r->dsap < 0); /* Slave_Diag and Get_Cfg want data */
    st->tries = 0;
    st->withdrawn = false;
    st->retries = repeatable ? r->retries : 0;
    if (n < 0) {
        dpm_confirm confirm = {.status = DPM_CONF_INVALID, .tsdr = -1};
        finish(st, st->last_activity, &confirm);
        return;
    }
    st->tx_n = (uint16_t)n;
    st->tx_kind = DPM_TX_REQUEST;
    st->tx_not_before = st->not_before;
}

/* Ask the users by priority for a request; without one, when they may have one. Past the token hold time only the first
 * user is asked: its messages are those of high priority. The others have one message in each turn, so that none of them
 * starves the first, or the next; and where the first one's use up all time of every turn, they begin one now and then. */
static int64_t ask_users(dpm_station *st, int64_t now, bool high_only)
{
    int64_t wake = DPM_NEVER;
    const unsigned first = st->passed_over > TURNS_FOR_ONE && st->n_users > 1;
    for (unsigned k = 0; k < st->n_users; k++) {
        const unsigned i = high_only ? k : (first + k) % st->n_users;
        if (i > 0 && (high_only || st->served & 1u << i))
            continue;
        if (i > 0)
            st->passed_over = 0;
        dpm_request request = {.dsap = DPM_NO_SAP, .ssap = DPM_NO_SAP};
        if (st->users[i].next(st->users[i].context, now, &request, &wake)) {
            st->served |= (uint8_t)(1u << i);
            take_request(st, &st->users[i], &request);
            return now;
        }
        if (st->state != DPM_FDL_USE_TOKEN)
            return now; /* the user went offline */
    }
    return wake;
}

/* Check_Access_Time: one message of high priority always, more while the token hold time lasts. */
static void use_token_in_ring(dpm_station *st, int64_t now)
{
    const bool over = now >= st->hold_until;
    if (!(over && st->worked))
        ask_users(st, now, over);
    if (st->tx_kind == DPM_TX_NONE && st->state == DPM_FDL_USE_TOKEN)
        st->state = DPM_FDL_PASS_TOKEN;
}

/* Alone: work of the users, else the token to oneself. With more to do the next turn begins without a telegram, ten slot
 * times long at most, and within Ttr; with nothing to do the token still goes round before the bus has been silent for
 * two thirds of the shortest Tto, so that no other master takes it for lost. Returns when to look again. */
static int64_t use_token_alone(dpm_station *st, int64_t now)
{
    const int64_t idle_end = st->last_activity + st->idle;
    if (now >= st->hold_until) {
        use_token_in_ring(st, now);
        return now;
    }
    st->users_wake = ask_users(st, now, false);
    if (st->state == DPM_FDL_USE_TOKEN && st->tx_kind == DPM_TX_NONE && st->worked && st->users_wake <= now &&
        now < st->token_at + st->turn) {
        dpm_station_begin_turn(st, now);
        st->users_wake = ask_users(st, now, false);
    }
    if (st->tx_kind != DPM_TX_NONE || st->state != DPM_FDL_USE_TOKEN)
        return now;
    if (!st->worked && st->users_wake > now && now < idle_end && !dpm_token_gap_is_due(st, now))
        return min_of(st->users_wake, idle_end);
    st->state = DPM_FDL_PASS_TOKEN;
    return now;
}

static int64_t use_token(dpm_station *st, int64_t now)
{
    const bool alone = dpm_token_alone(st);
    if (now < st->not_before)
        return alone ? max_of(st->not_before, min_of(st->users_wake, st->last_activity + st->idle)) : st->not_before;
    if (alone)
        return use_token_alone(st, now);
    use_token_in_ring(st, now);
    return now;
}

/* A late host looks often enough to know, when a token or a request comes, how old that may be; behind its own pass, too, for in
 * a ring of two the token may be the first that comes back. */
static int64_t look_at(const dpm_station *st)
{
    const bool may_come = st->state == DPM_FDL_LISTEN_TOKEN || st->state == DPM_FDL_ACTIVE_IDLE ||
                          st->state == DPM_FDL_CHECK_TOKEN_PASS;
    return st->config.traits.allowance && may_come ? st->asked + st->late_slot / LOOKS : DPM_NEVER;
}

/* When silence will let the machine conclude something. */
static int64_t silence_at(const dpm_station *st)
{
    const int64_t unfinished = min_of(dpm_receiver_deadline(&st->receiver), look_at(st));
    switch (st->state) {
    case DPM_FDL_ACTIVE_IDLE:
        return min_of(unfinished, silence_ends(st));
    case DPM_FDL_LISTEN_TOKEN:
        return min_of(unfinished, claim_at(st));
    case DPM_FDL_AWAIT_DATA_RESPONSE:
    case DPM_FDL_AWAIT_STATUS_RESPONSE:
    case DPM_FDL_CHECK_TOKEN_PASS:
        if (st->heard < 0)
            return min_of(unfinished, st->deadline);
        return min_of(unfinished, max_of(st->deadline, st->heard + st->tsyn + st->config.traits.granularity));
    default:
        return unfinished;
    }
}

/* Our own silence was so long that another master may have the token: nothing is sent on an old right. What others did
 * meanwhile is unknown, so we listen for a whole Tto. An answer still awaited is judged by its slot, not here. */
static void drop_stale_token(dpm_station *st, int64_t now)
{
    const bool waits = st->tx_kind == DPM_TX_NONE &&
                       (st->state == DPM_FDL_AWAIT_DATA_RESPONSE || st->state == DPM_FDL_AWAIT_STATUS_RESPONSE);
    if (!dpm_station_talks(st) || waits || now <= right_ends(st))
        return;
    st->statistics.tokens_lost++;
    st->statistics.late_dropped += st->tx_kind != DPM_TX_NONE;
    put_event(st, now, DPM_EV_LATE, 0, 0, now - right_ends(st));
    dpm_station_drop_token(st, DPM_FDL_ACTIVE_IDLE, now, false);
    if (dpm_token_alone(st)) {
        dpm_token_listen(st, now);
        st->paused = true;
    }
    st->last_activity = now;
}

static void drop_late_reply(dpm_station *st, int64_t now)
{
    if (st->tx_kind != DPM_TX_REPLY || now <= st->tx_not_after)
        return;
    st->statistics.late_dropped++;
    put_event(st, now, DPM_EV_LATE, 0, 0, now - st->tx_not_after);
    st->tx_kind = DPM_TX_NONE;
}

static void station_ask(dpm_machine *machine, int64_t now, dpm_offer *offer)
{
    dpm_station *st = (dpm_station *)machine;
    *offer = (dpm_offer){.octets = st->tx, .not_before = now, .not_after = DPM_NEVER, .wake = DPM_NEVER};
    if (st->state <= DPM_FDL_PASSIVE_IDLE)
        return;
    if (st->last_activity < 0)
        st->last_activity = now;
    st->asked = now;
    drop_stale_token(st, now);
    drop_late_reply(st, now);
    if (st->echo_kind != DPM_TX_NONE) {
        offer->wake = min_of(echo_due(st), silence_at(st));
        return;
    }
    if (st->tx_kind == DPM_TX_NONE && st->state == DPM_FDL_USE_TOKEN)
        offer->wake = use_token(st, now);
    if (st->tx_kind == DPM_TX_NONE && (st->state == DPM_FDL_CLAIM_TOKEN || st->state == DPM_FDL_PASS_TOKEN))
        dpm_token_make(st, now);
    if (st->tx_kind == DPM_TX_NONE) {
        offer->wake = min_of(offer->wake, silence_at(st));
        return;
    }
    if (st->tx_kind != DPM_TX_REPLY) {
        st->tx_not_before = max_of(st->tx_not_before, st->not_before);
        st->tx_not_after = right_ends(st);
    }
    offer->n = st->tx_n;
    offer->not_before = st->tx_not_before;
    offer->not_after = st->tx_not_after;
    offer->wake = st->tx_not_before;
}

/* --- set-up ------------------------------------------------------------------------------------------------------ */

size_t dpm_station_size(void) { return sizeof(dpm_station); }

/* Alone and with nothing to do: less than 6 Tsl, Tto of address 0 and the shortest. A Tsl longer than the rate's own is for
 * hosts that wake late; beside us may be one on such a port whose Tsl is not, and that waits for as long as its host may be
 * late. Not the same for two stations, since two that each believe to be alone could otherwise talk over each other in step
 * for ever. */
static int64_t idle_time(const dpm_station *st, const dpm_parameters *p, uint8_t address)
{
    dpm_parameters usual;
    const bool known = dpm_parameters_default(&usual, p->rate_num / p->rate_den, 0) == DPM_OK;
    const int64_t own = 4 * st->tsl + st->tsl * address / 84, tsl = known ? dpm_bits_up(p, usual.tsl) : st->tsl;
    return min_of(own, 4 * tsl + tsl * address / 84 + st->config.traits.allowance / 2);
}

static void derive_times(dpm_station *st, const dpm_parameters *p, uint8_t address)
{
    st->tsl = dpm_bits_up(p, p->tsl);
    st->tid1 = dpm_bits_up(p, dpm_tid1(p));
    st->tid2 = dpm_bits_up(p, dpm_tid2(p));
    st->tto = dpm_bits_up(p, dpm_tto(p, address));
    st->tsyn = dpm_bits_up(p, DPM_TSYN);
    st->tsyni = dpm_bits_up(p, DPM_TSYNI);
    st->min_tsdr = dpm_bits_up(p, p->min_tsdr);
    st->max_tsdr = dpm_bits_down(p, p->max_tsdr);
    st->late_slot = dpm_bits_up(p, dpm_ring_tsl(p, st->config.traits.allowance + st->config.traits.delivery));
    st->idle = idle_time(st, p, address);
    st->turn = 10 * st->tsl;
}

int dpm_station_init(void *block, size_t size, const dpm_station_config *config, dpm_station **station)
{
    const dpm_parameters *p = &config->parameters;
    dpm_refusal refusal;
    if (!block || size < sizeof(dpm_station) || (uintptr_t)block % 16)
        return DPM_E_BLOCK;
    if (config->address > DPM_ADDRESS_MAX)
        return DPM_E_ADDRESS;
    if (config->role > DPM_ROLE_PASSIVE || config->traits.allowance < 0 || config->traits.granularity < 0 ||
        config->traits.delivery < 0)
        return DPM_E_ARGUMENT;
    if (dpm_parameters_check(p, config->address, &refusal) < 0)
        return DPM_E_PARAMETER;
    if (config->role == DPM_ROLE_RING && dpm_ring_tsl(p, config->traits.allowance + config->traits.delivery) > p->tsl)
        return DPM_E_SLOT;
    dpm_station *st = block;
    memset(st, 0, sizeof *st);
    st->machine.octets = station_octets;
    st->machine.quiet = station_quiet;
    st->machine.sent = station_sent;
    st->machine.ask = station_ask;
    st->config = *config;
    derive_times(st, p, config->address);
    st->last_activity = -1;
    st->foreign = -1;
    st->heard = -1;
    st->given_up = -1;
    st->ring.ts = config->address;
    st->ring.ns = config->address;
    st->ring.ps = config->address;
    dpm_receiver_init(&st->receiver, dpm_bits_up(p, DPM_CHARACTER_BITS), st->tsyn + config->traits.granularity, 0);
    *station = st;
    return DPM_OK;
}

dpm_machine *dpm_station_machine(dpm_station *station) { return &station->machine; }

int dpm_station_add_user(dpm_station *station, const dpm_fdl_user *user)
{
    if (station->n_users == DPM_STATION_USERS)
        return DPM_E_FULL;
    station->users[station->n_users++] = *user;
    return DPM_OK;
}

static int swap_ring(dpm_station *station, dpm_ring *from, dpm_ring *to, int error)
{
    for (unsigned i = 0; i < DPM_STATION_RINGS; i++)
        if (station->rings[i] == from) {
            station->rings[i] = to;
            return DPM_OK;
        }
    return error;
}

int dpm_station_add_ring(dpm_station *station, dpm_ring *ring) { return swap_ring(station, NULL, ring, DPM_E_FULL); }

int dpm_station_remove_ring(dpm_station *station, dpm_ring *ring)
{
    return swap_ring(station, ring, NULL, DPM_E_ARGUMENT);
}

void dpm_station_online(dpm_station *station, bool online, int64_t now)
{
    if (online == (station->state != DPM_FDL_OFFLINE))
        return;
    dpm_station_drop_token(station, DPM_FDL_OFFLINE, now, false);
    dpm_receiver_flush(&station->receiver);
    station->last_activity = -1; /* Tto counts from the first look at the bus */
    station->echoes = station->config.traits.echo; /* of another port, perhaps */
    station->echo_kind = DPM_TX_NONE;
    station->spoilt = 0;
    station->not_before = 0;
    if (online)
        dpm_token_listen(station, now);
}

int dpm_station_state(const dpm_station *station) { return station->state; }

void dpm_station_statistics(const dpm_station *station, dpm_fdl_statistics *statistics)
{
    *statistics = station->statistics;
    memcpy(statistics->rejected, station->receiver.rejected, sizeof statistics->rejected);
}

void dpm_station_restart(dpm_station *station, uint8_t address) { station->fcb[address & 0x7F] = DPM_FCB_UNKNOWN; }
