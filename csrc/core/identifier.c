/* SPDX-License-Identifier: MIT
 *
 * Configuration identifiers, the octets of Chk_Cfg and Get_Cfg, decoded to lengths. Touches nothing but its arguments.
 */
#include "dpmaster/error.h"
#include "dpmaster/identifier.h"
#include "dpmaster/telegram.h"

/* Bits of an identifier; the special format is the one with neither direction in bits 5..4, and has its own above. */
#define CONSISTENT 0x80u
#define WORDS 0x40u
#define OUTPUT 0x20u
#define INPUT 0x10u
#define SPECIAL_OUTPUT 0x80u
#define SPECIAL_INPUT 0x40u
#define COUNT 0x0fu
#define LENGTH_COUNT 0x3fu /* of a length octet, which shares CONSISTENT and WORDS */
#define UNCHECKED 15       /* "no check of this entry" in place of a number: nothing of the maker's follows */

static void set_inputs(dpm_identifier *identifier, unsigned octet, unsigned count)
{
    identifier->input_unit = octet & WORDS ? 2 : 1;
    identifier->inputs = (uint8_t)(((octet & count) + 1) * identifier->input_unit);
    identifier->input_consistent = octet & CONSISTENT;
}

static void set_outputs(dpm_identifier *identifier, unsigned octet, unsigned count)
{
    identifier->output_unit = octet & WORDS ? 2 : 1;
    identifier->outputs = (uint8_t)(((octet & count) + 1) * identifier->output_unit);
    identifier->output_consistent = octet & CONSISTENT;
}

int dpm_identifier_decode(const uint8_t *octets, size_t n, dpm_identifier *identifier)
{
    *identifier = (dpm_identifier){.octets = 1};
    if (n == 0)
        return DPM_E_CONFIGURATION;
    unsigned first = octets[0];
    if (first & (INPUT | OUTPUT)) {
        if (first & INPUT)
            set_inputs(identifier, first, COUNT);
        if (first & OUTPUT)
            set_outputs(identifier, first, COUNT);
        return identifier->octets;
    }
    /* Special: the lengths, outputs first, then the maker's octets. */
    unsigned lengths = (first & SPECIAL_OUTPUT ? 1 : 0) + (first & SPECIAL_INPUT ? 1 : 0);
    unsigned makers = (first & COUNT) == UNCHECKED ? 0 : first & COUNT;
    if (n < 1 + lengths + makers)
        return DPM_E_CONFIGURATION;
    if (first & SPECIAL_OUTPUT)
        set_outputs(identifier, octets[1], LENGTH_COUNT);
    if (first & SPECIAL_INPUT)
        set_inputs(identifier, octets[lengths], LENGTH_COUNT);
    identifier->specific = (uint8_t)makers;
    identifier->octets = (uint8_t)(1 + lengths + makers);
    return identifier->octets;
}

int dpm_configuration_lengths(const uint8_t *octets, size_t n, uint16_t *inputs, uint16_t *outputs)
{
    int slots = 0;
    unsigned in = 0, out = 0;
    for (size_t at = 0; at < n; slots++) {
        dpm_identifier identifier;
        int taken = dpm_identifier_decode(octets + at, n - at, &identifier);
        if (taken < 0)
            return taken;
        at += (size_t)taken;
        in += identifier.inputs;
        out += identifier.outputs;
        if (in > DPM_IO_MAX || out > DPM_IO_MAX)
            return DPM_E_CONFIGURATION;
    }
    *inputs = (uint16_t)in;
    *outputs = (uint16_t)out;
    return slots;
}
