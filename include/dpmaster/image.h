/* SPDX-License-Identifier: MIT
 *
 * The process image between the bus's thread and an application's: neither side waits for the other, neither ever
 * sees half of a write. A dpm_image carries whole frames one way, from one writing thread to one reading thread
 * (several threads of one side take turns under a lock of their own). A dpm_outputs adds what makes outputs safe:
 * an epoch. Every commit is stamped with the epoch it was made in, and only commits of the present epoch are ever sent.
 */
#ifndef DPMASTER_IMAGE_H
#define DPMASTER_IMAGE_H

#include "dpmaster/telegram.h"

typedef struct dpm_frame {
    uint64_t number;   /* of the commit, 1, 2, ...; of the update for inputs; 0: nothing yet */
    uint64_t cycle;    /* bus cycle the octets came in; 0 for commits */
    int64_t time;      /* ns, when they were received or committed */
    uint32_t epoch;
    uint16_t length;
    bool valid;        /* inputs: the station is in Data_Exchange; a slave's outputs: not cleared */
    uint8_t octets[DPM_IO_MAX];
} dpm_frame;

typedef struct dpm_image dpm_image;

DPM_API size_t dpm_image_size(void);
/* In the caller's block; NULL when that is too small or not aligned to 16. */
DPM_API dpm_image *dpm_image_init(void *block, size_t size);

/* Writing side: hand over a copy of `frame`; its number is set here (the last one plus 1) and returned. */
DPM_API uint64_t dpm_image_put(dpm_image *image, const dpm_frame *frame);
/* Reading side: the newest frame, valid until the next call; never NULL. */
DPM_API const dpm_frame *dpm_image_get(dpm_image *image);
/* Reading side: a copy of it, for who may read again before it is done: a signal's handler. */
DPM_API void dpm_image_read(dpm_image *image, dpm_frame *frame);

typedef struct dpm_outputs dpm_outputs;

DPM_API size_t dpm_outputs_size(void);
/* Outputs of `length` octets, 0..244; all zero, epoch 1. NULL as dpm_image_init, and for a longer one. */
DPM_API dpm_outputs *dpm_outputs_init(void *block, size_t size, uint16_t length);

/* Application: change `n` octets at `offset` and commit the whole image in one step. Octets not named keep what was
 * committed before in this epoch; in a new epoch they begin as zeros. Returns the commit's number (1, 2, ...),
 * DPM_E_LENGTH, or DPM_E_LATCHED while latched. */
DPM_API int64_t dpm_outputs_commit(dpm_outputs *outputs, uint16_t offset, const uint8_t *octets, uint16_t n, int64_t now);
/* Application: the same, but bits set in `keep` (n octets) stay as the next commit would have them anyway: a bit of a
 * word is changed with no moment between reading and writing in which an epoch could end and an old bit cross over. */
DPM_API int64_t dpm_outputs_change(dpm_outputs *outputs, uint16_t offset, const uint8_t *keep, const uint8_t *octets,
                                   uint16_t n, int64_t now);
/* Application: 1 when commit `number` (or one after it) was sent and answered, 0 not yet, DPM_E_DISCARDED when it
 * never will be, DPM_E_ARGUMENT when there is no such commit. */
DPM_API int dpm_outputs_was_sent(const dpm_outputs *outputs, uint64_t number);
/* Application: copy, in the length of the outputs, of what the next commit builds on. */
DPM_API void dpm_outputs_peek(const dpm_outputs *outputs, uint8_t *octets);

/* Bus: the frame to send now; the octets are zeros (number 0) while no commit of this epoch exists. */
DPM_API const dpm_frame *dpm_outputs_take(dpm_outputs *outputs);
/* Bus: the telegram with commit `number` was answered. */
DPM_API void dpm_outputs_answered(dpm_outputs *outputs, uint64_t number);
/* Bus: a new epoch: what was committed so far is never sent again. `latch` refuses commits until dpm_outputs_unlatch. */
DPM_API void dpm_outputs_make_safe(dpm_outputs *outputs, bool latch);
DPM_API void dpm_outputs_unlatch(dpm_outputs *outputs);

#endif
