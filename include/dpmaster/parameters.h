/* SPDX-License-Identifier: MIT
 *
 * Bus parameters and bit-time arithmetic. Tbit figures are the standard's; nanoseconds appear only where a machine
 * compares them with a clock: minima are rounded up, maxima down, so rounding never breaks a rule.
 */
#ifndef DPMASTER_PARAMETERS_H
#define DPMASTER_PARAMETERS_H

#include "dpmaster/api.h"

#define DPM_CHARACTER_BITS 11 /* start, eight data, even parity, stop */
#define DPM_TSYN 33           /* Tbit of silence before every request */
#define DPM_TSYNI 11385       /* Tbit without such a silence that are babbling: 2 (2 (33 + 255 * 11)) + 33 */

typedef struct dpm_parameters {
    uint32_t rate_num;       /* bit/s as a fraction: 500000/11 for 45.45 kbit/s */
    uint32_t rate_den;
    uint16_t tsl;            /* slot time, Tbit, 52..16383, >= max_tsdr + 15 */
    uint16_t min_tsdr;       /* 11..255, < max_tsdr */
    uint16_t max_tsdr;       /* 37..1023 */
    uint8_t tqui;            /* 0..31, < min_tsdr */
    uint8_t tset;            /* 1..255 */
    uint32_t ttr;            /* target rotation time, 256..16777960 */
    uint8_t g;               /* GAP update factor, 1..100 */
    uint8_t hsa;             /* highest station address, 0..126, >= own */
    uint8_t max_retry_limit; /* 0..15 */
} dpm_parameters;

/* Why a set of parameters is refused; all pointers are to constant text. */
typedef struct dpm_refusal {
    const char *parameter;
    int64_t value;
    int64_t minimum;
    int64_t maximum;
    const char *rule;
} dpm_refusal;

/* The standard set for a nominal rate in bit/s (9600, 19200, 31250, 45450, 93750, 187500, 500000, 1500000, 3000000,
 * 6000000, 12000000; 45454 and 45455 mean 45450) and the largest MaxTsdr of the stations, Tbit (0: the table's).
 * DPM_E_PARAMETER for any other rate. */
DPM_API int dpm_parameters_default(dpm_parameters *parameters, uint32_t rate, uint16_t max_tsdr);

/* 0, or DPM_E_PARAMETER with the first rule that is broken. `address` is the own station's. */
DPM_API int dpm_parameters_check(const dpm_parameters *parameters, uint8_t address, dpm_refusal *refusal);

/* The least G, up to 100, with which the polls of a GAP round, one in G * Ttr, take no more than 2 % of the bus. */
DPM_API uint8_t dpm_parameters_g(const dpm_parameters *parameters);

/* Nominal rates in ascending order; returns 0 past the last. */
DPM_API uint32_t dpm_parameters_rate(unsigned index);

/* Nanoseconds of `bits` Tbit, rounded up or down. */
DPM_API int64_t dpm_bits_up(const dpm_parameters *parameters, int64_t bits);
DPM_API int64_t dpm_bits_down(const dpm_parameters *parameters, int64_t bits);

/* Derived times in Tbit. Tid1 = 35 + 2 Tset + Tqui, at least min Tsdr; Tid2 = max(Tid1, max Tsdr); Tto = (6 + 2 n) Tsl. */
DPM_API uint32_t dpm_tid1(const dpm_parameters *parameters);
DPM_API uint32_t dpm_tid2(const dpm_parameters *parameters);
DPM_API uint32_t dpm_tto(const dpm_parameters *parameters, uint8_t address);

/* Predicted Tbit (protocol page D.3, EN 50170 part 9 eq. 21): one Data_Exchange with the worst Tsdr, its request
 * unanswered once, the token to oneself, a Global_Control. Lengths in octets of user data, 0..244. */
DPM_API uint32_t dpm_predict_exchange(const dpm_parameters *parameters, unsigned outputs, unsigned inputs);
DPM_API uint32_t dpm_predict_failure(const dpm_parameters *parameters, unsigned outputs);
DPM_API uint32_t dpm_predict_token(const dpm_parameters *parameters);
DPM_API uint32_t dpm_predict_global_control(const dpm_parameters *parameters);

#endif
