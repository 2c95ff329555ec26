/* SPDX-License-Identifier: MIT
 *
 * The only table of error texts. Each says the rule or the remedy; who raises it adds the thing and its value.
 */
#include "dpmaster/error.h"

static const char *const texts[] = {
    [-DPM_OK] = "no error",
    [-DPM_E_ARGUMENT] = "an argument is outside its range",
    [-DPM_E_BLOCK] = "the memory block is too small or not aligned to 16: ask the _size function of the object",
    [-DPM_E_ADDRESS] = "this station address cannot be used here: stations have 0..125, 126 waits for Set_Slave_Add, "
                       "127 is everybody and only a destination",
    [-DPM_E_DUPLICATE] = "the address has a station already: each address may be used once",
    [-DPM_E_FULL] = "no room left: the number given at set-up is used up",
    [-DPM_E_LENGTH] = "the octets do not fit: more than the telegram, the image or the buffer holds, or not the number "
                      "that the format needs",
    [-DPM_E_CONFIGURATION] = "the configuration is not valid: an identifier is cut short, or inputs or outputs "
                             "exceed 244 octets",
    [-DPM_E_PARAMETER] = "a bus parameter breaks a rule",
    [-DPM_E_MODE] = "not possible in the present mode",
    [-DPM_E_LATCHED] = "outputs are latched safe: call operate() before the next commit",
    [-DPM_E_BUSY] = "the one place for this request is taken: wait for its answer or cancel it",
    [-DPM_E_TIMEOUT] = "the time given has passed",
    [-DPM_E_INTERRUPTED] = "interrupted by a signal",
    [-DPM_E_CLOSED] = "the object was closed",
    [-DPM_E_FORKED] = "the object belongs to the parent process: open it again after fork",
    [-DPM_E_NO_PORT] = "no such port: check the path and that the adapter is plugged in",
    [-DPM_E_PERMISSION] = "no permission to open the port: join the group that owns it (dialout on Debian)",
    [-DPM_E_IN_USE] = "another program, or another object of this one, has the port: close that first",
    [-DPM_E_NOT_TTY] = "the path is not a serial port",
    [-DPM_E_SETTINGS] = "the port does not keep 8 data bits, even parity and 1 stop bit, without which no PROFIBUS station "
                        "understands it: choose another port (the mini UART of a Raspberry Pi has no parity, its PL011 has)",
    [-DPM_E_GONE] = "the port vanished",
    [-DPM_E_SYSTEM] = "the system refused the call",
    [-DPM_E_DISCARDED] = "the commit will never be sent: a later one overtook it, or outputs went safe",
    [-DPM_E_RATE] = "the port does not make this rate within 0.3 %: choose a lower one, or an adapter that can",
    [-DPM_E_RS485] = "the driver of this port has no RS-485 mode: leave the direction to a hat or an adapter that switches by "
                     "itself",
    [-DPM_E_SLOT] = "the slot time has no room for how late this host may wake",
};

const char *dpm_strerror(int code)
{
    const int last = (int)(sizeof texts / sizeof *texts) - 1;

    return code <= 0 && code >= -last && texts[-code] ? texts[-code] : "unknown error code";
}
