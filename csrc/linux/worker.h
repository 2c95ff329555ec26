/* SPDX-License-Identifier: MIT
 *
 * What the bus thread and the segment hub have in common: a thread that blocks all signals, calls that other threads
 * run on it between two events, and a counter they may wait on. The thread itself never takes a lock and never waits
 * for a caller. Private to csrc/linux.
 */
#ifndef DPM_LINUX_WORKER_H
#define DPM_LINUX_WORKER_H

#include <pthread.h>
#include <stdatomic.h>
#include <sys/types.h>

#include "dpmaster/error.h"
#include "dpmaster/machine.h"
#include "dpmaster/realtime.h"

typedef struct dpm_worker {
    pthread_t thread;
    void *(*run)(void *context);
    void *context;
    uintptr_t stack;              /* where the thread began; its stack grows down from here */
    uintptr_t locked;             /* the part up to `stack` that stays in memory begins here; 0: none does */
    pid_t owner;                  /* the process that opened it; in a child every call is DPM_E_FORKED */
    int wake_fd;                  /* eventfd, O_CLOEXEC: a call is pending or the end is wanted */
    bool running;                 /* under `callers` */
    atomic_bool closing;          /* callers and waiters are turned away */
    atomic_bool stopping;         /* the thread is to end */
    pthread_mutex_t callers;      /* taken by callers only, never by the thread */
    _Atomic(struct dpm_call *) pending;
    _Atomic uint32_t progress;    /* futex word of dpm_worker_wait */
    _Atomic uint32_t waiters;
} dpm_worker;

/* Open the wake-up descriptor. DPM_E_SYSTEM. */
int dpm_worker_init(dpm_worker *worker);
/* Start `run(context)` with all signals blocked. It must return soon after dpm_worker_stopping() turns true, and
 * serve calls until then. DPM_E_SYSTEM, DPM_E_CLOSED, DPM_E_FORKED, DPM_E_MODE when it runs already. */
int dpm_worker_start(dpm_worker *worker, void *(*run)(void *), void *context);
/* Idempotent; from any thread of the owner (not its own): lets the call under way finish, ends and joins the thread,
 * closes wake_fd; calls and waits fail with DPM_E_CLOSED. Returns true to the one caller that ended it, once the
 * thread is gone: what the thread used may then be closed. In a forked child it does nothing. */
bool dpm_worker_stop(dpm_worker *worker);

/* Run fn(object, argument) on the thread and return its result. DPM_E_CLOSED, DPM_E_FORKED. When the worker was never
 * started, runs it on the caller's thread. */
int dpm_worker_call(dpm_worker *worker, int (*fn)(void *object, void *argument), void *object, void *argument);
/* As dpm_bus_wait; a negative timeout or DPM_NEVER has no end. */
int dpm_worker_wait(dpm_worker *worker, uint32_t seen, int64_t timeout);
/* Schedule the running thread anew. DPM_E_MODE before it runs, DPM_E_ARGUMENT, DPM_E_CLOSED, DPM_E_FORKED. */
int dpm_worker_realtime(dpm_worker *worker, const dpm_realtime *wish, dpm_refusals *refusals);

/* On the thread, whenever wake_fd is readable: drain it and run the pending call, if any. */
void dpm_worker_serve(dpm_worker *worker);
bool dpm_worker_stopping(const dpm_worker *worker);
/* On the thread: `progress` differs from last time: wake the waiters. One relaxed load when nothing changed. */
void dpm_worker_publish(dpm_worker *worker, uint32_t progress);

#endif
