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

from canopy_skel.errors import UsageError

Function = TypeVar("Function", bound=Callable[..., object])


def kernel(signature: str, error_model: str = "python") -> Callable[[Function], Function]:
    """Return the decorator for what Python calls.

    Raises:
        UsageError: (by the decorator) there is no folder to keep kernels in.
    """
    return _kept(signature, error_model=error_model)


def inner(signature: str, error_model: str = "python") -> Callable[[Function], Function]:
    """Return the decorator for what only kernels call.

    Raises:
        UsageError: (by the decorator) there is no folder to keep kernels in.
    """
    return _kept(signature, error_model=error_model, no_cpython_wrapper=True)


def _kept(signature: str, **options: str | bool) -> Callable[[Function], Function]:
    decorator: Callable[[Function], Function] = njit(  # type: ignore[call-overload]  # not in its stubs
        signature, cache=True, nogil=True, no_cfunc_wrapper=True, **options
    )

    def compiled(function: Function) -> Function:
        try:
            return decorator(function)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
            raise UsageError(
                "compiled kernels cannot be kept: neither the folder of the program nor the home"
                " folder may be written; set NUMBA_CACHE_DIR to a folder that may"
            ) from error

    return compiled
