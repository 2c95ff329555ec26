/* SPDX-License-Identifier: MIT
 *
 * The only program of the guest (see uart.py): it tries the library on UART drivers of a real kernel and prints what it
 * found on the console, a line "@subject words" for each fact. What is right is for the host to judge.
 *
 * On each port: every rate, parity, exclusive use, RS-485 mode, counters, octets, a break, the end of a transmission, and a
 * master that brings the SI-P1 on the host into Data_Exchange and lets its motor run.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/serial.h>
#include <stdalign.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mount.h>
#include <sys/reboot.h>
#include <sys/stat.h>
#include <unistd.h>

#include "dpmaster/bus.h"
#include "dpmaster/error.h"
#include "dpmaster/telegram.h"

#define MS INT64_C(1000000)
#define SECOND (1000 * MS)

enum { OCTETS = 264, SIP1 = 5, EXCHANGES = 300, RUN = 1, HZ30 = 3000 };

static const char *subject; /* the port under test, for the lines printed */

static int64_t least(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

static void *block(size_t size)
{
    void *memory = aligned_alloc(16, (size + 15) / 16 * 16);
    if (!memory)
        abort();
    return memset(memory, 0, size);
}

/* ---- one port ---- */

static int open_echoing(const char *path, uint32_t rate, int direction, int echo, dpm_port **port)
{
    dpm_parameters parameters;
    dpm_parameters_default(&parameters, rate, 0);
    dpm_port_config config = {.path = path, .rate_num = parameters.rate_num, .rate_den = parameters.rate_den,
                              .direction = direction, .echo = echo, .allowance = -1};
    return dpm_port_open(block(dpm_port_size()), dpm_port_size(), &config, port);
}

static int open_port(const char *path, uint32_t rate, int direction, dpm_port **port)
{
    return open_echoing(path, rate, direction, DPM_ECHO_AUTO, port);
}

static dpm_port_info info_of(const dpm_port *port)
{
    dpm_port_info info;
    dpm_port_get_info(port, &info);
    return info;
}

static void try_rates(const char *path)
{
    uint32_t rate;
    for (unsigned i = 0; (rate = dpm_parameters_rate(i)); i++) {
        dpm_port *port = NULL;
        int code = open_port(path, rate, DPM_DIRECTION_AUTO, &port);
        printf("@%s.rate.%u %d %u %d %s\n", subject, rate, code, code ? 0 : info_of(port).rate,
               code ? 0 : info_of(port).parity, dpm_strerror(code));
        if (!code)
            dpm_port_close(port);
    }
}

static void try_modes(const char *path, uint32_t rate)
{
    dpm_port *port, *second;
    if (open_port(path, rate, DPM_DIRECTION_AUTO, &port))
        return;
    dpm_port_info info = info_of(port);
    printf("@%s.driver %d %d %d %d\n", subject, info.drains, info.counted, info.low_latency, info.fifo_trigger);
    int code = open_port(path, rate, DPM_DIRECTION_AUTO, &second), exclusive = 0;
    (void)ioctl(dpm_port_fd(port), TIOCGEXCL, &exclusive);
    printf("@%s.second %d %d\n", subject, code, exclusive);
    dpm_port_close(port);
    for (int direction = DPM_DIRECTION_RS485; direction <= DPM_DIRECTION_RS485_INVERTED; direction++) {
        code = open_port(path, rate, direction, &port);
        printf("@%s.rs485.%d %d %d %s\n", subject, direction, code, code ? 0 : info_of(port).rs485, dpm_strerror(code));
        if (!code)
            dpm_port_close(port);
    }
}

/* A mode of the device tree's, with delays and a receiver that is on while sending, and what the library leaves of it. */
static void try_flags(const char *path, uint32_t rate)
{
    struct serial_rs485 mode = {.flags = SER_RS485_ENABLED | SER_RS485_RTS_AFTER_SEND | SER_RS485_RX_DURING_TX,
                                .delay_rts_before_send = 3, .delay_rts_after_send = 5};
    dpm_port *port;
    if (open_port(path, rate, DPM_DIRECTION_AUTO, &port))
        return;
    int code = ioctl(dpm_port_fd(port), TIOCSRS485, &mode);
    printf("@%s.mode %d %u %u %u\n", subject, code, mode.flags, mode.delay_rts_before_send, mode.delay_rts_after_send);
    dpm_port_close(port);
    for (int echo = DPM_ECHO_AUTO; !code && echo <= DPM_ECHO_ON; echo++) {
        if (open_echoing(path, rate, DPM_DIRECTION_RS485, echo, &port) || ioctl(dpm_port_fd(port), TIOCGRS485, &mode) < 0)
            continue;
        printf("@%s.mode.%d %u %u %u\n", subject, echo, mode.flags, mode.delay_rts_before_send, mode.delay_rts_after_send);
        dpm_port_close(port);
    }
}

/* A machine that keeps what it hears, what went wrong on the line, and when its own transmission ended. */
typedef struct witness {
    dpm_machine machine;
    unsigned errors;
    size_t octets;
    uint8_t heard[512];
    int64_t start;
    int64_t end_earliest;
    int64_t end_latest;
} witness;

static void on_octets(dpm_machine *machine, const dpm_span *span)
{
    witness *w = (witness *)machine;
    for (size_t i = 0; i < span->n; i++) {
        w->heard[w->octets++ % sizeof w->heard] = span->octets[i];
        w->errors |= span->errors ? span->errors[i] : 0u;
    }
}

static void on_quiet(dpm_machine *machine, int64_t until)
{
    (void)machine;
    (void)until;
}

static void on_sent(dpm_machine *machine, int64_t start, int64_t end_earliest, int64_t end_latest, int result)
{
    witness *w = (witness *)machine;
    (void)result;
    w->start = start;
    w->end_earliest = end_earliest;
    w->end_latest = end_latest;
}

#define WITNESS {.machine = {.octets = on_octets, .quiet = on_quiet, .sent = on_sent}}

static void listen_for(dpm_port *port, witness *w, size_t n)
{
    int64_t end = dpm_now() + 5 * SECOND;
    while (w->octets < n && dpm_now() < end) {
        (void)dpm_port_wait(port, -1, end);
        (void)dpm_port_read(port, &w->machine);
    }
}

/* Each octet there is: a driver that marks errors doubles a good FF. */
static void try_octets(const char *path, uint32_t rate)
{
    witness w = WITNESS;
    dpm_port *port;
    if (open_port(path, rate, DPM_DIRECTION_AUTO, &port))
        return;
    printf("@%s.wants-octets\n", subject);
    listen_for(port, &w, OCTETS);
    printf("@%s.octets %u ", subject, w.errors);
    for (size_t i = 0; i < w.octets && i < sizeof w.heard; i++)
        printf("%02x", w.heard[i]);
    printf("\n");
    dpm_port_close(port);
}

static void try_break(const char *path, uint32_t rate)
{
    witness w = WITNESS;
    dpm_port *port;
    if (open_port(path, rate, DPM_DIRECTION_AUTO, &port))
        return;
    printf("@%s.wants-break\n", subject);
    listen_for(port, &w, 1);
    dpm_port_info info = info_of(port);
    printf("@%s.break %u %zu %llu %u %u\n", subject, w.errors, w.octets, (unsigned long long)info.line_errors,
           info.driver.breaks, info.driver.parity + info.driver.framing);
    dpm_port_close(port);
}

/* Nobody has the address, so nobody answers. */
static void try_end(const char *path, uint32_t rate)
{
    witness w = WITNESS;
    uint8_t octets[10 * DPM_TELEGRAM_MAX];
    const uint8_t data[DPM_DATA_MAX] = {0};
    const dpm_telegram telegram = {.da = 120, .sa = 1, .fc = DPM_FC_REQUEST | DPM_SDN_LOW, .dsap = DPM_NO_SAP,
                                   .ssap = DPM_NO_SAP, .dsegment = -1, .ssegment = -1, .length = sizeof data, .data = data};
    dpm_port *port;
    int64_t duration = 0;
    if (open_port(path, rate, DPM_DIRECTION_AUTO, &port))
        return;
    const int64_t character = SECOND * DPM_CHARACTER_BITS / rate;
    (void)dpm_port_write(port, &w.machine, (const uint8_t[]){0xDC, 120, 1}, 3);
    printf("@%s.end %lld %lld %lld\n", subject, (long long)(3 * character), (long long)(w.end_earliest - w.start),
           (long long)(w.end_latest - w.start));
    size_t n = 0;
    while (n + DPM_TELEGRAM_MAX <= sizeof octets)
        n += (size_t)dpm_encode(&telegram, octets + n, sizeof octets - n);
    int code = dpm_port_measure(port, octets, n, 20 * SECOND, &duration);
    printf("@%s.measure %d %lld %lld\n", subject, code, (long long)((int64_t)n * character), (long long)duration);
    dpm_port_close(port);
}

/* ---- the master ---- */

static dpm_image *image(void)
{
    return dpm_image_init(block(dpm_image_size()), dpm_image_size());
}

static int start_master(dpm_bus *bus, uint32_t rate, dpm_outputs *outputs, dpm_image *inputs)
{
    dpm_master *master;
    dpm_master_config config = {.station = {.address = 1}, .slaves = 1, .data_control_time = SECOND};
    /* The manual's ident number and "Basic data", three words each way; a watchdog of 5 s. */
    dpm_slave_set set = {.address = SIP1, .ident_number = 0x00CA, .configuration = {0x72}, .configuration_length = 1,
                         .wd_fact_1 = 10, .wd_fact_2 = 50, .min_tsdr = 11, .min_slave_interval = 1, .active = true};
    dpm_parameters_default(&config.station.parameters, rate, 0);
    dpm_bus_get_traits(bus, &config.station.traits);
    int code = dpm_master_init(block(dpm_master_size(1)), dpm_master_size(1), &config, &master);
    if (!code)
        code = dpm_bus_start(bus, dpm_master_machine(master), master);
    if (!code)
        code = dpm_bus_add(bus, &set, outputs, inputs);
    return code ? code : dpm_bus_set_mode(bus, DPM_MODE_OPERATE);
}

static uint64_t exchanges(dpm_bus *bus)
{
    dpm_slave_status status;
    return dpm_bus_get_slave(bus, 0, &status) ? 0 : status.statistics.exchanges;
}

static bool await_exchanges(dpm_bus *bus, uint64_t n, int64_t time)
{
    int64_t end = dpm_now() + time;
    while (exchanges(bus) < n && dpm_now() < end)
        (void)dpm_bus_wait(bus, dpm_bus_progress(bus), SECOND / 10);
    return exchanges(bus) >= n;
}

/* Words of the fast area, high octet first: command (bit 0 runs forward), frequency reference in 0.01 Hz. */
static void commit(dpm_outputs *outputs, uint16_t command, uint16_t frequency)
{
    const uint8_t octets[6] = {(uint8_t)(command >> 8), (uint8_t)command, (uint8_t)(frequency >> 8), (uint8_t)frequency};
    (void)dpm_outputs_commit(outputs, 0, octets, sizeof octets, dpm_now());
}

static int compare(const void *a, const void *b)
{
    const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

static void tell_times(int64_t *durations, size_t n)
{
    int64_t sum = 0;
    qsort(durations, n, sizeof *durations, compare);
    while (n && !*durations) { /* a repeated request was not recorded */
        durations++;
        n--;
    }
    for (size_t i = 0; i < n; i++)
        sum += durations[i];
    if (n)
        printf("@%s.exchange %zu %lld %lld %lld %lld\n", subject, n, (long long)(sum / (int64_t)n), (long long)durations[0],
               (long long)durations[n / 2], (long long)durations[n - 1]);
}

/* At rest until the drive's card is up, then 30 Hz for so long that the host can look at the motor, then stop. */
static void turn_motor(dpm_bus *bus, dpm_outputs *outputs, dpm_image *inputs, unsigned count)
{
    static int64_t durations[EXCHANGES];
    dpm_realtime wish = {.priority = 40, .cpu = -1, .lock = true};
    dpm_refusals refusals;
    dpm_slave_status slave;
    dpm_bus_info info;
    int code = dpm_bus_realtime(bus, &wish, &refusals);
    printf("@%s.realtime %d %d %d\n", subject, code, refusals.priority, refusals.lock);
    bool data = await_exchanges(bus, 20, 20 * SECOND);
    (void)dpm_bus_record(bus, durations, count);
    commit(outputs, RUN, HZ30);
    bool ran = await_exchanges(bus, exchanges(bus) + count, 20 * SECOND);
    (void)dpm_bus_record(bus, NULL, 0);
    const dpm_frame *frame = dpm_image_get(inputs);
    printf("@%s.running %d %d %02x%02x\n", subject, data, ran, frame->octets[0], frame->octets[1]);
    await_exchanges(bus, UINT64_MAX, SECOND);
    commit(outputs, 0, 0);
    await_exchanges(bus, exchanges(bus) + 20, 5 * SECOND);
    if (ran)
        tell_times(durations, count);
    (void)dpm_bus_get_slave(bus, 0, &slave);
    (void)dpm_bus_get_info(bus, &info);
    printf("@%s.master %d %llu %llu %llu %llu\n", subject, slave.state, (unsigned long long)slave.statistics.exchanges,
           (unsigned long long)slave.statistics.losses, (unsigned long long)slave.statistics.unanswered,
           (unsigned long long)info.port.line_errors);
}

static void try_master(const char *path, uint32_t rate, int direction, unsigned count)
{
    dpm_parameters parameters;
    dpm_bus *bus;
    dpm_parameters_default(&parameters, rate, 0);
    /* Two emulations and a loaded host lie between here and the card: any answer counts that comes at all. */
    dpm_port_config config = {.path = path, .rate_num = parameters.rate_num, .rate_den = parameters.rate_den,
                              .direction = direction, .allowance = SECOND / 4};
    dpm_outputs *outputs = dpm_outputs_init(block(dpm_outputs_size()), dpm_outputs_size(), 6);
    dpm_image *inputs = image();
    int code = dpm_bus_open(block(dpm_bus_size()), dpm_bus_size(), &config, &bus);
    if (!code)
        code = start_master(bus, rate, outputs, inputs);
    printf("@%s.start %d\n", subject, code);
    if (code)
        return;
    turn_motor(bus, outputs, inputs, count);
    (void)dpm_bus_set_mode(bus, DPM_MODE_OFFLINE);
    int64_t end = dpm_now() + 2 * SECOND;
    dpm_master_status status = {.mode = DPM_MODE_OPERATE};
    while (!dpm_bus_get_status(bus, &status) && status.mode && dpm_now() < end)
        (void)dpm_bus_wait(bus, dpm_bus_progress(bus), least(end - dpm_now(), SECOND / 10));
    dpm_bus_close(bus);
}

/* ---- the guest ---- */

static void try_port(const char *name, const char *path, uint32_t rate, int direction, unsigned count)
{
    subject = name;
    try_rates(path);
    try_modes(path, rate);
    try_flags(path, rate);
    try_octets(path, rate);
    try_break(path, rate);
    try_end(path, rate);
    try_master(path, rate, direction, count);
}

int main(void)
{
    mkdir("/dev", 0755);
    mkdir("/sys", 0755);
    if (mount("dev", "/dev", "devtmpfs", 0, NULL) || mount("sys", "/sys", "sysfs", 0, NULL))
        return 1;
    int console = open("/dev/console", O_RDWR);
    for (int fd = 0; fd < 3; fd++)
        dup2(console, fd);
    setvbuf(stdout, NULL, _IOLBF, 0);
    printf("@up %lld\n", (long long)dpm_now());
    try_port("pl011", "/dev/ttyAMA0", 500000, DPM_DIRECTION_RS485, EXCHANGES);
    try_port("16550", "/dev/ttyS1", 19200, DPM_DIRECTION_AUTO, 60);
    printf("@done %lld\n", (long long)dpm_now());
    fflush(stdout);
    usleep(100000); /* the console's FIFO */
    reboot(RB_POWER_OFF);
    return 0;
}
