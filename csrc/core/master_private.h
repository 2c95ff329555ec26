/* SPDX-License-Identifier: MIT
 *
 * The DP master's memory, shared by master.c (the cycle) and slave_handler.c (one slave).
 */
#ifndef DPM_CORE_MASTER_PRIVATE_H
#define DPM_CORE_MASTER_PRIVATE_H

#include <stdatomic.h>

#include "core/station_private.h"
#include "dpmaster/master.h"

/* What was asked of a slave; the confirmation is judged by it. */
enum dpm_service { DPM_ASK_DIAG, DPM_ASK_PRM, DPM_ASK_CFG, DPM_ASK_DATA, DPM_ASK_UNLOCK };

typedef struct dpm_slave {
    dpm_slave_set set;
    dpm_outputs *outputs;
    dpm_image *inputs;
    uint16_t input_length, output_length;
    uint8_t state;          /* enum dpm_station_state */
    uint8_t asked;          /* enum dpm_service */
    uint8_t reason;         /* enum dpm_reason */
    int32_t detail;
    bool locked;            /* Set_Prm went out, and nothing since then says that it is not ours */
    bool silent;            /* it did not answer when it was last asked */
    bool diagnosis_pending; /* DH came, or static diagnosis stands */
    bool cleared;           /* by order: zeros, or nothing, though the master operates */
    bool owes;              /* an order waits for its next Data_Exchange ... */
    bool pays;              /* ... which is under way */
    bool greeted;           /* its first Data_Exchange was answered: Global_Control is to tell it the mode */
    bool operating;         /* Global_Control Operate went out since then: outputs may go to it */
    bool returning;         /* it was in Data_Exchange before: safe outputs at its return */
    uint32_t tries;         /* requests without an answer since it was heard last */
    uint32_t missed;        /* telegrams of Data_Exchange without an answer since then */
    uint32_t refusals;
    int64_t data_at;        /* the last Data_Exchange was answered */
    int64_t active_since;
    int64_t checked_at;     /* Chk_Cfg was taken: is it ready? */
    int64_t pause;          /* ns after the next refusal or loss; grows with each until data are exchanged */
    int64_t interval;       /* Min_Slave_Interval, ns */
    int64_t spaced_at;      /* Min_Slave_Interval since the last request is over */
    int64_t not_before;     /* the next request to it */
    uint64_t carried;       /* commit in the Data_Exchange under way */
    dpm_frame received;     /* the inputs published last */
    uint8_t diagnosis[DPM_IO_MAX];
    uint8_t diagnosis_length;
    uint64_t diagnosis_number;
    int64_t diagnosis_time;
    dpm_slave_statistics statistics;
} dpm_slave;

/* What the DP user's request under way is. */
enum dpm_errand { DPM_ERRAND_SLAVE, DPM_ERRAND_MODE, DPM_ERRAND_ORDER, DPM_ERRAND_REMINDER };

struct dpm_master {
    dpm_station station; /* first: the master's machine is the station's */
    void (*station_ask)(dpm_machine *, int64_t, dpm_offer *);
    void (*station_quiet)(dpm_machine *, int64_t);
    dpm_master_config config;
    uint8_t mode, target; /* enum dpm_mode; target while leaving */
    bool leaving;
    int64_t left_at;      /* the last that is left was told to go; NEVER: nobody waits for it */
    int64_t tokenless;    /* and since then there was no token to tell it with */
    bool latched;
    uint8_t latched_by;   /* what had fed the output watchdog when it ran out */
    bool port_works;
    atomic_uint fed_tick;
    atomic_int fed_by;
    atomic_bool armed;    /* outputs of a commit are alive */

    bool fresh_token;     /* a turn of the token that has not begun a cycle yet */
    bool in_cycle;
    bool tried;
    bool control_due;
    unsigned turn, try_turn, asked;
    uint64_t cycle;
    int64_t cycle_start, cycle_at, cycle_last, cycle_max; /* cycle_at: the next one's place; 0: where it begins */
    int64_t began, ended, began_late;                     /* the last whole cycle */
    dpm_lateness lateness;
    int64_t control_at, try_at;
    unsigned reminder;    /* the next slave to be told again that it is cleared; n_slaves: none */
    int64_t asked_at;     /* the last time the machine was asked: now, for who reads its status */
    int64_t transfer_at;  /* Auto_Clear: when a slave may have been without data transfer for too long */
    int16_t auto_cleared;

    uint8_t errand;       /* enum dpm_errand */
    dpm_slave *current;   /* whose request is under way; NULL: nobody's, or its answer counts no more */
    uint8_t pdu[DPM_IO_MAX];
    dpm_control *order;
    dpm_raw *raw;         /* queue: the first is next, or out */
    bool raw_out;         /* the station has one */
    bool raw_cancelled;   /* and nobody waits for it any more */
    dpm_slave *raw_first; /* its interval is kept free for the first of the queue */

    int64_t *record;
    size_t record_size, recorded;

    unsigned n_slaves;
    dpm_slave slaves[];
};

/* slave_handler.c */
bool dpm_slave_wants(const dpm_slave *slave);
void dpm_slave_request(dpm_master *master, dpm_slave *slave, int64_t now, dpm_request *request);
void dpm_slave_confirm(dpm_master *master, dpm_slave *slave, int64_t now, const dpm_confirm *confirm);
/* Gone, for a reason; back to OFFLINE. Slaves that were not there lose nothing. */
void dpm_slave_lose(dpm_master *master, dpm_slave *slave, int64_t now, uint8_t reason, int32_t detail);
/* It is left: unlocked if it is ours and may be told so, until `dpm_slave_forget`. */
void dpm_slave_leave(dpm_master *master, dpm_slave *slave, int64_t now);
void dpm_slave_forget(dpm_master *master, dpm_slave *slave, int64_t now);
/* (De)activated; deactivated it is left. */
void dpm_slave_activate(dpm_master *master, dpm_slave *slave, int64_t now, bool active);
/* New_Prm. */
void dpm_slave_new_prm(dpm_master *master, dpm_slave *slave, int64_t now);
/* Somebody else fetched its diagnosis with our address: the slave takes it for told. */
void dpm_slave_overhear(dpm_master *master, dpm_slave *slave, int64_t now, const dpm_confirm *confirm);
/* Its diagnosis, or its absence, is something to look at. */
bool dpm_slave_in_trouble(const dpm_slave *slave);

/* A request to it begins now. */
void dpm_slave_space(dpm_slave *slave, int64_t now);

/* master.c */
/* Outputs of a commit made at `time` are alive: from now on the output watchdog watches the program. False: they must not
 * be, for it has not stood by them for longer than that, and nothing of a commit was alive that could have shown it. */
bool dpm_master_arm(dpm_master *master, int64_t time);
/* The token is here, or may come. */
bool dpm_master_may_tell(const dpm_master *master);
bool dpm_master_exchanges(const dpm_master *master);
/* The answer to what is under way for this slave changes its state no more; outputs are not sent again. */
void dpm_master_drop(dpm_master *master, const dpm_slave *slave, int64_t now);

#endif
