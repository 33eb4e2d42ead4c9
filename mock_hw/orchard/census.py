"""How well the foliage of simulated trees meets its densities, species by species."""

from collections.abc import Iterable
from dataclasses import dataclass

from mock_hw.orchard.dataset import Recorded

ALLOWED_MISS = 0.03


@dataclass(frozen=True, kw_only=True, slots=True)
class DensityRow:
    """All trees of a species under one foliage density.

    leaf_count, v_det, segmented: least and most. worst_miss: largest distance of V_det from its
    target; worst_file: the recording that has it.
    """

    species: str
    foliage: int
    trees: int
    leaf_count: tuple[int, int]
    v_det_target: float
    v_det: tuple[float, float]
    segmented: tuple[float, float]
    worst_miss: float
    worst_file: str


def density_rows(recordings: Iterable[Recorded]) -> list[DensityRow]:
    """Return one row per species and foliage density."""
    groups: dict[tuple[str, int], list[Recorded]] = {}
    for one in sorted(recordings, key=lambda one: one.file):
        groups.setdefault((one.species, one.foliage), []).append(one)
    return [_row(group) for _, group in sorted(groups.items())]


def as_table(rows: Iterable[DensityRow]) -> str:
    """Return the rows as a table for people, which Markdown shows as one too."""
    lines = [
        "| species | FD | trees | leaves | V_det | target | worst miss | of | segmented |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        stem = row.worst_file.removesuffix(".mcap")
        lines.append(
            f"| {row.species} | {row.foliage} | {row.trees} | {_span(row.leaf_count, 'd')} |"
            f" {_span(row.v_det, '.3f')} | {row.v_det_target:.2f} | {row.worst_miss:.3f} |"
            f" {stem} | {_span(row.segmented, '.3f')} |"
        )
    return "\n".join(lines)


def _row(group: list[Recorded]) -> DensityRow:
    worst = max(group, key=_miss)
    return DensityRow(
        species=worst.species,
        foliage=worst.foliage,
        trees=len(group),
        leaf_count=(min(r.leaf_count for r in group), max(r.leaf_count for r in group)),
        v_det_target=worst.v_det_target,
        v_det=(min(r.v_det for r in group), max(r.v_det for r in group)),
        segmented=(min(r.segmented for r in group), max(r.segmented for r in group)),
        worst_miss=round(_miss(worst), 6),
        worst_file=worst.file,
    )


def _miss(one: Recorded) -> float:
    return abs(one.v_det - one.v_det_target)


def _span(ends: tuple[float, float], form: str) -> str:
    low, high = (format(end, form) for end in ends)
    return low if low == high else f"{low}–{high}"
