"""How kernels are compiled: on import, for exactly the types in their signature, kept on disk.

Callers must pass these types: arrays of this dtype, C-contiguous where the signature has `::1`,
and writable. Most of compiling is Numba's own Python, so what is compiled is kept small: a wrapper
only for what Python calls, none for C; loops instead of `np.linalg`, `np.sort`, `np.median` and
assignments to slices, which take a second or more each.
"""

from typing import Any

from numba import njit


def kernel(signature: str, **options: object) -> Any:
    """Return the decorator for what Python calls."""
    return njit(signature, cache=True, nogil=True, no_cfunc_wrapper=True, **options)


def inner(signature: str, **options: object) -> Any:
    """Return the decorator for what only kernels call."""
    return njit(
        signature,
        cache=True,
        nogil=True,
        no_cfunc_wrapper=True,
        no_cpython_wrapper=True,
        **options,
    )
