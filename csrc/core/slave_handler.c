/* SPDX-License-Identifier: MIT
 *
 * The master's slave handler (EN 50170 part 8): the way of one slave into Data_Exchange and back from every state.
 *
 *   OFFLINE -> DIAG1 -> PRM -> CFG -> DIAG2 -> DATA
 *
 * A slave that answers the first Slave_Diag and is free goes to PRM at once. Refusals come back to DIAG1 with a pause
 * that grows, silence leads to OFFLINE with the same pause, where it is tried at a low rate.
 */
#include <string.h>

#include "core/master_private.h"

/* Slave_Diag, octets 1, 2 and 4 (EN 50170 part 8); bits marked M are the master's own. */
enum {
    NON_EXISTENT = 0x01 /* M */, NOT_READY = 0x02, CFG_FAULT = 0x04, NOT_SUPPORTED = 0x10,
    INVALID_RESPONSE = 0x20 /* M */, PRM_FAULT = 0x40, MASTER_LOCK = 0x80 /* M */, OWN_BITS_1 = 0xA1
};
enum { PRM_REQ = 0x01, STAT_DIAG = 0x02, DEACTIVATED = 0x80 /* M */ };
enum { OVERFLOW = 0x80 };
#define NO_MASTER 0xFF
#define DIAGNOSIS_MIN 6

/* Set_Prm, octet 1. */
enum { PRM_LOCK = 0x80, PRM_UNLOCK = 0x40, PRM_WD_ON = 0x08, PRM_SYNC_FREEZE = 0x30 };

/* ns: a slave that is not ready is asked again after WAIT; one that refused or fell silent comes again at once, and
 * if it does so again before it has exchanged data after a pause that doubles from WAIT to PAUSE_MAX. */
#define WAIT 10000000
#define PAUSE_MAX 1280000000
/* Leaving is bounded: an Unlock waits so long for Min_Slave_Interval, and not for one of seconds, ns. */
#define LEAVE_WAIT 100000000

static void put_event(dpm_master *m, const dpm_slave *slave, int64_t now, uint16_t kind, int32_t a, int32_t b)
{
    const dpm_event event = {.time = now, .kind = kind, .address = slave->set.address, .a = a, .b = b};
    dpm_station_event(&m->station, &event);
}

/* --- entering and leaving states ---------------------------------------------------------------------------------- */

/* The octets stay for the onlooker, their validity is gone. */
static void invalidate_inputs(dpm_slave *slave)
{
    slave->received.valid = false;
    dpm_image_put(slave->inputs, &slave->received);
}

static void enter(dpm_master *m, dpm_slave *slave, int64_t now, uint8_t state)
{
    const uint8_t old = slave->state;
    if (old == state)
        return;
    if (old == DPM_ST_DATA) {
        slave->returning = true;
        slave->diagnosis_pending = false;
        slave->owes = false;
        invalidate_inputs(slave);
    }
    /* A station that left Data_Exchange comes back with safe outputs: commits made before are void from the moment it
     * is lost, and once more at its return for those made in between. */
    if (slave->returning && !slave->set.hold && (old == DPM_ST_DATA || state == DPM_ST_DATA))
        dpm_outputs_make_safe(slave->outputs, m->latched);
    if (state == DPM_ST_DATA) {
        slave->statistics.starts++;
        slave->greeted = false;
        slave->operating = false;
        slave->missed = 0;
        slave->refusals = 0;
        slave->reason = DPM_WHY_NONE;
        slave->detail = 0;
    }
    if (state == DPM_ST_DIAG2)
        slave->checked_at = now;
    slave->state = state;
    put_event(m, slave, now, DPM_EV_STATE, state, old);
}

/* Back to `state` because of `reason`; told once, however often it repeats. */
static void fall_back(dpm_master *m, dpm_slave *slave, int64_t now, uint8_t state, uint8_t reason, int32_t detail)
{
    const bool news = slave->reason != reason || slave->detail != detail || slave->state == DPM_ST_DATA;
    slave->statistics.losses += slave->state == DPM_ST_DATA;
    slave->reason = reason;
    slave->detail = detail;
    if (news)
        put_event(m, slave, now, DPM_EV_FAULT, reason, detail);
    enter(m, slave, now, state);
}

static void wait(dpm_slave *slave, int64_t now, int64_t pause)
{
    if (slave->not_before < now + pause)
        slave->not_before = now + pause;
}

/* The slave did not take what it was given: trying again and again at once would only load the bus. */
static void back_off(dpm_slave *slave, int64_t now)
{
    wait(slave, now, slave->pause);
    slave->pause = slave->pause ? slave->pause * 2 : WAIT;
    if (slave->pause > PAUSE_MAX)
        slave->pause = PAUSE_MAX;
}

static void refused(dpm_master *m, dpm_slave *slave, int64_t now, uint8_t reason, int32_t detail)
{
    slave->refusals++;
    fall_back(m, slave, now, DPM_ST_DIAG1, reason, detail);
    back_off(slave, now);
}

/* Where a slave rests that is not ours: deactivated ones are not even tried. */
static uint8_t away(const dpm_slave *slave) { return slave->set.active ? DPM_ST_OFFLINE : DPM_ST_INACTIVE; }

void dpm_slave_lose(dpm_master *master, dpm_slave *slave, int64_t now, uint8_t reason, int32_t detail)
{
    if (slave->state == DPM_ST_OFFLINE || slave->state == DPM_ST_INACTIVE)
        return;
    dpm_station_restart(&master->station, slave->set.address);
    if (slave->state == DPM_ST_LEAVING)
        return; /* nobody exchanges with it, and it is to be unlocked yet */
    fall_back(master, slave, now, away(slave), reason, detail);
    slave->tries = 0;
    slave->refusals = 0;
    slave->diagnosis[0] |= NON_EXISTENT;
}

static void unlock_soon(dpm_slave *slave, int64_t now)
{
    slave->not_before = slave->spaced_at < now + LEAVE_WAIT ? slave->spaced_at : now + LEAVE_WAIT;
}

void dpm_slave_leave(dpm_master *master, dpm_slave *slave, int64_t now)
{
    enter(master, slave, now, slave->locked && dpm_master_may_tell(master) ? DPM_ST_LEAVING : away(slave));
    master->left_at = master->tokenless = now;
    slave->tries = 0;
    unlock_soon(slave, now);
}

void dpm_slave_forget(dpm_master *master, dpm_slave *slave, int64_t now)
{
    if (slave->state == DPM_ST_LEAVING)
        enter(master, slave, now, away(slave));
}

void dpm_slave_activate(dpm_master *master, dpm_slave *slave, int64_t now, bool active)
{
    if (slave->set.active == active)
        return;
    slave->set.active = active;
    slave->active_since = now;
    slave->pause = 0;
    slave->diagnosis[1] = (uint8_t)(active ? slave->diagnosis[1] & ~DEACTIVATED : slave->diagnosis[1] | DEACTIVATED);
    if (slave->state == DPM_ST_LEAVING)
        return; /* unlocked first, then as it is now */
    dpm_master_drop(master, slave, now);
    if (!active)
        dpm_outputs_make_safe(slave->outputs, master->latched); /* left on purpose: `hold` is for losses */
    dpm_slave_leave(master, slave, now);
}

void dpm_slave_new_prm(dpm_master *master, dpm_slave *slave, int64_t now)
{
    if (slave->state < DPM_ST_PRM || slave->state > DPM_ST_DATA)
        return; /* its next Set_Prm is still to come */
    dpm_master_drop(master, slave, now);
    slave->pause = 0;
    slave->refusals = 0;
    dpm_outputs_make_safe(slave->outputs, master->latched); /* asked for, and `hold` is for losses */
    enter(master, slave, now, DPM_ST_PRM);
}

/* --- requests ----------------------------------------------------------------------------------------------------- */

bool dpm_slave_wants(const dpm_slave *slave) { return slave->state != DPM_ST_OFFLINE && slave->state != DPM_ST_INACTIVE; }

static uint8_t service_of(const dpm_slave *slave)
{
    switch (slave->state) {
    case DPM_ST_PRM:
        return DPM_ASK_PRM;
    case DPM_ST_CFG:
        return DPM_ASK_CFG;
    case DPM_ST_DATA:
        return slave->diagnosis_pending ? DPM_ASK_DIAG : DPM_ASK_DATA;
    case DPM_ST_LEAVING:
        return DPM_ASK_UNLOCK;
    default:
        return DPM_ASK_DIAG;
    }
}

/* Set_Prm: station status, watchdog factors, min Tsdr, ident number, group, user parameters. */
static uint8_t build_set_prm(const dpm_slave *slave, uint8_t *pdu)
{
    const dpm_slave_set *set = &slave->set;
    const bool watchdog = set->wd_fact_1 != 0;
    pdu[0] = (uint8_t)(PRM_LOCK | (watchdog ? PRM_WD_ON : 0) | (set->station_status & PRM_SYNC_FREEZE));
    pdu[1] = watchdog ? set->wd_fact_1 : 1;
    pdu[2] = watchdog ? set->wd_fact_2 : 1;
    pdu[3] = set->min_tsdr;
    pdu[4] = (uint8_t)(set->ident_number >> 8);
    pdu[5] = (uint8_t)set->ident_number;
    pdu[6] = set->group;
    memcpy(pdu + 7, set->user_parameters, set->user_parameters_length);
    return (uint8_t)(7 + set->user_parameters_length);
}

static uint8_t build_unlock(const dpm_slave *slave, uint8_t *pdu)
{
    const uint8_t octets[7] = {PRM_UNLOCK, 1, 1, 0, (uint8_t)(slave->set.ident_number >> 8),
                               (uint8_t)slave->set.ident_number, 0};
    memcpy(pdu, octets, sizeof octets);
    return sizeof octets;
}

/* Some slaves take no outputs before they have heard Operate; those of one that is to hold never dip to zero. */
static bool may_have_outputs(const dpm_master *m, const dpm_slave *slave)
{
    return m->mode == DPM_MODE_OPERATE && !slave->cleared && (slave->operating || (slave->set.hold && slave->returning));
}

/* Outputs: the newest commit of this epoch in Operate; else zeros, or nothing for a fail-safe slave. */
static void build_data(dpm_master *m, dpm_slave *slave, dpm_request *request)
{
    const bool operate = may_have_outputs(m, slave);
    const dpm_frame *frame = operate ? dpm_outputs_take(slave->outputs) : NULL;
    if (frame && frame->number && !dpm_master_arm(m, frame->time))
        frame = NULL;
    slave->carried = frame ? frame->number : 0;
    slave->pays = slave->owes;
    request->dsap = DPM_NO_SAP;
    request->ssap = DPM_NO_SAP;
    if (m->config.data_retries >= 0)
        request->retries = (uint8_t)m->config.data_retries;
    request->length = operate || !slave->set.fail_safe ? (uint8_t)slave->output_length : 0;
    request->data = frame ? frame->octets : m->pdu;
    if (!frame)
        memset(m->pdu, 0, request->length);
}

void dpm_slave_space(dpm_slave *slave, int64_t now)
{
    slave->spaced_at = now + slave->interval;
    wait(slave, now, slave->interval);
}

void dpm_slave_request(dpm_master *master, dpm_slave *slave, int64_t now, dpm_request *request)
{
    if (slave->set.diagnosis_poll && now >= slave->diagnosis_time + slave->set.diagnosis_poll)
        slave->diagnosis_pending = true;
    slave->asked = service_of(slave);
    dpm_slave_space(slave, now);
    master->current = slave;
    *request = (dpm_request){.da = slave->set.address, .function = DPM_SRD_HIGH, .dsap = DPM_SAP_SLAVE_DIAG,
                             .ssap = DPM_SAP_MASTER, .data = master->pdu,
                             .retries = master->config.station.parameters.max_retry_limit};
    switch (slave->asked) {
    case DPM_ASK_PRM:
        slave->locked = true; /* it may be, whatever becomes of the answer */
        request->dsap = DPM_SAP_SET_PRM;
        request->length = build_set_prm(slave, master->pdu);
        break;
    case DPM_ASK_UNLOCK:
        request->dsap = DPM_SAP_SET_PRM;
        request->length = build_unlock(slave, master->pdu);
        break;
    case DPM_ASK_CFG:
        request->dsap = DPM_SAP_CHK_CFG;
        request->length = slave->set.configuration_length;
        request->data = slave->set.configuration;
        break;
    case DPM_ASK_DATA:
        build_data(master, slave, request);
        break;
    default:
        break;
    }
}

/* --- answers ------------------------------------------------------------------------------------------------------ */

static bool is_refusal(const dpm_confirm *c)
{
    const uint8_t code = c->fc & 0x0F;
    return code == DPM_RES_UE || code == DPM_RES_RR || code == DPM_RES_RS;
}

/* Set_Prm and Chk_Cfg are acknowledged by SC; OK and NR say the same. */
static bool is_acknowledge(const dpm_confirm *c)
{
    const uint8_t code = c->fc & 0x0F;
    return c->short_ack || code == DPM_RES_OK || code == DPM_RES_NR;
}

static void keep_diagnosis(dpm_master *m, dpm_slave *slave, int64_t now, const dpm_confirm *c)
{
    const uint8_t n = c->length < DPM_IO_MAX ? c->length : DPM_IO_MAX;
    const uint8_t owner = c->data[3];
    memcpy(slave->diagnosis, c->data, n);
    slave->diagnosis[0] &= (uint8_t)~OWN_BITS_1;
    slave->diagnosis[1] &= (uint8_t)~DEACTIVATED;
    if (owner != NO_MASTER && owner != m->config.station.address)
        slave->diagnosis[0] |= MASTER_LOCK;
    slave->diagnosis_length = n;
    slave->diagnosis_number++;
    slave->diagnosis_time = now;
    if (slave->set.history)
        dpm_history_put(slave->set.history, slave->diagnosis_number, now, slave->diagnosis, n);
    slave->statistics.diagnoses++;
    put_event(m, slave, now, DPM_EV_DIAGNOSIS, slave->diagnosis[0], slave->diagnosis[1]);
}

/* Faults that a diagnosis names, the gravest first. */
static uint8_t fault_of(const dpm_slave *slave, int32_t *detail)
{
    const uint8_t *d = slave->diagnosis;
    const int32_t ident = d[4] << 8 | d[5];
    *detail = 0;
    if (ident != slave->set.ident_number && !slave->set.any_ident) {
        *detail = ident;
        return DPM_WHY_IDENT;
    }
    if (d[0] & MASTER_LOCK) {
        *detail = d[3];
        return DPM_WHY_LOCKED;
    }
    if (d[0] & PRM_FAULT)
        return d[0] & NOT_SUPPORTED ? DPM_WHY_NOT_SUPPORTED : DPM_WHY_PRM_FAULT;
    if (d[0] & CFG_FAULT)
        return DPM_WHY_CFG_FAULT;
    if (d[0] & NOT_SUPPORTED)
        return DPM_WHY_NOT_SUPPORTED;
    return d[1] & PRM_REQ ? DPM_WHY_PRM_REQ : DPM_WHY_NONE;
}

static bool explains_refusal(const dpm_slave *slave, uint8_t fault)
{
    return slave->reason == DPM_WHY_SERVICE &&
           (fault == DPM_WHY_PRM_FAULT || fault == DPM_WHY_CFG_FAULT || fault == DPM_WHY_NOT_SUPPORTED);
}

/* First contact: old faults do not count, Set_Prm will tell, unless they say why the slave has just refused a service.
 * A device of another ident is not parameterised, unless any will do. */
static void judge_first_diagnosis(dpm_master *m, dpm_slave *slave, int64_t now)
{
    int32_t detail;
    const uint8_t fault = fault_of(slave, &detail);
    if (fault == DPM_WHY_IDENT || fault == DPM_WHY_LOCKED) {
        refused(m, slave, now, fault, detail);
        return;
    }
    if (explains_refusal(slave, fault))
        fall_back(m, slave, now, slave->state, fault, detail);
    enter(m, slave, now, DPM_ST_PRM);
}

static void judge_second_diagnosis(dpm_master *m, dpm_slave *slave, int64_t now)
{
    int32_t detail;
    const uint8_t fault = fault_of(slave, &detail);
    const bool static_diag = slave->diagnosis[1] & STAT_DIAG;
    const int64_t patience = slave->set.ready_timeout;
    if (fault != DPM_WHY_NONE) {
        refused(m, slave, now, fault, detail);
    } else if (slave->diagnosis[0] & NOT_READY && patience && now > slave->checked_at + patience) {
        fall_back(m, slave, now, DPM_ST_PRM, DPM_WHY_NOT_READY, 0);
        wait(slave, now, WAIT);
    } else if (slave->diagnosis[0] & NOT_READY || static_diag) {
        fall_back(m, slave, now, DPM_ST_DIAG2, static_diag ? DPM_WHY_STATIC_DIAG : DPM_WHY_NOT_READY, 0);
        wait(slave, now, WAIT);
    } else {
        enter(m, slave, now, DPM_ST_DATA);
    }
}

/* In Data_Exchange: extended diagnosis is news, a wish for parameters is the end of it. */
static void judge_running_diagnosis(dpm_master *m, dpm_slave *slave, int64_t now)
{
    int32_t detail;
    uint8_t fault = fault_of(slave, &detail);
    if (fault == DPM_WHY_NONE && slave->diagnosis[0] & NOT_READY)
        fault = DPM_WHY_NOT_READY;
    slave->diagnosis_pending = slave->diagnosis[1] & STAT_DIAG;
    slave->owes &= !slave->diagnosis_pending; /* no Data_Exchange is to come soon */
    if (fault != DPM_WHY_NONE)
        fall_back(m, slave, now, DPM_ST_DIAG1, fault, detail);
}

static void invalid_answer(dpm_master *m, dpm_slave *slave, int64_t now, const dpm_confirm *c)
{
    slave->statistics.invalid++;
    refused(m, slave, now, DPM_WHY_INVALID_ANSWER, c->length);
    slave->diagnosis[0] |= INVALID_RESPONSE;
}

static void confirm_diagnosis(dpm_master *m, dpm_slave *slave, int64_t now, const dpm_confirm *c)
{
    if (c->length < DIAGNOSIS_MIN) {
        invalid_answer(m, slave, now, c);
        return;
    }
    keep_diagnosis(m, slave, now, c);
    switch (slave->state) {
    case DPM_ST_DATA:
        judge_running_diagnosis(m, slave, now);
        break;
    case DPM_ST_DIAG2:
        judge_second_diagnosis(m, slave, now);
        break;
    case DPM_ST_OFFLINE:
    case DPM_ST_DIAG1:
        slave->locked &= slave->diagnosis[3] == m->config.station.address;
        judge_first_diagnosis(m, slave, now);
        break;
    default:
        break;
    }
}

void dpm_slave_overhear(dpm_master *master, dpm_slave *slave, int64_t now, const dpm_confirm *confirm)
{
    if (slave->state != DPM_ST_DATA || (confirm->fc & 0x0F) != DPM_RES_DL || confirm->length < DIAGNOSIS_MIN)
        return;
    keep_diagnosis(master, slave, now, confirm);
    judge_running_diagnosis(master, slave, now);
}

bool dpm_slave_in_trouble(const dpm_slave *slave)
{
    const uint8_t *d = slave->diagnosis;
    const bool shown = d[0] || d[1] & (PRM_REQ | STAT_DIAG) || d[2] & OVERFLOW;
    return slave->set.active && (slave->state != DPM_ST_DATA || shown);
}

/* Inputs of the length that Chk_Cfg agreed on. A slave without inputs says SC; some say it with an empty telegram, or
 * announce diagnosis in one that may carry a dummy octet (EN 50170 leaves it open). RDL and RDH leave the outputs untaken. */
static bool is_data_answer(const dpm_slave *slave, const dpm_confirm *c)
{
    const uint8_t code = c->fc & 0x0F;
    const bool data = !c->short_ack && (code == DPM_RES_DL || code == DPM_RES_DH);
    if (slave->input_length == 0)
        return (is_acknowledge(c) || data) && c->length <= (code == DPM_RES_DH ? 1 : 0);
    return data && c->length == slave->input_length;
}

static void measure(dpm_master *m, dpm_slave *slave, const dpm_confirm *c)
{
    dpm_slave_statistics *s = &slave->statistics;
    if (c->tries != 1)
        return;
    if (c->tsdr >= 0 && (s->tsdr_min < 0 || c->tsdr < s->tsdr_min))
        s->tsdr_min = c->tsdr;
    if (c->tsdr > s->tsdr_max)
        s->tsdr_max = c->tsdr;
    if (m->recorded < m->record_size)
        m->record[m->recorded++] = c->time - c->start;
}

static void confirm_data(dpm_master *m, dpm_slave *slave, int64_t now, const dpm_confirm *c)
{
    if (!is_data_answer(slave, c)) {
        invalid_answer(m, slave, now, c);
        return;
    }
    dpm_frame *frame = &slave->received;
    frame->cycle = m->cycle;
    frame->time = now;
    frame->valid = true;
    if (slave->input_length)
        memcpy(frame->octets, c->data, slave->input_length);
    dpm_image_put(slave->inputs, frame);
    if (slave->carried)
        dpm_outputs_answered(slave->outputs, slave->carried);
    slave->data_at = now;
    slave->missed = 0;
    slave->owes &= !slave->pays;
    slave->statistics.exchanges++;
    measure(m, slave, c);
    if ((c->fc & 0x0F) == DPM_RES_DH)
        slave->diagnosis_pending = true;
    if (!slave->greeted) {
        slave->greeted = true;
        slave->pause = 0;
        m->control_due = true;
    }
}

static void confirm_answer(dpm_master *m, dpm_slave *slave, int64_t now, const dpm_confirm *c)
{
    slave->tries = 0;
    slave->silent = false;
    if (slave->asked == DPM_ASK_UNLOCK) {
        slave->locked = false;
        enter(m, slave, now, away(slave));
        return;
    }
    if (c->status == DPM_CONF_INVALID) {
        invalid_answer(m, slave, now, c);
        return;
    }
    if (is_refusal(c)) {
        slave->statistics.refused++;
        refused(m, slave, now, DPM_WHY_SERVICE, c->fc);
    } else if (slave->asked == DPM_ASK_DIAG) {
        confirm_diagnosis(m, slave, now, c);
    } else if (slave->asked == DPM_ASK_DATA) {
        confirm_data(m, slave, now, c);
    } else if (is_acknowledge(c)) {
        enter(m, slave, now, slave->asked == DPM_ASK_PRM ? DPM_ST_CFG : DPM_ST_DIAG2);
    } else {
        invalid_answer(m, slave, now, c);
    }
}

/* "Max-Retry-Limit(DX) may be 0": what is not repeated in its cycle counts on in the next ones. */
static bool may_be_missed(const dpm_master *m, dpm_slave *slave, uint8_t tries)
{
    if (slave->state != DPM_ST_DATA || slave->asked != DPM_ASK_DATA)
        return false;
    slave->missed += tries;
    return slave->missed <= m->config.station.parameters.max_retry_limit;
}

void dpm_slave_confirm(dpm_master *master, dpm_slave *slave, int64_t now, const dpm_confirm *confirm)
{
    slave->statistics.repetitions += confirm->tries > 1 ? confirm->tries - 1u : 0u;
    if (confirm->status == DPM_CONF_DS)
        return; /* the bus was lost or the outputs were withdrawn, not the slave; its FCB starts anew */
    if (confirm->status != DPM_CONF_NA) {
        confirm_answer(master, slave, now, confirm);
        return;
    }
    slave->statistics.unanswered++;
    slave->tries++;
    if (may_be_missed(master, slave, confirm->tries))
        return;
    /* A first contact, which the station does not repeat; nothing else would free the slave. */
    const bool again = !slave->silent && confirm->tries <= master->config.station.parameters.max_retry_limit;
    slave->silent = true;
    if (slave->state == DPM_ST_LEAVING && again) {
        unlock_soon(slave, now);
    } else if (slave->state == DPM_ST_LEAVING) {
        slave->locked = false; /* for all that we know: it is not asked again */
        enter(master, slave, now, away(slave));
    } else if (slave->state != DPM_ST_OFFLINE) {
        dpm_slave_lose(master, slave, now, DPM_WHY_NO_ANSWER, slave->state);
        back_off(slave, now);
    } else if (slave->reason == DPM_WHY_NONE) {
        fall_back(master, slave, now, DPM_ST_OFFLINE, DPM_WHY_NO_ANSWER, DPM_ST_OFFLINE);
    }
}
