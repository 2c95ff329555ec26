/* SPDX-License-Identifier: MIT
 *
 * The active FDL station (EN 50170 part 4; IEC 61158-4-3 clause 8): one exchange at a time with retries and the frame
 * count bit, FDL status, and its place on the bus. It serves users (the DP master, raw requests) that it asks for work
 * when it holds the token.
 *
 * In the ring it builds its list of active stations (LAS), takes the token from its predecessor (PS), uses it for the
 * token hold time, looks after its GAP and passes the token to its successor (NS). As a sole master it has the token
 * for itself and goes silent when it hears a foreign one. A passive station never sends a bit.
 */
#ifndef DPMASTER_STATION_H
#define DPMASTER_STATION_H

#include "dpmaster/event.h"
#include "dpmaster/machine.h"
#include "dpmaster/parameters.h"
#include "dpmaster/receiver.h"

/* The standard's states under the standard's names. Check_Access_Time is a decision, no state to rest in. */
enum dpm_fdl_state {
    DPM_FDL_OFFLINE = 0,
    DPM_FDL_PASSIVE_IDLE,
    DPM_FDL_LISTEN_TOKEN,
    DPM_FDL_ACTIVE_IDLE,
    DPM_FDL_CLAIM_TOKEN,
    DPM_FDL_USE_TOKEN,
    DPM_FDL_AWAIT_DATA_RESPONSE,
    DPM_FDL_PASS_TOKEN,
    DPM_FDL_CHECK_TOKEN_PASS,
    DPM_FDL_AWAIT_STATUS_RESPONSE
};

/* How a station takes part. A host that wakes late, or is handed whole telegrams, may only enter a ring whose slot time has
 * room for it: max Tsdr + 15 Tbit + allowance + delivery <= Tsl. */
enum dpm_role {
    DPM_ROLE_SOLE = 0,  /* alone on the bus, else silent; waits Tsl + allowance for answers */
    DPM_ROLE_RING,      /* DPM_E_SLOT at set-up where the slot time has no room */
    DPM_ROLE_PASSIVE    /* listens only */
};

/* What is known of an address by its last answer, to whomever, or by its token. */
enum dpm_live {
    DPM_LIVE_UNKNOWN = 0,     /* not asked yet, or gone out of the ring */
    DPM_LIVE_NONE,
    DPM_LIVE_SLAVE,
    DPM_LIVE_MASTER_NOT_READY,
    DPM_LIVE_MASTER_READY,
    DPM_LIVE_MASTER_IN_RING
};

/* The station's view of the ring. */
typedef struct dpm_ring_view {
    uint8_t las[16];          /* list of active stations: bit n % 8 of octet n / 8 is address n */
    uint8_t ts;               /* this station */
    uint8_t ns;               /* the next one; ts: alone */
    uint8_t ps;               /* the previous one */
    bool duplicate;           /* another station has our address: the bus was left */
    uint8_t live[128];        /* enum dpm_live, by address: what our requests and all that is heard tell */
    uint64_t rotations;       /* times the token came; passive: rotations seen */
    int64_t trr;              /* ns, the last real rotation time, 0 none yet; alone: between two tokens to oneself */
    int64_t trr_min;
    int64_t trr_max;
} dpm_ring_view;

/* What became of a request, besides the FC of the answer. */
enum dpm_confirm_status {
    DPM_CONF_ANSWER = 0,  /* answered: look at fc, data */
    DPM_CONF_SENT,        /* SDN: it went out */
    DPM_CONF_NA,          /* no answer, or none that was whole, after all tries */
    DPM_CONF_INVALID,     /* the station answered with something that is no answer to this request */
    DPM_CONF_DS           /* the station lost the token or left the bus before it was done, it was withdrawn, or an SDN
                           * did not leave whole */
};

typedef struct dpm_request {
    uint8_t da;           /* 0..126, 127 for SDN */
    uint8_t function;     /* enum dpm_function: an SRD, SDA, SDN, FDL_STATUS, IDENT or LSAP_STATUS */
    int16_t dsap;         /* both or neither */
    int16_t ssap;
    uint8_t retries;      /* repetitions, 0..15; a first contact (FCV = 0), SDN and FDL status are never repeated */
    uint8_t length;
    const uint8_t *data;  /* copied when the telegram is made */
} dpm_request;

typedef struct dpm_confirm {
    uint8_t status;       /* enum dpm_confirm_status */
    uint8_t fc;           /* of the answer; 0 for SC */
    bool short_ack;       /* the answer was SC */
    uint8_t tries;        /* telegrams sent, 1.. */
    uint8_t length;
    const uint8_t *data;  /* valid during the call */
    int64_t tsdr;         /* ns from the request's end to the answer's first bit, as well as the port can tell; -1 */
    int64_t start;        /* ns, when the last try began to leave */
    int64_t time;         /* ns, end of the answer or of the last wait */
} dpm_confirm;

/* A user of the station. next() fills `request` and returns 1, or returns 0: nothing (more) in this turn of the token,
 * and lowers *wake to when there may be. confirm() is called exactly once for each request taken. token() tells that a
 * new turn begins (held), or that a foreign master has the bus (not held); it may be NULL. */
typedef struct dpm_fdl_user {
    void *context;
    int (*next)(void *context, int64_t now, dpm_request *request, int64_t *wake);
    void (*confirm)(void *context, int64_t now, const dpm_confirm *confirm);
    void (*token)(void *context, int64_t now, bool held);
} dpm_fdl_user;

typedef struct dpm_fdl_statistics {
    uint64_t requests;         /* SRD, SDA and status requests, without repetitions */
    uint64_t answers;
    uint64_t repetitions;
    uint64_t unanswered;       /* requests given up after all tries */
    uint64_t abandoned;        /* requests under way when the token or the bus was lost, or they were withdrawn */
    uint64_t sdn;
    uint64_t tokens;           /* tokens sent */
    uint64_t late_dropped;     /* telegrams dropped past their latest time */
    uint64_t stray;            /* good telegrams that belonged to nobody: late, doubled, foreign answers */
    uint64_t foreign;          /* tokens and requests of foreign masters */
    uint64_t send_failed;
    uint64_t tokens_lost;      /* times the token was given up after our own silence */
    uint64_t token_repetitions; /* tokens sent again because the successor was silent */
    uint64_t tokens_spoilt;    /* own tokens that were not heard back as they were sent, where the port echoes */
    uint64_t gap_polls;
    uint32_t rejected[DPM_REJECT_COUNT]; /* octets thrown away by the receiver; [0] counts good telegrams */
} dpm_fdl_statistics;

typedef struct dpm_station dpm_station;

typedef struct dpm_station_config {
    dpm_parameters parameters;
    uint8_t address;           /* TS, 0..125 */
    uint8_t role;              /* enum dpm_role */
    dpm_port_traits traits;
} dpm_station_config;

DPM_API size_t dpm_station_size(void);
/* DPM_E_BLOCK, DPM_E_ARGUMENT, DPM_E_PARAMETER, DPM_E_ADDRESS, DPM_E_SLOT. The block is the caller's and must outlive the station. */
DPM_API int dpm_station_init(void *block, size_t size, const dpm_station_config *config, dpm_station **station);
DPM_API dpm_machine *dpm_station_machine(dpm_station *station);
/* Up to 4 users, asked in the order they were added: the first has priority. DPM_E_FULL. */
DPM_API int dpm_station_add_user(dpm_station *station, const dpm_fdl_user *user);
/* Events go to every ring added, up to 8 (DPM_E_FULL), until it is removed (DPM_E_ARGUMENT: it is not there). */
DPM_API int dpm_station_add_ring(dpm_station *station, dpm_ring *ring);
DPM_API int dpm_station_remove_ring(dpm_station *station, dpm_ring *ring);
/* Leave Offline for Listen_Token, or go Offline at once: nothing more is sent. */
DPM_API void dpm_station_online(dpm_station *station, bool online, int64_t now);
DPM_API int dpm_station_state(const dpm_station *station);
DPM_API void dpm_station_get_ring(const dpm_station *station, dpm_ring_view *view);
/* Slot time in Tbit that a ring needs for a host that is so late (ns; allowance and delivery): max Tsdr + 15 + late, rounded
 * up. */
DPM_API uint32_t dpm_ring_tsl(const dpm_parameters *parameters, int64_t late);
DPM_API void dpm_station_statistics(const dpm_station *station, dpm_fdl_statistics *statistics);
/* Forget a station's frame count bit: the next request to it is a first contact (FCB = 1, FCV = 0). */
DPM_API void dpm_station_restart(dpm_station *station, uint8_t address);

#endif
