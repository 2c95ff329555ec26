/* SPDX-License-Identifier: MIT
 *
 * Error marks (marks.h). Coding touches nothing; the claims touch record locks of the descriptor they are given.
 */
#include "linux/marks.h"

#include <fcntl.h>
#include <unistd.h>

#include "dpmaster/machine.h"

enum { MARK = 0xFF };

size_t dpm_unmark(dpm_marks *marks, const uint8_t *raw, size_t n, uint8_t *octets, uint8_t *errors)
{
    size_t out = 0;
    for (size_t i = 0; i < n; i++) {
        uint8_t octet = raw[i];
        if (marks->seen == 0 && octet == MARK) {
            marks->seen = 1;
        } else if (marks->seen == 1 && octet == 0) {
            marks->seen = 2;
        } else if (marks->seen == 1 && octet != MARK) {
            /* No driver writes that: octets are missing in between. */
            octets[out] = MARK;
            errors[out++] = DPM_LINE_OVERRUN;
            octets[out] = octet;
            errors[out++] = DPM_LINE_OVERRUN;
            marks->seen = 0;
        } else {
            /* A break is marked as a bad 00; the mark does not tell parity from framing. */
            octets[out] = octet;
            errors[out++] = marks->seen != 2 ? 0 : octet ? DPM_LINE_PARITY : DPM_LINE_PARITY | DPM_LINE_BREAK;
            marks->seen = 0;
        }
    }
    return out;
}

size_t dpm_mark(const uint8_t *octets, const uint8_t *errors, size_t n, uint8_t *raw)
{
    size_t out = 0;
    for (size_t i = 0; i < n; i++) {
        const bool bad = errors && errors[i];
        if (bad || octets[i] == MARK)
            raw[out++] = MARK;
        if (bad)
            raw[out++] = 0;
        raw[out++] = octets[i];
    }
    return out;
}

/* One octet of the "file" for each end; its descriptor needs no reading or writing for that. */
static struct flock record(enum dpm_pty_end end, short type)
{
    return (struct flock){.l_type = type, .l_whence = SEEK_SET, .l_start = (off_t)end, .l_len = 1};
}

bool dpm_pty_claim(int fd, enum dpm_pty_end end, bool claimed)
{
    struct flock lock = record(end, claimed ? F_WRLCK : F_UNLCK);
    return fcntl(fd, F_OFD_SETLK, &lock) == 0;
}

bool dpm_pty_claimed(int fd, enum dpm_pty_end end)
{
    struct flock lock = record(end, F_WRLCK);
    return fcntl(fd, F_OFD_GETLK, &lock) == 0 && lock.l_type != F_UNLCK;
}
