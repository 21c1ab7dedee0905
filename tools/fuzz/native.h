/* Between `native.c` and what it fuzzes. */
#ifndef FUZZ_NATIVE_H
#define FUZZ_NATIVE_H

#include <stddef.h>
#include <stdint.h>

/* Take one input, whatever it is. */
void check(const uint8_t *bytes, size_t size);

/* Say that something was reached. */
void shown(uint64_t feature);

/* Whether an input goes all the way: while fuzzing one in 64, by its check sum. */
int chosen(void);

/* Say that a promise is broken; does not return. */
void finding(const char *why);

#endif
