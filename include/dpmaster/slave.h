/* SPDX-License-Identifier: MIT
 *
 * DP slaves, the part of a DP ASIC: FDL responder with FCB and stored answer, the DP states, watchdog, diagnosis
 * flag, checks of ident and configuration, lock to one master, buffers that the application exchanges without tearing. One machine
 * carries any number of slaves on one wire. Protocol page F to I.
 *
 * One answer waits at a time, to the latest request on the wire: a good telegram that arrives first revokes it, noise
 * does not. Ident and LSAP status requests are answered RS. Outputs are applied from the first Data_Exchange on, as an
 * ASIC does, unless the master said Clear; a card that wants an Operate first looks at `operate_seen`.
 *
 * An outputs frame is published, and the machine's progress grows, only when octets, length or validity of the outputs
 * changed, never for each exchange: exchanges and exchange_time in the report tell that the bus is alive. Progress
 * grows also with state, master, configuration, clear, operate_seen and connection.
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

#define DPM_SLAVE_CONFIGURATIONS 16

typedef struct dpm_slave_config {
    uint8_t address;              /* 0..126 */
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
} dpm_slave_config;

typedef struct dpm_slave_state_report {
    uint8_t address;
    uint8_t state;                /* enum dpm_slave_state */
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
} dpm_slave_state_report;

typedef struct dpm_slaves dpm_slaves;

DPM_API size_t dpm_slaves_size(uint16_t slaves);
/* A machine for up to `slaves` slaves (1..126) on one wire. DPM_E_BLOCK, DPM_E_ARGUMENT, DPM_E_PARAMETER. */
DPM_API int dpm_slaves_init(void *block, size_t size, const dpm_parameters *parameters, const dpm_port_traits *traits,
                            uint16_t slaves, dpm_slaves **out);
DPM_API dpm_machine *dpm_slaves_machine(dpm_slaves *slaves);
/* The images are the caller's: `outputs` frames are written here (valid = false while the master is in Clear or the
 * exchange is lost), `inputs` frames are read (their first octets, padded with zeros to the configured length).
 * Returns the slave's index, or DPM_E_ADDRESS, DPM_E_DUPLICATE, DPM_E_FULL, DPM_E_CONFIGURATION, DPM_E_ARGUMENT. */
DPM_API int dpm_slaves_add(dpm_slaves *slaves, const dpm_slave_config *config, dpm_image *outputs, dpm_image *inputs);
DPM_API int dpm_slaves_get(const dpm_slaves *slaves, int index, dpm_slave_state_report *report);
/* Unplug (nothing is answered, state kept as a powered card keeps it: the watchdog runs), plug in, or power-cycle. */
DPM_API int dpm_slaves_connect(dpm_slaves *slaves, int index, bool connected);
DPM_API int dpm_slaves_reset(dpm_slaves *slaves, int index, int64_t now);
/* The application's diagnosis behind the six standard octets; what exceeds max_diagnosis is cut off and reported as
 * Ext_Diag_Overflow. `announce` raises the diagnosis flag (DH) until the own master has fetched it; ext_diag and
 * static_diag set the status bits. */
DPM_API int dpm_slaves_diagnosis(dpm_slaves *slaves, int index, const uint8_t *octets, uint8_t n, bool announce,
                                 bool ext_diag, bool static_diag);
/* The application is ready to deliver data (true after init): while false, Station_Not_Ready stays set. */
DPM_API int dpm_slaves_ready(dpm_slaves *slaves, int index, bool ready);
DPM_API const uint32_t *dpm_slaves_rejected(const dpm_slaves *slaves); /* DPM_REJECT_COUNT counters */

#endif
