/* SPDX-License-Identifier: MIT
 *
 * The FDL station's place in the token ring (EN 50170 part 4, 4.1 and 4.2): the list of active stations, taking the
 * token from the predecessor, passing it to the successor, the GAP. What is done with the token is station.c's.
 */
#include "core/station_private.h"

#include <string.h>

#define TOKEN_TRIES 3 /* one and two repetitions, then the successor is out of the list */

/* --- the list of active stations --------------------------------------------------------------------------------- */

static bool has(const uint8_t *las, uint8_t address) { return las[address / 8] >> (address % 8) & 1; }

static void add(uint8_t *las, uint8_t address) { las[address / 8] |= (uint8_t)(1u << (address % 8)); }

static void drop(uint8_t *las, uint8_t address) { las[address / 8] &= (uint8_t)~(1u << (address % 8)); }

/* Strictly between `from` and `to` in the ring's order; from == to is the whole way round. */
static bool between(uint8_t from, uint8_t address, uint8_t to)
{
    const unsigned way = (unsigned)(to - from) & 127, part = (unsigned)(address - from) & 127;
    return part != 0 && (way == 0 || part < way);
}

/* The next member behind (step 1) or before (step 127) an address; itself when there is no other. */
static uint8_t neighbour(const uint8_t *las, uint8_t address, unsigned step)
{
    uint8_t at = address;
    do
        at = (uint8_t)((at + step) & 127);
    while (at != address && !has(las, at));
    return at;
}

void dpm_token_live(dpm_station *station, uint8_t address, uint8_t live, int64_t now)
{
    const uint8_t old = station->ring.live[address];
    if (old == live)
        return;
    station->ring.live[address] = live;
    if (old == DPM_LIVE_UNKNOWN && live == DPM_LIVE_NONE)
        return; /* nobody came and nobody went */
    const dpm_event event = {.time = now, .kind = DPM_EV_LIVE, .address = address, .a = live, .b = old};
    dpm_station_event(station, &event);
}

static void find_neighbours(dpm_station *st)
{
    st->ring.ns = neighbour(st->ring.las, st->ring.ts, 1);
    st->ring.ps = neighbour(st->ring.las, st->ring.ts, 127);
}

/* "Everything strictly between SA and DA is not active": such stations have been passed over. */
static void clear_between(dpm_station *st, uint8_t sa, uint8_t da, int64_t now)
{
    for (uint8_t address = 0; address <= DPM_ADDRESS_MAX; address++)
        if (address != st->ring.ts && has(st->ring.las, address) && between(sa, address, da)) {
            drop(st->ring.las, address);
            dpm_token_live(st, address, DPM_LIVE_UNKNOWN, now); /* out of the ring, perhaps still there */
        }
}

static void begin_gap(dpm_station *st)
{
    st->gap_at = st->ring.ts;
    st->gap_wait = 0;
}

bool dpm_token_alone(const dpm_station *station) { return station->ring.ns == station->ring.ts; }

/* --- Listen_Token ------------------------------------------------------------------------------------------------ */

void dpm_token_listen(dpm_station *station, int64_t now)
{
    const bool passive = station->config.role == DPM_ROLE_PASSIVE;
    memset(station->ring.las, 0, sizeof station->ring.las);
    memset(station->seen, 0, sizeof station->seen);
    if (!passive)
        add(station->ring.las, station->ring.ts);
    find_neighbours(station);
    station->listened = false;
    station->token_at = -1;
    station->ready = false;
    station->paused = false;
    station->own_heard = 0;
    station->stranger = -1;
    station->ring.duplicate = false;
    dpm_station_enter(station, passive ? DPM_FDL_PASSIVE_IDLE : DPM_FDL_LISTEN_TOKEN, now);
}

/* Out of the ring with an exchange or a turn under way. The users come last: one may go Offline. */
static void relisten(dpm_station *st, int64_t now)
{
    dpm_token_listen(st, now);
    dpm_station_drop_token(st, DPM_FDL_LISTEN_TOKEN, now, true);
}

/* The token came. Returns Trr, 0 for the first one behind a time out of the ring: what was before it is no rotation. */
static int64_t count_rotation(dpm_station *st, int64_t now)
{
    const int64_t trr = st->token_at < 0 ? 0 : now - st->token_at;
    st->token_at = now;
    st->ring.rotations++;
    if (!trr)
        return 0;
    st->ring.trr = trr;
    st->ring.trr_min = !st->ring.trr_min || trr < st->ring.trr_min ? trr : st->ring.trr_min;
    st->ring.trr_max = max_of(trr, st->ring.trr_max);
    return trr;
}

/* A passive station has no turn: to it a rotation is from one wrap of the addresses to the next. */
static void watch(dpm_station *st, int64_t now)
{
    for (uint8_t address = 0; address <= DPM_ADDRESS_MAX; address++)
        if (has(st->ring.las, address) && !has(st->seen, address))
            dpm_token_live(st, address, DPM_LIVE_UNKNOWN, now);
    if (st->listened)
        count_rotation(st, now);
    st->token_at = now;
}

/* A rotation ends where the addresses wrap round. The list counts once it was the same in two of them. */
static void listen(dpm_station *st, uint8_t sa, uint8_t da, int64_t now)
{
    add(st->seen, sa);
    if (da > sa)
        return;
    if (st->state == DPM_FDL_PASSIVE_IDLE)
        watch(st, now);
    st->ready = st->listened && !memcmp(st->seen, st->ring.las, sizeof st->seen);
    memcpy(st->ring.las, st->seen, sizeof st->seen);
    memset(st->seen, 0, sizeof st->seen);
    st->listened = true;
    find_neighbours(st);
}

/* --- a token heard ------------------------------------------------------------------------------------------------ */

/* Our address as the sender, though we have sent nothing: in Listen_Token the second time is proof of a station with
 * our address, in the ring two in a row are. */
static void heard_own(dpm_station *st, int64_t now)
{
    if (++st->own_heard < 2)
        return;
    if (st->state != DPM_FDL_LISTEN_TOKEN) {
        relisten(st, now);
        return;
    }
    st->ring.duplicate = true;
    const dpm_event event = {.time = now, .kind = DPM_EV_DUPLICATE, .address = st->ring.ts};
    dpm_station_event(st, &event);
    dpm_station_drop_token(st, DPM_FDL_OFFLINE, now, true);
}

/* Token hold time Tth = Ttr - Trr; the first telegram must begin so that the predecessor hears of it within its slot: when its
 * first character has ended, or where telegrams are handed over whole, when the longest has. */
static void accept(dpm_station *st, const dpm_received *rx)
{
    const dpm_parameters *p = &st->config.parameters;
    const int64_t now = rx->end_latest;
    const int64_t heard = dpm_bits_up(p, DPM_CHARACTER_BITS) + st->config.traits.delivery;
    st->speak_until = dpm_station_came(st, rx) + st->tsl - heard;
    const bool too_late = now > st->speak_until; /* no rotation ends with one that nobody knows the age of */
    st->hold_until = too_late ? now : now + max_of(dpm_bits_down(p, p->ttr) - count_rotation(st, now), 0);
    st->spoke = false;
    st->stranger = -1;
    st->passes = 0;
    st->gap_polled = false;
    dpm_station_begin_turn(st, now);
}

/* For us: from PS at once; from anybody else when it says so a second time, and then that is PS. */
static void token_for_us(dpm_station *st, uint8_t sa, const dpm_received *rx)
{
    if (sa != st->ring.ps && sa != st->stranger) {
        st->stranger = sa;
        return;
    }
    clear_between(st, sa, st->ring.ts, rx->end_latest);
    add(st->ring.las, sa);
    find_neighbours(st);
    st->ring.ps = sa;
    accept(st, rx);
}

static void follow(dpm_station *st, uint8_t sa, uint8_t da, int64_t now)
{
    st->stranger = -1;
    add(st->ring.las, sa);
    if (sa != da && between(sa, st->ring.ts, da)) {
        dpm_token_listen(st, now); /* passed over: we are out of the ring */
        return;
    }
    if (sa != da)
        clear_between(st, sa, da, now);
    find_neighbours(st);
}

void dpm_token_heard(dpm_station *station, uint8_t sa, uint8_t da, const dpm_received *received)
{
    const int64_t now = received->end_latest;
    const bool own = sa == station->ring.ts && station->state != DPM_FDL_PASSIVE_IDLE; /* a listener's address is nobody's */
    /* What seems to be ours, too: whoever it is for may take it. One to ourselves may be an echo that no port marked. */
    if (dpm_station_talks(station) && !(own && da == sa))
        dpm_station_drop_token(station, DPM_FDL_ACTIVE_IDLE, now, false);
    if (own) {
        heard_own(station, now);
        return;
    }
    dpm_token_live(station, sa, DPM_LIVE_MASTER_IN_RING, now);
    if (station->state <= DPM_FDL_LISTEN_TOKEN) {
        listen(station, sa, da, now);
        return;
    }
    station->own_heard = 0;
    if (da == station->ring.ts)
        token_for_us(station, sa, received);
    else
        follow(station, sa, da, now);
}

/* --- FDL status ---------------------------------------------------------------------------------------------------- */

/* "Ready when asked by its predecessor": only from there the token comes next. */
uint8_t dpm_token_status(dpm_station *station, uint8_t asker)
{
    const bool listening = station->state == DPM_FDL_LISTEN_TOKEN;
    station->ready_told = listening && station->ready && station->config.role == DPM_ROLE_RING && asker == station->ring.ps;
    if (station->ready_told)
        return DPM_TYPE_MASTER_READY;
    return listening ? DPM_TYPE_MASTER_NOT_READY : DPM_TYPE_MASTER_IN_RING;
}

/* The predecessor knows that we are ready. */
void dpm_token_status_told(dpm_station *station, int64_t now)
{
    if (!station->ready_told)
        return;
    station->ready_told = false;
    add(station->ring.las, station->ring.ts);
    find_neighbours(station);
    station->own_heard = 0;
    begin_gap(station);
    dpm_station_enter(station, DPM_FDL_ACTIVE_IDLE, now);
}

/* --- claiming ------------------------------------------------------------------------------------------------------ */

/* At a cold start the list holds only us; a token lost in a running ring leaves it as it was (EN 50170 part 4). */
void dpm_token_claim(dpm_station *station, int64_t now)
{
    if (station->state == DPM_FDL_LISTEN_TOKEN) {
        memset(station->ring.las, 0, sizeof station->ring.las);
        add(station->ring.las, station->ring.ts);
        find_neighbours(station);
        station->own_heard = 0;
    }
    station->claims = 2;
    begin_gap(station);
    dpm_station_enter(station, DPM_FDL_CLAIM_TOKEN, now);
}

static void own_turn(dpm_station *st, int64_t now)
{
    st->hold_until = max_of(now, st->token_at + dpm_bits_down(&st->config.parameters, st->config.parameters.ttr));
    st->spoke = true;
    st->gap_polled = false;
    dpm_station_begin_turn(st, now);
}

void dpm_token_sent(dpm_station *station, int64_t now)
{
    if (station->state == DPM_FDL_CLAIM_TOKEN) {
        if (--station->claims == 0)
            own_turn(station, now);
        station->token_at = now;
        return;
    }
    if (dpm_token_alone(station)) {
        own_turn(station, now);
        count_rotation(station, now);
        return;
    }
    station->spoke = true;
    station->statistics.token_repetitions += station->passes > 0;
    station->passes++;
    station->heard = -1;
    station->deadline = station->tx_end_latest + station->tsl;
    dpm_station_enter(station, DPM_FDL_CHECK_TOKEN_PASS, now);
}

/* "Listens to its own frame": once may be the line's fault, and the pass is repeated if the successor was silent, too. Twice
 * in a row is the transceiver's: who heard something leaves the ring and listens, who heard nothing is deaf as well and would
 * claim a token that others have, so it leaves the bus. */
void dpm_token_echoed(dpm_station *station, bool right, int64_t now)
{
    const bool deaf = station->echo_n == 0;
    station->statistics.tokens_spoilt += !right;
    station->spoilt = right ? 0 : (uint8_t)(station->spoilt + 1);
    station->own_heard = right ? 0 : station->own_heard; /* one of ours in between */
    if (station->spoilt < 2)
        return;
    station->spoilt = 0;
    const dpm_event event = {.time = now, .kind = DPM_EV_ECHO, .address = -1, .a = deaf};
    dpm_station_event(station, &event);
    if (deaf)
        dpm_station_drop_token(station, DPM_FDL_OFFLINE, now, true);
    else
        relisten(station, now);
}

/* --- GAP ------------------------------------------------------------------------------------------------------------ */

/* The next address of the GAP, TS + 1 to NS - 1 without what lies above HSA; -1 when it is through and rests for
 * G * Ttr. Alone, the GAP is everybody else. */
static int next_of_gap(dpm_station *st, int64_t now)
{
    const dpm_parameters *p = &st->config.parameters;
    const uint8_t top = p->hsa > DPM_ADDRESS_MAX ? DPM_ADDRESS_MAX : p->hsa;
    const uint8_t at = st->gap_at >= top ? 0 : (uint8_t)(st->gap_at + 1);
    if (at == st->ring.ns || at == st->ring.ts || !between(st->ring.ts, at, st->ring.ns)) {
        st->gap_at = st->ring.ts;
        st->gap_wait = now + dpm_bits_up(p, (int64_t)p->g * p->ttr);
        return -1;
    }
    return at;
}

/* One address per token, in the time that is left. */
bool dpm_token_gap_is_due(const dpm_station *station, int64_t now)
{
    if (station->config.role != DPM_ROLE_RING || station->gap_polled || station->passes || now < station->gap_wait)
        return false;
    return dpm_token_alone(station) || now < station->hold_until;
}

void dpm_token_make(dpm_station *station, int64_t now)
{
    const bool claiming = station->state == DPM_FDL_CLAIM_TOKEN;
    const int address = !claiming && dpm_token_gap_is_due(station, now) ? next_of_gap(station, now) : -1;
    const dpm_telegram poll = {.format = DPM_SD1, .da = (uint8_t)address, .sa = station->ring.ts,
                               .fc = DPM_FC_REQUEST | DPM_FDL_STATUS, .dsap = DPM_NO_SAP, .ssap = DPM_NO_SAP,
                               .dsegment = -1, .ssegment = -1};
    const dpm_telegram token = {.format = DPM_SD4, .da = claiming ? station->ring.ts : station->ring.ns,
                                .sa = station->ring.ts, .dsap = DPM_NO_SAP, .ssap = DPM_NO_SAP,
                                .dsegment = -1, .ssegment = -1};
    const bool polls = address >= 0;
    const int n = dpm_encode(polls ? &poll : &token, station->tx, sizeof station->tx);
    station->tx_n = (uint16_t)n;
    station->tx_kind = polls ? DPM_TX_STATUS : DPM_TX_TOKEN;
    station->tx_not_before = station->not_before;
    if (polls)
        station->gap_at = (uint8_t)address;
}

void dpm_token_poll_sent(dpm_station *station)
{
    station->gap_polled = true;
    station->spoke = true;
    station->statistics.gap_polls++;
    station->heard = -1;
    station->deadline = station->tx_end_latest + station->tsl;
    station->state = DPM_FDL_AWAIT_STATUS_RESPONSE;
}

/* A master that is ready, or believes to be in the ring, is the new NS and gets the token at once. */
void dpm_token_poll_answered(dpm_station *station, uint8_t address, uint8_t fc)
{
    if (station->state != DPM_FDL_AWAIT_STATUS_RESPONSE || address != station->gap_at || (fc & 0x0F) != DPM_RES_OK)
        return;
    station->state = DPM_FDL_PASS_TOKEN;
    if (fc & DPM_TYPE_MASTER_READY) {
        add(station->ring.las, address);
        find_neighbours(station);
        begin_gap(station);
    }
}

void dpm_token_slot_over(dpm_station *station, int64_t now)
{
    if (station->state == DPM_FDL_AWAIT_STATUS_RESPONSE) {
        dpm_token_live(station, station->gap_at, DPM_LIVE_NONE, now);
        station->state = DPM_FDL_PASS_TOKEN;
        /* Two that each believe to be alone, since they claimed in the same moment, must not scan in step: while both
         * talk neither hears. A bit time for each address, when alone, and one of them is heard soon. */
        if (dpm_token_alone(station))
            station->not_before = max_of(station->not_before, station->deadline +
                                         dpm_bits_up(&station->config.parameters, station->ring.ts));
        return;
    }
    if (station->passes >= TOKEN_TRIES) {
        dpm_token_live(station, station->ring.ns, DPM_LIVE_NONE, now);
        drop(station->ring.las, station->ring.ns);
        find_neighbours(station);
        station->passes = 0;
        begin_gap(station); /* it has grown, and whoever is in it may come back: at the next token */
        station->gap_polled = true;
    }
    station->state = DPM_FDL_PASS_TOKEN;
}

/* --- what onlookers read ------------------------------------------------------------------------------------------ */

void dpm_station_get_ring(const dpm_station *station, dpm_ring_view *view) { *view = station->ring; }

uint32_t dpm_ring_tsl(const dpm_parameters *parameters, int64_t late)
{
    uint32_t bits = (uint32_t)parameters->max_tsdr + 15;
    const int64_t need = dpm_bits_up(parameters, bits) + late;
    /* ns to Tbit, rounded up: late * rate / 1e9 */
    const uint64_t more = (uint64_t)late * parameters->rate_num / ((uint64_t)parameters->rate_den * 1000000000u);
    bits += (uint32_t)more;
    while (dpm_bits_up(parameters, bits) < need)
        bits++;
    return bits;
}
