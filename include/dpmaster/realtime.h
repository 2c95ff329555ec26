/* SPDX-License-Identifier: MIT
 *
 * How a bus thread or a segment's hub is scheduled. Asked for on the running thread, from another one; what the system
 * refuses is told item by item, and the rest holds.
 */
#ifndef DPMASTER_REALTIME_H
#define DPMASTER_REALTIME_H

#include "dpmaster/api.h"

typedef struct dpm_realtime {
    int priority;        /* SCHED_FIFO, 1..99; 0: ordinary scheduling */
    int cpu;             /* the only one the thread runs on; -1: those it has */
    bool lock;           /* its stack, 64 KiB of it, stays in memory; for blocks see dpm_lock */
} dpm_realtime;

/* For each item 0, or the errno it was refused with. */
typedef struct dpm_refusals {
    int priority;
    int cpu;
    int lock;
} dpm_refusals;

/* Keep a block of the caller's in memory, until it is unmapped. 0, or DPM_E_SYSTEM with errno: ENOMEM beyond
 * RLIMIT_MEMLOCK. */
DPM_API int dpm_lock(const void *block, size_t size);

#endif
