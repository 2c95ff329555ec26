/* SPDX-License-Identifier: MIT
 *
 * Configuration identifiers (Chk_Cfg, Get_Cfg): which modules a slave has and how long its inputs and outputs are.
 * General format: bits 5..4 01 input, 10 output, 11 both; bit 6 words; bit 7 consistency over all; bits 3..0 units - 1.
 * Special format: bits 5..4 00; bits 7..6 00 empty, 01 input, 10 output, 11 output then input length octets; bits 3..0
 * maker's octets behind them. A length octet: bit 7 consistency, bit 6 words, bits 5..0 units - 1.
 */
#ifndef DPMASTER_IDENTIFIER_H
#define DPMASTER_IDENTIFIER_H

#include "dpmaster/api.h"

typedef struct dpm_identifier {
    uint8_t octets;            /* octets of the identifier itself, 1..17 */
    uint8_t inputs;            /* octets of input data, 0..128 */
    uint8_t outputs;
    uint8_t input_unit;        /* 1 byte, 2 word, 0 none */
    uint8_t output_unit;
    bool input_consistent;     /* over the whole length, not only a unit */
    bool output_consistent;
    uint8_t specific;          /* maker's octets at its end, 0..14 */
} dpm_identifier;

/* The identifier at octets[0]: returns the octets it takes, or DPM_E_CONFIGURATION when it is cut short. */
DPM_API int dpm_identifier_decode(const uint8_t *octets, size_t n, dpm_identifier *identifier);

/* Sums over a whole configuration: returns the number of identifiers (slots, empty ones too), or
 * DPM_E_CONFIGURATION when one is cut short or a sum exceeds 244. */
DPM_API int dpm_configuration_lengths(const uint8_t *octets, size_t n, uint16_t *inputs, uint16_t *outputs);

#endif
