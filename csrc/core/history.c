/* SPDX-License-Identifier: MIT
 *
 * A slave's last diagnoses: see history.h. It may touch its own block only.
 */
#include "dpmaster/history.h"

#include <string.h>

struct dpm_history {
    uint32_t room;
    uint32_t kept;
    uint32_t next; /* where the next record goes */
    dpm_diagnosis records[];
};

size_t dpm_history_size(uint16_t records)
{
    return records ? sizeof(dpm_history) + records * sizeof(dpm_diagnosis) : 0;
}

dpm_history *dpm_history_init(void *block, size_t size, uint16_t records)
{
    const size_t needed = dpm_history_size(records);
    if (!block || !needed || size < needed || (uintptr_t)block % 16)
        return NULL;
    dpm_history *history = block;
    memset(history, 0, needed);
    history->room = records;
    return history;
}

static dpm_diagnosis *newest(dpm_history *history)
{
    return history->kept ? &history->records[(history->next + history->room - 1) % history->room] : NULL;
}

void dpm_history_put(dpm_history *history, uint64_t number, int64_t time, const uint8_t *octets, uint8_t n)
{
    dpm_diagnosis *record = newest(history);
    n = n < DPM_IO_MAX ? n : DPM_IO_MAX;
    if (!record || record->length != n || memcmp(record->octets, octets, n) != 0) {
        record = &history->records[history->next];
        history->next = (history->next + 1) % history->room;
        history->kept += history->kept < history->room;
        *record = (dpm_diagnosis){.first = time, .length = n};
        memcpy(record->octets, octets, n);
    }
    record->number = number;
    record->time = time;
    record->count++;
}

size_t dpm_history_get(const dpm_history *history, uint64_t after, dpm_diagnosis *records, size_t n)
{
    size_t found = 0;
    for (uint32_t i = history->kept; i && found < n; i--) {
        const dpm_diagnosis *record = &history->records[(history->next + history->room - i) % history->room];
        if (record->number > after)
            records[found++] = *record;
    }
    return found;
}
