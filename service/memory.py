"""How the C library deals with memory that pictures took."""

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_KEPT_BYTES = 1 << 29
_LARGE_BYTES = 1 << 25
"""The most that every glibc takes."""


def keep_freed_memory() -> bool:
    """Keep up to half a GiB of freed memory for the next view; False where there is no glibc.

    Otherwise arrays as large as a picture go back to the system after every view and come as fresh
    pages, 40 MB a view: a tenth of the time that one takes. Call it before threads start: they
    share what was freed, instead of each giving back its own.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = (
        (_M_MMAP_THRESHOLD, _LARGE_BYTES),
        (_M_TRIM_THRESHOLD, _KEPT_BYTES),
        (_M_ARENA_MAX, 1),
    )
    return all(mallopt(name, value) for name, value in settings)
