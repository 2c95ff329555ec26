/* SPDX-License-Identifier: MIT
 *
 * One DP slave behind its FDL responder: what slave.c (wire, frame count bit, times) and slave_services.c (services,
 * states, images) share. Private to the core. The services know no wire, no other slave and no clock: they see good
 * requests with the times these were on the wire.
 */
#ifndef DPM_CORE_SLAVE_SERVICES_H
#define DPM_CORE_SLAVE_SERVICES_H

#include "dpmaster/slave.h"

typedef struct dpm_responder {
    /* What dpm_slaves_get tells. Its state is the card's own: unplugged, it is kept and only told as OFF. */
    dpm_slave_state_report report;
    bool connected;
    bool changed;              /* something an onlooker may wait for; slave.c turns it into progress */

    /* The responder's: who the last numbered request came from, its FCB, and its answer for a repetition. */
    int16_t fcb_master;        /* -1: no request since power-on */
    bool fcb;
    uint8_t answer_length;
    uint8_t answer[DPM_TELEGRAM_MAX];

    uint16_t min_tsdr;         /* Tbit */
    uint16_t max_tsdr;
    int64_t request_start;     /* the last new request began not before this */
    int64_t watchdog_deadline; /* DPM_NEVER: not running */
    int64_t baud_deadline;     /* until then the rate is known; DPM_NEVER: nothing takes it away */
    int64_t search_start;
    bool searching;

    const uint8_t *station;    /* of the machine, by address: 0 where no slave is */
    uint8_t mapped;            /* the address under which this slave is there */

    uint8_t inputs_length;     /* of the accepted configuration */
    uint8_t outputs_length;
    dpm_image *inputs;
    dpm_image *outputs;
    dpm_frame terminals;       /* the outputs as last published */

    bool cleared;              /* by Global_Control, until Operate */
    bool sync_enabled;         /* asked for by Set_Prm */
    bool freeze_enabled;
    bool sync;
    bool freeze;
    bool buffer_valid;         /* in Sync: `buffer` holds outputs that wait for the next Sync or Unsync */
    uint8_t buffer[DPM_IO_MAX];
    uint8_t frozen[DPM_IO_MAX];

    bool ready;
    bool prm_fault;
    bool cfg_fault;
    bool not_supported;
    bool ext_diag;
    bool static_diag;
    bool diagnosis_overflow;
    bool announced;            /* DH until the own master has fetched the diagnosis */
    uint8_t diagnosis_length;
    uint8_t diagnosis[DPM_IO_MAX];

    uint8_t scratch[DPM_IO_MAX]; /* an answer's data where they are not ready made elsewhere */

    uint8_t configuration_inputs[DPM_SLAVE_CONFIGURATIONS];
    uint8_t configuration_outputs[DPM_SLAVE_CONFIGURATIONS];
    dpm_slave_config config;
} dpm_responder;

/* A service's answer before it is a telegram. */
typedef struct dpm_reply {
    bool short_ack;      /* SC; the rest does not count */
    uint8_t fc;          /* enum dpm_response */
    uint8_t length;
    const uint8_t *data; /* valid until the next call on the slave */
} dpm_reply;

/* Power on: WAIT_PRM, nothing known, outputs safe. Counters, images, configuration and address stay. */
void dpm_responder_power_on(dpm_responder *slave, int64_t time);
/* Execute a new SRD or SDA request. */
dpm_reply dpm_responder_serve(dpm_responder *slave, const dpm_received *request);
/* Execute a Global_Control. */
void dpm_responder_control(dpm_responder *slave, const dpm_received *request);
/* The watchdog ran out at its deadline. */
void dpm_responder_expire(dpm_responder *slave);

#endif
