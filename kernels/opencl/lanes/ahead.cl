// Tables of the next world, fetched into the caches while particles of this one read theirs (WORLDS).
// requires: shapes lanes/types

// Lines of the caches to be fetched, from one address to another.
typedef struct {
    size_t next, end;
} Lines;

#if WORLDS
#define CACHE_LINE 64

// Return a part of the lines of a table with size bytes; none where they are more than twice the reads meanwhile.
Lines lines_ahead(const size_t table, const long size, const int part, const int parts, const long reads) {
    const int lines = (int)(size / CACHE_LINE), each = (lines + parts - 1) / parts;
    const size_t begin = table + (size_t)(each * part) * CACHE_LINE;
    const Lines none = {0, 0}, ahead = {begin, begin + (size_t)each * CACHE_LINE};
    return lines > 2 * reads ? none : ahead;
}

// Fetch some of the lines, if any are left. Many at once would keep other reads waiting.
INLINE void fetch_lines(Lines *ahead, const int some) {
    if (ahead->next >= ahead->end) return;
    for (int i = 0; i < some; ++i) __builtin_prefetch((const void *)(ahead->next + i * CACHE_LINE), 0, 2);
    ahead->next += (size_t)some * CACHE_LINE;
}
#else
#define fetch_lines(ahead, some)
#endif
