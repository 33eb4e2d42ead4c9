import numpy as np
import pytest
from contracts.segmenter import SegmenterContract
from scenes.drawn import drawn, straight
from scenes.views import view_of

from canopy_skel.segmenters.recorded import RecordedSegmenter


class TestRecordedSegmenter(SegmenterContract):
    @pytest.fixture
    def segmenter(self):
        return RecordedSegmenter()

    @pytest.fixture
    def view_with_branches(self):
        image = drawn([straight((80, 60), 20, 90, 4), straight((200, 160), 110, 120, 7)])
        return view_of(image.color_rgb, instances=image.instances, scores=(0.9, 0.7))

    @pytest.fixture
    def empty_view(self):
        nothing = np.zeros((40, 60), np.uint16)
        return view_of(np.zeros((40, 60, 3), np.uint8), instances=nothing, scores=())
