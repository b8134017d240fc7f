// Tables of the next world, fetched into the caches while particles of this one read theirs (WORLDS).
// requires: shapes

// Lines of the caches to be fetched, from one address to another.
typedef struct {
    size_t next, end;
} Lines;

#if WORLDS
#define CACHE_LINE 64

// Return a part of the lines of a table with size bytes; none where they are more than twice the reads meanwhile.
Lines lines_ahead(const size_t table, const long size, const long part, const long parts, const long reads) {
    const long lines = size / CACHE_LINE;
    const Lines none = {0, 0};
    const Lines ahead = {table + lines * part / parts * CACHE_LINE, table + lines * (part + 1) / parts * CACHE_LINE};
    return lines > 2 * reads ? none : ahead;
}

// Fetch the next lines. Many at once would keep other reads waiting.
void fetch_lines(Lines *ahead, const int most) {
    for (int i = 0; i < most && ahead->next < ahead->end; ++i, ahead->next += CACHE_LINE)
        __builtin_prefetch((const void *)ahead->next, 0, 2);
}
#else
#define fetch_lines(ahead, most)
#endif
