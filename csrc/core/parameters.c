/* SPDX-License-Identifier: MIT
 *
 * Bus parameters: the standard sets, the rules between them, bit times in ns. Integers only, and nothing outside the
 * caller's structures is touched.
 */
#include "dpmaster/error.h"
#include "dpmaster/parameters.h"

#define SECOND 1000000000
#define HSA 126
/* One GAP round polls every other address, 66 Tbit and a slot each; a round in G * Ttr may take this part of the bus. */
#define GAP_SHARE 50
#define G_MAX 100
/* "User profile: TTR >= 5000 HSA"; room for 125 slaves with some 170 octets of inputs and outputs each at any rate. */
#define TTR (5000 * HSA)
#define TSL_MARGIN 15 /* Tsl1 = max Tsdr + 11 + Tsm, and Tsm is 4 where Tset is 1: the engineering tools' rule */

typedef struct profile {
    uint32_t rate, rate_num, rate_den;
    uint16_t tsl, max_tsdr;
    uint8_t tqui, tset, max_retry_limit;
} profile;

/* The DP profile. Rates up to 187.5 kbit/s share one row of the standard, 31.25 kbit/s of DP/PA couplers among them. */
static const profile profiles[] = {
    {9600, 9600, 1, 100, 60, 0, 1, 1},
    {19200, 19200, 1, 100, 60, 0, 1, 1},
    {31250, 31250, 1, 100, 60, 0, 1, 1},
    {45450, 500000, 11, 100, 60, 0, 1, 1},
    {93750, 93750, 1, 100, 60, 0, 1, 1},
    {187500, 187500, 1, 100, 60, 0, 1, 1},
    {500000, 500000, 1, 200, 100, 0, 1, 1},
    {1500000, 1500000, 1, 300, 150, 0, 1, 1},
    {3000000, 3000000, 1, 400, 250, 3, 4, 2},
    {6000000, 6000000, 1, 600, 450, 6, 8, 3},
    {12000000, 12000000, 1, 1000, 800, 9, 16, 4},
};

#define PROFILES (sizeof profiles / sizeof profiles[0])

uint32_t dpm_parameters_rate(unsigned index)
{
    return index < PROFILES ? profiles[index].rate : 0;
}

uint8_t dpm_parameters_g(const dpm_parameters *parameters)
{
    uint32_t round = parameters->hsa * (66 + (uint32_t)parameters->tsl);
    uint32_t g = parameters->ttr ? round * GAP_SHARE / parameters->ttr + 1 : G_MAX;
    return (uint8_t)(g < G_MAX ? g : G_MAX);
}

int dpm_parameters_default(dpm_parameters *parameters, uint32_t rate, uint16_t max_tsdr)
{
    if (rate == 45454 || rate == 45455)
        rate = 45450;
    const profile *p = profiles;
    while (p->rate != rate)
        if (++p == profiles + PROFILES)
            return DPM_E_PARAMETER;

    uint16_t slowest = max_tsdr > p->max_tsdr ? max_tsdr : p->max_tsdr;
    /* May wrap only for a MaxTsdr far beyond 1023, which dpm_parameters_check refuses by its name, before Tsl. */
    uint16_t tsl = (uint16_t)(slowest + TSL_MARGIN);
    tsl = tsl > p->tsl ? tsl : p->tsl;
    *parameters = (dpm_parameters){
        .rate_num = p->rate_num,
        .rate_den = p->rate_den,
        .tsl = tsl,
        .min_tsdr = 11,
        .max_tsdr = slowest,
        .tqui = p->tqui,
        .tset = p->tset,
        .ttr = TTR,
        .hsa = HSA,
        .max_retry_limit = p->max_retry_limit,
    };
    parameters->g = dpm_parameters_g(parameters);
    return DPM_OK;
}

static int64_t least(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

static int64_t most(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

/* The order matters: a bound is computed only from parameters that have passed. */
int dpm_parameters_check(const dpm_parameters *parameters, uint8_t address, dpm_refusal *refusal)
{
    const dpm_parameters *p = parameters;
    const int64_t tid1 = 35 + 2 * p->tset + p->tqui;
    const dpm_refusal rules[] = {
        {"rate", p->rate_den ? p->rate_num / p->rate_den : 0, 9600, 12000000, "9600 bit/s to 12 Mbit/s"},
        {"address", address, 0, 125, "a station's address is 0 to 125; 126 and 127 are no master's"},
        {"tset", p->tset, 1, 255, "1 to 255 Tbit"},
        {"tqui", p->tqui, 0, 31, "at most 31 Tbit"},
        {"max_tsdr", p->max_tsdr, tid1, 1023, "35 + 2 Tset + Tqui to 1023 Tbit"},
        {"min_tsdr", p->min_tsdr, 11, least(255, tid1 - 1),
         "11 to 255 Tbit, below 35 + 2 Tset + Tqui and with that below max Tsdr"},
        {"tqui", p->tqui, 0, p->min_tsdr - 1, "below min Tsdr: the line is quiet again before an answer begins"},
        {"tsl", p->tsl, most(52, p->max_tsdr + TSL_MARGIN), 16383, "max Tsdr + 15 to 16383 Tbit"},
        {"ttr", p->ttr, 256, 16777960, "256 to 16777960 Tbit"},
        {"g", p->g, 1, 100, "1 to 100"},
        {"hsa", p->hsa, address, 126, "from the own address to 126"},
        {"max_retry_limit", p->max_retry_limit, 0, 15, "0 to 15"},
    };
    for (unsigned i = 0; i < sizeof rules / sizeof rules[0]; i++) {
        if (rules[i].value >= rules[i].minimum && rules[i].value <= rules[i].maximum)
            continue;
        if (refusal)
            *refusal = rules[i];
        return DPM_E_PARAMETER;
    }
    return DPM_OK;
}

/* Exact: whole seconds are split off first, so the rest times 10^9 stays below 2^62. */
static int64_t nanoseconds(const dpm_parameters *parameters, int64_t bits, bool up)
{
    int64_t num = parameters->rate_num, scaled = bits * parameters->rate_den;
    return scaled / num * SECOND + (scaled % num * SECOND + (up ? num - 1 : 0)) / num;
}

int64_t dpm_bits_up(const dpm_parameters *parameters, int64_t bits)
{
    return nanoseconds(parameters, bits, true);
}

int64_t dpm_bits_down(const dpm_parameters *parameters, int64_t bits)
{
    return nanoseconds(parameters, bits, false);
}

uint32_t dpm_tid1(const dpm_parameters *parameters)
{
    return (uint32_t)most(35 + 2 * parameters->tset + parameters->tqui, parameters->min_tsdr);
}

uint32_t dpm_tid2(const dpm_parameters *parameters)
{
    return (uint32_t)most(dpm_tid1(parameters), parameters->max_tsdr);
}

uint32_t dpm_tto(const dpm_parameters *parameters, uint8_t address)
{
    return (6u + 2u * address) * parameters->tsl;
}

/* Characters of a Data_Exchange request: SD1 without outputs, else SD2; of its answer: SC without inputs. */
static uint32_t request_bits(unsigned outputs)
{
    return DPM_CHARACTER_BITS * (outputs ? 9 + outputs : 6);
}

static uint32_t answer_bits(unsigned inputs)
{
    return DPM_CHARACTER_BITS * (inputs ? 9 + inputs : 1);
}

uint32_t dpm_predict_exchange(const dpm_parameters *parameters, unsigned outputs, unsigned inputs)
{
    return request_bits(outputs) + parameters->max_tsdr + answer_bits(inputs) + dpm_tid1(parameters);
}

uint32_t dpm_predict_failure(const dpm_parameters *parameters, unsigned outputs)
{
    return request_bits(outputs) + parameters->tsl;
}

uint32_t dpm_predict_token(const dpm_parameters *parameters)
{
    return 3 * DPM_CHARACTER_BITS + dpm_tid1(parameters);
}

uint32_t dpm_predict_global_control(const dpm_parameters *parameters)
{
    return 13 * DPM_CHARACTER_BITS + dpm_tid2(parameters);
}
