/* SPDX-License-Identifier: MIT
 *
 * What the bus thread needs of a port beyond its public face, and the decoder of the driver's error marks, by itself
 * so that it can be tried without a UART. Private to csrc/linux.
 */
#ifndef DPM_LINUX_PORT_H
#define DPM_LINUX_PORT_H

#include "dpmaster/port.h"

/* With INPCK and PARMRK the driver marks a bad character as FF 00 xx and doubles a real FF (termios(3)). A mark may be
 * split between two reads. */
typedef struct dpm_marks {
    uint8_t seen; /* octets of an unfinished mark: 0, 1 (FF), 2 (FF 00) */
} dpm_marks;

/* Decode `n` octets as the driver gives them into `octets` and `errors`, both with room for n + 2. Returns their count. */
size_t dpm_unmark(dpm_marks *marks, const uint8_t *raw, size_t n, uint8_t *octets, uint8_t *errors);

/* Close what vanished; the counters stay. */
void dpm_port_lose(dpm_port *port);
/* Open it again with the same configuration. Errors as dpm_port_open. */
int dpm_port_reopen(dpm_port *port);

#endif
