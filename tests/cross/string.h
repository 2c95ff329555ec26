/* SPDX-License-Identifier: MIT
 *
 * All that the core asks of a C library: the four functions that compilers call by themselves. For builds on targets
 * that have none.
 */
#ifndef STRING_H
#define STRING_H

#include <stddef.h>

void *memcpy(void *restrict to, const void *restrict from, size_t n);
void *memmove(void *to, const void *from, size_t n);
void *memset(void *to, int octet, size_t n);
int memcmp(const void *a, const void *b, size_t n);

#endif
