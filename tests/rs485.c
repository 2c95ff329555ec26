/* SPDX-License-Identifier: MIT
 *
 * A port on a pty whose driver has an RS-485 mode, as the serial core of Linux 6.8 makes one: what cannot be is taken out
 * silently, and RS-422 leaves nothing but itself and the termination. Linked with --wrap=ioctl.
 *
 *   rs485 PATH DIRECTION FLAGS STAYS   opens it in that mode; STAYS: flags that its hardware never loses
 *
 * It prints the code, dpm_port_info.rs485 and the flags in the end.
 */
#include <asm/termbits.h>
#include <linux/serial.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/ioctl.h>

#include "dpmaster/port.h"

enum { ENABLED = 1, TERMINATE_BUS = 32, MODE_RS422 = 512 };

int __real_ioctl(int fd, unsigned long request, ...);
int __wrap_ioctl(int fd, unsigned long request, ...);

static struct serial_rs485 kept;
static unsigned stays;

int __wrap_ioctl(int fd, unsigned long request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    struct serial_rs485 *mode = argument;
    if (request != TIOCSRS485 && request != TIOCGRS485)
        return __real_ioctl(fd, request, argument);
    if (request == TIOCSRS485) {
        kept = *mode;
        kept.flags |= stays;
        if (kept.flags & MODE_RS422)
            kept.flags &= ENABLED | TERMINATE_BUS | MODE_RS422;
        if (!(kept.flags & ENABLED))
            kept = (struct serial_rs485){0};
    }
    *mode = kept;
    return 0;
}

int main(int argc, char **argv)
{
    static _Alignas(16) unsigned char block[1 << 16];
    if (argc != 5 || dpm_port_size() > sizeof block)
        return 2;
    dpm_port_config config = {.path = argv[1], .rate_num = 500000, .rate_den = 1, .direction = atoi(argv[2]), .allowance = -1};
    kept.flags = (unsigned)atoi(argv[3]);
    stays = (unsigned)atoi(argv[4]);
    dpm_port *port = NULL;
    dpm_port_info info = {0};
    int code = dpm_port_open(block, sizeof block, &config, &port);
    if (port)
        dpm_port_get_info(port, &info);
    printf("%d %d %u\n", code, info.rs485, kept.flags);
    return 0;
}
