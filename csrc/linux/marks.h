/* SPDX-License-Identifier: MIT
 *
 * Line errors marked among the octets, as termios(3) has it for INPCK with PARMRK: a bad character comes as FF 00 xx, a
 * break as FF 00 00, a real FF is doubled. Drivers of real UARTs mark; for a pty, whose kernel has no error to mark, the
 * segment hub does it in their place. Private to csrc/linux.
 */
#ifndef DPM_LINUX_MARKS_H
#define DPM_LINUX_MARKS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* A mark may be split between two reads. */
typedef struct dpm_marks {
    uint8_t seen; /* octets of an unfinished mark: 0, 1 (FF), 2 (FF 00) */
} dpm_marks;

/* Decode `n` octets as the driver gives them into `octets` and `errors`, both with room for n + 2. Returns their count. */
size_t dpm_unmark(dpm_marks *marks, const uint8_t *raw, size_t n, uint8_t *octets, uint8_t *errors);
/* The other way; `errors` may be NULL, `raw` has room for 3 n. Returns the count in `raw`. */
size_t dpm_mark(const uint8_t *octets, const uint8_t *errors, size_t n, uint8_t *raw);

/* The two ends of a pty that want marks between them say so by a record lock each on its slave end. A setting would
 * outlive a port that was killed, and the next program would read marks it knows nothing of; a lock ends with its holder. */
enum dpm_pty_end {
    DPM_PTY_READS_MARKS,
    DPM_PTY_WRITES_MARKS
};

/* `fd`: any descriptor of the slave end, the same to claim and to give up. */
bool dpm_pty_claim(int fd, enum dpm_pty_end end, bool claimed);
/* Whether somebody else has claimed. */
bool dpm_pty_claimed(int fd, enum dpm_pty_end end);

#endif
