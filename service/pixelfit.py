"""Fit the small network that tells wood pixels from leaves."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from canopy_skel.frame import Float32Array
from canopy_skel.geometry import BoolArray
from canopy_skel.woodpixels import PixelModel

HIDDEN = 48
_ROUNDS = 8
_BATCH = 2048
_FASTEST = 0.004
_DECAY = 0.01


def fit_pixels(
    figures: Float32Array, right: BoolArray, weights: Float32Array, provenance: str
) -> PixelModel:
    """Fit to figures (N, F) of pixels, which of them are wood (N,), their weights (N,).

    The same pixels in the same order give the same model.
    """
    # In double: as 32-bit sums over millions of rows, means and spreads come out wrong.
    means = figures.mean(axis=0, dtype=np.float64).astype(np.float32)
    scales = (figures.std(axis=0, dtype=np.float64) + 1e-6).astype(np.float32)
    rows = np.column_stack([(figures - means) / scales, right, weights / weights.mean()])
    with _one_thread():
        net = _trained(torch.from_numpy(rows.astype(np.float32, copy=False)))
    first, first_bias, second, second_bias = (
        parameter.detach().numpy().astype(np.float32) for parameter in net.parameters()
    )
    raw: NDArray[np.float32] = first.T / scales[:, None]
    return PixelModel(
        first=np.ascontiguousarray(raw),
        first_bias=first_bias - means @ raw,
        second=second[0],
        second_bias=float(second_bias[0]),
        provenance=provenance,
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch use one thread: batches are too small for more, and sums would depend on them."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _trained(rows: torch.Tensor) -> nn.Sequential:
    """Return the network for rows (N, F + 2): figures, wood or not, weight."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        count = rows.shape[1] - 2
        net = nn.Sequential(nn.Linear(count, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))
        batches = -(-len(rows) // _BATCH)
        steps = torch.optim.AdamW(net.parameters(), lr=_FASTEST, weight_decay=_DECAY)
        rates = torch.optim.lr_scheduler.OneCycleLR(
            steps, _FASTEST, total_steps=_ROUNDS * batches, cycle_momentum=False
        )
        for _ in range(_ROUNDS):
            for batch in rows[torch.randperm(len(rows))].tensor_split(batches):
                odds = net(batch[:, :count])[:, 0]
                loss = nn.functional.binary_cross_entropy_with_logits(
                    odds, batch[:, -2], weight=batch[:, -1]
                )
                steps.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
                steps.step()
                rates.step()
    return net
