/* json_scan.h: the strict first pass over a JSON text. */
#ifndef DAR_LIB_JSON_SCAN_H
#define DAR_LIB_JSON_SCAN_H

#include <stdbool.h>
#include <stddef.h>

#define DAR_JSON_WHAT 96

/* Is text[0, size) RFC 8259 JSON with comments, UTF-8, at most DAR_JSON_DEPTH levels?  If so, comments (and a byte
 * order mark) in it are now spaces.  If not, *at is where, `what` why: "unexpected '}', expected a value".  Recursion
 * nowhere, time linear. */
bool dar_json_scan(char *text, size_t size, size_t *at, char what[DAR_JSON_WHAT]);

#endif
