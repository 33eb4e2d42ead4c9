"""Straight extensions of free ends, as far as they are probable and nothing was seen through."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from canopy_skel.errors import UsageError
from canopy_skel.evidence import BACKGROUND, HIDDEN, LEAF, THROUGH, WOOD, is_empty
from canopy_skel.geometry import BoolArray, FloatArray, IntArray
from canopy_skel.links import Cost, Evidence, Parts


@dataclass(frozen=True, kw_only=True, slots=True)
class ExtensionConfig:
    """Steps of `step_m` up to `reach_m`, while the probability is at least `min_probability`.

    From the end of a fragment, whose direction is less sure, `min_fragment_probability` counts. An
    extension also stops within `clear_m` of other wood.
    """

    step_m: float = 0.005
    reach_m: float = 0.15
    min_probability: float = 0.6
    min_fragment_probability: float = 0.8
    clear_m: float = 0.012

    def __post_init__(self) -> None:
        """Refuse steps that lead nowhere, and a reach without end."""
        if not (self.step_m > 0 and 0 <= self.reach_m < np.inf):
            raise UsageError(
                f"extensions in steps of step_m {self.step_m} m up to reach_m {self.reach_m} m:"
                " give a step above 0, such as 0.005, and a reach from 0 (none) on"
            )


@dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Rays:
    """What lies ahead of the chosen ends.

    end: (K,). points: (K, n, 3), step by step. features: (K, n, F). open: (K, n), nothing is in
    the way up to there.
    """

    end: IntArray
    points: FloatArray
    features: FloatArray
    open: BoolArray


def rays_of(
    parts: Parts, chosen: IntArray, evidence: Evidence, cost: Cost, config: ExtensionConfig
) -> Rays:
    """Look ahead of the chosen ends (K,); of none where not even a step is within reach."""
    ends, steps = parts.ends, round(config.reach_m / config.step_m)
    if steps == 0:
        chosen, steps = chosen[:0], 1
    start = ends.vertex[chosen]
    length = config.step_m * np.arange(1, steps + 1)
    points = parts.points[start][:, None] + length[None, :, None] * ends.tangents[chosen][:, None]
    shape = (len(chosen), steps)
    flat = points.reshape(-1, 3)
    counts = evidence(flat)
    empty = is_empty(counts).reshape(shape)
    nats = cost(flat).reshape(shape)
    far = np.arange(1, steps + 1)
    shares = {
        code: np.cumsum((counts[:, code] > 0).reshape(shape), axis=1) / far
        for code in (WOOD, LEAF, HIDDEN, THROUGH, BACKGROUND)
    }
    # Where leaves hide little of a tree, its ends are tips: what all rays meet tells that.
    leafy = float(shares[LEAF][:, -1].mean()) if len(chosen) else 0.0
    own = np.column_stack(
        [
            parts.confidence[start],
            np.log(parts.radius_m[start] + 1e-4),
            np.log(ends.behind_m[chosen] + 0.005),
            np.log(parts.length_m[start] + 0.01),
            ends.tangents[chosen][:, 2],
            shares[THROUGH][:, -1],
            np.full(len(chosen), leafy),
        ]
    )
    along = [
        np.broadcast_to(length, shape),
        np.broadcast_to(np.sqrt(length), shape),
        *shares.values(),
        nats,
        np.cumsum(nats, axis=1) / far,
    ]
    features = np.concatenate(
        [np.stack(along, axis=2), np.repeat(own[:, None], steps, axis=1)], axis=2
    )
    blocked = empty | _beside_wood(parts, start, points, config.clear_m)
    return Rays(
        end=chosen,
        points=points,
        features=features,
        open=np.logical_and.accumulate(~blocked, axis=1),
    )


def lengths(rays: Rays, parts: Parts, probability: FloatArray, config: ExtensionConfig) -> IntArray:
    """Return how many steps each extension goes (K,), for the probabilities (K, n)."""
    fragment = parts.fragment[parts.ends.vertex[rays.end]]
    limit = np.where(fragment, config.min_fragment_probability, config.min_probability)
    going = rays.open & (probability >= limit[:, None])
    return np.asarray(np.logical_and.accumulate(going, axis=1).sum(axis=1), dtype=np.int64)


def _beside_wood(parts: Parts, start: IntArray, points: FloatArray, clear_m: float) -> BoolArray:
    """Say which steps (K, n) come within `clear_m` of wood that is not the end itself."""
    distance, _ = cKDTree(parts.points).query(points.reshape(-1, 3))
    from_end = np.linalg.norm(points - parts.points[start][:, None], axis=2)
    near = np.asarray(distance).reshape(from_end.shape)
    return np.asarray((near < clear_m) & (near < from_end - 1e-6) & (from_end > clear_m))
