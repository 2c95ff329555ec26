/* SPDX-License-Identifier: MIT
 *
 * DP slaves, the part of a DP ASIC: FDL responder with FCB and stored answer, the DP states, watchdog, search of the
 * rate, diagnosis flag, checks of ident and configuration, lock to one master, buffers that the application exchanges
 * without tearing. One machine carries any number of slaves on one wire. Protocol page F to I.
 *
 * One answer waits at a time, to the latest request on the wire: a good telegram that arrives first revokes it, noise
 * does not. LSAP status requests are answered RS. Outputs are applied from the first Data_Exchange on, as an ASIC does,
 * unless the master said Clear; a card that wants an Operate first looks at `operate_seen`.
 *
 * An outputs frame is published, and the machine's progress grows, only when octets, length or validity of the outputs
 * changed, never for each exchange: exchanges and exchange_time in the report tell that the bus is alive. Progress
 * grows also with state, master, configuration, parameters, clear, operate_seen, address, rate and connection.
 *
 * A slave at address 126 waits for Set_Slave_Add and is never parameterised. Its new address, and whether that may be
 * changed once more, outlive power cycles as in an EEPROM.
 *
 * A slave that searches its rate listens at the fastest first and goes down the table, at each rate for 10 ms and 5000
 * bit times, round and round. At another rate than the wire's it hears nothing; at the wire's any good telegram, whoever
 * it is for, tells it that this is the rate, and it answers from the next one on.
 */
#ifndef DPMASTER_SLAVE_H
#define DPMASTER_SLAVE_H

#include "dpmaster/image.h"
#include "dpmaster/machine.h"
#include "dpmaster/parameters.h"
#include "dpmaster/receiver.h"

enum dpm_slave_state {
    DPM_SL_OFF = 0,       /* unplugged: answers nothing */
    DPM_SL_WAIT_PRM,
    DPM_SL_WAIT_CFG,
    DPM_SL_DATA_EXCH
};

/* The states of an ASIC's watchdog; the numbers are those of its status register (page I.6). */
enum dpm_baud_state {
    DPM_BAUD_SEARCH = 0,  /* deaf at all rates but the one it tries */
    DPM_BAUD_CONTROL,     /* the rate is found */
    DPM_DP_CONTROL        /* and Set_Prm has switched the watchdog on */
};

/* How new diagnosis is announced where there are no inputs: SC cannot carry the flag (page I.2). */
enum dpm_announce {
    DPM_ANNOUNCE_SD1 = 0, /* SD1 with DH in place of SC */
    DPM_ANNOUNCE_OCTET,   /* one octet of data, 00, with DH in place of SC */
    DPM_ANNOUNCE_NEVER    /* SC all the same: a master finds it when it looks, as with Stat_Diag at start-up */
};

#define DPM_SLAVE_CONFIGURATIONS 16
#define DPM_SLAVE_IDENTITY 64
#define DPM_SLAVE_REMOTE 240

typedef struct dpm_slave_config {
    uint8_t address;              /* 0..126; 126: waits for Set_Slave_Add */
    uint16_t ident_number;
    uint8_t configurations;       /* 1..16 configurations it accepts; the first is its real one (Get_Cfg) until one is chosen */
    uint8_t configuration_length[DPM_SLAVE_CONFIGURATIONS];
    uint8_t configuration[DPM_SLAVE_CONFIGURATIONS][DPM_IO_MAX];
    uint8_t user_parameters_min;  /* octets of User_Prm_Data accepted */
    uint8_t user_parameters_max;
    bool fail_safe;               /* an empty Data_Exchange is Clear, not an error */
    bool sync_supported;
    bool freeze_supported;
    uint8_t max_diagnosis;        /* 6..244 */
    uint16_t min_tsdr;            /* Tbit before Set_Prm says otherwise, 11..255 */
    uint16_t min_slave_interval;  /* 100 us between two requests of a master; sooner ones are answered and counted */
    bool set_address;             /* Set_Slave_Add is there; else RS */
    bool address_locked;          /* No_Add_Chg was said before: Set_Slave_Add changes nothing */
    bool auto_baud;               /* searches its rate after power-on and when it was lost */
    uint8_t baud_control;         /* WD_Baud_Control_Val, 10 ms: so long without a request to it, and the rate is lost; 0: never */
    uint8_t identity_length;      /* what Ident is answered: four lengths, then vendor, controller, hardware, software */
    uint8_t identity[DPM_SLAVE_IDENTITY];
    /* What the protocol page marks as disputed; zero is this library's choice. */
    bool wrong_length_ue;         /* outputs of a wrong length are answered UE, not RS; either way it leaves Data_Exchange */
    bool prm_keeps_exchange;      /* Set_Prm in DATA_EXCH that changes neither user parameters nor sync nor freeze: it
                                   * stays there, not WAIT_CFG */
    bool foreign_sc;              /* locked, another's Set_Prm, Chk_Cfg, Data_Exchange: SC and ignored, not RS */
    uint8_t announce;             /* enum dpm_announce */
    bool control_feeds;           /* Global_Control of the own master retriggers the watchdog */
    bool cfg_fault_keeps_master;  /* after a wrong Chk_Cfg Diag.Master_Add stays the master's, not FF; it is free either way */
    bool prm_open_takes_user;     /* Set_Prm without Lock and Unlock: user parameters are taken too, not min Tsdr only */
} dpm_slave_config;

typedef struct dpm_slave_state_report {
    uint8_t address;
    bool address_locked;
    uint8_t state;                /* enum dpm_slave_state */
    uint8_t baud_state;           /* enum dpm_baud_state */
    int16_t master;               /* address of the master that has it, -1 none */
    int8_t configuration;         /* index of the accepted configuration, -1 none */
    bool clear;                   /* the master is in Clear */
    bool watchdog_on;
    bool operate_seen;            /* a Global_Control Operate came since Data_Exchange began */
    uint32_t watchdog_expired;    /* times, since init */
    int64_t watchdog;             /* ns */
    uint8_t user_parameters_length;
    uint8_t user_parameters[237]; /* of the last good Set_Prm */
    uint8_t group;
    uint64_t requests;            /* telegrams for this slave that were good */
    uint64_t answers;
    uint64_t repetitions;         /* answered from the stored answer */
    uint64_t late_dropped;        /* answers dropped past max Tsdr + allowance */
    uint64_t exchanges;
    int64_t exchange_time;        /* ns, the last Data_Exchange */
    uint64_t too_soon;            /* requests that broke min_slave_interval */
    uint8_t remote_length;
    uint8_t remote[DPM_SLAVE_REMOTE]; /* Rem_Slave_Data of the last Set_Slave_Add: the application's to keep */
} dpm_slave_state_report;

typedef struct dpm_slaves dpm_slaves;

DPM_API size_t dpm_slaves_size(uint16_t slaves);
/* A machine for up to `slaves` slaves (1..126) on one wire. DPM_E_BLOCK, DPM_E_ARGUMENT, DPM_E_PARAMETER. */
DPM_API int dpm_slaves_init(void *block, size_t size, const dpm_parameters *parameters, const dpm_port_traits *traits,
                            uint16_t slaves, dpm_slaves **out);
DPM_API dpm_machine *dpm_slaves_machine(dpm_slaves *slaves);
/* The images are the caller's: `outputs` frames are written here (valid = false while the master is in Clear or the
 * exchange is lost), `inputs` frames are read (their first octets, padded with zeros to the configured length).
 * Returns the slave's index, or DPM_E_ADDRESS, DPM_E_DUPLICATE, DPM_E_FULL, DPM_E_CONFIGURATION, DPM_E_ARGUMENT. What is
 * done with an index that is nobody's is DPM_E_ARGUMENT. */
DPM_API int dpm_slaves_add(dpm_slaves *slaves, const dpm_slave_config *config, dpm_image *outputs, dpm_image *inputs);
DPM_API int dpm_slaves_get(const dpm_slaves *slaves, int index, dpm_slave_state_report *report);
/* Unplug (nothing is answered, state kept as a powered card keeps it: the watchdog runs), plug in, or power-cycle. */
DPM_API int dpm_slaves_connect(dpm_slaves *slaves, int index, bool connected);
DPM_API int dpm_slaves_reset(dpm_slaves *slaves, int index, int64_t now);
/* Another address by the application: a switch, or back to 126. As after power on. DPM_E_ADDRESS, DPM_E_DUPLICATE. */
DPM_API int dpm_slaves_set_address(dpm_slaves *slaves, int index, uint8_t address, bool locked, int64_t now);
/* The application's diagnosis behind the six standard octets; what exceeds max_diagnosis is cut off and reported as
 * Ext_Diag_Overflow. `announce` raises the diagnosis flag (DH) until the own master has fetched it; ext_diag and
 * static_diag set the status bits. */
DPM_API int dpm_slaves_diagnosis(dpm_slaves *slaves, int index, const uint8_t *octets, uint8_t n, bool announce,
                                 bool ext_diag, bool static_diag);
/* The application is ready to deliver data (true after init): while false, Station_Not_Ready stays set. */
DPM_API int dpm_slaves_ready(dpm_slaves *slaves, int index, bool ready);
DPM_API const uint32_t *dpm_slaves_rejected(const dpm_slaves *slaves); /* DPM_REJECT_COUNT counters */

#endif
