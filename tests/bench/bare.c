/* SPDX-License-Identifier: MIT
 *
 * What the benchmark measures the master against: the same telegrams by the shortest program that keeps the two times
 * of the bus, idle before a request (Tid1) and before an answer (min Tsdr). Its ports are opened and its waits are
 * made by the library's own port.c, so that what differs is the master's work and nothing else.
 *
 *   bare exchange COUNT RATE                      one pty of its own, both ends here
 *   bare exchange COUNT RATE INITIATOR RESPONDER  two ports of a segment
 *   bare decode COUNT                             dpm_decode over SD2 telegrams of 20 octets
 *
 * `exchange` writes int64_t to stdout: ns of the initiator's thread, ns of the whole, then COUNT durations in ns, each
 * from before its request was written to after its answer was read. `decode` writes telegrams per second as text.
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <stdalign.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "dpmaster/error.h"
#include "dpmaster/port.h"
#include "dpmaster/telegram.h"

#define OCTETS 15 /* six of data, each way */
#define LOST 1000000000 /* ns: a second without an answer means a broken set-up */

static dpm_parameters parameters;

static _Noreturn void fail(const char *what, const char *why)
{
    fprintf(stderr, "bare: %s: %s\n", what, why);
    exit(1);
}

static dpm_port *open_port(const char *path, bool paced)
{
    dpm_port_config config = {
        .path = path, .rate_num = parameters.rate_num, .rate_den = parameters.rate_den, .echo = DPM_ECHO_OFF,
        .pace = paced ? DPM_PACE_BAUD : DPM_PACE_NONE, .allowance = -1,
    };
    size_t size = (dpm_port_size() + 15) & ~(size_t)15;
    void *block = aligned_alloc(16, size);
    dpm_port *port = NULL;
    if (!block)
        fail(path, "no memory");
    memset(block, 0, size);
    int result = dpm_port_open(block, size, &config, &port);
    if (result < 0)
        fail(path, dpm_strerror(result));
    return port;
}

/* Read until a whole telegram is there: false when the other end has gone. */
static bool receive(dpm_port *port)
{
    uint8_t octets[DPM_TELEGRAM_MAX];
    size_t have = 0;
    while (have < OCTETS) {
        if (!(dpm_port_wait(port, -1, dpm_now() + LOST) & 1))
            return false;
        ssize_t n = read(dpm_port_fd(port), octets + have, sizeof octets - have);
        if (n <= 0)
            return false;
        have += (size_t)n;
    }
    return true;
}

static void hold(dpm_port *port, int64_t until)
{
    while (dpm_now() < until)
        dpm_port_wait(port, -1, until);
}

static void transmit(dpm_port *port, const uint8_t octets[OCTETS])
{
    if (write(dpm_port_fd(port), octets, OCTETS) != OCTETS)
        fail("write", strerror(errno));
}

static void encode(uint8_t octets[OCTETS], uint8_t da, uint8_t sa, uint8_t fc)
{
    static const uint8_t data[6] = {0};
    const dpm_telegram telegram = {
        .da = da, .sa = sa, .fc = fc, .dsap = DPM_NO_SAP, .ssap = DPM_NO_SAP, .dsegment = -1, .ssegment = -1,
        .length = sizeof data, .data = data,
    };
    if (dpm_encode(&telegram, octets, OCTETS) != OCTETS)
        fail("encode", "not 15 octets");
}

/* The far end of an unpaced pty, as the segment hub holds it: no port of the library, the same system calls. */
static void *respond_pty(void *context)
{
    const int fd = *(const int *)context;
    const int64_t tsdr = dpm_bits_up(&parameters, parameters.min_tsdr);
    uint8_t answer[OCTETS], octets[DPM_TELEGRAM_MAX];
    encode(answer, 1, 5, DPM_RES_DL);
    for (size_t have = 0;;) {
        struct pollfd poll = {.fd = fd, .events = POLLIN};
        ssize_t n;
        if (ppoll(&poll, 1, NULL, NULL) < 0 || (n = read(fd, octets + have, sizeof octets - have)) <= 0)
            return NULL;
        have += (size_t)n;
        if (have < OCTETS)
            continue;
        have = 0;
        for (int64_t until = dpm_now() + tsdr; dpm_now() < until;)
            ;
        if (write(fd, answer, OCTETS) != OCTETS)
            return NULL;
    }
}

static void *respond_port(void *context)
{
    dpm_port *port = context;
    const int64_t tsdr = dpm_bits_up(&parameters, parameters.min_tsdr);
    uint8_t answer[OCTETS];
    encode(answer, 1, 5, DPM_RES_DL);
    while (receive(port)) {
        hold(port, dpm_now() + tsdr);
        transmit(port, answer);
    }
    return NULL;
}

static int64_t thread_time(void)
{
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void initiate(dpm_port *port, size_t count)
{
    const int64_t tid1 = dpm_bits_up(&parameters, dpm_tid1(&parameters));
    int64_t *result = malloc((count + 2) * sizeof *result);
    uint8_t request[OCTETS];
    if (!result)
        fail("exchange", "no memory");
    encode(request, 5, 1, DPM_FC_REQUEST | DPM_FC_FCV | DPM_SRD_HIGH);
    hold(port, dpm_now() + tid1);
    const int64_t cpu = thread_time(), begin = dpm_now();
    for (size_t i = 0; i < count; i++) {
        const int64_t start = dpm_now();
        transmit(port, request);
        if (!receive(port))
            fail("exchange", "no answer");
        const int64_t end = dpm_now();
        result[2 + i] = end - start;
        hold(port, end + tid1);
    }
    result[0] = thread_time() - cpu;
    result[1] = dpm_now() - begin;
    fwrite(result, sizeof *result, count + 2, stdout);
    free(result);
}

static void exchange(size_t count, const char *initiator, const char *responder)
{
    pthread_t thread;
    dpm_port *port;
    int fd = -1;
    if (initiator) {
        port = open_port(initiator, true);
        if (pthread_create(&thread, NULL, respond_port, open_port(responder, true)))
            fail("exchange", "no thread");
    } else {
        struct termios raw;
        fd = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
        if (fd < 0 || grantpt(fd) || unlockpt(fd) || tcgetattr(fd, &raw))
            fail("pty", strerror(errno));
        cfmakeraw(&raw);
        tcsetattr(fd, TCSANOW, &raw);
        port = open_port(ptsname(fd), false);
        if (pthread_create(&thread, NULL, respond_pty, &fd))
            fail("exchange", "no thread");
    }
    initiate(port, count);
}

static void decode(size_t count)
{
    enum { LENGTH = 20, TELEGRAMS = 64 };
    static uint8_t octets[TELEGRAMS * LENGTH];
    for (size_t i = 0; i < TELEGRAMS; i++) {
        const uint8_t data[LENGTH - 9] = {(uint8_t)i, (uint8_t)(i * 7)};
        const dpm_telegram telegram = {
            .da = (uint8_t)(i % 126), .sa = 1, .fc = DPM_RES_DL, .dsap = DPM_NO_SAP, .ssap = DPM_NO_SAP,
            .dsegment = -1, .ssegment = -1, .length = sizeof data, .data = data,
        };
        if (dpm_encode(&telegram, octets + i * LENGTH, LENGTH) != LENGTH)
            fail("decode", "not 20 octets");
    }
    unsigned sum = 0; /* printed: what is decoded is used */
    const int64_t begin = dpm_now();
    for (size_t i = 0; i < count; i++) {
        dpm_telegram telegram;
        if (dpm_decode(octets + i % TELEGRAMS * LENGTH, LENGTH, &telegram) != LENGTH)
            fail("decode", "a good telegram was refused");
        sum += telegram.data[0];
    }
    printf("%.0f %u\n", (double)count * 1e9 / (double)(dpm_now() - begin), sum);
}

int main(int argc, char **argv)
{
    const size_t count = argc > 2 ? strtoul(argv[2], NULL, 10) : 0;
    if (argc == 3 && !strcmp(argv[1], "decode"))
        decode(count);
    else if ((argc == 4 || argc == 6) && !strcmp(argv[1], "exchange") &&
             dpm_parameters_default(&parameters, (uint32_t)strtoul(argv[3], NULL, 10), 0) == 0)
        exchange(count, argc == 6 ? argv[4] : NULL, argc == 6 ? argv[5] : NULL);
    else
        fail("arguments", "exchange COUNT RATE [INITIATOR RESPONDER] | decode COUNT");
    return 0;
}
