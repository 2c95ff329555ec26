/* SPDX-License-Identifier: MIT
 *
 * The last answers of a slave to Slave_Diag. Where diagnoses come faster than a program reads, none between two reads
 * is lost as long as there is room, and how many were dropped can be told. Put and read on the machine's thread.
 */
#ifndef DPMASTER_HISTORY_H
#define DPMASTER_HISTORY_H

#include "dpmaster/telegram.h"

/* An answer, or the same one several times in a row: a slave that is asked again and again is one record. */
typedef struct dpm_diagnosis {
    uint64_t number;   /* of the last of them; numbers count all answers of the slave, from 1 */
    uint64_t count;    /* so many in a row */
    int64_t first;     /* ns, when the first of them came */
    int64_t time;      /* ns, when the last of them came */
    uint8_t length;
    uint8_t octets[DPM_IO_MAX];
} dpm_diagnosis;

typedef struct dpm_history dpm_history;

/* Bytes for a history of 1..65535 records; 0 for other numbers. */
DPM_API size_t dpm_history_size(uint16_t records);
/* NULL when the block is too small or not aligned to 16. */
DPM_API dpm_history *dpm_history_init(void *block, size_t size, uint16_t records);
/* Answer `number`, which came at `time`. A full history drops its oldest record. */
DPM_API void dpm_history_put(dpm_history *history, uint64_t number, int64_t time, const uint8_t *octets, uint8_t n);
/* Copy the records whose last answer has a number above `after`, oldest first, at most `n`: how many. What is missing between
 * `after` and the first answer of the first record was dropped. */
DPM_API size_t dpm_history_get(const dpm_history *history, uint64_t after, dpm_diagnosis *records, size_t n);

#endif
