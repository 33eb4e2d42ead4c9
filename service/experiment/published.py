"""Table I of the paper: precision, recall and OSR by method, species and foliage density."""

METHODS = ("mst", "ftsem", "paper")
FIGURES = ("precision", "recall", "osr")
_TABLE = """
oak 1     .99 .88 .05  .97 .86 .03  .99 .91 .04
oak 2     .96 .78 .08  .93 .73 .04  .98 .82 .08
oak 3     .89 .51 .14  .88 .46 .11  .96 .54 .15
oak 4     .86 .29 .17  .90 .27 .16  .98 .32 .19
apple 1   .94 .71 .14  .91 .64 .07  .98 .73 .12
apple 2   .95 .62 .16  .94 .51 .05  .99 .65 .13
apple 3   .95 .49 .14  .91 .40 .05  .99 .52 .14
apple 4   .94 .39 .15  .91 .32 .06  .97 .42 .16
walnut 1  .95 .70 .10  .95 .65 .07  .99 .72 .08
walnut 2  .93 .64 .12  .93 .56 .06  .98 .66 .10
walnut 3  .86 .48 .15  .84 .39 .10  .96 .49 .16
walnut 4  .80 .34 .16  .84 .29 .13  .97 .34 .17
"""


def published() -> dict[tuple[str, int, str, str], float]:
    """Return the paper's numbers by (species, foliage density, method, figure)."""
    numbers = {}
    for line in _TABLE.split("\n")[1:-1]:
        species, foliage, *values = line.split()
        cells = [(method, figure) for method in METHODS for figure in FIGURES]
        for (method, figure), value in zip(cells, values, strict=True):
            numbers[species, int(foliage), method, figure] = float(value)
    return numbers
