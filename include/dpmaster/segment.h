/* SPDX-License-Identifier: MIT
 *
 * The segment hub: a piece of virtual RS-485 wire with any number of ports, each a pty, and slaves of this process
 * attached directly. What one writes all others hear (and itself, with echo). A paced segment delivers a telegram when
 * its last octet would have ended and garbles transmissions that overlap. One thread; it blocks all signals.
 */
#ifndef DPMASTER_SEGMENT_H
#define DPMASTER_SEGMENT_H

#include "dpmaster/realtime.h"
#include "dpmaster/slave.h"

#define DPM_SEGMENT_PORTS 64

typedef struct dpm_segment_config {
    dpm_parameters parameters; /* of the slaves attached; the pace too, when `paced` */
    bool paced;
    bool echo;                 /* every port hears its own transmissions, as cheap hats do */
    uint16_t ports;            /* 0..64 */
    uint16_t slaves;           /* room for attached slaves, 0..126 */
} dpm_segment_config;

/* Faults by seed. Chances are per million octets, drawn for each octet on the wire; the same seed and the same octets
 * give the same faults. */
typedef struct dpm_segment_faults {
    uint64_t seed;
    uint32_t lose;
    uint32_t flip;             /* one bit of the octet and the parity bit: no line error tells */
    uint32_t parity;           /* one bit of the octet: the receiver sees that its parity is wrong */
    uint32_t insert;           /* a random octet before this one */
    uint32_t duplicate;
    uint32_t lose_telegram;    /* per million transmissions: all of it */
    int64_t delay;             /* ns added to every delivery */
    int64_t chunk;             /* ns between two deliveries to a port's reader, as adapters gather them; 0: at once */
} dpm_segment_faults;

typedef struct dpm_segment_info {
    uint64_t transmissions;
    uint64_t octets;
    uint64_t collisions;       /* paced: transmissions that overlapped another */
    uint64_t faults;           /* octets or transmissions touched by faults */
    uint64_t undelivered;      /* octets lost: a port's reader did not fetch them in time, or their wire was cut */
    int64_t late_max;          /* paced: ns a delivery came after its due time */
    int64_t late_sum;
    uint64_t deliveries;
} dpm_segment_info;

typedef struct dpm_segment dpm_segment;

DPM_API size_t dpm_segment_size(const dpm_segment_config *config);
DPM_API int dpm_segment_open(void *block, size_t size, const dpm_segment_config *config, dpm_segment **segment);
/* The path of a port's pty, "/dev/pts/N". */
DPM_API const char *dpm_segment_path(const dpm_segment *segment, unsigned port);
DPM_API int dpm_segment_start(dpm_segment *segment);
/* Idempotent, bounded; the ports hang up. */
DPM_API void dpm_segment_close(dpm_segment *segment);

DPM_API uint32_t dpm_segment_progress(const dpm_segment *segment);
DPM_API int dpm_segment_wait(dpm_segment *segment, uint32_t seen, int64_t timeout); /* as dpm_bus_wait */
DPM_API int dpm_segment_realtime(dpm_segment *segment, const dpm_realtime *wish, dpm_refusals *refusals); /* as dpm_bus_realtime */

/* Run on the hub's thread. */
DPM_API int dpm_segment_attach(dpm_segment *segment, const dpm_slave_config *config, dpm_image *outputs, dpm_image *inputs);
DPM_API int dpm_segment_slave_get(dpm_segment *segment, int index, dpm_slave_state_report *report);
DPM_API int dpm_segment_slave_connect(dpm_segment *segment, int index, bool connected);
DPM_API int dpm_segment_slave_reset(dpm_segment *segment, int index);
DPM_API int dpm_segment_slave_set_address(dpm_segment *segment, int index, uint8_t address, bool locked);
DPM_API int dpm_segment_slave_diagnosis(dpm_segment *segment, int index, const uint8_t *octets, uint8_t n, bool announce,
                                        bool ext_diag, bool static_diag);
DPM_API int dpm_segment_slave_ready(dpm_segment *segment, int index, bool ready);
DPM_API int dpm_segment_set_faults(dpm_segment *segment, const dpm_segment_faults *faults);
/* Cut one port's wire (nothing passes either way) or join it again. */
DPM_API int dpm_segment_cut(dpm_segment *segment, unsigned port, bool cut);
/* Pull a port out, as an adapter (its client sees it hang up), or plug it in: it is another pty then, see dpm_segment_path. */
DPM_API int dpm_segment_plug(dpm_segment *segment, unsigned port, bool in);
DPM_API int dpm_segment_get_info(dpm_segment *segment, dpm_segment_info *info);

#endif
