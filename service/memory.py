"""How the C library deals with memory that pictures took."""

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT_BYTES, _LARGE_BYTES = 1 << 29, 1 << 26


def keep_freed_memory() -> bool:
    """Keep up to half a GiB of freed memory for the next view; False where there is no glibc.

    Otherwise arrays as large as a picture go back to the system after every view and come as fresh
    pages, 40 MB a view: a seventh of the time that one takes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES) and mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
    )
