/* SPDX-License-Identifier: MIT
 *
 * Serial ports and ptys: settings, reading with times, echo, writing, waiting. It may touch its own descriptor and
 * the clock; it keeps no thread and calls nobody but the machine it is given.
 */
#include "linux/port.h"

#include <asm/termbits.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <linux/serial.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <time.h>
#include <unistd.h>

#include "dpmaster/error.h"
#include "dpmaster/telegram.h"
#include "linux/marks.h"

enum {
    CHUNK = 512,           /* octets read at once: more than the longest telegram */
    ECHO_MAX = 256,        /* no telegram is longer than 255 octets */
    ECHOES = 4             /* transmissions whose echo an adapter may still have: two tokens to oneself, a request, and one more */
};

/* The end of a wait is spun, for the kernel wakes some tens of microseconds late even with the timer slack gone. */
#define SPIN INT64_C(40000)
/* Longer waits end without a spin: time-outs, idle bus, the next cycle are no matter of microseconds, and a spin for
 * each of them would cost more than the exchange. */
#define SHORT INT64_C(250000)
/* In the last bit of it even a look at the descriptors takes too long; they are looked at once more when it is over. */
#define LAST INT64_C(5000)

/* The end of a longer transmission is computed: at the rates where there are such, that is exact to a fraction of a bit,
 * and the thread stays free. */
#define MEASURED INT64_C(2000000)
/* A FIFO that has not reached its trigger hands over after four characters' silence. Where that is longer than this, the
 * first octet raises an interrupt; where it is not, an interrupt for each octet would cost more than it wins. */
#define FIFO_WAIT INT64_C(200000)

/* What the host may be late, by the kind of port. These are starting values for an idle desktop or a Raspberry Pi; a
 * program that has measured its own gives dpm_port_config.allowance. */
static const dpm_port_traits profiles[] = {
    [DPM_PROFILE_UART] = {INT64_C(2000000), INT64_C(2000000), 0, false},   /* receive FIFO time-out, flip buffer, wake-up */
    [DPM_PROFILE_USB] = {INT64_C(20000000), INT64_C(18000000), 0, false}, /* 16 ms latency timer, 1 ms frames each way */
    [DPM_PROFILE_PTY] = {INT64_C(25000000), INT64_C(5000000), 0, false},   /* wake-up of two processes under load */
};

/* Linux 6.8, where the headers may be older: with ENABLED it makes the port an RS-422 one, whose transmitter never leaves
 * the line, and the levels of RTS are dropped. */
#define MODE_RS422 (1u << 9)

/* A transmission of ours, while its echo may come. */
typedef struct transmission {
    uint8_t octets[ECHO_MAX];
    size_t length;
    int64_t end;
    int64_t due;           /* what is not here by now does not come */
} transmission;

/* Who does not know of the echo yet has not waited for it, so it may come behind the next transmissions. */
typedef struct echo_filter {
    transmission sent[ECHOES]; /* the oldest first, to which the octets heard belong */
    size_t waiting;        /* 0: no echo is looked for */
    size_t held;           /* octets heard that may be it; held back until the verdict */
    size_t equal;          /* how many of them are as they were sent */
    uint8_t heard[ECHO_MAX];
    uint8_t errors[ECHO_MAX];
    bool expected;         /* told so, or found */
    int64_t earliest;      /* of the octets held */
    int64_t latest;
} echo_filter;

/* Which symbolic link led to a pty; all zeros when none did. */
typedef struct link_mark {
    ino_t inode;
    struct timespec changed;
} link_mark;

struct dpm_port {
    int fd;                /* -1: closed, or vanished */
    dev_t device;
    dpm_port_config config;
    dpm_port_info info;
    bool pty;
    bool exclusive;        /* TIOCEXCL is ours */
    bool marked;           /* the driver marks errors; behind a pty, the segment hub */
    bool paced;            /* a transmission takes its characters' time */
    int64_t character;     /* ns of one character at the rate */
    int64_t spacing;       /* ns between octets read in one go */
    int64_t lag;           /* ns that octets may lie unseen in a FIFO */
    struct serial_icounter_struct counted; /* by the driver, before the port was ours */
    dpm_marks marks;
    echo_filter echo;
    link_mark link;
    char path[PATH_MAX];
    uint8_t raw[CHUNK];
    uint8_t octets[CHUNK + 2];
    uint8_t errors[CHUNK + 2];
};

int64_t dpm_now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

/* ---- opening ---- */

static int open_error(int code)
{
    switch (code) {
    case ENOENT: case ENOTDIR: case ENXIO: case ENODEV: case EIO: case ENAMETOOLONG: case ELOOP:
        return DPM_E_NO_PORT;
    case EACCES: case EPERM: case EROFS:
        return DPM_E_PERMISSION;
    case EBUSY: case EWOULDBLOCK:
        return DPM_E_IN_USE;
    case EISDIR: case ENOTTY: case EINVAL:
        return DPM_E_NOT_TTY;
    default:
        return DPM_E_SYSTEM;
    }
}

/* Documentation/admin-guide/devices.txt: 136..143 are the slave ends of ptys, 166 and 188 USB serial adapters. */
static int detect_profile(dev_t device)
{
    unsigned type = major(device);
    if (type >= 136 && type <= 143)
        return DPM_PROFILE_PTY;
    return type == 166 || type == 188 ? DPM_PROFILE_USB : DPM_PROFILE_UART;
}

/* Of 500/11 kbit/s no more than the whole: a driver that cuts its divisor off would make 3 % more of a bit too much. */
static uint32_t nominal_rate(const dpm_port_config *config)
{
    return config->rate_num / config->rate_den;
}

/* Whether the kernel's driver of the port has one of these names. Since Linux 6.5 two devices of the serial core lie between
 * the port and the device that the driver drives. */
static bool driven_by(const dpm_port *port, const char *const *names)
{
    static const char *const above[] = {"", "/..", "/../.."};
    for (size_t i = 0; i < sizeof above / sizeof *above; i++) {
        char path[64], target[PATH_MAX];
        (void)snprintf(path, sizeof path, "/sys/dev/char/%u:%u/device%s/driver", major(port->device), minor(port->device),
                       above[i]);
        ssize_t n = readlink(path, target, sizeof target - 1);
        target[n < 0 ? 0 : n] = '\0';
        const char *slash = strrchr(target, '/');
        for (size_t j = 0; slash && names[j]; j++)
            if (!strcmp(slash + 1, names[j]))
                return true;
    }
    return false;
}

/* The rate behind the one that the driver says. The plain 8250 and the SC16IS7xx divide their clock by a whole number, rounded
 * or cut off, and yet tell what they were asked for; other drivers tell what they make, or nothing that could be computed. */
static uint32_t real_rate(const dpm_port *port, uint32_t told)
{
    static const char *const rounding[] = {"serial8250", "serial", "of_serial", NULL}, *const cutting[] = {"sc16is7xx", NULL};
    const bool rounds = driven_by(port, rounding);
    struct serial_struct serial;
    memset(&serial, 0, sizeof serial);
    if (port->pty || !told || !(rounds || driven_by(port, cutting)) || ioctl(port->fd, TIOCGSERIAL, &serial) < 0 ||
        serial.baud_base <= 0)
        return told;
    uint32_t base = (uint32_t)serial.baud_base, divisor = (base + (rounds ? told / 2 : 0)) / told;
    return divisor ? base / divisor : base;
}

/* The mini UART of the Raspberry Pi takes every setting and has no parity. */
static bool keeps_parity(const dpm_port *port, tcflag_t flags)
{
    static const char *const without[] = {"bcm2835-aux-uart", NULL};
    return (flags & (PARENB | PARODD)) == PARENB && !driven_by(port, without);
}

/* 8E1, raw, at the rate; then see what the driver made of it: some change silently what they cannot do. */
static int set_line(dpm_port *port)
{
    struct termios2 line;
    uint32_t rate = nominal_rate(&port->config);
    if (ioctl(port->fd, TCGETS2, &line) < 0)
        return open_error(errno);
    line.c_iflag = port->pty ? 0 : INPCK | PARMRK; /* on a pty the kernel would double the hub's marks */
    line.c_oflag = 0;
    line.c_lflag = 0;
    line.c_cflag = CS8 | PARENB | CREAD | CLOCAL | BOTHER | BOTHER << IBSHIFT;
    line.c_ispeed = line.c_ospeed = rate;
    line.c_cc[VMIN] = 1; /* an empty read is EAGAIN then, and 0 means that the line hung up */
    line.c_cc[VTIME] = 0;
    if (ioctl(port->fd, TCSETS2, &line) < 0 || ioctl(port->fd, TCGETS2, &line) < 0)
        return errno == EINVAL ? DPM_E_SETTINGS : open_error(errno);
    uint32_t real = real_rate(port, line.c_ospeed);
    port->info.rate = real;
    port->info.parity = keeps_parity(port, line.c_cflag);
    if ((real > rate ? real - rate : rate - real) * UINT64_C(1000) > rate * UINT64_C(3))
        return DPM_E_RATE; /* EN 50170: the rate is kept within 0.3 % */
    if ((line.c_cflag & CSIZE) != CS8 || (line.c_cflag & (CSTOPB | CRTSCTS)))
        return DPM_E_SETTINGS;
    return port->info.parity || port->pty ? DPM_OK : DPM_E_SETTINGS;
}

/* Only what is meant is set; a termination that the device tree has switched on stays. Delays are whole milliseconds,
 * longer than a slot time: none. Whether the receiver is on while sending stays, too, unless it was said whether there is an
 * echo: one that is expected and never comes is a deaf port, one that is not would be somebody's telegram. Some drivers
 * take what they cannot do, and some stay in RS-422 mode. */
static int set_direction(dpm_port *port)
{
    const uint32_t levels = SER_RS485_RTS_ON_SEND | SER_RS485_RTS_AFTER_SEND;
    const uint32_t kind = SER_RS485_ENABLED | MODE_RS422;
    struct serial_rs485 mode;
    memset(&mode, 0, sizeof mode);
    const bool known = ioctl(port->fd, TIOCGRS485, &mode) == 0;
    struct serial_rs485 before = mode;
    if (port->config.direction == DPM_DIRECTION_AUTO) {
        port->info.rs485 = known && (mode.flags & kind) == SER_RS485_ENABLED;
        return DPM_OK;
    }
    const uint32_t level = port->config.direction == DPM_DIRECTION_RS485 ? SER_RS485_RTS_ON_SEND : SER_RS485_RTS_AFTER_SEND;
    mode.flags = (mode.flags & ~(levels | kind)) | SER_RS485_ENABLED | level;
    if (port->config.echo == DPM_ECHO_ON)
        mode.flags |= SER_RS485_RX_DURING_TX;
    if (port->config.echo == DPM_ECHO_OFF)
        mode.flags &= ~(uint32_t)SER_RS485_RX_DURING_TX;
    mode.delay_rts_before_send = mode.delay_rts_after_send = 0;
    if (ioctl(port->fd, TIOCSRS485, &mode) < 0 || ioctl(port->fd, TIOCGRS485, &mode) < 0)
        return errno == EPERM || errno == EACCES ? DPM_E_PERMISSION : DPM_E_RS485;
    port->info.rs485 = (mode.flags & (kind | levels)) == (SER_RS485_ENABLED | level);
    if (!port->info.rs485) /* the wrong level would keep the transceiver sending */
        (void)ioctl(port->fd, TIOCSRS485, &before);
    return port->info.rs485 ? DPM_OK : DPM_E_RS485;
}

/* Drivers that gather octets deliver them at once, where they know how. */
static void ask_low_latency(dpm_port *port)
{
    struct serial_struct serial;
    memset(&serial, 0, sizeof serial);
    if (ioctl(port->fd, TIOCGSERIAL, &serial) < 0)
        return;
    serial.flags |= (int)ASYNC_LOW_LATENCY;
    (void)ioctl(port->fd, TIOCSSERIAL, &serial);
    port->info.low_latency = ioctl(port->fd, TIOCGSERIAL, &serial) == 0 && (serial.flags & (int)ASYNC_LOW_LATENCY);
}

/* The 8250's receive FIFO; its file is root's, so an ordinary user only learns what is set (see the udev rule). */
static void set_fifo_trigger(dpm_port *port)
{
    char path[64], text[16] = "";
    (void)snprintf(path, sizeof path, "/sys/dev/char/%u:%u/rx_trig_bytes", major(port->device), minor(port->device));
    if (4 * port->character > FIFO_WAIT) {
        int fd = open(path, O_WRONLY | O_CLOEXEC);
        ssize_t written = fd < 0 ? 0 : write(fd, "1", 1);
        (void)written; /* what came of it is read below */
        if (fd >= 0)
            close(fd);
    }
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return;
    if (read(fd, text, sizeof text - 1) > 0)
        port->info.fifo_trigger = atoi(text);
    close(fd);
}

/* TIOCSER_TEMT: FIFO and shift register are empty. */
static bool transmitter_empty(int fd)
{
    unsigned state = 0;
    return ioctl(fd, TIOCSERGETLSR, &state) == 0 && (state & TIOCSER_TEMT);
}

/* What a driver of a real UART offers beyond its line. An adapter's answer would come over USB, later than it matters. */
static void ask_driver(dpm_port *port)
{
    ask_low_latency(port);
    port->info.drains = port->info.profile == DPM_PROFILE_UART && transmitter_empty(port->fd);
    port->info.counted = ioctl(port->fd, TIOCGICOUNT, &port->counted) == 0;
    set_fifo_trigger(port);
}

/* The lock ends with its holder, however that dies. TIOCEXCL does so only where the last close resets it: a hub holds
 * its ptys open, and the flag of a dead client would shut everybody out. */
static int lock_port(dpm_port *port)
{
    int taken = 0;
    if (flock(port->fd, LOCK_EX | LOCK_NB) < 0)
        return open_error(errno);
    if (port->pty)
        return DPM_OK;
    if (ioctl(port->fd, TIOCGEXCL, &taken) == 0 && taken)
        return DPM_E_IN_USE; /* root was let in all the same */
    port->exclusive = ioctl(port->fd, TIOCEXCL) == 0;
    return DPM_OK;
}

static void close_fd(dpm_port *port)
{
    if (port->fd < 0)
        return;
    if (port->exclusive)
        (void)ioctl(port->fd, TIOCNXCL);
    port->exclusive = false;
    /* By hand: a forked child may still hold the descriptor. */
    (void)dpm_pty_claim(port->fd, DPM_PTY_READS_MARKS, false);
    (void)flock(port->fd, LOCK_UN);
    close(port->fd);
    port->fd = -1;
}

int dpm_profile_traits(int profile, dpm_port_traits *traits)
{
    if (profile <= DPM_PROFILE_AUTO || profile > DPM_PROFILE_PTY || !traits)
        return DPM_E_ARGUMENT;
    *traits = profiles[profile];
    return DPM_OK;
}

static int64_t character_time(uint32_t rate_num, uint32_t rate_den)
{
    return (INT64_C(11000000000) * rate_den + rate_num - 1) / rate_num;
}

int64_t dpm_pty_delivery(uint32_t rate_num, uint32_t rate_den)
{
    return DPM_TELEGRAM_MAX * character_time(rate_num, rate_den);
}

/* What follows from the kind of port. */
static void set_kind(dpm_port *port)
{
    int kind = detect_profile(port->device);
    int profile = port->config.profile ? port->config.profile : kind;
    port->pty = kind == DPM_PROFILE_PTY;
    port->paced = !port->pty || port->config.pace == DPM_PACE_BAUD;
    port->spacing = port->pty ? 0 : port->character;
    port->info.profile = profile;
    port->info.traits = profiles[profile];
    /* A paced hub hands over a telegram when its last octet would have ended, so nothing of an answer is there sooner. */
    if (port->pty && port->config.pace != DPM_PACE_NONE)
        port->info.traits.delivery = dpm_pty_delivery(port->config.rate_num, port->config.rate_den);
    port->info.traits.echo = port->config.echo == DPM_ECHO_ON;
    if (port->config.allowance >= 0)
        port->info.traits.allowance = port->config.allowance;
    port->lag = profile == DPM_PROFILE_PTY ? 0 : port->info.traits.granularity;
}

static void forget_echo(dpm_port *port)
{
    port->echo.waiting = port->echo.held = port->echo.equal = 0;
}

static int open_line(dpm_port *port)
{
    struct stat status;
    struct termios2 line;
    port->fd = open(port->path, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (port->fd < 0)
        return open_error(errno);
    if (fstat(port->fd, &status) < 0 || ioctl(port->fd, TCGETS2, &line) < 0)
        return open_error(errno);
    port->device = status.st_rdev;
    set_kind(port);
    int code = lock_port(port);
    if (code)
        return code;
    code = set_line(port);
    if (!code)
        code = set_direction(port);
    if (code) {
        (void)ioctl(port->fd, TCSETS2, &line); /* it may be somebody's console */
        return code;
    }
    if (!port->pty)
        ask_driver(port);
    port->marked = !port->pty ||
                   (dpm_pty_claimed(port->fd, DPM_PTY_WRITES_MARKS) && dpm_pty_claim(port->fd, DPM_PTY_READS_MARKS, true));
    (void)ioctl(port->fd, TCFLSH, TCIFLUSH); /* what others wrote before is on its way: it is not ours to take back */
    port->marks.seen = 0;
    forget_echo(port);
    return DPM_OK;
}

static link_mark mark_link(const char *path)
{
    struct stat status;
    link_mark mark;
    memset(&mark, 0, sizeof mark);
    if (lstat(path, &status) == 0 && S_ISLNK(status.st_mode)) {
        mark.inode = status.st_ino;
        mark.changed = status.st_ctim;
    }
    return mark;
}

static bool same_link(const link_mark *a, const link_mark *b)
{
    return a->inode == b->inode && a->changed.tv_sec == b->changed.tv_sec && a->changed.tv_nsec == b->changed.tv_nsec;
}

static int open_path(dpm_port *port)
{
    int code = open_line(port);
    int why = errno;
    if (code)
        close_fd(port);
    else
        port->link = mark_link(port->path);
    errno = why;
    return code;
}

void dpm_port_lose(dpm_port *port)
{
    close_fd(port);
}

int dpm_port_reopen(dpm_port *port)
{
    /* The number of a pty goes to the next who asks, which may be somebody's terminal: only a link that was made anew
     * since is a promise that the port is back. */
    if (port->pty) {
        link_mark now = mark_link(port->path);
        if (!now.inode || same_link(&now, &port->link))
            return DPM_E_NO_PORT;
    }
    return open_path(port);
}

size_t dpm_port_size(void)
{
    return sizeof(dpm_port);
}

int dpm_port_open(void *block, size_t size, const dpm_port_config *config, dpm_port **out)
{
    if (!block || size < sizeof(dpm_port) || (uintptr_t)block % 16)
        return DPM_E_BLOCK;
    /* Of a rate below 1 bit/s nothing would be left, and to set nothing is to hang up (B0). */
    if (!config->path || !config->rate_den || config->rate_num < config->rate_den || config->profile < DPM_PROFILE_AUTO ||
        config->profile > DPM_PROFILE_PTY || config->echo < DPM_ECHO_AUTO || config->echo > DPM_ECHO_ON ||
        config->pace < DPM_PACE_AUTO || config->pace > DPM_PACE_BAUD ||
        config->direction < DPM_DIRECTION_AUTO || config->direction > DPM_DIRECTION_RS485_INVERTED)
        return DPM_E_ARGUMENT;
    size_t length = strlen(config->path);
    if (length >= PATH_MAX)
        return DPM_E_NO_PORT;
    dpm_port *port = block;
    memset(port, 0, sizeof *port);
    memcpy(port->path, config->path, length + 1);
    port->config = *config;
    port->config.path = port->path;
    port->character = character_time(config->rate_num, config->rate_den);
    port->echo.expected = config->echo == DPM_ECHO_ON;
    int code = open_path(port);
    if (!code)
        *out = port;
    return code;
}

void dpm_port_close(dpm_port *port)
{
    close_fd(port);
}

int dpm_port_fd(const dpm_port *port)
{
    return port->fd;
}

void dpm_port_get_info(const dpm_port *port, dpm_port_info *info)
{
    const struct serial_icounter_struct *then = &port->counted;
    struct serial_icounter_struct now;
    *info = port->info;
    if (!info->counted || ioctl(port->fd, TIOCGICOUNT, &now) < 0)
        return;
    info->driver.parity = (uint32_t)(now.parity - then->parity);
    info->driver.framing = (uint32_t)(now.frame - then->frame);
    info->driver.breaks = (uint32_t)(now.brk - then->brk);
    info->driver.overruns = (uint32_t)(now.overrun - then->overrun);
    info->driver.buffer_overruns = (uint32_t)(now.buf_overrun - then->buf_overrun);
}

/* ---- receiving ---- */

/* The last of `n` octets had come at `read`, the others a character before each other. How long they had lain in FIFO
 * and kernel by then, only the port's granularity bounds: an empty read or a wait before proves nothing closer, since
 * neither tells when in a long silence they came. */
static void give(dpm_port *port, dpm_machine *machine, const uint8_t *octets, const uint8_t *errors, size_t n,
                 int64_t earliest, int64_t read, bool echo)
{
    int64_t latest = read - (int64_t)(n - 1) * port->spacing;
    dpm_span span = {octets, errors, n, earliest < latest ? earliest : latest, latest, port->spacing, echo};
    machine->octets(machine, &span);
}

/* The verdict on what was held back: our echo, spoilt or not, if most of it is as it was sent; else it is somebody's
 * telegram. Where an echo was due, anything but a whole one is a collision or a short. */
static void release(dpm_port *port, dpm_machine *machine)
{
    echo_filter *echo = &port->echo;
    const size_t held = echo->held, equal = echo->equal, length = echo->sent[0].length;
    const bool ours = equal == length || (echo->expected && 2 * equal > length);
    port->info.echo_octets += ours ? equal : 0;
    port->info.echo_errors += echo->expected && equal < length;
    echo->expected |= ours;
    if (equal == length) {
        port->info.echoes++;
        port->info.echo_late = echo->latest - echo->sent[0].end;
    }
    echo->waiting--;
    echo->held = echo->equal = 0;
    memmove(echo->sent, echo->sent + 1, echo->waiting * sizeof *echo->sent);
    if (held)
        give(port, machine, echo->heard, echo->errors, held, echo->earliest, echo->latest, ours);
}

/* Take of `n` octets, from the one at `i`, what may be the echo of our oldest transmission; returns where that ends. An octet
 * that differs ends it, unless the echo is known to come and has begun. */
static size_t take_echo(dpm_port *port, dpm_machine *machine, size_t i, size_t n, int64_t earliest, int64_t read)
{
    echo_filter *echo = &port->echo;
    for (; i < n && echo->held < echo->sent[0].length; i++, echo->held++) {
        const bool equal = port->octets[i] == echo->sent[0].octets[echo->held] && !port->errors[i];
        if (!equal && !(echo->expected && echo->held))
            break;
        if (!echo->held)
            echo->earliest = earliest + (int64_t)i * port->spacing;
        echo->latest = read - (int64_t)(n - 1 - i) * port->spacing;
        echo->equal += equal;
        echo->heard[echo->held] = port->octets[i];
        echo->errors[echo->held] = port->errors[i];
    }
    if (echo->held == echo->sent[0].length || i < n)
        release(port, machine);
    return i;
}

static void take_octets(dpm_port *port, dpm_machine *machine, size_t n)
{
    int64_t read = dpm_now();
    const uint8_t *errors = NULL;
    if (port->marked) {
        n = dpm_unmark(&port->marks, port->raw, n, port->octets, port->errors);
        for (size_t i = 0; i < n; i++) {
            if (port->errors[i]) {
                port->info.line_errors++;
                errors = port->errors;
            }
        }
    } else {
        memcpy(port->octets, port->raw, n);
    }
    if (n == 0)
        return; /* the first part of a mark */
    port->info.octets_in += n;
    int64_t earliest = read - (int64_t)(n - 1) * port->spacing - port->info.traits.granularity;
    size_t taken = 0;
    while (taken < n && port->echo.waiting)
        taken = take_echo(port, machine, taken, n, earliest, read);
    if (taken < n)
        give(port, machine, port->octets + taken, errors ? errors + taken : NULL, n - taken, earliest, read, false);
}

/* Nothing is unread. While an echo is half here its octets are held, and nothing is said about the line. */
static void report_quiet(dpm_port *port, dpm_machine *machine, int64_t before)
{
    if (port->echo.held) {
        if (before < port->echo.sent[0].due)
            return;
        release(port, machine);
    }
    machine->quiet(machine, before - port->lag);
}

int dpm_port_read(dpm_port *port, dpm_machine *machine)
{
    ssize_t n;
    int64_t before;
    do {
        before = dpm_now();
        n = read(port->fd, port->raw, CHUNK);
    } while (n < 0 && errno == EINTR);
    if (n > 0)
        take_octets(port, machine, (size_t)n);
    else if (n < 0 && errno == EAGAIN)
        report_quiet(port, machine, before);
    else
        return DPM_E_GONE;
    return n > 0 ? (int)n : 0;
}

/* ---- waiting ---- */

static int poll_for(struct pollfd fds[2], int64_t time)
{
    struct timespec timeout = {(time_t)(time / 1000000000), (long)(time % 1000000000)};
    if (ppoll(fds, 2, &timeout, NULL) <= 0)
        return 0;
    return (fds[0].revents ? 1 : 0) | (fds[1].revents ? 2 : 0);
}

/* As dpm_port_wait, on any two descriptors; -1 is none. */
static int wait_for(int fd, int wake_fd, int64_t deadline)
{
    struct pollfd fds[2] = {{fd, POLLIN, 0}, {wake_fd, POLLIN, 0}};
    const int64_t spin = deadline - dpm_now() < SHORT ? SPIN : 0;
    for (;;) {
        int64_t left = deadline - dpm_now();
        while (left > 0 && left < LAST)
            left = deadline - dpm_now();
        /* An hour at most, so that the time fits wherever time_t is small; the loop goes on. */
        int64_t sleep = left - spin > INT64_C(3600000000000) ? INT64_C(3600000000000) : left - spin;
        int mask = poll_for(fds, sleep > 0 ? sleep : 0);
        if (mask || left <= 0)
            return mask;
    }
}

int dpm_port_wait(dpm_port *port, int wake_fd, int64_t deadline)
{
    return wait_for(port->fd, wake_fd, deadline);
}

/* ---- sending ---- */

static void expect_echo(dpm_port *port, const uint8_t *octets, size_t n, int64_t end)
{
    if (port->config.echo == DPM_ECHO_OFF)
        return;
    transmission *sent = &port->echo.sent[port->echo.waiting++];
    memcpy(sent->octets, octets, n);
    sent->length = n;
    sent->end = end;
    sent->due = end + port->info.traits.allowance;
}

/* Of those whose echo does not come any more there is a verdict before the next transmission. */
static void end_echoes(dpm_port *port, dpm_machine *machine, int64_t now)
{
    const echo_filter *echo = &port->echo;
    while (echo->waiting && (port->config.echo == DPM_ECHO_ON || echo->waiting == ECHOES || now > echo->sent[0].due))
        release(port, machine);
}

/* Ask the driver for the end of a transmission. The thread has nothing else to do meanwhile: the line is ours. */
static void await_end(dpm_port *port, int64_t *earliest, int64_t *latest)
{
    const int64_t limit = *latest + port->info.traits.allowance;
    for (int64_t look = *earliest;; look = dpm_now() + port->character) {
        (void)wait_for(-1, -1, look);
        int64_t before = dpm_now();
        bool empty = transmitter_empty(port->fd);
        *latest = dpm_now();
        port->info.drains = empty || before < limit; /* one that never tells is not asked again */
        if (empty || !port->info.drains)
            return;
        *earliest = before;
    }
}

int dpm_port_write(dpm_port *port, dpm_machine *machine, const uint8_t *octets, size_t n)
{
    if (n == 0 || n > ECHO_MAX)
        return DPM_E_LENGTH;
    if (port->echo.held) {
        release(port, machine);
        return DPM_OK; /* it was no echo and may revoke the offer: the machine is asked again */
    }
    int64_t start = dpm_now();
    end_echoes(port, machine, start);
    ssize_t written = write(port->fd, octets, n);
    int why = errno;
    int64_t end_earliest = dpm_now(), end_latest = end_earliest;
    if (written <= 0) {
        machine->sent(machine, start, end_earliest, end_latest, DPM_SENT_FAILED);
        return written < 0 && (why == EAGAIN || why == EINTR) ? DPM_OK : DPM_E_GONE;
    }
    int64_t duration = (int64_t)written * port->character;
    if (port->paced) {
        /* The first start bit went out while write was under way. */
        end_earliest = start + duration;
        end_latest += duration;
        if (port->info.drains && duration <= MEASURED)
            await_end(port, &end_earliest, &end_latest);
    } else if (port->config.pace == DPM_PACE_AUTO && start + duration > end_latest) {
        end_latest = start + duration;
    }
    port->info.octets_out += (uint64_t)written;
    expect_echo(port, octets, (size_t)written, end_latest);
    machine->sent(machine, start, end_earliest, end_latest, (size_t)written < n ? DPM_SENT_CUT : DPM_SENT_WHOLE);
    return DPM_OK;
}

/* Hand over what the kernel's buffer does not take at once. */
static int write_all(dpm_port *port, const uint8_t *octets, size_t n, int64_t end)
{
    while (n) {
        struct pollfd room = {port->fd, POLLOUT, 0};
        struct timespec slice = {0, 10000000};
        ssize_t written = write(port->fd, octets, n);
        if (written < 0 && errno != EAGAIN && errno != EINTR)
            return DPM_E_GONE;
        if (dpm_now() > end)
            return DPM_E_TIMEOUT;
        if (written > 0) {
            octets += written;
            n -= (size_t)written;
            port->info.octets_out += (uint64_t)written;
        } else {
            (void)ppoll(&room, 1, &slice, NULL);
        }
    }
    return DPM_OK;
}

int dpm_port_measure(dpm_port *port, const uint8_t *octets, size_t n, int64_t limit, int64_t *duration)
{
    if (!port->info.drains)
        return DPM_E_MODE;
    const int64_t start = dpm_now();
    int code = write_all(port, octets, n, start + limit);
    while (!code && !transmitter_empty(port->fd))
        code = dpm_now() - start > limit ? DPM_E_TIMEOUT : DPM_OK;
    *duration = dpm_now() - start;
    (void)ioctl(port->fd, TCFLSH, code ? TCIOFLUSH : TCIFLUSH);
    forget_echo(port);
    return code;
}
