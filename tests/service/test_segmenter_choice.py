import numpy as np
import pytest
from pydantic import ValidationError

from service.http.requests import ScanBody, SpeedCaps, scan_spec
from service.skeletons import SEGMENTERS
from service.specs import fields_of, spec_from

PATHS = {"one": [np.eye(4)]}


def test_a_scan_may_ask_for_any_segmenter_and_gets_it_after_a_restart():
    assert set(SEGMENTERS) == {"recorded", "unet"}
    for name in SEGMENTERS:
        body = ScanBody(tree_id="t", path="one", segmenter=name)
        spec = scan_spec(body, PATHS, SpeedCaps())
        assert spec.segmenter == name
        assert spec_from(spec.scan_id, fields_of(spec)).segmenter == name


def test_an_unknown_segmenter_is_refused_before_anything_moves():
    with pytest.raises(ValidationError, match="segmenter"):
        ScanBody(tree_id="t", path="one", segmenter="maskrcnn9")


def test_without_a_word_masks_come_from_the_recording():
    assert ScanBody(tree_id="t", path="one").segmenter == "recorded"
