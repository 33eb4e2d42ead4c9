"""Rows condensed: means over topologies with standard errors, and differences on the same trees."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from service.experiment.rows import Row


@dataclass(frozen=True, kw_only=True, slots=True)
class Mean:
    """A mean over trees, its standard error (None of one tree), and how many trees."""

    mean: float
    error: float | None
    count: int

    def __str__(self) -> str:
        """Return the mean and its error in three decimals."""
        error = "" if self.error is None else f" ±{self.error:.3f}".replace("±0.", "±.")
        return f"{self.mean:.3f}{error}"


def mean_of(values: Iterable[float | None]) -> Mean | None:
    """Return the mean of those that are there; None of nothing."""
    numbers = [value for value in values if value is not None]
    if not numbers:
        return None
    mean = math.fsum(numbers) / len(numbers)
    if len(numbers) == 1:
        return Mean(mean=mean, error=None, count=1)
    variance = math.fsum((value - mean) ** 2 for value in numbers) / (len(numbers) - 1)
    return Mean(mean=mean, error=math.sqrt(variance / len(numbers)), count=len(numbers))


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows that can be narrowed down; those that failed are left out."""

    rows: tuple[Row, ...]

    @staticmethod
    def of(rows: Iterable[Row]) -> "Rows":
        """Take the rows that have figures."""
        return Rows(tuple(row for row in rows if not row.failed))

    def where(
        self,
        *,
        species: str | None = None,
        foliage: Sequence[int] | None = None,
        method: str | None = None,
        segmenter: str | None = None,
    ) -> "Rows":
        """Return the rows for which everything given holds."""

        def wanted(row: Row) -> bool:
            return (
                species in (None, row.tree.species)
                and (foliage is None or row.tree.foliage in foliage)
                and method in (None, row.method)
                and segmenter in (None, row.segmenter)
            )

        return Rows(tuple(row for row in self.rows if wanted(row)))

    def mean(self, figure: str) -> Mean | None:
        """Return the mean of a figure over the rows."""
        return mean_of(row.number(figure) for row in self.rows)

    @property
    def species(self) -> list[str]:
        """The species there are."""
        return sorted({row.tree.species for row in self.rows})

    @property
    def foliage(self) -> list[int]:
        """The foliage densities there are."""
        return sorted({row.tree.foliage for row in self.rows})

    @property
    def trees(self) -> int:
        """How many trees there are."""
        return len({row.tree.sha256 for row in self.rows})

    def difference(self, figure: str, method: str, other: str) -> Mean | None:
        """Return the mean of method - other over the trees and segmenters that both have."""
        sides = [
            {(row.tree.sha256, row.segmenter): row.number(figure) for row in rows.rows}
            for rows in (self.where(method=method), self.where(method=other))
        ]
        pairs = ((sides[0][key], sides[1][key]) for key in sides[0].keys() & sides[1].keys())
        return mean_of(a - b for a, b in pairs if a is not None and b is not None)
