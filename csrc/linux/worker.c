/* SPDX-License-Identifier: MIT
 *
 * The worker: see worker.h. It may touch its own descriptor, mutex and thread, nothing else.
 *
 * Two rules shape it. The thread never waits for anybody: a call is handed over through one atomic pointer, and its
 * caller sleeps on a futex word of its own. And nothing is touched in a forked child, not even the mutex, for another
 * thread of the parent may have held it at the fork.
 */
#include "linux/worker.h"

#include <errno.h>
#include <limits.h>
#include <linux/futex.h>
#include <sched.h>
#include <signal.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "dpmaster/port.h"

/* The variant with 64-bit times where there are two, so that the size of time_t does not matter. */
#ifdef SYS_futex_time64
#define FUTEX SYS_futex_time64
#else
#define FUTEX SYS_futex
#endif

enum { STACK = 65536 }; /* octets of a thread's stack that are kept in memory: far more than the loop and its calls use */

struct futex_time {
    int64_t seconds;
    int64_t nanoseconds;
};

/* A call waiting to be run; it lives on its caller's stack. */
struct dpm_call {
    int (*fn)(void *object, void *argument);
    void *object;
    void *argument;
    int result;
    _Atomic uint32_t done; /* futex word */
};

/* Sleep while *word equals `value`, until `deadline` of CLOCK_MONOTONIC. Returns 0 or -1 with errno. */
static int futex_wait(_Atomic uint32_t *word, uint32_t value, int64_t deadline)
{
    /* Always with a time: a signal then ends the wait with EINTR even where its handler asks for SA_RESTART. */
    struct futex_time time = {deadline / 1000000000, deadline % 1000000000};
    return (int)syscall(FUTEX, word, FUTEX_WAIT_BITSET | FUTEX_PRIVATE_FLAG, value, &time, NULL,
                        FUTEX_BITSET_MATCH_ANY);
}

static void futex_wake(_Atomic uint32_t *word)
{
    (void)syscall(FUTEX, word, FUTEX_WAKE | FUTEX_PRIVATE_FLAG, INT_MAX, NULL, NULL, 0);
}

static void wake_thread(dpm_worker *worker)
{
    uint64_t one = 1;
    /* It fails only when the counter is full, and then the descriptor is readable anyway. */
    ssize_t written = write(worker->wake_fd, &one, sizeof one);
    (void)written;
}

/* 0, or why the worker cannot be used by this caller. */
static int usable(const dpm_worker *worker)
{
    if (getpid() != worker->owner)
        return DPM_E_FORKED;
    return atomic_load(&worker->closing) ? DPM_E_CLOSED : DPM_OK;
}

int dpm_worker_init(dpm_worker *worker)
{
    memset(worker, 0, sizeof *worker);
    worker->owner = getpid();
    pthread_mutex_init(&worker->callers, NULL); /* never destroyed: late callers may still be queued; it owns nothing */
    worker->wake_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    return worker->wake_fd < 0 ? DPM_E_SYSTEM : DPM_OK;
}

static void unlock_stack(dpm_worker *worker)
{
    if (worker->locked)
        (void)munlock((const void *)worker->locked, worker->stack - worker->locked);
    worker->locked = 0;
}

static void *begin(void *context)
{
    dpm_worker *worker = context;
    uint8_t here;
    worker->stack = (uintptr_t)&here;
    void *result = worker->run(worker->context);
    unlock_stack(worker); /* the C library keeps the stack for the next thread */
    return result;
}

/* A new thread inherits the mask of its maker, so there is no moment in which a signal could hit it. */
static int spawn(dpm_worker *worker, void *(*run)(void *), void *context)
{
    sigset_t all, before;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    worker->run = run;
    worker->context = context;
    int error = pthread_create(&worker->thread, NULL, begin, worker);
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    errno = error;
    return error ? DPM_E_SYSTEM : DPM_OK;
}

int dpm_worker_start(dpm_worker *worker, void *(*run)(void *), void *context)
{
    int code = usable(worker);
    if (code)
        return code;
    pthread_mutex_lock(&worker->callers);
    code = usable(worker);
    if (!code && worker->running)
        code = DPM_E_MODE;
    if (!code)
        code = spawn(worker, run, context);
    if (!code)
        worker->running = true;
    pthread_mutex_unlock(&worker->callers);
    return code;
}

bool dpm_worker_stop(dpm_worker *worker)
{
    if (getpid() != worker->owner)
        return false;
    /* Turn new callers away first, or a crowd of them could keep us from the mutex for ever. The one that holds it is
     * served by the thread, which is told to end only after that. */
    atomic_store(&worker->closing, true);
    pthread_mutex_lock(&worker->callers);
    bool first = worker->wake_fd >= 0;
    if (worker->running) {
        atomic_store(&worker->stopping, true);
        wake_thread(worker);
        pthread_join(worker->thread, NULL);
        worker->running = false;
    }
    if (first) {
        close(worker->wake_fd);
        worker->wake_fd = -1;
        /* Changing the word also turns back a waiter that has looked at `closing` but does not sleep yet. */
        atomic_fetch_add(&worker->progress, 1);
        futex_wake(&worker->progress);
    }
    pthread_mutex_unlock(&worker->callers);
    return first;
}

static int hand_over(dpm_worker *worker, struct dpm_call *call)
{
    atomic_store(&worker->pending, call);
    wake_thread(worker);
    /* A call is short and cannot be taken back: signals do not end this wait. */
    while (!atomic_load(&call->done))
        (void)futex_wait(&call->done, 0, DPM_NEVER);
    return call->result;
}

int dpm_worker_call(dpm_worker *worker, int (*fn)(void *object, void *argument), void *object, void *argument)
{
    int code = usable(worker);
    if (code)
        return code;
    struct dpm_call call = {fn, object, argument, DPM_OK, 0};
    pthread_mutex_lock(&worker->callers);
    code = usable(worker);
    if (!code)
        code = worker->running ? hand_over(worker, &call) : fn(object, argument);
    pthread_mutex_unlock(&worker->callers);
    return code;
}

/* ---- scheduling ---- */

int dpm_lock(const void *block, size_t size)
{
    return mlock(block, size) < 0 ? DPM_E_SYSTEM : DPM_OK;
}

struct realtime_call {
    const dpm_realtime *wish;
    dpm_refusals *refusals;
};

/* All of the stack would be 8 MiB, which is as much as an ordinary user may lock in all. */
static int lock_stack(dpm_worker *worker)
{
    uint8_t room[STACK];
    unlock_stack(worker);
    if (mlock(room, worker->stack - (uintptr_t)room) < 0)
        return errno;
    worker->locked = (uintptr_t)room;
    return 0;
}

static int set_cpu(int cpu)
{
    cpu_set_t cpus;
    CPU_ZERO(&cpus);
    CPU_SET((size_t)cpu, &cpus);
    return sched_setaffinity(0, sizeof cpus, &cpus) < 0 ? errno : 0;
}

/* On the thread: 0 is the caller in these calls. */
static int do_realtime(void *object, void *argument)
{
    dpm_worker *worker = object;
    const struct realtime_call *call = argument;
    const struct sched_param parameter = {.sched_priority = call->wish->priority};
    dpm_refusals *refusals = call->refusals;
    if (!worker->stack)
        return DPM_E_MODE;
    /* Not sched_setscheduler: musl has it for no thread. */
    refusals->priority = pthread_setschedparam(pthread_self(), parameter.sched_priority ? SCHED_FIFO : SCHED_OTHER, &parameter);
    refusals->cpu = call->wish->cpu < 0 ? 0 : set_cpu(call->wish->cpu);
    refusals->lock = call->wish->lock ? lock_stack(worker) : 0;
    if (!call->wish->lock)
        unlock_stack(worker);
    return DPM_OK;
}

int dpm_worker_realtime(dpm_worker *worker, const dpm_realtime *wish, dpm_refusals *refusals)
{
    struct realtime_call call = {wish, refusals};
    if (wish->priority < 0 || wish->priority > 99 || wish->cpu < -1 || wish->cpu >= CPU_SETSIZE)
        return DPM_E_ARGUMENT;
    return dpm_worker_call(worker, do_realtime, worker, &call);
}

/* ---- waits ---- */

int dpm_worker_wait(dpm_worker *worker, uint32_t seen, int64_t timeout)
{
    int64_t now = dpm_now();
    int64_t deadline = timeout < 0 || timeout > DPM_NEVER - now ? DPM_NEVER : now + timeout;
    int code = usable(worker);
    while (!code && atomic_load(&worker->progress) == seen) {
        atomic_fetch_add(&worker->waiters, 1);
        int woken = futex_wait(&worker->progress, seen, deadline);
        int why = errno;
        atomic_fetch_sub(&worker->waiters, 1);
        code = usable(worker);
        if (!code && woken < 0 && why != EAGAIN)
            code = why == ETIMEDOUT ? DPM_E_TIMEOUT : why == EINTR ? DPM_E_INTERRUPTED : DPM_E_SYSTEM;
    }
    return code;
}

void dpm_worker_serve(dpm_worker *worker)
{
    uint64_t count;
    ssize_t drained = read(worker->wake_fd, &count, sizeof count);
    (void)drained; /* drained first: a call that comes in from here on makes it readable again */
    struct dpm_call *call = atomic_exchange(&worker->pending, NULL);
    if (!call)
        return;
    call->result = call->fn(call->object, call->argument);
    /* From the store on the caller may be gone; waking an address that nobody waits on does no harm. */
    atomic_store(&call->done, 1);
    futex_wake(&call->done);
}

bool dpm_worker_stopping(const dpm_worker *worker)
{
    return atomic_load_explicit(&worker->stopping, memory_order_relaxed);
}

void dpm_worker_publish(dpm_worker *worker, uint32_t progress)
{
    if (atomic_load_explicit(&worker->progress, memory_order_relaxed) == progress)
        return;
    atomic_store(&worker->progress, progress);
    if (atomic_load(&worker->waiters))
        futex_wake(&worker->progress);
}
