"""What each pixel of an instance knows of the instance's middle line."""

import numpy as np
from numpy.typing import NDArray

from canopy_skel.kernels.compiled import kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U16 = NDArray[np.uint16]
F32 = NDArray[np.float32]


@kernel("void(uint16[:,::1], float64[:,::1], int64[::1], int64, float32[:,:,::1])")
def nearest_on_lines(instances: U16, lines: F64, starts: I64, stride: int, out: F32) -> None:
    """Fill out (h, w, 3) with offset from the middle line, its angle and its radius.

    instances: (h, w), 0 = none; cell (i, j) stands for u = stride·j + (stride-1)/2, v likewise.
    lines: (M, 3) u, v, radius of all lines; that of instance k is lines[starts[k-1]:starts[k]].
    """
    shift = 0.5 * (stride - 1)
    for i in range(instances.shape[0]):
        for j in range(instances.shape[1]):
            k = instances[i, j]
            if k == 0:
                continue
            u, v = stride * j + shift, stride * i + shift
            best = np.inf
            for n in range(starts[k - 1], starts[k] - 1):
                du, dv = lines[n + 1, 0] - lines[n, 0], lines[n + 1, 1] - lines[n, 1]
                square = du * du + dv * dv + 1e-12
                t = ((u - lines[n, 0]) * du + (v - lines[n, 1]) * dv) / square
                t = min(max(t, 0.0), 1.0)
                a, b = u - lines[n, 0] - t * du, v - lines[n, 1] - t * dv
                away = a * a + b * b
                if away < best:
                    best = away
                    across = abs((u - lines[n, 0]) * dv - (v - lines[n, 1]) * du)
                    out[i, j, 0] = across / np.sqrt(square)
                    out[i, j, 1] = np.arctan2(dv, du)
                    out[i, j, 2] = lines[n, 2] + t * (lines[n + 1, 2] - lines[n, 2])
