/* SPDX-License-Identifier: MIT
 *
 * Chance by seed, for what makes faults: the segment hub and the simulated segment. Not for anything on a real bus.
 */
#ifndef DPM_CORE_CHANCE_H
#define DPM_CORE_CHANCE_H

#include <stdbool.h>
#include <stdint.h>

/* SplitMix64: a Weyl sequence through a mixing function; any seed is a good one. */
static inline uint64_t dpm_draw(uint64_t *state)
{
    uint64_t z = *state += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
}

/* The high half decides, the low octet is left for what to do. */
static inline bool dpm_hit(uint64_t drawn, uint32_t per_million)
{
    return (drawn >> 32) * 1000000u >> 32 < per_million;
}

/* A number from 0 to `most`. */
static inline int64_t dpm_draw_up_to(uint64_t *state, int64_t most)
{
    return most > 0 ? (int64_t)(dpm_draw(state) % ((uint64_t)most + 1)) : 0;
}

#endif
