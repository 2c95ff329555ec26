/* SPDX-License-Identifier: MIT
 *
 * Error codes. A function that can fail returns one of these, always negative; dpm_strerror is the only table of texts.
 */
#ifndef DPMASTER_ERROR_H
#define DPMASTER_ERROR_H

#include "dpmaster/api.h"

enum dpm_error {
    DPM_OK = 0,
    DPM_E_ARGUMENT = -1,    /* an argument is outside its range */
    DPM_E_BLOCK = -2,       /* the memory block is too small or not aligned to 16 */
    DPM_E_ADDRESS = -3,     /* a station address that cannot be used here */
    DPM_E_DUPLICATE = -4,   /* the address has a station already */
    DPM_E_FULL = -5,        /* no room left: the count given at set-up is used up */
    DPM_E_LENGTH = -6,      /* more octets than the telegram or the image holds */
    DPM_E_CONFIGURATION = -7, /* configuration octets that no decoder accepts */
    DPM_E_PARAMETER = -8,   /* a bus parameter breaks a rule */
    DPM_E_MODE = -9,        /* not possible in the present mode */
    DPM_E_LATCHED = -10,    /* outputs are latched safe until the next operate() */
    DPM_E_BUSY = -11,       /* the one place for this request is taken */
    DPM_E_TIMEOUT = -13,    /* the time given has passed */
    DPM_E_INTERRUPTED = -14, /* a signal arrived; wait again to go on */
    DPM_E_CLOSED = -15,     /* the object was closed */
    DPM_E_FORKED = -16,     /* the object belongs to the parent process */
    DPM_E_NO_PORT = -17,    /* no such port */
    DPM_E_PERMISSION = -18, /* the port may not be opened by this user */
    DPM_E_IN_USE = -19,     /* somebody has the port already */
    DPM_E_NOT_TTY = -20,    /* the path is not a serial port */
    DPM_E_SETTINGS = -21,   /* the port does not keep 8E1 */
    DPM_E_GONE = -22,       /* the port vanished */
    DPM_E_SYSTEM = -23,     /* the system refused; errno says why */
    DPM_E_DISCARDED = -24,  /* a commit that no telegram will carry any more: it was overtaken, or outputs went safe */
    DPM_E_SLOT = -25,       /* the slot time has no room for how late this host may wake */
    DPM_E_RATE = -26,       /* the port does not make the rate */
    DPM_E_RS485 = -27       /* the driver does not switch the direction */
};

/* English text for a code of enum dpm_error, never NULL. */
DPM_API const char *dpm_strerror(int code);

#endif
