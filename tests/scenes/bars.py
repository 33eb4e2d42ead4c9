"""What a network that knows it would say of a bar, and strands on its grid."""

import numpy as np

from canopy_skel.segmenters.unet.grouping import Candidates
from canopy_skel.segmenters.unet.network import Known, Maps

SIZE = (120, 160)
MAP = {name: place for place, name in enumerate(Maps._fields)}
FEATURES = 2
KNOWN = len(Maps._fields) + FEATURES
MIDDLE = (80.0, 60.0)
RADIUS_CELLS = 4.0


def bar(angle_deg, length):
    """Return what a network that knows it would say of a bar in the middle, and its cells."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    angle = np.radians(angle_deg)
    c, s = np.cos(angle), np.sin(angle)
    along = (u - MIDDLE[0]) * c + (v - MIDDLE[1]) * s
    aside = (v - MIDDLE[1]) * c - (u - MIDDLE[0]) * s
    inside = (abs(along) <= length / 2) & (abs(aside) <= RADIUS_CELLS)
    share = -along / (length / 2)
    known = np.zeros((KNOWN, *SIZE), np.float32)
    known[MAP["branch"]] = np.where(inside, 4, -20)
    known[MAP["cosine"]], known[MAP["sine"]] = np.cos(2 * angle), np.sin(2 * angle)
    known[MAP["log_radius"]] = np.log(2 * RADIUS_CELLS)
    known[MAP["middle_u"]], known[MAP["middle_v"]] = share * c, share * s
    known[MAP["log_length"]] = np.log(2 * length)
    known[-2:] = 7.0
    return Known(known[:-FEATURES], known[-FEATURES:]), np.flatnonzero(inside)


def candidates(*cells):
    return Candidates(size=SIZE, cells=cells, way=np.zeros(len(cells), np.int64))
