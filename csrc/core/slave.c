/* SPDX-License-Identifier: MIT
 *
 * The slaves' side of the wire: one receiver for all of them, the FDL responder of each with frame count bit and
 * stored answer, the times between which an answer may leave, the watchdogs, the search of the rate. What a request
 * means is the business of slave_services.c.
 *
 * One answer waits at a time, to the latest request: any good telegram revokes it, since the bus has gone on. Noise
 * does not (a hat that glitches when it turns round would never be answered), but while octets lie there that may
 * become a telegram the answer is held back.
 */
#include "core/slave_services.h"

#include <string.h>

#include "dpmaster/error.h"
#include "dpmaster/identifier.h"

#define SLAVES_MAX 126

/* How long a slave that searches stays at a rate: a poll to somebody absent and its slot time must have room. */
#define SEARCH_TIME 10000000 /* ns */
#define SEARCH_BITS 5000
#define BAUD_CONTROL_UNIT 10000000 /* ns */
#define SLAVE_INTERVAL_UNIT 100000

struct dpm_slaves {
    dpm_machine machine; /* first: a pointer to one is a pointer to the other */
    dpm_parameters parameters;
    int64_t answer_within; /* ns after a request: max Tsdr and what the host may be late */
    uint16_t room;
    uint16_t count;
    uint16_t searching; /* slaves that search their rate */
    uint8_t station[DPM_BROADCAST + 1]; /* by address: the slave's index plus 1, 0 none */
    /* The answer that waits to leave. */
    dpm_responder *answering; /* NULL: none */
    const uint8_t *answer;
    size_t answer_length;
    int64_t not_before;
    int64_t not_after;
    /* The search's round through the rates, ns: when in it the wire's rate is tried, and for how long (0: never). */
    int64_t search_round;
    int64_t search_begin;
    int64_t search_length;
    uint8_t unnumbered[DPM_TELEGRAM_MAX]; /* answers outside the FCB's sequence: the stored ones stay */
    int64_t deadline[SLAVES_MAX]; /* of watchdog and rate, apart from the slaves: searched with every event */
    dpm_receiver receiver;
    dpm_responder slave[];
};

/* After anything that was done to a slave. */
static void settle(dpm_slaves *slaves, dpm_responder *slave)
{
    ptrdiff_t index = slave - slaves->slave;
    slaves->deadline[index] = slave->watchdog_deadline < slave->baud_deadline ? slave->watchdog_deadline : slave->baud_deadline;
    if (slave->mapped != slave->report.address) {
        slaves->station[slave->mapped] = 0;
        slave->mapped = slave->report.address;
        slaves->station[slave->mapped] = (uint8_t)(index + 1);
    }
    if (slave->changed)
        slaves->machine.progress++;
    slave->changed = false;
}

/* ---- the rate, page I.6 ---- */

/* "BAUD_CONTROL: retriggered by each error-free telegram to the own address"; in DP_CONTROL the watchdog supervises. */
static void keep_rate(dpm_responder *slave, int64_t time)
{
    bool supervised = slave->config.auto_baud && slave->config.baud_control > 0 && !slave->report.watchdog_on;
    slave->baud_deadline = supervised ? time + slave->config.baud_control * (int64_t)BAUD_CONTROL_UNIT : DPM_NEVER;
}

static void set_searching(dpm_slaves *slaves, dpm_responder *slave, bool searching)
{
    slaves->searching = (uint16_t)(slaves->searching + searching - slave->searching);
    slave->searching = searching;
    slave->changed = true;
}

static void search_rate(dpm_slaves *slaves, dpm_responder *slave, int64_t time)
{
    set_searching(slaves, slave, true);
    slave->search_start = time;
    slave->baud_deadline = DPM_NEVER;
}

/* "Starts at 12M, goes down after a monitoring time": where it listens is a matter of time, so a search needs no timer. */
static bool hears(const dpm_slaves *slaves, const dpm_responder *slave, const dpm_received *received)
{
    int64_t since = received->start_latest - slave->search_start;
    int64_t begin = since % slaves->search_round - slaves->search_begin;
    return since >= 0 && begin >= 0 &&
           begin + (received->end_earliest - received->start_latest) <= slaves->search_length;
}

/* "An error-free SD1/SD2/SD3 telegram (of anybody)" at the rate that is tried. */
static void find_rate(dpm_slaves *slaves, const dpm_received *received)
{
    for (uint16_t i = 0; i < slaves->count; i++) {
        dpm_responder *slave = &slaves->slave[i];
        if (!slave->searching || !slave->connected || !hears(slaves, slave, received))
            continue;
        set_searching(slaves, slave, false);
        keep_rate(slave, received->end_latest);
        settle(slaves, slave);
    }
}

/* The way down the table, and where on it the wire's own rate lies. */
static void plan_search(dpm_slaves *slaves)
{
    dpm_parameters at;
    unsigned n = 0;
    while (dpm_parameters_rate(n) != 0)
        n++;
    while (n-- > 0) {
        (void)dpm_parameters_default(&at, dpm_parameters_rate(n), 0);
        int64_t length = SEARCH_TIME + dpm_bits_up(&at, SEARCH_BITS);
        if ((uint64_t)at.rate_num * slaves->parameters.rate_den == (uint64_t)slaves->parameters.rate_num * at.rate_den) {
            slaves->search_begin = slaves->search_round;
            slaves->search_length = length;
        }
        slaves->search_round += length;
    }
}

static bool listens(const dpm_responder *slave)
{
    return slave->connected && !slave->searching;
}

/* ---- power, watchdogs ---- */

static void power_on(dpm_slaves *slaves, dpm_responder *slave, int64_t now)
{
    if (slaves->answering == slave)
        slaves->answering = NULL;
    dpm_responder_power_on(slave, now);
    slave->request_start = -DPM_NEVER / 2; /* there was none */
    slave->baud_deadline = DPM_NEVER;
    if (slave->config.auto_baud)
        search_rate(slaves, slave, now);
    settle(slaves, slave);
}

static void expire_slave(dpm_slaves *slaves, dpm_responder *slave, int64_t time)
{
    if (slave->watchdog_deadline < time) {
        int64_t deadline = slave->watchdog_deadline;
        dpm_responder_expire(slave);
        keep_rate(slave, deadline); /* "DP state machine reset, then BAUD_CONTROL" */
    }
    if (slave->baud_deadline < time)
        search_rate(slaves, slave, slave->baud_deadline);
}

/* "Octets that lie in a FIFO are never called missing": `time` is one up to which all octets have been seen. */
static void expire(dpm_slaves *slaves, int64_t time)
{
    for (uint16_t i = 0; i < slaves->count; i++) {
        if (slaves->deadline[i] < time) {
            expire_slave(slaves, &slaves->slave[i], time);
            settle(slaves, &slaves->slave[i]);
        }
    }
}

static int64_t next_deadline(const dpm_slaves *slaves)
{
    int64_t next = DPM_NEVER;
    for (uint16_t i = 0; i < slaves->count; i++)
        if (slaves->deadline[i] < next)
            next = slaves->deadline[i];
    return next;
}

/* ---- answers ---- */

static uint8_t encode(const dpm_telegram *request, const dpm_reply *reply, uint8_t *out)
{
    if (reply->short_ack) {
        out[0] = DPM_SC;
        return 1;
    }
    dpm_telegram answer = {
        .da = request->sa, .sa = request->da, .fc = DPM_TYPE_SLAVE | reply->fc,
        .dsap = DPM_NO_SAP, .ssap = DPM_NO_SAP, .dsegment = -1, .ssegment = -1,
    };
    if (reply->length > 0) { /* an answer without data is SD1 and has no SAPs */
        answer.dsap = request->ssap;
        answer.ssap = request->dsap;
        answer.data = reply->data;
        answer.length = reply->length;
    }
    int n = dpm_encode(&answer, out, DPM_TELEGRAM_MAX);
    return n > 0 ? (uint8_t)n : 0;
}

static void offer_answer(dpm_slaves *slaves, dpm_responder *slave, const dpm_received *request, const uint8_t *octets,
                         uint8_t n)
{
    slaves->answering = n > 0 ? slave : NULL;
    slaves->answer = octets;
    slaves->answer_length = n;
    slaves->not_before = request->end_latest + dpm_bits_up(&slaves->parameters, slave->min_tsdr);
    slaves->not_after = request->end_earliest + slaves->answer_within;
}

static void answer_unnumbered(dpm_slaves *slaves, dpm_responder *slave, const dpm_received *request, const dpm_reply *reply)
{
    uint8_t n = encode(&request->telegram, reply, slaves->unnumbered);
    offer_answer(slaves, slave, request, slaves->unnumbered, n);
}

/* ---- requests ---- */

/* "Retriggered by every correct request of the own master to this slave": SRD and SDA whatever their answer and their
 * repetitions, but no status requests, and Global_Control only where that is set: it may go on when the master's DP is
 * long dead. */
static void retrigger(dpm_responder *slave, const dpm_received *request)
{
    if (slave->report.watchdog_on && slave->report.master == request->telegram.sa)
        slave->watchdog_deadline = request->end_latest + slave->report.watchdog;
}

/* "The master must keep this distance for every master-slave function": what is certainly less is counted. */
static void measure_interval(dpm_responder *slave, const dpm_received *request)
{
    int64_t least = slave->config.min_slave_interval * (int64_t)SLAVE_INTERVAL_UNIT;
    slave->report.too_soon += request->start_latest - slave->request_start < least;
    slave->request_start = request->start_latest - (request->end_latest - request->end_earliest);
}

/* The responder's frame count bit, page C.2. */
static void exchange(dpm_slaves *slaves, dpm_responder *slave, const dpm_received *request)
{
    const dpm_telegram *telegram = &request->telegram;
    bool fcv = telegram->fc & DPM_FC_FCV, fcb = telegram->fc & DPM_FC_FCB;
    retrigger(slave, request);

    if (fcv && slave->fcb_master == telegram->sa && slave->fcb == fcb) { /* "resend the stored reply, do not execute again" */
        slave->report.repetitions++;
        offer_answer(slaves, slave, request, slave->answer, slave->answer_length);
        return;
    }
    measure_interval(slave, request);
    dpm_reply reply = dpm_responder_serve(slave, request);
    if (!fcv && !fcb) { /* "no FCB evaluation" */
        answer_unnumbered(slaves, slave, request, &reply);
        return;
    }
    slave->fcb_master = telegram->sa;
    slave->fcb = fcb;
    slave->answer_length = encode(telegram, &reply, slave->answer);
    offer_answer(slaves, slave, request, slave->answer, slave->answer_length);
}

static bool is_control(const dpm_telegram *telegram)
{
    uint8_t function = telegram->fc & 0x0F;
    return (function == DPM_SDN_LOW || function == DPM_SDN_HIGH) && telegram->dsap == DPM_SAP_GLOBAL_CONTROL &&
           telegram->ssap == DPM_SAP_MASTER;
}

static void control(dpm_responder *slave, const dpm_received *request)
{
    if (slave->config.control_feeds)
        retrigger(slave, request);
    dpm_responder_control(slave, request);
}

static dpm_reply identity(const dpm_responder *slave)
{
    const dpm_slave_config *config = &slave->config;
    return (dpm_reply){.fc = config->identity_length > 0 ? DPM_RES_DL : DPM_RES_RS, .data = config->identity,
                       .length = config->identity_length};
}

static void request_for(dpm_slaves *slaves, dpm_responder *slave, const dpm_received *request)
{
    static const dpm_reply status = {.fc = DPM_RES_OK}, refused = {.fc = DPM_RES_RS};
    dpm_reply who;
    switch (request->telegram.fc & 0x0F) {
    case DPM_SDA_LOW:
    case DPM_SDA_HIGH:
    case DPM_SRD_LOW:
    case DPM_SRD_HIGH:
        exchange(slaves, slave, request);
        break;
    case DPM_FDL_STATUS:
        answer_unnumbered(slaves, slave, request, &status);
        break;
    case DPM_IDENT:
        who = identity(slave);
        answer_unnumbered(slaves, slave, request, &who);
        break;
    case DPM_LSAP_STATUS:
        answer_unnumbered(slaves, slave, request, &refused);
        break;
    case DPM_SDN_LOW:
    case DPM_SDN_HIGH:
        if (is_control(&request->telegram))
            control(slave, request);
        break;
    default: /* time events and reserved codes: silence */
        return;
    }
    slave->report.requests++;
    keep_rate(slave, request->end_latest);
    settle(slaves, slave);
}

static void broadcast(dpm_slaves *slaves, const dpm_received *request)
{
    if (!is_control(&request->telegram)) /* "127: broadcast, SDN only" */
        return;
    for (uint16_t i = 0; i < slaves->count; i++) {
        if (!listens(&slaves->slave[i]))
            continue;
        control(&slaves->slave[i], request);
        settle(slaves, &slaves->slave[i]);
    }
}

static void dispatch(dpm_slaves *slaves, const dpm_received *received)
{
    const dpm_telegram *telegram = &received->telegram;
    /* Bit 7 is for clock values only; SA 126 and segments are no requester of ours (page B.3 rules 4 and 5). */
    if ((telegram->fc & 0xC0) != DPM_FC_REQUEST || telegram->sa > DPM_ADDRESS_MAX || telegram->dsegment >= 0 ||
        telegram->ssegment >= 0)
        return;
    if (telegram->da == DPM_BROADCAST) {
        broadcast(slaves, received);
    } else if (slaves->station[telegram->da] != 0) {
        dpm_responder *slave = &slaves->slave[slaves->station[telegram->da] - 1];
        if (listens(slave))
            request_for(slaves, slave, received);
    }
}

static void deliver(dpm_slaves *slaves, const dpm_received *received)
{
    slaves->answering = NULL;
    expire(slaves, received->end_earliest);
    if (received->telegram.format == DPM_SC || received->telegram.format == DPM_SD4)
        return;
    dispatch(slaves, received);
    if (slaves->searching > 0)
        find_rate(slaves, received);
}

/* ---- the event contract ---- */

static void on_octets(dpm_machine *machine, const dpm_span *span)
{
    dpm_slaves *slaves = (dpm_slaves *)machine;
    if (span->echo || span->n == 0)
        return;
    int64_t last = span->earliest + (int64_t)(span->n - 1) * span->spacing;
    dpm_span rest = *span;
    dpm_received received;
    while (dpm_receiver_take(&slaves->receiver, &rest, &received))
        deliver(slaves, &received);
    expire(slaves, last);
}

static void on_quiet(dpm_machine *machine, int64_t until)
{
    dpm_slaves *slaves = (dpm_slaves *)machine;
    dpm_received received;
    while (dpm_receiver_quiet(&slaves->receiver, until, &received))
        deliver(slaves, &received);
    expire(slaves, until + 1); /* a request that ended at the deadline itself would have been seen */
}

static void on_sent(dpm_machine *machine, int64_t start, int64_t end_earliest, int64_t end_latest, int result)
{
    dpm_slaves *slaves = (dpm_slaves *)machine;
    (void)start, (void)end_earliest, (void)end_latest;
    if (slaves->answering && result == DPM_SENT_WHOLE)
        slaves->answering->report.answers++;
    slaves->answering = NULL;
}

static void on_ask(dpm_machine *machine, int64_t now, dpm_offer *offer)
{
    dpm_slaves *slaves = (dpm_slaves *)machine;
    int64_t unfinished = dpm_receiver_deadline(&slaves->receiver), deadline = next_deadline(slaves);
    *offer = (dpm_offer){.wake = unfinished < deadline ? unfinished : deadline};
    if (slaves->answering && now > slaves->not_after) {
        slaves->answering->report.late_dropped++;
        slaves->answering = NULL;
    }
    if (!slaves->answering || unfinished != DPM_NEVER)
        return;
    offer->octets = slaves->answer;
    offer->n = slaves->answer_length;
    offer->not_before = slaves->not_before;
    offer->not_after = slaves->not_after;
}

/* ---- the public face ---- */

size_t dpm_slaves_size(uint16_t slaves)
{
    return sizeof(dpm_slaves) + slaves * sizeof(dpm_responder);
}

int dpm_slaves_init(void *block, size_t size, const dpm_parameters *parameters, const dpm_port_traits *traits,
                    uint16_t slaves, dpm_slaves **out)
{
    dpm_refusal refusal;
    if (!parameters || !traits || !out || slaves < 1 || slaves > SLAVES_MAX || traits->allowance < 0 || traits->granularity < 0)
        return DPM_E_ARGUMENT;
    if (!block || (uintptr_t)block % 16 != 0 || size < dpm_slaves_size(slaves))
        return DPM_E_BLOCK;
    if (dpm_parameters_check(parameters, 0, &refusal) != DPM_OK)
        return DPM_E_PARAMETER;
    dpm_slaves *self = block;
    memset(self, 0, dpm_slaves_size(slaves));
    self->machine = (dpm_machine){.octets = on_octets, .quiet = on_quiet, .sent = on_sent, .ask = on_ask};
    self->parameters = *parameters;
    plan_search(self);
    self->answer_within = dpm_bits_down(parameters, parameters->max_tsdr) + traits->allowance;
    self->room = slaves;
    /* "A receiver can treat 33 Tbit idle as a definite frame end"; what the port cannot tell is never held against it. */
    dpm_receiver_init(&self->receiver, dpm_bits_up(parameters, DPM_CHARACTER_BITS),
                      dpm_bits_up(parameters, DPM_TSYN) + traits->granularity,
                      dpm_bits_up(parameters, DPM_TSYN) + traits->granularity);
    *out = self;
    return DPM_OK;
}

dpm_machine *dpm_slaves_machine(dpm_slaves *slaves)
{
    return &slaves->machine;
}

static int check_config(const dpm_slaves *slaves, const dpm_slave_config *config)
{
    if (config->address >= DPM_BROADCAST)
        return DPM_E_ADDRESS;
    if (slaves->station[config->address] != 0)
        return DPM_E_DUPLICATE;
    if (config->configurations < 1 || config->configurations > DPM_SLAVE_CONFIGURATIONS)
        return DPM_E_CONFIGURATION;
    if (config->user_parameters_min > config->user_parameters_max || config->user_parameters_max > 237 ||
        config->max_diagnosis < 6 || config->max_diagnosis > DPM_IO_MAX || config->min_tsdr < 11 ||
        config->min_tsdr > 255 || config->min_tsdr >= slaves->parameters.max_tsdr ||
        config->identity_length > DPM_SLAVE_IDENTITY || config->announce > DPM_ANNOUNCE_NEVER)
        return DPM_E_ARGUMENT;
    return DPM_OK;
}

static int take_configurations(dpm_responder *slave)
{
    const dpm_slave_config *config = &slave->config;
    for (unsigned i = 0; i < config->configurations; i++) {
        uint16_t inputs, outputs;
        uint8_t n = config->configuration_length[i];
        if (n < 1 || n > DPM_IO_MAX || dpm_configuration_lengths(config->configuration[i], n, &inputs, &outputs) < 0)
            return DPM_E_CONFIGURATION;
        slave->configuration_inputs[i] = (uint8_t)inputs;
        slave->configuration_outputs[i] = (uint8_t)outputs;
    }
    return DPM_OK;
}

int dpm_slaves_add(dpm_slaves *slaves, const dpm_slave_config *config, dpm_image *outputs, dpm_image *inputs)
{
    if (!config || !outputs || !inputs)
        return DPM_E_ARGUMENT;
    int bad = check_config(slaves, config);
    if (bad)
        return bad;
    if (slaves->count == slaves->room)
        return DPM_E_FULL;
    dpm_responder *slave = &slaves->slave[slaves->count];
    memset(slave, 0, sizeof *slave);
    slave->config = *config;
    bad = take_configurations(slave);
    if (bad)
        return bad;
    slave->outputs = outputs;
    slave->inputs = inputs;
    slave->max_tsdr = slaves->parameters.max_tsdr;
    slave->connected = slave->ready = true;
    slave->station = slaves->station;
    slave->report.address = slave->mapped = config->address;
    slave->report.address_locked = config->address_locked;
    slaves->station[config->address] = (uint8_t)++slaves->count;
    power_on(slaves, slave, 0);
    return slaves->count - 1;
}

static dpm_responder *find(dpm_slaves *slaves, int index)
{
    return index >= 0 && index < slaves->count ? &slaves->slave[index] : NULL;
}

int dpm_slaves_get(const dpm_slaves *slaves, int index, dpm_slave_state_report *report)
{
    if (index < 0 || index >= slaves->count || !report)
        return DPM_E_ARGUMENT;
    const dpm_responder *slave = &slaves->slave[index];
    *report = slave->report;
    report->baud_state = slave->searching ? DPM_BAUD_SEARCH : report->watchdog_on ? DPM_DP_CONTROL : DPM_BAUD_CONTROL;
    if (!slave->connected)
        report->state = DPM_SL_OFF;
    return DPM_OK;
}

int dpm_slaves_connect(dpm_slaves *slaves, int index, bool connected)
{
    dpm_responder *slave = find(slaves, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    if (slaves->answering == slave)
        slaves->answering = NULL;
    slave->changed = slave->connected != connected;
    slave->connected = connected;
    settle(slaves, slave);
    return DPM_OK;
}

int dpm_slaves_reset(dpm_slaves *slaves, int index, int64_t now)
{
    dpm_responder *slave = find(slaves, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    power_on(slaves, slave, now);
    return DPM_OK;
}

int dpm_slaves_set_address(dpm_slaves *slaves, int index, uint8_t address, bool locked, int64_t now)
{
    dpm_responder *slave = find(slaves, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    if (address >= DPM_BROADCAST)
        return DPM_E_ADDRESS;
    if (slaves->station[address] != 0 && slave->report.address != address)
        return DPM_E_DUPLICATE;
    slave->report.address = address;
    slave->report.address_locked = locked;
    slave->changed = true;
    power_on(slaves, slave, now);
    return DPM_OK;
}

int dpm_slaves_diagnosis(dpm_slaves *slaves, int index, const uint8_t *octets, uint8_t n, bool announce, bool ext_diag,
                         bool static_diag)
{
    dpm_responder *slave = find(slaves, index);
    if (!slave || (n > 0 && !octets))
        return DPM_E_ARGUMENT;
    uint8_t room = (uint8_t)(slave->config.max_diagnosis - 6);
    slave->diagnosis_overflow = n > room;
    slave->diagnosis_length = n > room ? room : n;
    if (n > 0)
        memcpy(slave->diagnosis, octets, slave->diagnosis_length);
    slave->ext_diag = ext_diag;
    slave->static_diag = static_diag;
    slave->announced = slave->announced || announce;
    return DPM_OK;
}

int dpm_slaves_ready(dpm_slaves *slaves, int index, bool ready)
{
    dpm_responder *slave = find(slaves, index);
    if (!slave)
        return DPM_E_ARGUMENT;
    /* In Data_Exchange the master learns of it through the diagnosis flag only. */
    slave->announced = slave->announced || (slave->ready && !ready && slave->report.state == DPM_SL_DATA_EXCH);
    slave->ready = ready;
    return DPM_OK;
}

const uint32_t *dpm_slaves_rejected(const dpm_slaves *slaves)
{
    return slaves->receiver.rejected;
}
