/* SPDX-License-Identifier: MIT
 *
 * What every header of the library shares: the export mark and the time scale.
 *
 * Python's binding takes its declarations from these headers (dpmaster/_build.py), so a header holds plain C only:
 * typedefs, enums, literal defines and prototypes. Anything that needs the preprocessor belongs into csrc/.
 *
 * Times are int64_t nanoseconds of one monotonic clock. Which clock is the caller's business: the core never reads one.
 */
#ifndef DPMASTER_API_H
#define DPMASTER_API_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifndef DPM_API
#define DPM_API __attribute__((visibility("default")))
#endif

/* A time that never comes: no deadline, or nothing to wait for. */
#define DPM_NEVER 0x7fffffffffffffff

#endif
