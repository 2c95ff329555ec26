/* SPDX-License-Identifier: MIT
 *
 * What the bus thread needs of a port beyond its public face. Private to csrc/linux.
 */
#ifndef DPM_LINUX_PORT_H
#define DPM_LINUX_PORT_H

#include "dpmaster/port.h"

/* Close what vanished; the counters stay. */
void dpm_port_lose(dpm_port *port);
/* Open it again with the same configuration. Errors as dpm_port_open. */
int dpm_port_reopen(dpm_port *port);

#endif
