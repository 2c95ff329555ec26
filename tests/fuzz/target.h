/* SPDX-License-Identifier: MIT
 *
 * What every fuzz target has: oracles that end the program, and with -DREPLAY a main that replays the files it is given, for
 * compilers without libFuzzer. Included once, by the target.
 */
#ifndef DPM_FUZZ_TARGET_H
#define DPM_FUZZ_TARGET_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#define MUST(x) ((x) ? (void)0 : (fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #x), abort()))

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#ifdef REPLAY
int main(int argc, char **argv)
{
    static uint8_t input[4096]; /* libFuzzer's own limit, without -max_len */
    for (int i = 1; i < argc; i++) {
        FILE *file = fopen(argv[i], "rb");
        if (!file)
            return fprintf(stderr, "%s: cannot be read\n", argv[i]), 1;
        LLVMFuzzerTestOneInput(input, fread(input, 1, sizeof input, file));
        fclose(file);
    }
    return 0;
}
#endif

#endif
