/* SPDX-License-Identifier: MIT
 *
 * Preloaded, it makes of each pty the port of a serial driver that test_odd_drivers.py describes in the environment: its
 * name and major number, its clock, the rate it ends at, what it does to RS-485 flags. All else is the pty's own.
 */
#include <asm/termbits.h>
#include <dlfcn.h>
#include <errno.h>
#include <linux/serial.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <unistd.h>

#define MODE_RS422 (1u << 9) /* Linux 6.8, where the headers may be older */

static tcflag_t parity;
static struct serial_struct serial;
static struct serial_rs485 rs485;
static unsigned asked; /* for the end of a transmission */

static const char *word(const char *name)
{
    const char *value = getenv(name);
    return value ? value : "";
}

static unsigned number(const char *name)
{
    return (unsigned)strtoul(word(name), NULL, 10);
}

int fstat(int fd, struct stat *status)
{
    int (*real)(int, struct stat *) = (int (*)(int, struct stat *))dlsym(RTLD_NEXT, "fstat");
    int result = real(fd, status);
    if (!result && S_ISCHR(status->st_mode) && major(status->st_rdev) == 136)
        status->st_rdev = makedev(number("ODD_MAJOR"), minor(status->st_rdev));
    return result;
}

ssize_t readlink(const char *restrict path, char *restrict target, size_t size)
{
    ssize_t (*real)(const char *, char *, size_t) = (ssize_t (*)(const char *, char *, size_t))dlsym(RTLD_NEXT, "readlink");
    size_t n = strlen(path), length = strlen(word("ODD_DRIVER"));
    if (n < 13 || strcmp(path + n - 13, "device/driver") != 0)
        return real(path, target, size);
    memcpy(target, "/", 1);
    memcpy(target + 1, word("ODD_DRIVER"), length);
    return (ssize_t)length + 1;
}

/* As the serial core answers. A driver takes of the RS-485 flags those of its mask and keeps those that its hardware never
 * loses; RS-422 leaves nothing but itself and the termination. */
static int of_driver(unsigned long request, void *argument)
{
    switch (request) {
    case TIOCSERGETLSR: /* empty so many times, then never again */
        if (!number("ODD_EMPTY"))
            break;
        *(unsigned *)argument = asked++ < number("ODD_EMPTY") ? TIOCSER_TEMT : 0;
        return 0;
    case TIOCGRS485: /* even one that has no such mode */
        *(struct serial_rs485 *)argument = rs485;
        return 0;
    case TIOCSRS485:
        if (!number("ODD_RS485"))
            break;
        rs485 = *(struct serial_rs485 *)argument;
        rs485.flags = (rs485.flags & number("ODD_RS485")) | number("ODD_STAYS");
        if (rs485.flags & MODE_RS422)
            rs485.flags &= SER_RS485_ENABLED | SER_RS485_TERMINATE_BUS | MODE_RS422;
        if (!(rs485.flags & SER_RS485_ENABLED))
            memset(&rs485, 0, sizeof rs485);
        return 0;
    case TIOCGSERIAL:
        serial.baud_base = (int)number("ODD_BASE");
        serial.type = (int)number("ODD_TYPE");
        *(struct serial_struct *)argument = serial;
        return 0;
    case TIOCSSERIAL:
        serial = *(struct serial_struct *)argument;
        return 0;
    }
    errno = ENOTTY;
    return -1;
}

int ioctl(int fd, unsigned long request, ...)
{
    int (*real)(int, unsigned long, ...) = (int (*)(int, unsigned long, ...))dlsym(RTLD_NEXT, "ioctl");
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if (request == TIOCGSERIAL || request == TIOCSSERIAL || request == TIOCGRS485 || request == TIOCSRS485 ||
        request == TIOCSERGETLSR)
        return of_driver(request, argument);
    struct termios2 *line = argument;
    if (request == TCSETS2) {
        parity = line->c_cflag & (PARENB | PARODD);
        if (number("ODD_MOST") && line->c_ospeed > number("ODD_MOST"))
            line->c_ospeed = number("ODD_MOST");
    }
    int result = real(fd, request, argument);
    if (request == TCGETS2)
        line->c_cflag |= parity;
    return result;
}
