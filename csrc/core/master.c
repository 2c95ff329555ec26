/* SPDX-License-Identifier: MIT
 *
 * The DP master class 1: modes, the cycle and its scheduler, Global_Control, the output watchdog, raw requests. What
 * it does with one slave is in slave_handler.c; the telegrams' way over the bus is the FDL station's.
 */
#include "core/master_private.h"

#include <string.h>

#include "dpmaster/error.h"
#include "dpmaster/identifier.h"

/* Tries of absent slaves may cost this part of the bus's time once other slaves exchange data: one in so many. */
#define TRY_SHARE 20
#define HOUR 3600000000000 /* ns; the longest time a caller may set */
/* A cycle in which no slave was asked is not repeated before this has passed, ns. */
#define EMPTY_CYCLE 1000000
/* Leaving is bounded: the longest wait for a token to unlock slaves with (two of the ring's rotations within Ttr, where that is
 * longer), and for slaves that were silent, ns. */
#define PATIENCE 500000000
/* The output watchdog's clock: ns of a tick, and ticks by which a feed may be ahead of the bus thread's last look. */
enum { TICK = 1 << 18, AHEAD = 1 << 14 };

/* Control_Command: Clear_Data, and what a program may order besides. */
enum { CLEAR_DATA = 0x02, COMMANDS = 0x3C };

#define MODE_STEP 0x40
#define LONG_AGO (-HOUR * 24)

static void put_event(dpm_master *m, int64_t now, uint16_t kind, int32_t a, int32_t b)
{
    const dpm_event event = {.time = now, .kind = kind, .address = -1, .a = a, .b = b};
    dpm_station_event(&m->station, &event);
}

/* A slave that was removed leaves its place to the next that is added. */
static bool is_taken(const dpm_slave *slave) { return slave->outputs != NULL; }

static dpm_slave *slave_at(dpm_master *m, uint8_t address)
{
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (is_taken(&m->slaves[i]) && m->slaves[i].set.address == address)
            return &m->slaves[i];
    return NULL;
}

/* --- outputs and the watchdog over the program ------------------------------------------------------------------ */

/* "What was written before is never sent again": not as the repetition of a telegram under way either. */
static void drop_outputs(dpm_master *m, const dpm_slave *slave, int64_t now)
{
    if (slave && m->current == slave && slave->asked == DPM_ASK_DATA)
        dpm_station_withdraw(&m->station, now);
}

/* There was a pause: the next cycle begins when it can, and lays the raster anew. */
static void forget_cycle(dpm_master *m)
{
    m->in_cycle = false;
    m->cycle_at = 0;
    m->cycle_start = 0;
}

static void make_outputs_safe(dpm_master *m, bool latch, int64_t now)
{
    drop_outputs(m, m->current, now);
    atomic_store_explicit(&m->armed, false, memory_order_release);
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (is_taken(&m->slaves[i]))
            dpm_outputs_make_safe(m->slaves[i].outputs, latch);
}

/* "Steps only between neighbours: Offline - Stop - Clear - Operate"; Global_Control tells the slaves of each. What was
 * cleared by order is so no longer: the mode is told to all. */
static void enter_mode(dpm_master *m, uint8_t mode, int64_t now)
{
    while (m->mode != mode) {
        const uint8_t old = m->mode;
        if (old < DPM_MODE_CLEAR)
            forget_cycle(m);
        m->mode = (uint8_t)(mode > old ? old + MODE_STEP : old - MODE_STEP);
        m->control_due = true;
        put_event(m, now, DPM_EV_MODE, m->mode, old);
        for (unsigned i = 0; i < m->n_slaves; i++)
            m->slaves[i].cleared = false;
    }
}

/* Any thread feeds, so the time is one word, which never hides a lock (see image.c): a number of ticks, rounded up. It goes
 * round in 13 days; what seems further ahead than a feed can be was long ago. */
static int64_t fed_at(const dpm_master *m, int64_t now)
{
    const int64_t horizon = now / TICK + AHEAD;
    return (horizon - (uint32_t)((uint32_t)horizon - atomic_load_explicit(&m->fed_tick, memory_order_acquire))) * TICK;
}

/* Behind its time a feed is too late, also where the bus thread has slept as long as the program (SIGSTOP, a suspended
 * machine) and has yet to judge: "when the program hangs, drives do not run on". */
static bool too_late(const dpm_master *m, int64_t now)
{
    return m->config.output_watchdog && atomic_load_explicit(&m->armed, memory_order_acquire) &&
           now > fed_at(m, now) + m->config.output_watchdog;
}

static void feed(dpm_master *m, int64_t now, int by)
{
    atomic_store_explicit(&m->fed_by, by, memory_order_relaxed);
    atomic_store_explicit(&m->fed_tick, (uint32_t)(now / TICK + 1), memory_order_release);
}

void dpm_master_feed(dpm_master *master, int64_t now, int by)
{
    if (too_late(master, now))
        return;
    feed(master, now, by);
}

bool dpm_master_arm(dpm_master *master, int64_t time)
{
    if (!atomic_load_explicit(&master->armed, memory_order_relaxed)) {
        atomic_store_explicit(&master->armed, true, memory_order_release);
        if (time > fed_at(master, master->asked_at))
            feed(master, time, DPM_FED_COMMIT);
    }
    return !too_late(master, master->asked_at);
}

/* When the output watchdog runs out; outputs that no commit has ever touched are safe already. */
static int64_t watchdog_at(const dpm_master *m, int64_t now)
{
    if (m->mode != DPM_MODE_OPERATE || !m->config.output_watchdog ||
        !atomic_load_explicit(&m->armed, memory_order_acquire))
        return DPM_NEVER;
    return fed_at(m, now) + m->config.output_watchdog;
}

static void judge_watchdog(dpm_master *m, int64_t now)
{
    if (now <= watchdog_at(m, now))
        return;
    m->latched = true;
    m->latched_by = (uint8_t)atomic_load_explicit(&m->fed_by, memory_order_relaxed);
    make_outputs_safe(m, true, now);
    enter_mode(m, DPM_MODE_CLEAR, now);
    put_event(m, now, DPM_EV_WATCHDOG, m->latched_by, 0);
}

/* --- data transfer and Auto_Clear ---------------------------------------------------------------------------------- */

/* "In data transfer during Data_Control_Time." */
static bool transfers(const dpm_master *m, const dpm_slave *slave, int64_t now)
{
    return now <= slave->data_at + m->config.data_control_time;
}

/* One that has just been activated has as long to get there. */
static int64_t transfer_ends(const dpm_master *m, const dpm_slave *slave)
{
    const bool new = slave->active_since > slave->data_at;
    return (new ? slave->active_since : slave->data_at) + m->config.data_control_time;
}

static int64_t auto_clear_at(const dpm_master *m)
{
    return m->config.auto_clear && m->mode == DPM_MODE_OPERATE ? m->transfer_at : DPM_NEVER;
}

static void auto_clear(dpm_master *m, const dpm_slave *slave, int64_t now)
{
    const dpm_event event = {.time = now, .kind = DPM_EV_AUTO_CLEAR, .address = slave->set.address};
    m->auto_cleared = slave->set.address;
    make_outputs_safe(m, false, now);
    enter_mode(m, DPM_MODE_CLEAR, now);
    dpm_station_event(&m->station, &event);
}

/* Error_Action_Flag: "if any activated slave was not in data transfer during Data_Control_Time, Operate -> Clear". */
static void judge_transfer(dpm_master *m, int64_t now)
{
    if (now <= auto_clear_at(m))
        return;
    m->transfer_at = DPM_NEVER;
    for (unsigned i = 0; i < m->n_slaves; i++) {
        const dpm_slave *slave = &m->slaves[i];
        if (!slave->set.active)
            continue;
        if (now > transfer_ends(m, slave)) {
            auto_clear(m, slave, now);
            return;
        }
        m->transfer_at = min_of(m->transfer_at, transfer_ends(m, slave));
    }
}

/* "Clear -> Operate only when all were in data exchange within Data_Control_Time." */
static bool all_transfer(const dpm_master *m, int64_t now)
{
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (m->slaves[i].set.active && !transfers(m, &m->slaves[i], now))
            return false;
    return true;
}

/* --- the cycle --------------------------------------------------------------------------------------------------- */

static void note_lateness(dpm_lateness *lateness, int64_t late, int64_t allowance)
{
    unsigned n = 0;
    for (int64_t us = late / 1000; us >= 2 && n < DPM_LATENESS_CLASSES - 1; us /= 2)
        n++;
    lateness->counts[n]++;
    lateness->last = late;
    lateness->max = late > lateness->max ? late : lateness->max;
    lateness->over += late > allowance;
}

/* A fixed cycle keeps its raster for ever, whenever the host woke: one that overran is followed at once, and the one after
 * that is in its place again. Places that passed meanwhile are skipped. */
static int64_t next_place(dpm_master *m, int64_t now, int64_t interval)
{
    if (!m->config.cycle_time)
        return m->cycle_start + interval > now ? m->cycle_start + interval : now;
    const int64_t place = m->cycle_at + interval;
    const int64_t skipped = now > place ? (now - place) / interval : 0;
    m->lateness.skipped += (uint64_t)skipped;
    return place + skipped * interval;
}

static bool begin_cycle(dpm_master *m, int64_t now, int64_t *wake)
{
    if (!m->fresh_token)
        return false;
    if (now < m->cycle_at) {
        *wake = min_of(*wake, m->cycle_at);
        return false;
    }
    m->fresh_token = false;
    m->in_cycle = true;
    m->turn = 0;
    m->asked = 0;
    m->tried = false;
    if (m->cycle_start) {
        m->cycle_last = now - m->cycle_start;
        m->cycle_max = m->cycle_last > m->cycle_max ? m->cycle_last : m->cycle_max;
    }
    m->cycle_start = now;
    m->cycle_at = m->cycle_at ? m->cycle_at : now;
    if (m->config.cycle_time)
        note_lateness(&m->lateness, now - m->cycle_at, m->station.config.traits.allowance);
    return true;
}

static void end_cycle(dpm_master *m, int64_t now, int64_t *wake)
{
    int64_t interval = m->config.cycle_time;
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (m->slaves[i].state == DPM_ST_DATA && m->slaves[i].interval > interval)
            interval = m->slaves[i].interval;
    if (!m->asked && interval < EMPTY_CYCLE)
        interval = EMPTY_CYCLE;
    m->in_cycle = false;
    m->cycle++;
    m->began = m->cycle_start;
    m->ended = now;
    m->began_late = m->lateness.last;
    m->station.machine.progress++;
    m->cycle_at = next_place(m, now, interval);
    *wake = min_of(*wake, m->cycle_at > now ? m->cycle_at : now);
}

/* --- Global_Control ------------------------------------------------------------------------------------------------ */

static bool concerns(const dpm_control *order, const dpm_slave *slave)
{
    const bool addressed = order->da == DPM_BROADCAST || order->da == slave->set.address;
    return is_taken(slave) && addressed && (order->group == 0 || order->group & slave->set.group);
}

static bool clear_to_all(const dpm_master *m) { return m->mode != DPM_MODE_OPERATE; }

static bool put_control(dpm_master *m, dpm_request *request, uint8_t errand, uint8_t da, uint8_t command, uint8_t group)
{
    m->errand = errand;
    m->current = NULL;
    m->pdu[0] = command;
    m->pdu[1] = group;
    *request = (dpm_request){.da = da, .function = DPM_SDN_HIGH, .dsap = DPM_SAP_GLOBAL_CONTROL, .ssap = DPM_SAP_MASTER,
                             .length = 2, .data = m->pdu};
    return true;
}

/* The mode: on every change, for whoever joined, and three times per Data_Control_Time. It bears no Sync and no Freeze,
 * so it neither cancels nor repeats one. */
static bool mode_request(dpm_master *m, int64_t now, dpm_request *request)
{
    if (!m->control_due && now < m->control_at)
        return false;
    m->control_due = false;
    m->control_at = now + m->config.data_control_time / 3;
    return put_control(m, request, DPM_ERRAND_MODE, DPM_BROADCAST, clear_to_all(m) ? CLEAR_DATA : 0, 0);
}

/* Slaves that are cleared by order are told so again when a telegram to all has said Operate. */
static bool reminder_request(dpm_master *m, dpm_request *request)
{
    for (; m->reminder < m->n_slaves; m->reminder++)
        if (m->slaves[m->reminder].cleared && m->slaves[m->reminder].state == DPM_ST_DATA)
            return put_control(m, request, DPM_ERRAND_REMINDER, m->slaves[m->reminder++].set.address, CLEAR_DATA, 0);
    return false;
}

/* A Sync takes effect on what was committed before it was ordered: first each slave concerned is given that. */
static bool order_request(dpm_master *m, dpm_request *request)
{
    const dpm_control *order = m->order;
    if (!order)
        return false;
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (m->slaves[i].owes && order->clear != 1)
            return false;
    const bool clear = clear_to_all(m) || order->clear == 1;
    return put_control(m, request, DPM_ERRAND_ORDER, order->da, (uint8_t)(order->command | (clear ? CLEAR_DATA : 0)), order->group);
}

/* Global_Control has a place of its own in the cycle: before the first Data_Exchange. */
static bool control_request(dpm_master *m, int64_t now, dpm_request *request)
{
    return mode_request(m, now, request) || reminder_request(m, request) || (!m->leaving && order_request(m, request));
}

static void order_sent(dpm_master *m)
{
    dpm_control *order = m->order;
    if (!order)
        return; /* revoked meanwhile */
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (order->clear == 0 && concerns(order, &m->slaves[i]))
            m->slaves[i].cleared = false;
    m->order = NULL;
    order->done = true;
    m->station.machine.progress++;
}

/* Global_Control went out, or could not: then it is due again. */
static void control_confirm(dpm_master *m, const dpm_confirm *confirm)
{
    const bool sent = confirm->status == DPM_CONF_SENT;
    if (!sent && m->errand == DPM_ERRAND_MODE)
        m->control_due = true;
    if (!sent)
        return;
    if (m->errand == DPM_ERRAND_ORDER)
        order_sent(m);
    if (!(m->pdu[0] & CLEAR_DATA))
        m->reminder = 0;
    if (m->errand != DPM_ERRAND_MODE)
        return;
    for (unsigned i = 0; i < m->n_slaves; i++)
        m->slaves[i].operating = !(m->pdu[0] & CLEAR_DATA) && m->slaves[i].greeted;
}

static void revoke(dpm_master *m)
{
    m->order = NULL;
    if (m->errand == DPM_ERRAND_ORDER)
        m->errand = DPM_ERRAND_REMINDER; /* too late to hold it back, but its end is not the next order's */
    for (unsigned i = 0; i < m->n_slaves; i++)
        m->slaves[i].owes = false;
}

int dpm_master_order(dpm_master *master, dpm_control *control, int64_t now)
{
    if (control->command & (uint8_t)~COMMANDS || control->da > DPM_BROADCAST || control->clear < -1 || control->clear > 1 ||
        control->da == master->config.station.address)
        return DPM_E_ARGUMENT;
    if (master->order)
        return DPM_E_BUSY;
    if (master->mode < DPM_MODE_CLEAR || master->leaving || (master->mode == DPM_MODE_CLEAR && control->clear == 0))
        return DPM_E_MODE;
    control->done = false;
    master->order = control;
    master->station.users_wake = 0;
    for (unsigned i = 0; i < master->n_slaves; i++) {
        dpm_slave *slave = &master->slaves[i];
        if (!concerns(control, slave))
            continue;
        slave->owes = slave->state == DPM_ST_DATA;
        slave->pays = false;
        if (control->clear != 1)
            continue;
        drop_outputs(master, slave, now);
        slave->cleared = true;
        dpm_outputs_make_safe(slave->outputs, master->latched);
    }
    return DPM_OK;
}

void dpm_master_revoke(dpm_master *master, dpm_control *control)
{
    if (master->order == control)
        revoke(master);
}

/* --- the slaves' turns --------------------------------------------------------------------------------------------- */

static bool ask_slave(dpm_master *m, dpm_slave *slave, int64_t now, dpm_request *request)
{
    m->asked++;
    m->errand = DPM_ERRAND_SLAVE;
    dpm_slave_request(m, slave, now, request);
    return true;
}

/* The slaves' turn; one that may not be asked yet (Min_Slave_Interval) keeps its place until then. */
static bool slave_request(dpm_master *m, int64_t now, dpm_request *request, int64_t *wake)
{
    for (; m->turn < m->n_slaves; m->turn++) {
        dpm_slave *slave = &m->slaves[m->turn];
        if (!dpm_slave_wants(slave) || slave == m->raw_first)
            continue;
        if (now < slave->not_before) {
            if (slave->state == DPM_ST_DATA) {
                *wake = min_of(*wake, slave->not_before);
                return false;
            }
            continue;
        }
        m->turn++;
        return ask_slave(m, slave, now, request);
    }
    return false;
}

/* The way out, which no fixed cycle time delays. Those that did not answer come last: the slots of a plant without power
 * would keep the others waiting. */
static bool unlock_request(dpm_master *m, int64_t now, dpm_request *request, int64_t *wake)
{
    dpm_slave *found = NULL;
    for (unsigned i = 0; i < m->n_slaves; i++) {
        dpm_slave *slave = &m->slaves[i];
        if (slave->state != DPM_ST_LEAVING)
            continue;
        if (now < slave->not_before)
            *wake = min_of(*wake, slave->not_before);
        else if (!found || (found->silent && !slave->silent))
            found = slave;
    }
    return found && ask_slave(m, found, now, request);
}

/* One absent slave may be tried per cycle, in turn. Once others exchange data, what a try without an answer costs is
 * spread over TRY_SHARE times as long; a slave that was never tried, or that was just lost, need not wait. */
static bool try_request(dpm_master *m, int64_t now, dpm_request *request)
{
    dpm_slave *found = NULL;
    for (unsigned i = 0; i < m->n_slaves && !m->tried; i++) {
        dpm_slave *slave = &m->slaves[(m->try_turn + i) % m->n_slaves];
        if (slave->state != DPM_ST_OFFLINE || now < slave->not_before || (slave->tries && now < m->try_at))
            continue;
        found = slave;
        m->try_turn = (m->try_turn + i + 1) % m->n_slaves;
        break;
    }
    if (!found)
        return false;
    m->tried = true;
    return ask_slave(m, found, now, request);
}

static bool anyone_leaving(const dpm_master *m)
{
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (m->slaves[i].state == DPM_ST_LEAVING)
            return true;
    return false;
}

/* The way out is done when every slave that was ours has been unlocked, or could not be reached. */
static void finish_leaving(dpm_master *m, int64_t now)
{
    if (!m->leaving || anyone_leaving(m))
        return;
    m->leaving = false;
    revoke(m);
    enter_mode(m, m->target, now);
    if (m->target == DPM_MODE_OFFLINE)
        dpm_station_online(&m->station, false, now);
}

bool dpm_master_may_tell(const dpm_master *master)
{
    return dpm_station_state(&master->station) >= DPM_FDL_LISTEN_TOKEN && master->mode >= DPM_MODE_CLEAR;
}

/* For how long those that are left wait for the token to be told so. A silent bus is claimed sooner; a ring lets us in again. */
static int64_t patience(const dpm_master *m)
{
    if (m->config.station.role == DPM_ROLE_SOLE)
        return min_of(2 * dpm_station_patience(&m->station), PATIENCE);
    const dpm_parameters *p = &m->config.station.parameters;
    return max_of(min_of(2 * m->station.ring.trr, dpm_bits_up(p, p->ttr)), PATIENCE);
}

static bool waits_for_token(const dpm_master *m)
{
    return m->tokenless != DPM_NEVER && !dpm_station_talks(&m->station);
}

static void forget_leaving(dpm_master *m, int64_t now)
{
    for (unsigned i = 0; i < m->n_slaves; i++)
        dpm_slave_forget(m, &m->slaves[i], now);
    m->left_at = m->tokenless = DPM_NEVER;
    finish_leaving(m, now);
}

static void forget_silent(dpm_master *m, int64_t now)
{
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (m->slaves[i].silent)
            dpm_slave_forget(m, &m->slaves[i], now);
}

/* Nobody gives us the token. What a host that was away itself has waited does not count. */
static void judge_leaving(dpm_master *m, int64_t until)
{
    if (!waits_for_token(m) || until < m->tokenless + patience(m))
        return;
    if (until > m->tokenless + 2 * patience(m))
        m->tokenless = until;
    else
        forget_leaving(m, until);
}

static int master_next(void *context, int64_t now, dpm_request *request, int64_t *wake)
{
    dpm_master *m = context;
    if (m->leaving && now - m->left_at > PATIENCE)
        forget_silent(m, now);
    finish_leaving(m, now);
    *wake = min_of(*wake, watchdog_at(m, now));
    if (m->mode < DPM_MODE_CLEAR)
        return 0;
    if (!m->in_cycle && !begin_cycle(m, now, wake))
        return 0;
    if ((m->turn == 0 || m->leaving) && control_request(m, now, request))
        return 1;
    if (m->leaving)
        return unlock_request(m, now, request, wake);
    if (slave_request(m, now, request, wake))
        return 1;
    if (m->turn < m->n_slaves)
        return 0;
    if (try_request(m, now, request))
        return 1;
    end_cycle(m, now, wake);
    return 0;
}

/* A repetition may be the first that the slave has heard: Min_Slave_Interval counts from the last one. */
static void space_repeated(dpm_master *m, const dpm_confirm *confirm)
{
    dpm_slave *slave = confirm->tries > 1 ? slave_at(m, m->station.da) : NULL;
    if (slave)
        dpm_slave_space(slave, confirm->start);
}

static void master_confirm(void *context, int64_t now, const dpm_confirm *confirm)
{
    dpm_master *m = context;
    dpm_slave *slave = m->current;
    m->current = NULL;
    space_repeated(m, confirm);
    if (m->errand != DPM_ERRAND_SLAVE)
        control_confirm(m, confirm);
    if (!slave)
        return;
    if (slave->state == DPM_ST_OFFLINE && confirm->status == DPM_CONF_NA) /* what the host was away is no cost of it */
        m->try_at = now + (dpm_master_exchanges(m) ? TRY_SHARE * (m->station.deadline - confirm->start) : 0);
    dpm_slave_confirm(m, slave, now, confirm);
}

bool dpm_master_exchanges(const dpm_master *m)
{
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (m->slaves[i].state == DPM_ST_DATA)
            return true;
    return false;
}

static void lose_all(dpm_master *m, int64_t now)
{
    for (unsigned i = 0; i < m->n_slaves; i++)
        dpm_slave_lose(m, &m->slaves[i], now, DPM_WHY_BUS, 0);
    forget_cycle(m);
}

void dpm_master_drop(dpm_master *m, const dpm_slave *slave, int64_t now)
{
    drop_outputs(m, slave, now);
    if (m->current == slave)
        m->current = NULL;
}

static void master_token(void *context, int64_t now, bool held)
{
    dpm_master *m = context;
    m->fresh_token = held;
    if (held)
        return;
    lose_all(m, now);
    m->control_due |= m->leaving; /* nobody knows who has heard it */
    if (m->tokenless != DPM_NEVER)
        m->tokenless = LONG_AGO; /* since the next look: what a late host reads may bear any time before it */
    finish_leaving(m, now);
    if (dpm_station_state(&m->station) == DPM_FDL_OFFLINE) { /* another station has our address, or the port is deaf and dumb */
        forget_leaving(m, now);
        make_outputs_safe(m, false, now);
        enter_mode(m, DPM_MODE_OFFLINE, now);
    }
}

/* --- raw requests ------------------------------------------------------------------------------------------------ */

/* "The master must keep this distance for every master-slave function": Min_Slave_Interval is the request's, too. A slave
 * whose every interval the cycle would use up leaves one exchange out for it. */
static bool raw_must_wait(dpm_master *m, int64_t now, int64_t *wake)
{
    dpm_slave *slave = slave_at(m, m->raw->da);
    m->raw_first = NULL;
    if (!slave)
        return false;
    if (now < slave->spaced_at) {
        m->raw_first = slave->state == DPM_ST_DATA ? slave : NULL;
        *wake = min_of(*wake, slave->spaced_at);
        return true;
    }
    dpm_slave_space(slave, now);
    return false;
}

static int raw_next(void *context, int64_t now, dpm_request *request, int64_t *wake)
{
    dpm_master *m = context;
    const dpm_raw *raw = m->raw;
    if (!raw)
        m->raw_first = NULL;
    if (!raw || raw_must_wait(m, now, wake))
        return 0;
    m->raw_out = true;
    *request = (dpm_request){.da = raw->da, .function = raw->function, .dsap = raw->dsap, .ssap = raw->ssap,
                             .retries = m->config.station.parameters.max_retry_limit,
                             .length = raw->length, .data = raw->data};
    return 1;
}

/* The first of the queue is done. */
static void finish_raw(dpm_master *m, const dpm_confirm *confirm)
{
    dpm_raw *raw = m->raw;
    m->raw = raw->next;
    raw->status = confirm->status;
    raw->fc = confirm->fc;
    raw->short_ack = confirm->short_ack;
    raw->tries = confirm->tries;
    raw->tsdr = confirm->tsdr;
    raw->answer_length = confirm->length;
    if (confirm->length)
        memcpy(raw->answer, confirm->data, confirm->length);
    raw->done = true;
    m->station.machine.progress++;
}

/* A diagnosis that was fetched by hand is the handler's, too: the slave has withdrawn its flag. */
static void share_diagnosis(dpm_master *m, int64_t now, const dpm_confirm *confirm)
{
    dpm_slave *slave = slave_at(m, m->raw->da);
    if (slave && m->raw->dsap == DPM_SAP_SLAVE_DIAG && confirm->status == DPM_CONF_ANSWER)
        dpm_slave_overhear(m, slave, now, confirm);
}

static void raw_confirm(void *context, int64_t now, const dpm_confirm *confirm)
{
    dpm_master *m = context;
    const bool cancelled = m->raw_cancelled;
    m->raw_out = m->raw_cancelled = false;
    space_repeated(m, confirm);
    if (cancelled)
        return;
    share_diagnosis(m, now, confirm);
    finish_raw(m, confirm);
}

/* Off the bus nothing has its turn: who waits is told now. What is out is confirmed by the station. */
static void refuse_raw(dpm_master *m)
{
    const dpm_confirm refused = {.status = DPM_CONF_DS, .tsdr = -1};
    while (m->raw && dpm_station_state(&m->station) == DPM_FDL_OFFLINE)
        finish_raw(m, &refused);
}

int dpm_master_request(dpm_master *master, dpm_raw *raw)
{
    dpm_raw **last = &master->raw;
    if (master->mode == DPM_MODE_OFFLINE)
        return DPM_E_MODE;
    for (; *last; last = &(*last)->next)
        if (*last == raw)
            return DPM_E_BUSY;
    raw->done = false;
    raw->next = NULL;
    *last = raw;
    master->station.users_wake = 0;
    refuse_raw(master);
    return DPM_OK;
}

void dpm_master_cancel(dpm_master *master, dpm_raw *raw)
{
    dpm_raw **at = &master->raw;
    while (*at && *at != raw)
        at = &(*at)->next;
    if (!*at)
        return;
    master->raw_cancelled |= master->raw_out && raw == master->raw;
    master->raw_first = NULL;
    *at = raw->next;
}

/* --- modes ------------------------------------------------------------------------------------------------------- */

/* Unlock what is ours, by the cycle's own means, behind a Global_Control Clear to all. */
static void leave(dpm_master *m, uint8_t target, int64_t now)
{
    if (m->mode == DPM_MODE_OPERATE)
        enter_mode(m, DPM_MODE_CLEAR, now);
    m->target = target;
    m->leaving = true;
    m->raw_first = NULL;
    m->current = NULL; /* what is under way was asked on the way in: its answer changes no state any more */
    for (unsigned i = 0; i < m->n_slaves; i++)
        dpm_slave_leave(m, &m->slaves[i], now);
    m->control_due = true;
    m->cycle_at = now;
    finish_leaving(m, now);
}

static void operate(dpm_master *m, int64_t now)
{
    m->latched = false;
    m->auto_cleared = -1;
    m->transfer_at = now;
    feed(m, now, DPM_FED_OPERATE); /* what was committed in Clear comes alive now, and is watched from now */
    for (unsigned i = 0; i < m->n_slaves; i++)
        if (is_taken(&m->slaves[i]))
            dpm_outputs_unlatch(m->slaves[i].outputs);
    enter_mode(m, DPM_MODE_OPERATE, now);
}

int dpm_master_set_mode(dpm_master *master, int mode, int64_t now)
{
    if (mode != DPM_MODE_OFFLINE && mode != DPM_MODE_STOP && mode != DPM_MODE_CLEAR && mode != DPM_MODE_OPERATE)
        return DPM_E_ARGUMENT;
    if (mode == DPM_MODE_OPERATE && master->config.auto_clear && !all_transfer(master, now))
        return DPM_E_MODE;
    master->station.users_wake = 0;
    if (mode != DPM_MODE_OFFLINE)
        dpm_station_online(&master->station, master->port_works, now);
    if (master->mode == DPM_MODE_OPERATE && mode != DPM_MODE_OPERATE)
        make_outputs_safe(master, false, now);
    if (mode <= DPM_MODE_STOP && master->mode != mode) {
        leave(master, (uint8_t)mode, now);
        return DPM_OK;
    }
    master->leaving = false;
    if (mode == DPM_MODE_OPERATE)
        operate(master, now);
    else
        enter_mode(master, (uint8_t)mode, now);
    return DPM_OK;
}

void dpm_master_port(dpm_master *master, bool working, int64_t now)
{
    master->port_works = working;
    dpm_station_online(&master->station, false, now);
    lose_all(master, now);
    /* No output of a commit is alive: until one is again, a program that waits for its port has not hung. */
    atomic_store_explicit(&master->armed, false, memory_order_release);
    forget_leaving(master, now);
    if (working && master->mode != DPM_MODE_OFFLINE)
        dpm_station_online(&master->station, true, now);
}

/* --- the machine -------------------------------------------------------------------------------------------------- */

/* Only a silence that was heard is a token that nobody has: a host that was away claims it first. */
static void master_quiet(dpm_machine *machine, int64_t until)
{
    dpm_master *m = (dpm_master *)machine;
    m->station_quiet(machine, until);
    judge_leaving(m, until);
}

static void master_ask(dpm_machine *machine, int64_t now, dpm_offer *offer)
{
    dpm_master *m = (dpm_master *)machine;
    if (m->left_at != DPM_NEVER && now > m->asked_at + PATIENCE)
        m->left_at = now; /* nor had those that are left any time while the host was away */
    m->asked_at = now;
    judge_watchdog(m, now);
    judge_transfer(m, now);
    if (m->tokenless != DPM_NEVER && dpm_station_talks(&m->station))
        m->tokenless = now;
    m->station_ask(machine, now, offer);
    offer->wake = min_of(offer->wake, min_of(watchdog_at(m, now), auto_clear_at(m)));
    if (waits_for_token(m))
        offer->wake = min_of(offer->wake, m->tokenless + patience(m));
    refuse_raw(m);
}

/* --- set-up ------------------------------------------------------------------------------------------------------- */

size_t dpm_master_size(uint16_t slaves) { return sizeof(dpm_master) + slaves * sizeof(dpm_slave); }

int dpm_master_init(void *block, size_t size, const dpm_master_config *config, dpm_master **master)
{
    dpm_station *station;
    if (config->slaves < 1 || config->slaves > 126 || config->cycle_time < 0 || config->cycle_time > HOUR ||
        config->output_watchdog < 0 || config->output_watchdog > HOUR || config->data_control_time < 1 ||
        config->data_control_time > HOUR || config->data_retries < -1 || config->data_retries > 15)
        return DPM_E_ARGUMENT;
    if (!block || size < dpm_master_size(config->slaves))
        return DPM_E_BLOCK;
    memset(block, 0, size);
    const int result = dpm_station_init(block, size, &config->station, &station);
    if (result < 0)
        return result;
    dpm_master *m = block;
    m->config = *config;
    m->port_works = true;
    m->auto_cleared = -1;
    m->left_at = m->tokenless = DPM_NEVER;
    m->station_ask = station->machine.ask;
    m->station_quiet = station->machine.quiet;
    station->machine.ask = master_ask;
    station->machine.quiet = master_quiet;
    const dpm_fdl_user dp = {.context = m, .next = master_next, .confirm = master_confirm, .token = master_token};
    const dpm_fdl_user raw = {.context = m, .next = raw_next, .confirm = raw_confirm};
    dpm_station_add_user(station, &dp);
    dpm_station_add_user(station, &raw);
    *master = m;
    return DPM_OK;
}

dpm_machine *dpm_master_machine(dpm_master *master) { return &master->station.machine; }

dpm_station *dpm_master_station(dpm_master *master) { return &master->station; }

static int check_set(const dpm_master *m, const dpm_slave_set *set, uint16_t *inputs, uint16_t *outputs)
{
    if (set->address > DPM_ADDRESS_MAX || set->address == m->config.station.address)
        return DPM_E_ADDRESS;
    if (set->configuration_length < 1 || set->configuration_length > DPM_IO_MAX || set->user_parameters_length > 237)
        return DPM_E_LENGTH;
    if ((set->wd_fact_1 == 0) != (set->wd_fact_2 == 0) || (set->min_tsdr > 0 && set->min_tsdr < 11))
        return DPM_E_ARGUMENT;
    return dpm_configuration_lengths(set->configuration, set->configuration_length, inputs, outputs) < 0
               ? DPM_E_CONFIGURATION
               : DPM_OK;
}

static void take_set(dpm_slave *slave, const dpm_slave_set *set)
{
    slave->set = *set;
    slave->interval = (int64_t)set->min_slave_interval * 100000; /* unit 100 us */
}

/* The first free place; n_slaves only grows when there is none. */
static int free_place(dpm_master *m)
{
    unsigned i = 0;
    while (i < m->n_slaves && is_taken(&m->slaves[i]))
        i++;
    if (i == m->config.slaves)
        return DPM_E_FULL;
    m->n_slaves = i == m->n_slaves ? i + 1 : m->n_slaves;
    return (int)i;
}

int dpm_master_add(dpm_master *master, const dpm_slave_set *set, dpm_outputs *outputs, dpm_image *inputs)
{
    uint16_t input_length, output_length;
    const int result = check_set(master, set, &input_length, &output_length);
    if (result < 0)
        return result;
    if (slave_at(master, set->address))
        return DPM_E_DUPLICATE;
    const int place = free_place(master);
    if (place < 0)
        return place;
    dpm_slave *slave = &master->slaves[place];
    memset(slave, 0, sizeof *slave);
    take_set(slave, set);
    slave->outputs = outputs;
    slave->inputs = inputs;
    slave->input_length = input_length;
    slave->output_length = output_length;
    slave->received.length = input_length;
    slave->state = set->active ? DPM_ST_OFFLINE : DPM_ST_INACTIVE;
    slave->data_at = LONG_AGO;
    slave->active_since = master->asked_at;
    slave->statistics.tsdr_min = -1;
    slave->statistics.tsdr_max = -1;
    master->station.users_wake = 0;
    master->transfer_at = min_of(master->transfer_at, transfer_ends(master, slave));
    if (master->latched)
        dpm_outputs_make_safe(outputs, true);
    return place;
}

static dpm_slave *slave_of(dpm_master *m, int index)
{
    return index >= 0 && index < (int)m->n_slaves && is_taken(&m->slaves[index]) ? &m->slaves[index] : NULL;
}

int dpm_master_change(dpm_master *master, int index, const dpm_slave_set *set)
{
    uint16_t inputs, outputs;
    dpm_slave *slave = slave_of(master, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    const int result = check_set(master, set, &inputs, &outputs);
    if (result < 0)
        return result;
    if (set->address != slave->set.address)
        return DPM_E_ADDRESS;
    if (inputs != slave->input_length || outputs != slave->output_length)
        return DPM_E_LENGTH;
    const bool active = slave->set.active;
    take_set(slave, set);
    slave->set.active = active;
    return DPM_OK;
}

int dpm_master_new_prm(dpm_master *master, int index, int64_t now)
{
    dpm_slave *slave = slave_of(master, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    dpm_slave_new_prm(master, slave, now);
    master->station.users_wake = 0;
    return DPM_OK;
}

int dpm_master_activate(dpm_master *master, int index, bool active, int64_t now)
{
    dpm_slave *slave = slave_of(master, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    dpm_slave_activate(master, slave, now, active);
    master->station.users_wake = 0;
    master->transfer_at = min_of(master->transfer_at, now);
    return DPM_OK;
}

int dpm_master_remove(dpm_master *master, int index)
{
    dpm_slave *slave = slave_of(master, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    if (slave->state != DPM_ST_INACTIVE)
        return DPM_E_BUSY;
    if (master->raw_first == slave)
        master->raw_first = NULL;
    memset(slave, 0, sizeof *slave);
    slave->state = DPM_ST_INACTIVE;
    return DPM_OK;
}

/* --- what onlookers read ----------------------------------------------------------------------------------------- */

void dpm_master_get_status(const dpm_master *master, dpm_master_status *status)
{
    *status = (dpm_master_status){
        .auto_cleared = master->auto_cleared,
        .mode = master->mode,
        .fdl_state = (uint8_t)dpm_station_state(&master->station),
        .latched = master->latched,
        .fed_by = master->latched ? master->latched_by
                                  : (uint8_t)atomic_load_explicit(&master->fed_by, memory_order_relaxed),
        .foreign = master->station.foreign,
        .cycle = master->cycle,
        .cycle_last = master->cycle_last,
        .cycle_max = master->cycle_max,
        .cycle_began = master->began,
        .cycle_ended = master->ended,
        .cycle_late = master->began_late,
        .lateness = master->lateness,
    };
    dpm_station_statistics(&master->station, &status->fdl);
    for (unsigned i = 0; i < master->n_slaves; i++) {
        const dpm_slave *slave = &master->slaves[i];
        const uint8_t octet = slave->set.address / 8, bit = (uint8_t)(1u << slave->set.address % 8);
        if (is_taken(slave) && transfers(master, slave, master->asked_at))
            status->data_transfer[octet] |= bit;
        if (dpm_slave_in_trouble(slave))
            status->system_diagnostic[octet] |= bit;
    }
}

int dpm_master_get_slave(const dpm_master *master, int index, dpm_slave_status *status)
{
    const dpm_slave *slave = slave_of((dpm_master *)master, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    *status = (dpm_slave_status){
        .state = slave->state,
        .reason = slave->reason,
        .detail = slave->detail,
        .refusals = slave->refusals,
        .diagnosis_length = slave->diagnosis_length,
        .diagnosis_number = slave->diagnosis_number,
        .diagnosis_time = slave->diagnosis_time,
        .statistics = slave->statistics,
    };
    memcpy(status->diagnosis, slave->diagnosis, sizeof status->diagnosis);
    return DPM_OK;
}

void dpm_master_record(dpm_master *master, int64_t *durations, size_t n)
{
    master->record = durations;
    master->record_size = durations ? n : 0;
    master->recorded = 0;
}

size_t dpm_master_recorded(const dpm_master *master) { return master->recorded; }
