/* SPDX-License-Identifier: MIT
 *
 * Decodes the marks that a driver puts into the octets for parity and framing errors and breaks. Touches nothing.
 */
#include "linux/port.h"

enum { MARK = 0xFF };

size_t dpm_unmark(dpm_marks *marks, const uint8_t *raw, size_t n, uint8_t *octets, uint8_t *errors)
{
    size_t out = 0;
    for (size_t i = 0; i < n; i++) {
        uint8_t octet = raw[i];
        if (marks->seen == 0 && octet == MARK) {
            marks->seen = 1;
        } else if (marks->seen == 1 && octet == 0) {
            marks->seen = 2;
        } else if (marks->seen == 1 && octet != MARK) {
            /* No driver writes that: octets are missing in between. */
            octets[out] = MARK;
            errors[out++] = DPM_LINE_OVERRUN;
            octets[out] = octet;
            errors[out++] = DPM_LINE_OVERRUN;
            marks->seen = 0;
        } else {
            /* A break is marked as a bad 00; the mark does not tell parity from framing. */
            octets[out] = octet;
            errors[out++] = marks->seen != 2 ? 0 : octet ? DPM_LINE_PARITY : DPM_LINE_PARITY | DPM_LINE_BREAK;
            marks->seen = 0;
        }
    }
    return out;
}
