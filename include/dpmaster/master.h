/* SPDX-License-Identifier: MIT
 *
 * The DP master class 1 (EN 50170 part 8): an FDL station with the slave handler on top. Everything here is called on
 * the machine's thread, except the images, which are made for two.
 */
#ifndef DPMASTER_MASTER_H
#define DPMASTER_MASTER_H

#include "dpmaster/history.h"
#include "dpmaster/image.h"
#include "dpmaster/station.h"

enum dpm_mode {
    DPM_MODE_OFFLINE = 0x00, /* nothing is sent */
    DPM_MODE_STOP = 0x40,    /* token only; raw requests work, no slave is started */
    DPM_MODE_CLEAR = 0x80,   /* slaves are started and exchange; outputs are zeros, or empty for a fail-safe slave */
    DPM_MODE_OPERATE = 0xC0
};

/* The slave handler's states (EN 50170 part 8). */
enum dpm_station_state {
    DPM_ST_OFFLINE = 0,  /* not heard of; tried at a low rate */
    DPM_ST_DIAG1,        /* answers; is it free? */
    DPM_ST_PRM,          /* Set_Prm is next */
    DPM_ST_CFG,          /* Chk_Cfg is next */
    DPM_ST_DIAG2,        /* did it accept both, is it ready? */
    DPM_ST_DATA,         /* Data_Exchange */
    DPM_ST_INACTIVE,     /* deactivated: never asked */
    DPM_ST_LEAVING       /* Set_Prm with Unlock is next */
};

/* Why a station is not in Data_Exchange, or left it. */
enum dpm_reason {
    DPM_WHY_NONE = 0,
    DPM_WHY_NO_ANSWER,       /* detail: enum dpm_station_state it was lost in */
    DPM_WHY_SERVICE,         /* RS, UE, RR: detail = fc */
    DPM_WHY_INVALID_ANSWER,  /* wrong SAPs, wrong length: detail = octets received */
    DPM_WHY_IDENT,           /* another ident number: detail = it */
    DPM_WHY_PRM_FAULT,
    DPM_WHY_CFG_FAULT,
    DPM_WHY_NOT_SUPPORTED,   /* Diag.Not_Supported: a feature that Set_Prm asked for */
    DPM_WHY_LOCKED,          /* another master has it: detail = its address */
    DPM_WHY_NOT_READY,
    DPM_WHY_STATIC_DIAG,
    DPM_WHY_PRM_REQ,         /* the slave wants to be parameterised anew: reset, or its watchdog ran out */
    DPM_WHY_BUS              /* the master left the bus: foreign token, vanished port */
};

/* What fed the output watchdog last. */
enum dpm_feed {
    DPM_FED_OPERATE = 0,
    DPM_FED_COMMIT,
    DPM_FED_WAIT,
    DPM_FED_PROGRAM          /* master.feed() */
};

/* One slave as the master is to treat it. */
typedef struct dpm_slave_set {
    uint8_t address;            /* 0..125 */
    uint16_t ident_number;
    uint8_t configuration[DPM_IO_MAX];
    uint8_t configuration_length;   /* 1..244 */
    uint8_t user_parameters[237];
    uint8_t user_parameters_length; /* 0..237 */
    uint8_t station_status;     /* Set_Prm octet 1 without Lock, Unlock and WD_On: Sync_Req 20h, Freeze_Req 10h */
    uint8_t wd_fact_1;          /* watchdog = fact_1 * fact_2 * 10 ms, 1..255 each; both 0: off */
    uint8_t wd_fact_2;
    uint8_t min_tsdr;           /* Tbit, 11..255; 0: leave the slave's own */
    uint8_t group;              /* Group_Ident: a bit for each of 8 groups */
    bool fail_safe;             /* in Clear it gets an empty Data_Exchange instead of zeros */
    bool hold;                  /* resume="hold": outputs survive a loss (bare stations only) */
    bool active;                /* false: listed but never asked */
    uint16_t min_slave_interval; /* 100 us, 0..65535 */
    dpm_history *history;       /* the caller's, where diagnoses are kept; NULL: nowhere */
    bool any_ident;             /* Set_Prm is sent though Slave_Diag tells another ident number: the slave may refuse it */
    int64_t diagnosis_poll;     /* ns between two Slave_Diag in Data_Exchange, for a slave that cannot announce; 0: when told */
    int64_t ready_timeout;      /* ns after which a slave that is still not ready gets Set_Prm and Chk_Cfg anew; 0: never */
} dpm_slave_set;

typedef struct dpm_slave_statistics {
    uint64_t exchanges;         /* Data_Exchange answered */
    uint64_t diagnoses;         /* Slave_Diag answered */
    uint64_t repetitions;
    uint64_t unanswered;        /* requests given up after all tries */
    uint64_t refused;           /* RS, UE, RR */
    uint64_t invalid;           /* answers that fit no request */
    uint64_t starts;            /* times it came into Data_Exchange */
    uint64_t losses;            /* times it left Data_Exchange unasked */
    int64_t tsdr_min;           /* ns, -1: none measured */
    int64_t tsdr_max;
} dpm_slave_statistics;

typedef struct dpm_slave_status {
    uint8_t state;              /* enum dpm_station_state */
    uint8_t reason;             /* enum dpm_reason, of the last trouble */
    int32_t detail;
    uint32_t refusals;          /* since it last exchanged data or was silent */
    uint8_t diagnosis[DPM_IO_MAX]; /* as received, with the master's own bits added (Station_Non_Existent,
                                      Invalid_Slave_Response, Master_Lock, Deactivated) */
    uint8_t diagnosis_length;   /* 0: none yet */
    uint64_t diagnosis_number;  /* counts up with each one fetched */
    int64_t diagnosis_time;
    dpm_slave_statistics statistics;
} dpm_slave_status;

#define DPM_LATENESS_CLASSES 20

/* How late cycles of a fixed cycle time began, against a raster that never moves; all 0 when it runs free. */
typedef struct dpm_lateness {
    int64_t last;               /* ns */
    int64_t max;                /* ns */
    uint64_t over;              /* cycles that began later than the port's allowance */
    uint64_t skipped;           /* cycles that had no time at all: the one before took theirs */
    uint64_t counts[DPM_LATENESS_CLASSES]; /* cycles by lateness: class n is under 2^(n+1) us, the last one anything above */
} dpm_lateness;

typedef struct dpm_master_status {
    uint8_t mode;               /* enum dpm_mode */
    uint8_t fdl_state;          /* enum dpm_fdl_state */
    bool latched;               /* the output watchdog ran out */
    uint8_t fed_by;             /* enum dpm_feed; latched: the last before it ran out */
    int16_t auto_cleared;       /* the station for whose sake Operate was left (Auto_Clear), -1 none */
    int16_t foreign;            /* address of the foreign master heard last, -1 none */
    uint8_t data_transfer[16];  /* Data_Transfer_List: bit n % 8 of octet n / 8 is address n; was in data transfer within
                                   Data_Control_Time */
    uint8_t system_diagnostic[16]; /* System_Diagnostic: active and not in Data_Exchange, or with a diagnosis to look at */
    uint64_t cycle;
    int64_t cycle_last;         /* ns, duration of the last whole cycle */
    int64_t cycle_max;
    int64_t cycle_began;        /* of the last whole cycle: its start, its end, how late it began */
    int64_t cycle_ended;
    int64_t cycle_late;
    dpm_lateness lateness;
    dpm_fdl_statistics fdl;
} dpm_master_status;

typedef struct dpm_master_config {
    dpm_station_config station;
    uint16_t slaves;             /* room for so many, 1..126 */
    int64_t cycle_time;          /* ns from one cycle's start to the next one's, up to an hour; 0: free running */
    int64_t output_watchdog;     /* ns; 0: off */
    int64_t data_control_time;   /* ns; Global_Control is repeated three times in it */
    bool auto_clear;             /* Error_Action_Flag: Operate is left when an active slave was not in data transfer for so long */
    int8_t data_retries;         /* Max-Retry-Limit(DX): repetitions of a Data_Exchange in its cycle, 0..15; -1: max_retry_limit.
                                    The slave is lost after max_retry_limit repetitions all the same, those of later cycles
                                    among them */
} dpm_master_config;

/* A Global_Control ordered by a program. It goes out before the first Data_Exchange of a cycle, once each slave concerned
 * was given what was committed before the order. The memory is the caller's, until `done` or cancelled. */
typedef struct dpm_control {
    uint8_t da;                  /* one slave, not the master itself, or DPM_BROADCAST */
    uint8_t command;             /* Unfreeze 04h, Freeze 08h, Unsync 10h, Sync 20h; Clear_Data is added */
    uint8_t group;               /* Group_Select; 0: all */
    int8_t clear;                /* 1: outputs of those concerned are safe at once and stay so; 0: no longer, but for Clear;
                                    -1: as it is */
    bool done;
} dpm_control;

/* A raw request, made by a program step by step. The memory is the caller's, until `done` or cancelled. */
typedef struct dpm_raw dpm_raw;
struct dpm_raw {
    uint8_t da;
    uint8_t function;
    int16_t dsap;
    int16_t ssap;
    uint8_t length;
    uint8_t data[DPM_DATA_MAX];
    bool done;
    uint8_t status;              /* enum dpm_confirm_status */
    uint8_t fc;
    bool short_ack;
    uint8_t tries;
    uint8_t answer_length;
    uint8_t answer[DPM_DATA_MAX];
    int64_t tsdr;                /* ns, -1 unknown */
    dpm_raw *next;               /* the master's, while it is queued */
};

typedef struct dpm_master dpm_master;

DPM_API size_t dpm_master_size(uint16_t slaves);
/* DPM_E_BLOCK, DPM_E_ARGUMENT, DPM_E_PARAMETER, DPM_E_ADDRESS, DPM_E_SLOT. */
DPM_API int dpm_master_init(void *block, size_t size, const dpm_master_config *config, dpm_master **master);
DPM_API dpm_machine *dpm_master_machine(dpm_master *master);
DPM_API dpm_station *dpm_master_station(dpm_master *master);

/* Add a slave; its images are the caller's. Returns its index (0, 1, ...) or DPM_E_ADDRESS, DPM_E_DUPLICATE, DPM_E_FULL,
 * DPM_E_CONFIGURATION, DPM_E_LENGTH, DPM_E_ARGUMENT. What is done with an index that is nobody's is DPM_E_ARGUMENT. */
DPM_API int dpm_master_add(dpm_master *master, const dpm_slave_set *set, dpm_outputs *outputs, dpm_image *inputs);
/* Replace a slave's set (same address, same lengths, `active` as it is); what Set_Prm carries takes effect at the next
 * Set_Prm. Errors as dpm_master_add; DPM_E_LENGTH also when inputs or outputs would be of another length. */
DPM_API int dpm_master_change(dpm_master *master, int index, const dpm_slave_set *set);
/* New_Prm: Set_Prm and what follows, from wherever the slave is; it comes back with safe outputs. */
DPM_API int dpm_master_new_prm(dpm_master *master, int index, int64_t now);
/* Deactivate: outputs safe, unlocked, then INACTIVE, for which the machine takes its time. Activate: it is started again. */
DPM_API int dpm_master_activate(dpm_master *master, int index, bool active, int64_t now);
/* Forget a slave that is INACTIVE, else DPM_E_BUSY; its index and its place are free, its images the caller's again. */
DPM_API int dpm_master_remove(dpm_master *master, int index);
/* Change the mode, by steps between neighbours. Leaving Operate makes all outputs safe; STOP and OFFLINE unlock the slaves
 * first (leaving), for which the machine takes its time, half a second of it at most for a token that was lost and for slaves
 * that do not answer: watch status.mode. Going to OPERATE ends a latch. DPM_E_ARGUMENT; DPM_E_MODE with auto_clear while an
 * active slave is not in data transfer. */
DPM_API int dpm_master_set_mode(dpm_master *master, int mode, int64_t now);
/* Queue a request: each has its turn behind those that were there before, one for each cycle or turn of the token. It is done
 * at once, with DPM_CONF_DS, when the station leaves the bus or the port is gone. Slave_Diag of a slave in Data_Exchange serves
 * the handler as well as the caller. DPM_E_MODE in Offline, DPM_E_BUSY: it is queued already. */
DPM_API int dpm_master_request(dpm_master *master, dpm_raw *raw);
DPM_API void dpm_master_cancel(dpm_master *master, dpm_raw *raw);
/* DPM_E_BUSY: one is ordered already. DPM_E_MODE: no slave is exchanged with, or clear = 0 in Clear. DPM_E_ARGUMENT. */
DPM_API int dpm_master_order(dpm_master *master, dpm_control *control, int64_t now);
DPM_API void dpm_master_revoke(dpm_master *master, dpm_control *control);
DPM_API void dpm_master_get_status(const dpm_master *master, dpm_master_status *status);
DPM_API int dpm_master_get_slave(const dpm_master *master, int index, dpm_slave_status *status);
/* The port vanished or came back: everything is lost, or starts anew. */
DPM_API void dpm_master_port(dpm_master *master, bool working, int64_t now);

/* From any thread: the program lives. `by` is an enum dpm_feed. Ignored once the output watchdog's time has passed. */
DPM_API void dpm_master_feed(dpm_master *master, int64_t now, int by);

/* Bench and `perf`: record, for each Data_Exchange answered at the first try, the ns from its request's start to the
 * end of its answer, into `durations` until `n` are there. NULL stops it. */
DPM_API void dpm_master_record(dpm_master *master, int64_t *durations, size_t n);
DPM_API size_t dpm_master_recorded(const dpm_master *master);

#endif
