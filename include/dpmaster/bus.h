/* SPDX-License-Identifier: MIT
 *
 * The bus thread: drives one machine on one port. Other threads talk to the machine through calls that run on the bus
 * thread between two events; the thread itself takes no lock, blocks all signals and never calls back into a program.
 */
#ifndef DPMASTER_BUS_H
#define DPMASTER_BUS_H

#include "dpmaster/master.h"
#include "dpmaster/port.h"
#include "dpmaster/realtime.h"
#include "dpmaster/slave.h"

typedef struct dpm_bus dpm_bus;

typedef struct dpm_bus_info {
    dpm_port_info port;
    int port_error;          /* 0, or why the port is not working */
    int64_t cpu_time;        /* ns the thread has used (CLOCK_THREAD_CPUTIME_ID) */
    uint64_t wakeups;
} dpm_bus_info;

DPM_API size_t dpm_bus_size(void);
/* Open the port. The block is the caller's, until dpm_bus_close. Errors as dpm_port_open, DPM_E_SYSTEM. */
DPM_API int dpm_bus_open(void *block, size_t size, const dpm_port_config *config, dpm_bus **bus);
DPM_API void dpm_bus_get_traits(const dpm_bus *bus, dpm_port_traits *traits);
/* Start the thread on a machine. With `master` (may be NULL) the thread tells it when the port goes. DPM_E_MODE: it drives one
 * already; DPM_E_SYSTEM, DPM_E_CLOSED, DPM_E_FORKED. */
DPM_API int dpm_bus_start(dpm_bus *bus, dpm_machine *machine, dpm_master *master);
/* Stop the thread, close the port, wake every waiter with DPM_E_CLOSED. A master that is not Offline goes there first: Clear,
 * and its slaves unlocked. Idempotent; returns within a second. */
DPM_API void dpm_bus_close(dpm_bus *bus);
DPM_API int dpm_bus_get_info(dpm_bus *bus, dpm_bus_info *info);
/* Schedule the running bus thread. DPM_E_MODE before it runs, DPM_E_ARGUMENT, DPM_E_CLOSED, DPM_E_FORKED. */
DPM_API int dpm_bus_realtime(dpm_bus *bus, const dpm_realtime *wish, dpm_refusals *refusals);

/* A counter that grows whenever something an onlooker may wait for has changed. */
DPM_API uint32_t dpm_bus_progress(const dpm_bus *bus);
/* Wait until the counter differs from `seen`: 0, DPM_E_TIMEOUT, DPM_E_INTERRUPTED, DPM_E_CLOSED, DPM_E_FORKED. */
DPM_API int dpm_bus_wait(dpm_bus *bus, uint32_t seen, int64_t timeout);

/* Subscribe: events go to `ring`, and `event_fd` (an eventfd) becomes readable. DPM_E_FULL: there are seven; DPM_E_MODE before
 * the thread was started; DPM_E_ARGUMENT: it is not subscribed. */
DPM_API int dpm_bus_subscribe(dpm_bus *bus, dpm_ring *ring, int event_fd);
DPM_API int dpm_bus_unsubscribe(dpm_bus *bus, dpm_ring *ring);

/* The same as the dpm_master_ functions, run on the bus thread. Besides their own results: DPM_E_CLOSED, DPM_E_FORKED. */
DPM_API int dpm_bus_add(dpm_bus *bus, const dpm_slave_set *set, dpm_outputs *outputs, dpm_image *inputs);
DPM_API int dpm_bus_change(dpm_bus *bus, int index, const dpm_slave_set *set);
DPM_API int dpm_bus_new_prm(dpm_bus *bus, int index);
DPM_API int dpm_bus_activate(dpm_bus *bus, int index, bool active);
DPM_API int dpm_bus_remove(dpm_bus *bus, int index);
DPM_API int dpm_bus_set_mode(dpm_bus *bus, int mode);
DPM_API int dpm_bus_request(dpm_bus *bus, dpm_raw *raw);
DPM_API int dpm_bus_cancel(dpm_bus *bus, dpm_raw *raw);
DPM_API int dpm_bus_order(dpm_bus *bus, dpm_control *control);
DPM_API int dpm_bus_revoke(dpm_bus *bus, dpm_control *control);
DPM_API int dpm_bus_get_status(dpm_bus *bus, dpm_master_status *status);
DPM_API int dpm_bus_get_ring(dpm_bus *bus, dpm_ring_view *view);
DPM_API int dpm_bus_get_slave(dpm_bus *bus, int index, dpm_slave_status *status);
/* dpm_history_get, of a slave's history; how many records. */
DPM_API int dpm_bus_get_history(dpm_bus *bus, const dpm_history *history, uint64_t after, dpm_diagnosis *records, size_t n);
DPM_API int dpm_bus_record(dpm_bus *bus, int64_t *durations, size_t n);

/* The same for a machine of slaves on a bus of its own (an emulated card on somebody else's line). */
DPM_API int dpm_bus_start_slaves(dpm_bus *bus, dpm_slaves *slaves);
DPM_API int dpm_bus_slave_get(dpm_bus *bus, int index, dpm_slave_state_report *report);
DPM_API int dpm_bus_slave_connect(dpm_bus *bus, int index, bool connected);
DPM_API int dpm_bus_slave_reset(dpm_bus *bus, int index);
DPM_API int dpm_bus_slave_set_address(dpm_bus *bus, int index, uint8_t address, bool locked);
DPM_API int dpm_bus_slave_diagnosis(dpm_bus *bus, int index, const uint8_t *octets, uint8_t n, bool announce,
                                    bool ext_diag, bool static_diag);
DPM_API int dpm_bus_slave_ready(dpm_bus *bus, int index, bool ready);

#endif
