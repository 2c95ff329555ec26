/* SPDX-License-Identifier: MIT
 *
 * Serial ports and ptys on Linux: 8E1 at any rate, exclusive, raw. A port keeps no thread; whoever owns it calls it.
 */
#ifndef DPMASTER_PORT_H
#define DPMASTER_PORT_H

#include "dpmaster/machine.h"
#include "dpmaster/parameters.h"

enum dpm_profile {
    DPM_PROFILE_AUTO = 0, /* by what the path is */
    DPM_PROFILE_UART,
    DPM_PROFILE_USB,
    DPM_PROFILE_PTY
};

enum dpm_echo {
    DPM_ECHO_AUTO = 0,   /* found out: what equals our transmission, right behind it, is its echo */
    DPM_ECHO_OFF,
    DPM_ECHO_ON
};

enum dpm_pace {
    DPM_PACE_AUTO = 0,   /* a UART is paced; of a pty it is unknown */
    DPM_PACE_NONE,
    DPM_PACE_BAUD
};

/* Who switches the transceiver to sending. A program cannot: it would wake too late behind its own last stop bit. */
enum dpm_direction {
    DPM_DIRECTION_AUTO = 0,         /* hat or adapter by itself, or the driver as the device tree has set it */
    DPM_DIRECTION_RS485,            /* the driver's RS-485 mode: RTS active while sending */
    DPM_DIRECTION_RS485_INVERTED    /* the same with RTS active while not sending */
};

typedef struct dpm_port_config {
    const char *path;
    uint32_t rate_num;
    uint32_t rate_den;
    int profile;         /* enum dpm_profile */
    int echo;            /* enum dpm_echo */
    int pace;            /* enum dpm_pace */
    int direction;       /* enum dpm_direction */
    int64_t allowance;   /* ns; -1: the profile's default */
} dpm_port_config;

/* The driver's own counters (TIOCGICOUNT) since the port was opened. */
typedef struct dpm_driver_counters {
    uint32_t parity;
    uint32_t framing;
    uint32_t breaks;
    uint32_t overruns;        /* the UART's FIFO was read too late */
    uint32_t buffer_overruns; /* the kernel's buffer was */
} dpm_driver_counters;

typedef struct dpm_port_info {
    int profile;
    dpm_port_traits traits;
    uint32_t rate;            /* bit/s, as far as it is known what the driver makes */
    bool parity;              /* the driver kept even parity (a pty does not) */
    bool rs485;               /* the driver switches the direction */
    bool drains;              /* the driver tells when a transmission has ended; else that is computed */
    bool low_latency;         /* the driver hands over what it has at once, or says so */
    int fifo_trigger;         /* octets in the receive FIFO that raise an interrupt; 0: the driver does not say */
    bool counted;             /* `driver` counts */
    dpm_driver_counters driver;
    uint64_t octets_in;
    uint64_t octets_out;
    uint64_t echo_octets;     /* own octets heard back as they were sent */
    uint64_t echoes;          /* transmissions heard back whole */
    int64_t echo_late;        /* ns from the end of the last of them to its last octet: how late this host hears */
    uint64_t echo_errors;     /* echo expected, something else heard: a collision or a short */
    uint64_t line_errors;
} dpm_port_info;

typedef struct dpm_port dpm_port;

/* What a kind of port is reckoned to need, before one is opened. DPM_E_ARGUMENT for AUTO, which is no kind. */
DPM_API int dpm_profile_traits(int profile, dpm_port_traits *traits);
/* ns that the longest telegram takes on a paced pty until it is handed over, which is done when it is whole. */
DPM_API int64_t dpm_pty_delivery(uint32_t rate_num, uint32_t rate_den);

DPM_API size_t dpm_port_size(void);
/* 0, or DPM_E_NO_PORT, DPM_E_PERMISSION, DPM_E_IN_USE, DPM_E_NOT_TTY, DPM_E_SETTINGS, DPM_E_RATE,
 * DPM_E_RS485, DPM_E_SYSTEM, DPM_E_BLOCK, DPM_E_ARGUMENT. */
DPM_API int dpm_port_open(void *block, size_t size, const dpm_port_config *config, dpm_port **port);
DPM_API void dpm_port_close(dpm_port *port);
DPM_API int dpm_port_fd(const dpm_port *port);
DPM_API void dpm_port_get_info(const dpm_port *port, dpm_port_info *info);

/* Read what is there without waiting and give it, echo marked, to `machine`; report quiet when nothing was.
 * Returns the octets read, 0 none, DPM_E_GONE. */
DPM_API int dpm_port_read(dpm_port *port, dpm_machine *machine);
/* Write one telegram with one write and report sent(); a driver that tells the end of a short one is waited for.
 * DPM_E_GONE when the port is. */
DPM_API int dpm_port_write(dpm_port *port, dpm_machine *machine, const uint8_t *octets, size_t n);
/* How long the driver takes to send these octets, from the first write to the end of the last stop bit, ns. For a line of
 * one's own: it sends what it is given and waits for it, `limit` ns at most. What comes in meanwhile is dropped.
 * DPM_E_MODE where the driver does not tell (dpm_port_info.drains), DPM_E_TIMEOUT, DPM_E_GONE. */
DPM_API int dpm_port_measure(dpm_port *port, const uint8_t *octets, size_t n, int64_t limit, int64_t *duration);

/* Wait until octets come, `wake_fd` is readable, or `deadline`, the last microseconds in a short spin.
 * Returns a mask: 1 octets (or the port is gone: read tells), 2 wake_fd; 0 the deadline. */
DPM_API int dpm_port_wait(dpm_port *port, int wake_fd, int64_t deadline);

/* CLOCK_MONOTONIC in ns. */
DPM_API int64_t dpm_now(void);

#endif
