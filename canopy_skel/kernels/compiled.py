"""How kernels are compiled: on import, for exactly the types in their signature, kept on disk.

Callers must pass these types: arrays of this dtype, C-contiguous where the signature has `::1`,
and writable. Most of compiling is Numba's own Python, so what is compiled is kept small: a wrapper
only for what Python calls, none for C; loops instead of `np.linalg`, `np.sort`, `np.median`,
arithmetic of whole arrays and assignments to slices, which take a second or more each. No module
with kernels that Python calls imports another: processes that compile one each would compile both.
"""

from collections.abc import Callable
from typing import TypeVar

from numba import njit

Function = TypeVar("Function", bound=Callable[..., object])


def kernel(signature: str, error_model: str = "python") -> Callable[[Function], Function]:
    """Return the decorator for what Python calls."""
    decorator: Callable[[Function], Function] = njit(  # type: ignore[call-overload]  # not in its stubs
        signature, cache=True, nogil=True, error_model=error_model, no_cfunc_wrapper=True
    )
    return decorator


def inner(signature: str, error_model: str = "python") -> Callable[[Function], Function]:
    """Return the decorator for what only kernels call."""
    decorator: Callable[[Function], Function] = njit(  # type: ignore[call-overload]  # not in its stubs
        signature,
        cache=True,
        nogil=True,
        error_model=error_model,
        no_cfunc_wrapper=True,
        no_cpython_wrapper=True,
    )
    return decorator
