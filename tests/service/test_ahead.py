import threading

import numpy as np
import pytest
from scenes.wood import view_from

from canopy_skel.errors import ViewError
from canopy_skel.segmenters.recorded import RecordedSegmenter
from service.ahead import Ahead


class Watched(RecordedSegmenter):
    """Tells who looked at what, and refuses view 9."""

    def __init__(self):
        super().__init__()
        self.seen, self.threads, self.looked = [], set(), threading.Event()

    def segment(self, view):
        self.seen.append(view.index)
        self.threads.add(threading.get_ident())
        self.looked.set()
        if view.index == 9:
            raise ViewError("view 9: no")
        return super().segment(view)


def test_an_expected_view_is_looked_at_before_it_is_asked_for_and_once():
    watched = Watched()
    with Ahead(watched, maps=False) as ahead:
        ahead.expect(view_from(4))
        assert watched.looked.wait(10)
        assert len(ahead.segment(view_from(4))) == 3
        assert len(ahead.segment(view_from(5))) == 3
    assert watched.seen == [4, 5]
    assert threading.get_ident() not in watched.threads


def test_an_error_reaches_who_asks_for_the_view():
    with Ahead(Watched(), maps=False) as ahead:
        ahead.expect(view_from(9))
        ahead.expect(view_from(2))
        assert len(ahead.segment(view_from(2))) == 3
        with pytest.raises(ViewError, match="view 9: no"):
            ahead.segment(view_from(9))


def test_maps_come_where_they_are_wanted():
    with Ahead(Watched(), maps=True) as ahead:
        masks, maps = ahead.segment_and_map(view_from(1))
    assert len(masks) == 3
    assert maps.shape == (8, 150, 200)
    assert maps.dtype == np.float32
