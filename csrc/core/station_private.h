/* SPDX-License-Identifier: MIT
 *
 * The FDL station's memory, for station.c (the exchange), token.c (the ring), and the DP master that contains one.
 */
#ifndef DPM_CORE_STATION_PRIVATE_H
#define DPM_CORE_STATION_PRIVATE_H

#include "dpmaster/station.h"
#include "dpmaster/telegram.h"

#define DPM_STATION_USERS 4
#define DPM_STATION_RINGS 8

/* The telegram that waits for its time. */
enum dpm_tx_kind { DPM_TX_NONE = 0, DPM_TX_TOKEN, DPM_TX_STATUS, DPM_TX_REQUEST, DPM_TX_REPLY };

/* The frame count bit of one responder (EN 50170 part 4, "FCB"). */
enum dpm_fcb { DPM_FCB_UNKNOWN = 0, DPM_FCB_NEXT_0, DPM_FCB_NEXT_1 };

struct dpm_station {
    dpm_machine machine; /* first: the machine is the station */
    dpm_station_config config;
    dpm_fdl_user users[DPM_STATION_USERS];
    unsigned n_users;
    dpm_ring *rings[DPM_STATION_RINGS];
    dpm_fdl_statistics statistics;
    dpm_receiver receiver;
    /* the bus parameters in ns: minima rounded up, maxima down */
    int64_t tsl, tid1, tid2, tto, tsyn, tsyni, min_tsdr, max_tsdr, idle, turn;
    int64_t late_slot;     /* the slot time that a ring of hosts like ours would need */

    uint8_t state;         /* enum dpm_fdl_state */
    uint8_t claims;        /* tokens still to send in Claim_Token */
    bool worked;           /* something was sent since the token came */
    uint8_t served;        /* users that had their message in this turn, a bit each */
    uint8_t passed_over;   /* turns that the first user had for itself, in a row */
    int64_t token_at;      /* the token came; -1: not since we are in the ring */
    int64_t hold_until;    /* token hold time: Ttr - Trr after that */
    int64_t speak_until;   /* the first telegram of a turn: behind this the predecessor takes us for gone */
    bool spoke;            /* the turn's first telegram is out */
    int64_t users_wake;    /* no user has work before this; 0: not known, ask them */
    int64_t asked;         /* the last time the machine was asked what now */
    int64_t looked;        /* the host's last read: what it reads now, came later */
    int64_t last_activity; /* latest end of anything on the bus, ours too; -1: nothing known yet */
    int64_t not_before;    /* Tid1 or Tid2 after it: the earliest next transmission of ours */

    uint8_t tx[DPM_TELEGRAM_MAX];
    uint16_t tx_n;
    uint8_t tx_kind;       /* enum dpm_tx_kind */
    int64_t tx_not_before, tx_not_after;
    int64_t tx_start, tx_end_earliest, tx_end_latest;

    /* our own transmission heard back */
    bool echoes;           /* this port hears what it sends */
    bool echo_spoilt;      /* heard otherwise than sent */
    uint8_t echo_kind;     /* enum dpm_tx_kind of what is to come back; NONE: nothing, or it has */
    uint16_t echo_n;       /* octets of it heard */
    uint8_t spoilt;        /* own tokens that came back wrong or not at all, in a row */

    /* the one exchange under way: Await_Data_Response, or its request still in tx */
    dpm_fdl_user *user;    /* whose it is; NULL: none */
    uint8_t da, function, tries, retries;
    int16_t dsap, ssap;
    bool withdrawn;        /* not to be sent any more; an answer to what was sent is still good */
    int64_t deadline;      /* slot time over, allowance included */
    int16_t given_up;      /* whose request was given up last, until an answer comes; -1 none */
    bool late_sc;          /* and SC would have answered it: the next one may be its */
    bool sc_fits;          /* SC may answer the request under way */
    int16_t suspect;       /* sender of what looked like a token in the slot, -1 none */
    int64_t heard;         /* latest octet since the request went out, -1 none */

    int16_t foreign;       /* the foreign master heard last, -1 none */
    int64_t foreign_gap;   /* the longest silence heard between its telegrams while we listened */

    uint8_t fcb[128];      /* enum dpm_fcb, by address */

    /* the ring */
    dpm_ring_view ring;
    uint8_t seen[16];      /* Listen_Token: who sent a token in the rotation under way */
    bool listened;         /* Listen_Token: one rotation was seen whole */
    bool ready;            /* Listen_Token: the LAS was the same in two rotations */
    bool ready_told;       /* the answer in tx says "ready" */
    bool paused;           /* Listen_Token: our own silence was too long, and nobody has shown to have the bus */
    uint8_t own_heard;     /* tokens with our address that we did not send, in a row */
    int16_t stranger;      /* sent us a token though it is not PS; -1 none */
    uint8_t suspect_da;    /* whom the suspect's token was for */
    uint8_t passes;        /* tries to pass the token */
    bool gap_polled;       /* one address per token */
    uint8_t gap_at;        /* the address polled last */
    int64_t gap_wait;      /* the GAP rests until then */
};

static inline int64_t min_of(int64_t a, int64_t b) { return a < b ? a : b; }

static inline int64_t max_of(int64_t a, int64_t b) { return a > b ? a : b; }

/* What the exchange under way carries must not be sent again: it ends with DS, unless an answer still comes. */
void dpm_station_withdraw(dpm_station *station, int64_t now);

/* Put one event into every ring. */
void dpm_station_event(dpm_station *station, const dpm_event *event);

/* --- token.c ------------------------------------------------------------------------------------------------------ */

/* What an answer's FC says of its sender: bits 5 and 4 are the station type. */
#define DPM_LIVE_OF(fc) ((uint8_t)(DPM_LIVE_SLAVE + ((fc) >> 4 & 3)))

/* What was learned about an address. */
void dpm_token_live(dpm_station *station, uint8_t address, uint8_t live, int64_t now);
/* Whether the station is the only active one it knows. */
bool dpm_token_alone(const dpm_station *station);
/* A token of another station, or one with our address that is not ours. */
void dpm_token_heard(dpm_station *station, uint8_t sa, uint8_t da, const dpm_received *received);
/* FC of our answer to the FDL status that `asker` wants; `told` when it is out. */
uint8_t dpm_token_status(dpm_station *station, uint8_t asker);
void dpm_token_status_told(dpm_station *station, int64_t now);
/* Silence for Tto: claim the token. */
void dpm_token_claim(dpm_station *station, int64_t now);
/* Whether this token may carry a GAP poll. */
bool dpm_token_gap_is_due(const dpm_station *station, int64_t now);
/* In Pass_Token: put the GAP poll or the token into tx. */
void dpm_token_make(dpm_station *station, int64_t now);
/* Our token, or our GAP poll, is out. */
void dpm_token_sent(dpm_station *station, int64_t now);
void dpm_token_poll_sent(dpm_station *station);
/* Await_Status_Response, Check_Token_Pass: an answer, or the end of the slot. */
void dpm_token_poll_answered(dpm_station *station, uint8_t address, uint8_t fc);
void dpm_token_slot_over(dpm_station *station, int64_t now);
/* Our own token was heard back (`right`), spoilt, or not at all. */
void dpm_token_echoed(dpm_station *station, bool right, int64_t now);
/* Listen from the beginning, by role in Listen_Token or Passive_Idle: nothing is known about the ring. */
void dpm_token_listen(dpm_station *station, int64_t now);

/* --- station.c ---------------------------------------------------------------------------------------------------- */

/* The token is ours, or claimed. */
bool dpm_station_talks(const dpm_station *station);
/* Silence, ns, behind which a station without the token claims it. */
int64_t dpm_station_patience(const dpm_station *station);
void dpm_station_enter(dpm_station *station, uint8_t state, int64_t now);
/* The earliest moment at which a telegram can have ended. */
int64_t dpm_station_came(const dpm_station *station, const dpm_received *received);
/* A turn of the token begins: users may send. */
void dpm_station_begin_turn(dpm_station *station, int64_t now);
/* The token is not ours any more: the exchange under way ends without an answer. `lost`: the bus is, too. */
void dpm_station_drop_token(dpm_station *station, uint8_t state, int64_t now, bool lost);

#endif
