"""Linked regions by a search from every cell in reading order."""

from itertools import product

import numpy as np


def linked_slowly(inside, maps, least_cosine, most_ratio):
    height, width = inside.shape
    out = np.zeros((height, width), np.int32)

    def alike(a, b):
        u, v = maps[:2, *a].astype(float), maps[:2, *b].astype(float)
        cosine = u @ v / (np.linalg.norm(u) * np.linalg.norm(v))
        return cosine >= least_cosine and abs(maps[2, *a] - maps[2, *b]) <= most_ratio

    for start in product(range(height), range(width)):
        if not inside[start] or out[start]:
            continue
        number = out.max() + 1
        out[start] = number
        todo = [start]
        while todo:
            i, j = todo.pop()
            for di, dj in product((-1, 0, 1), repeat=2):
                near = (i + di, j + dj)
                if (
                    0 <= near[0] < height
                    and 0 <= near[1] < width
                    and inside[near]
                    and not out[near]
                    and alike((i, j), near)
                ):
                    out[near] = number
                    todo.append(near)
    return out
