/* SPDX-License-Identifier: MIT
 *
 * Events are hints; the facts can be read from the objects. Each subscriber has a ring of its own: one thread puts,
 * one takes, neither waits. A full ring drops its oldest event and counts it.
 */
#ifndef DPMASTER_EVENT_H
#define DPMASTER_EVENT_H

#include "dpmaster/api.h"

enum dpm_event_kind {
    DPM_EV_STATE = 1,       /* a station's state: a = new, b = old (enum dpm_station_state) */
    DPM_EV_FAULT,           /* a station was refused or lost: a = enum dpm_reason, b = detail */
    DPM_EV_DIAGNOSIS,       /* new diagnosis was fetched */
    DPM_EV_MODE,            /* the master's mode: a = new, b = old (enum dpm_mode) */
    DPM_EV_FDL,             /* the FDL station's state: a = new, b = old (enum dpm_fdl_state) */
    DPM_EV_FOREIGN,         /* a foreign master was heard: a = its address */
    DPM_EV_WATCHDOG,        /* the output watchdog ran out: a = what fed it last (enum dpm_feed) */
    DPM_EV_LATE,            /* a telegram was dropped because the host was late: value = ns late */
    DPM_EV_PORT,            /* the port: a = 0 working, or the error code; the bus layer puts this one */
    DPM_EV_DUPLICATE,       /* another station has our address: the bus was left */
    DPM_EV_LIVE,            /* live list: address answers differently: a = new, b = old (enum dpm_live) */
    DPM_EV_ECHO,            /* our own token came back wrong twice: the ring was left; a = 1: not at all, and the bus, too */
    DPM_EV_AUTO_CLEAR       /* Operate was left: address was not in data transfer for Data_Control_Time */
};

typedef struct dpm_event {
    int64_t time;      /* ns */
    uint64_t number;   /* 1, 2, ... over all events of the ring, dropped ones included */
    uint16_t kind;     /* enum dpm_event_kind */
    int16_t address;   /* of the station concerned, -1 none */
    int32_t a;
    int32_t b;
    int64_t value;
} dpm_event;

typedef struct dpm_ring dpm_ring;

/* Bytes for a ring of `events` events (a power of two, 2..65536); 0 for other numbers. */
DPM_API size_t dpm_ring_size(uint32_t events);
/* NULL when the block is too small or not aligned to 16. */
DPM_API dpm_ring *dpm_ring_init(void *block, size_t size, uint32_t events);
DPM_API void dpm_ring_put(dpm_ring *ring, const dpm_event *event);
/* 1 and the oldest event left, or 0. *lost grows by the events that were dropped before it. */
DPM_API int dpm_ring_take(dpm_ring *ring, dpm_event *event, uint64_t *lost);

#endif
