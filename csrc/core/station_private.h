/* SPDX-License-Identifier: MIT
 *
 * The FDL station's memory, for station.c and for the DP master that contains one.
 */
#ifndef DPM_CORE_STATION_PRIVATE_H
#define DPM_CORE_STATION_PRIVATE_H

#include "dpmaster/station.h"
#include "dpmaster/telegram.h"

#define DPM_STATION_USERS 4
#define DPM_STATION_RINGS 8

/* The telegram that waits for its time. */
enum dpm_tx_kind { DPM_TX_NONE = 0, DPM_TX_TOKEN, DPM_TX_REQUEST, DPM_TX_REPLY };

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

    uint8_t state;         /* enum dpm_fdl_state */
    uint8_t claims;        /* tokens still to send in Claim_Token */
    bool worked;           /* something was sent since the token came */
    int64_t token_at;      /* the token came */
    int64_t users_wake;    /* no user has work before this; 0: not known, ask them */
    int64_t last_activity; /* latest end of anything on the bus, ours too; -1: nothing known yet */
    int64_t not_before;    /* Tid1 or Tid2 after it: the earliest next transmission of ours */

    uint8_t tx[DPM_TELEGRAM_MAX];
    uint16_t tx_n;
    uint8_t tx_kind;       /* enum dpm_tx_kind */
    int64_t tx_not_before, tx_not_after;
    int64_t tx_start, tx_end_earliest, tx_end_latest;

    /* the one exchange under way: Await_Data_Response, or its request still in tx */
    dpm_fdl_user *user;    /* whose it is; NULL: none */
    uint8_t da, function, tries, retries;
    int16_t dsap, ssap;
    int64_t deadline;      /* slot time over, allowance included */
    int16_t suspect;       /* sender of what looked like a token in the slot, -1 none */
    int64_t heard;         /* latest octet since the request went out, -1 none */

    int16_t foreign;       /* the foreign master heard last, -1 none */

    uint8_t fcb[128];      /* enum dpm_fcb, by address */
};

/* Put one event into every ring. */
void dpm_station_event(dpm_station *station, const dpm_event *event);

#endif
