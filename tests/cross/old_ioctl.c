/* SPDX-License-Identifier: MIT
 *
 * For programs under qemu-user, whose system calls know no termios2 up to its version 10: the port's TCGETS2 and TCSETS2
 * become what they know. The line is a pty's, so that nothing is lost with the rate. Linked with --wrap=ioctl.
 */
#include <asm/termbits.h>
#include <stdarg.h>
#include <sys/ioctl.h>

int __real_ioctl(int fd, unsigned long request, ...);
int __wrap_ioctl(int fd, unsigned long request, ...);

static unsigned rate;

static int get(int fd, struct termios2 *line)
{
    struct termios old;
    int result = __real_ioctl(fd, TCGETS, &old);
    *line = (struct termios2){.c_iflag = old.c_iflag, .c_oflag = old.c_oflag, .c_lflag = old.c_lflag, .c_cflag = old.c_cflag,
                              .c_ispeed = rate, .c_ospeed = rate};
    for (int i = 0; i < NCCS; i++)
        line->c_cc[i] = old.c_cc[i];
    return result;
}

static int set(int fd, const struct termios2 *line)
{
    struct termios old = {.c_iflag = line->c_iflag, .c_oflag = line->c_oflag, .c_lflag = line->c_lflag,
                          .c_cflag = (line->c_cflag & ~(tcflag_t)(CBAUD | CBAUD << IBSHIFT)) | B9600};
    for (int i = 0; i < NCCS; i++)
        old.c_cc[i] = line->c_cc[i];
    rate = line->c_ospeed;
    return __real_ioctl(fd, TCSETS, &old);
}

int __wrap_ioctl(int fd, unsigned long request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if (request == TCGETS2)
        return get(fd, argument);
    return request == TCSETS2 ? set(fd, argument) : __real_ioctl(fd, request, argument);
}
