/* SPDX-License-Identifier: MIT
 *
 * The services and states of one DP slave, as a DP ASIC has them (protocol page F to I). It touches the slave and its
 * two images, nothing else.
 *
 * What is disputed is a setting of dpm_slave_config. Where the standard is silent, this is what is done:
 *   - Outputs are applied from the first Data_Exchange on, as an ASIC does; a card that wants to wait for Operate looks
 *     at `operate_seen`. After a Clear by Global_Control they stay zeros until a Data_Exchange behind an Operate.
 *   - Whatever leads to WAIT_PRM releases the master.
 *   - Slave_Diag, Get_Cfg and, in DATA_EXCH, RD_Inp and RD_Outp are for everybody.
 *   - SDA carries only what is answered without data (Set_Prm, Chk_Cfg, Set_Slave_Add); anything else by SDA is RS.
 */
#include "core/slave_services.h"

#include <string.h>

/* Octets of Set_Prm (page G.1) and bits of its Station_Status. */
enum { PRM_STATUS, PRM_WD_FACT_1, PRM_WD_FACT_2, PRM_MIN_TSDR, PRM_IDENT_HIGH, PRM_IDENT_LOW, PRM_GROUP, PRM_USER };
enum { PRM_WD_ON = 0x08, PRM_FREEZE_REQ = 0x10, PRM_SYNC_REQ = 0x20, PRM_UNLOCK_REQ = 0x40, PRM_LOCK_REQ = 0x80 };
enum { DPV1_WD_BASE_1MS = 0x04 };

/* Octets of Set_Slave_Add (page F.2). */
enum { ADD_NEW, ADD_IDENT_HIGH, ADD_IDENT_LOW, ADD_NO_CHANGE, ADD_REMOTE };

/* Bits of the standard diagnosis (page H.1). */
enum { DIAG_NOT_READY = 0x02, DIAG_CFG_FAULT = 0x04, DIAG_EXT_DIAG = 0x08, DIAG_NOT_SUPPORTED = 0x10, DIAG_PRM_FAULT = 0x40 };
enum { DIAG_PRM_REQ = 0x01, DIAG_STAT_DIAG = 0x02, DIAG_ALWAYS = 0x04, DIAG_WD_ON = 0x08, DIAG_FREEZE = 0x10, DIAG_SYNC = 0x20 };
enum { DIAG_OVERFLOW = 0x80, DIAG_NO_MASTER = 0xFF, DIAG_STANDARD = 6 };

/* Bits of Control_Command (page F.2). */
enum { GC_CLEAR = 0x02, GC_UNFREEZE = 0x04, GC_FREEZE = 0x08, GC_UNSYNC = 0x10, GC_SYNC = 0x20, GC_RESERVED = 0xC1 };

#define WD_BASE 10000000 /* ns */
#define WD_BASE_1MS 1000000

static const dpm_reply REPLY_SC = {.short_ack = true};
static const dpm_reply REPLY_RS = {.fc = DPM_RES_RS};
static const dpm_reply REPLY_UE = {.fc = DPM_RES_UE};

static dpm_reply reply_data(const uint8_t *data, uint8_t length)
{
    return (dpm_reply){.fc = DPM_RES_DL, .data = data, .length = length};
}

static bool locked_for(const dpm_responder *slave, uint8_t master)
{
    return slave->report.state != DPM_SL_WAIT_PRM && slave->report.master != master;
}

static dpm_reply refuse_other(const dpm_responder *slave)
{
    return slave->config.foreign_sc ? REPLY_SC : REPLY_RS;
}

/* ---- states and outputs ---- */

static void set_state(dpm_responder *slave, enum dpm_slave_state state, int16_t master, int8_t configuration)
{
    dpm_slave_state_report *report = &slave->report;
    if (report->state != state || report->master != master || report->configuration != configuration)
        slave->changed = true;
    report->state = (uint8_t)state;
    report->master = master;
    report->configuration = configuration;
}

/* An application is told of changes only: a bus that repeats one image 10 000 times a second shall not wake it. */
static void publish(dpm_responder *slave, const uint8_t *octets, uint8_t length, bool valid, int64_t time)
{
    dpm_frame *frame = &slave->terminals;
    if (frame->valid == valid && frame->length == length && memcmp(frame->octets, octets, length) == 0)
        return;
    memcpy(frame->octets, octets, length);
    frame->length = length;
    frame->valid = valid;
    frame->time = time;
    frame->cycle = slave->report.exchanges;
    frame->number = dpm_image_put(slave->outputs, frame);
    slave->changed = true;
}

static void publish_safe(dpm_responder *slave, uint8_t length, int64_t time)
{
    static const uint8_t zeros[DPM_IO_MAX];
    slave->buffer_valid = false;
    publish(slave, zeros, length, false, time);
}

static void set_clear(dpm_responder *slave, bool clear)
{
    if (slave->report.clear != clear)
        slave->changed = true;
    slave->report.clear = clear;
}

/* "Leaving DATA-EXCH cancels sync and freeze", and the outputs are safe at once. */
static void leave_exchange(dpm_responder *slave, int64_t time)
{
    slave->cleared = slave->sync = slave->freeze = false;
    slave->report.operate_seen = false;
    set_clear(slave, false);
    publish_safe(slave, (uint8_t)slave->terminals.length, time);
}

static void wait_prm(dpm_responder *slave, int64_t time)
{
    leave_exchange(slave, time);
    slave->report.watchdog_on = false;
    slave->watchdog_deadline = DPM_NEVER;
    set_state(slave, DPM_SL_WAIT_PRM, -1, -1);
}

void dpm_responder_power_on(dpm_responder *slave, int64_t time)
{
    slave->fcb_master = -1;
    slave->answer_length = 0;
    slave->min_tsdr = slave->config.min_tsdr;
    slave->prm_fault = slave->cfg_fault = slave->not_supported = false;
    slave->ext_diag = slave->static_diag = slave->diagnosis_overflow = slave->announced = false;
    slave->diagnosis_length = 0;
    slave->sync_enabled = slave->freeze_enabled = false;
    slave->report.user_parameters_length = 0;
    slave->report.group = 0;
    slave->report.watchdog = 0;
    wait_prm(slave, time);
}

void dpm_responder_expire(dpm_responder *slave)
{
    slave->report.watchdog_expired++;
    wait_prm(slave, slave->watchdog_deadline);
}

/* ---- Set_Prm ---- */

static bool user_parameters_fit(const dpm_responder *slave, const dpm_telegram *prm)
{
    int length = prm->length - PRM_USER;
    return length >= slave->config.user_parameters_min && length <= slave->config.user_parameters_max;
}

static bool ident_matches(const dpm_responder *slave, uint8_t high, uint8_t low)
{
    return (high << 8 | low) == slave->config.ident_number;
}

/* 0 keeps what is; below 11 nothing can be kept on the wire; past max Tsdr no answer would ever leave. */
static bool set_min_tsdr(dpm_responder *slave, uint8_t min_tsdr)
{
    if (min_tsdr == 0)
        return true;
    if (min_tsdr >= slave->max_tsdr)
        return false;
    slave->min_tsdr = min_tsdr < 11 ? 11 : min_tsdr;
    return true;
}

static int64_t watchdog_time(const dpm_responder *slave, const dpm_telegram *prm)
{
    int64_t base = WD_BASE;
    /* DPV1_Status_1 exists only where the slave takes the three DPV1 status octets. */
    if (slave->config.user_parameters_max >= 3 && prm->length > PRM_USER && (prm->data[PRM_USER] & DPV1_WD_BASE_1MS))
        base = WD_BASE_1MS;
    return base * prm->data[PRM_WD_FACT_1] * prm->data[PRM_WD_FACT_2];
}

/* Lock: every parameter is judged before one is taken. */
static bool parameters_good(dpm_responder *slave, const dpm_telegram *prm)
{
    uint8_t status = prm->data[PRM_STATUS];
    slave->not_supported = ((status & PRM_SYNC_REQ) && !slave->config.sync_supported) ||
                           ((status & PRM_FREEZE_REQ) && !slave->config.freeze_supported);
    bool watchdog_good = !(status & PRM_WD_ON) || watchdog_time(slave, prm) > 0; /* "factor 0 with WD_On is illegal" */
    return !slave->not_supported && watchdog_good && user_parameters_fit(slave, prm) &&
           set_min_tsdr(slave, prm->data[PRM_MIN_TSDR]);
}

static void take_user_parameters(dpm_responder *slave, const dpm_telegram *prm)
{
    slave->report.user_parameters_length = (uint8_t)(prm->length - PRM_USER);
    memcpy(slave->report.user_parameters, prm->data + PRM_USER, slave->report.user_parameters_length);
    slave->changed = true;
}

static void take_parameters(dpm_responder *slave, const dpm_telegram *prm, int64_t end)
{
    dpm_slave_state_report *report = &slave->report;
    uint8_t status = prm->data[PRM_STATUS];
    slave->sync_enabled = status & PRM_SYNC_REQ;
    slave->freeze_enabled = status & PRM_FREEZE_REQ;
    report->group = prm->data[PRM_GROUP];
    report->watchdog_on = status & PRM_WD_ON;
    report->watchdog = report->watchdog_on ? watchdog_time(slave, prm) : 0;
    slave->watchdog_deadline = report->watchdog_on ? end + report->watchdog : DPM_NEVER;
    take_user_parameters(slave, prm);
}

/* "DATA-EXCH if nothing relevant changed per some stacks, WAIT-CFG per others". */
static bool stays_in_exchange(const dpm_responder *slave, const dpm_telegram *prm)
{
    const dpm_slave_state_report *report = &slave->report;
    uint8_t status = prm->data[PRM_STATUS];
    return slave->config.prm_keeps_exchange && report->state == DPM_SL_DATA_EXCH &&
           slave->sync_enabled == (bool)(status & PRM_SYNC_REQ) && slave->freeze_enabled == (bool)(status & PRM_FREEZE_REQ) &&
           prm->length - PRM_USER == report->user_parameters_length &&
           memcmp(prm->data + PRM_USER, report->user_parameters, report->user_parameters_length) == 0;
}

static dpm_reply refuse_parameters(dpm_responder *slave, int64_t time)
{
    slave->prm_fault = true;
    wait_prm(slave, time);
    return REPLY_SC; /* "SC only confirms delivery; the verdict is in the next Slave_Diag" */
}

static dpm_reply set_prm(dpm_responder *slave, const dpm_received *request)
{
    const dpm_telegram *prm = &request->telegram;
    int64_t time = request->end_latest;
    if (slave->report.address > DPM_ADDRESS_MAX)
        return REPLY_RS;
    if (locked_for(slave, prm->sa))
        return refuse_other(slave);
    if (prm->length < PRM_USER)
        return refuse_parameters(slave, time);

    uint8_t lock = prm->data[PRM_STATUS] & (PRM_LOCK_REQ | PRM_UNLOCK_REQ);
    if (lock == 0) { /* only min Tsdr, "accepted even with a foreign ident number" */
        set_min_tsdr(slave, prm->data[PRM_MIN_TSDR]);
        if (slave->config.prm_open_takes_user && user_parameters_fit(slave, prm))
            take_user_parameters(slave, prm);
        return REPLY_SC;
    }
    if (!ident_matches(slave, prm->data[PRM_IDENT_HIGH], prm->data[PRM_IDENT_LOW]))
        return refuse_parameters(slave, time);
    if (lock & PRM_UNLOCK_REQ) { /* with Lock too: "Unlock wins" */
        wait_prm(slave, time);
        return REPLY_SC;
    }
    if (!parameters_good(slave, prm))
        return refuse_parameters(slave, time);

    slave->prm_fault = false;
    if (!stays_in_exchange(slave, prm)) {
        leave_exchange(slave, time);
        set_state(slave, DPM_SL_WAIT_CFG, prm->sa, -1);
    }
    take_parameters(slave, prm, time);
    return REPLY_SC;
}

/* ---- Set_Slave_Add ---- */

/* "Executed only in WAIT-PRM, only if the ident matches and address change not locked; else ignored (still SC)". On the
 * wire of this machine an address is one slave's. */
static dpm_reply set_slave_add(dpm_responder *slave, const dpm_telegram *add)
{
    dpm_slave_state_report *report = &slave->report;
    if (!slave->config.set_address)
        return REPLY_RS;
    if (report->state != DPM_SL_WAIT_PRM || report->address_locked || add->length < ADD_REMOTE ||
        add->data[ADD_NEW] > DPM_ADDRESS_MAX || !ident_matches(slave, add->data[ADD_IDENT_HIGH], add->data[ADD_IDENT_LOW]) ||
        (slave->station[add->data[ADD_NEW]] != 0 && add->data[ADD_NEW] != report->address))
        return REPLY_SC;
    report->address = add->data[ADD_NEW];
    report->address_locked = add->data[ADD_NO_CHANGE] != 0;
    report->remote_length = (uint8_t)(add->length - ADD_REMOTE);
    memcpy(report->remote, add->data + ADD_REMOTE, report->remote_length);
    slave->changed = true;
    return REPLY_SC;
}

/* ---- Chk_Cfg, Get_Cfg ---- */

static int8_t find_configuration(const dpm_responder *slave, const uint8_t *octets, uint8_t n)
{
    for (int8_t i = 0; i < slave->config.configurations; i++)
        if (slave->config.configuration_length[i] == n && memcmp(slave->config.configuration[i], octets, n) == 0)
            return i;
    return -1;
}

static dpm_reply chk_cfg(dpm_responder *slave, const dpm_received *request)
{
    const dpm_telegram *cfg = &request->telegram;
    if (slave->report.state == DPM_SL_WAIT_PRM)
        return REPLY_RS;
    if (locked_for(slave, cfg->sa))
        return refuse_other(slave);
    int8_t found = find_configuration(slave, cfg->data, cfg->length);
    slave->cfg_fault = found < 0;
    if (found < 0) {
        wait_prm(slave, request->end_latest);
        slave->report.master = slave->config.cfg_fault_keeps_master ? cfg->sa : -1;
    } else if (found != slave->report.configuration) { /* always so in WAIT_CFG */
        leave_exchange(slave, request->end_latest);
        slave->inputs_length = slave->configuration_inputs[found];
        slave->outputs_length = slave->configuration_outputs[found];
        publish_safe(slave, slave->outputs_length, request->end_latest);
        set_state(slave, DPM_SL_DATA_EXCH, cfg->sa, found);
    }
    return REPLY_SC;
}

static dpm_reply get_cfg(const dpm_responder *slave)
{
    int8_t i = slave->report.configuration < 0 ? 0 : slave->report.configuration;
    return reply_data(slave->config.configuration[i], slave->config.configuration_length[i]);
}

/* ---- Slave_Diag ---- */

static dpm_reply slave_diag(dpm_responder *slave, uint8_t master)
{
    const dpm_slave_state_report *report = &slave->report;
    bool not_ready = report->state != DPM_SL_DATA_EXCH || !slave->ready;
    uint8_t *out = slave->scratch;
    out[0] = (uint8_t)((not_ready ? DIAG_NOT_READY : 0) | (slave->cfg_fault ? DIAG_CFG_FAULT : 0) |
                       (slave->ext_diag ? DIAG_EXT_DIAG : 0) | (slave->not_supported ? DIAG_NOT_SUPPORTED : 0) |
                       (slave->prm_fault ? DIAG_PRM_FAULT : 0));
    out[1] = (uint8_t)(DIAG_ALWAYS | (report->state == DPM_SL_WAIT_PRM ? DIAG_PRM_REQ : 0) |
                       (slave->static_diag ? DIAG_STAT_DIAG : 0) | (report->watchdog_on ? DIAG_WD_ON : 0) |
                       (slave->freeze ? DIAG_FREEZE : 0) | (slave->sync ? DIAG_SYNC : 0));
    out[2] = slave->diagnosis_overflow ? DIAG_OVERFLOW : 0;
    out[3] = report->master < 0 ? DIAG_NO_MASTER : (uint8_t)report->master;
    out[4] = (uint8_t)(slave->config.ident_number >> 8);
    out[5] = (uint8_t)slave->config.ident_number;
    memcpy(out + DIAG_STANDARD, slave->diagnosis, slave->diagnosis_length);
    if (master == report->master)
        slave->announced = false;
    return reply_data(out, (uint8_t)(DIAG_STANDARD + slave->diagnosis_length));
}

/* ---- Data_Exchange, RD_Inp, RD_Outp ---- */

/* The application's newest inputs, in the configured length: "their first octets, padded with zeros". */
static const uint8_t *sample_inputs(dpm_responder *slave)
{
    const dpm_frame *frame = dpm_image_get(slave->inputs);
    if (frame->length >= slave->inputs_length)
        return frame->octets;
    memcpy(slave->scratch, frame->octets, frame->length);
    memset(slave->scratch + frame->length, 0, (size_t)(slave->inputs_length - frame->length));
    return slave->scratch;
}

static const uint8_t *current_inputs(dpm_responder *slave)
{
    return slave->freeze ? slave->frozen : sample_inputs(slave);
}

static dpm_reply no_inputs_reply(const dpm_responder *slave, bool diagnosis)
{
    static const uint8_t octet = 0;
    if (!diagnosis || slave->config.announce == DPM_ANNOUNCE_NEVER)
        return REPLY_SC;
    return (dpm_reply){.fc = DPM_RES_DH, .data = &octet, .length = slave->config.announce == DPM_ANNOUNCE_OCTET};
}

static dpm_reply inputs_reply(dpm_responder *slave)
{
    bool diagnosis = slave->announced || slave->static_diag;
    if (slave->inputs_length == 0)
        return no_inputs_reply(slave, diagnosis);
    dpm_reply reply = reply_data(current_inputs(slave), slave->inputs_length);
    reply.fc = diagnosis ? DPM_RES_DH : DPM_RES_DL;
    return reply;
}

static void take_outputs(dpm_responder *slave, const dpm_telegram *exchange, bool empty, int64_t time)
{
    set_clear(slave, slave->cleared || empty);
    if (slave->report.clear) {
        publish_safe(slave, slave->outputs_length, time);
    } else if (slave->sync) {
        memcpy(slave->buffer, exchange->data, exchange->length);
        slave->buffer_valid = true;
    } else {
        publish(slave, exchange->data, exchange->length, true, time);
    }
}

static dpm_reply data_exchange(dpm_responder *slave, const dpm_received *request)
{
    const dpm_telegram *exchange = &request->telegram;
    if (locked_for(slave, exchange->sa))
        return refuse_other(slave);
    if (slave->report.state != DPM_SL_DATA_EXCH)
        return REPLY_RS;
    bool empty = slave->config.fail_safe && exchange->length == 0 && slave->outputs_length > 0;
    if (exchange->length != slave->outputs_length && !empty) {
        wait_prm(slave, request->end_latest);
        return slave->config.wrong_length_ue ? REPLY_UE : REPLY_RS;
    }
    slave->report.exchanges++;
    slave->report.exchange_time = request->end_latest;
    take_outputs(slave, exchange, empty, request->end_latest);
    return inputs_reply(slave);
}

static dpm_reply read_image(const dpm_responder *slave, const uint8_t *octets, uint8_t length)
{
    if (slave->report.state != DPM_SL_DATA_EXCH)
        return REPLY_RS;
    return length > 0 ? reply_data(octets, length) : (dpm_reply){.fc = DPM_RES_NR};
}

/* ---- Global_Control ---- */

static void control_sync(dpm_responder *slave, uint8_t command, int64_t time)
{
    if (!slave->sync_enabled || !(command & (GC_SYNC | GC_UNSYNC)))
        return;
    if (slave->sync && slave->buffer_valid)
        publish(slave, slave->buffer, slave->outputs_length, true, time);
    slave->buffer_valid = false;
    slave->sync = !(command & GC_UNSYNC); /* "Unsync over Sync when both are set" */
}

static void control_freeze(dpm_responder *slave, uint8_t command)
{
    if (!slave->freeze_enabled || !(command & (GC_FREEZE | GC_UNFREEZE)))
        return;
    slave->freeze = !(command & GC_UNFREEZE);
    if (slave->freeze && slave->inputs_length > 0)
        memcpy(slave->frozen, sample_inputs(slave), slave->inputs_length);
}

void dpm_responder_control(dpm_responder *slave, const dpm_received *request)
{
    const dpm_telegram *control = &request->telegram;
    if (slave->report.state != DPM_SL_DATA_EXCH || locked_for(slave, control->sa) || control->length != 2)
        return;
    uint8_t command = control->data[0], groups = control->data[1];
    if ((command & GC_RESERVED) || (groups != 0 && !(groups & slave->report.group)))
        return;
    slave->cleared = command & GC_CLEAR;
    if (slave->cleared) { /* "both the buffer and terminals, even in Sync mode" */
        publish_safe(slave, slave->outputs_length, request->end_latest);
    } else if (!slave->report.operate_seen) {
        slave->report.operate_seen = true;
        slave->changed = true;
    }
    set_clear(slave, slave->cleared);
    control_sync(slave, command, request->end_latest);
    control_freeze(slave, command);
}

/* ---- which service ---- */

dpm_reply dpm_responder_serve(dpm_responder *slave, const dpm_received *request)
{
    const dpm_telegram *telegram = &request->telegram;
    uint8_t function = telegram->fc & 0x0F;
    bool data_asked = function == DPM_SRD_LOW || function == DPM_SRD_HIGH;

    if (telegram->dsap == DPM_NO_SAP && telegram->ssap == DPM_NO_SAP)
        return data_asked ? data_exchange(slave, request) : REPLY_RS;
    if (telegram->ssap != DPM_SAP_MASTER)
        return REPLY_RS;
    if (telegram->dsap == DPM_SAP_SET_PRM)
        return set_prm(slave, request);
    if (telegram->dsap == DPM_SAP_CHK_CFG)
        return chk_cfg(slave, request);
    if (telegram->dsap == DPM_SAP_SET_SLAVE_ADD)
        return set_slave_add(slave, telegram);
    if (!data_asked)
        return REPLY_RS;
    switch (telegram->dsap) {
    case DPM_SAP_SLAVE_DIAG:
        return slave_diag(slave, telegram->sa);
    case DPM_SAP_GET_CFG:
        return get_cfg(slave);
    case DPM_SAP_RD_INP:
        return read_image(slave, current_inputs(slave), slave->inputs_length);
    case DPM_SAP_RD_OUTP:
        return read_image(slave, slave->terminals.octets, slave->outputs_length);
    default:
        return REPLY_RS;
    }
}
