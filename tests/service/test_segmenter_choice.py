import numpy as np
import pytest
from pydantic import ValidationError

from canopy_skel.pipeline import MethodConfig
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


def test_a_scan_that_names_no_segmenter_gets_the_one_of_the_rig():
    body = ScanBody(tree_id="t", path="one")
    assert scan_spec(body, PATHS, SpeedCaps()).segmenter == "recorded"
    assert scan_spec(body, PATHS, SpeedCaps(), "unet").segmenter == "unet"
    own = ScanBody(tree_id="t", path="one", segmenter="recorded")
    assert scan_spec(own, PATHS, SpeedCaps(), "unet").segmenter == "recorded"


def test_a_scan_is_made_with_method_canopy_unless_it_says_otherwise():
    spec = scan_spec(ScanBody(tree_id="t", path="one"), PATHS, SpeedCaps())
    assert spec.config == MethodConfig(name="canopy")
    assert spec_from(spec.scan_id, fields_of(spec)).config == spec.config


def test_a_scan_may_ask_for_one_rooted_tree_and_gets_it_after_a_restart():
    spec = scan_spec(ScanBody(tree_id="t", path="one", rooted=True), PATHS, SpeedCaps())
    assert spec.config.canopy.rooted
    assert spec_from(spec.scan_id, fields_of(spec)).config == spec.config


def test_a_scan_may_say_how_far_its_tree_reaches_for_every_method():
    spec = scan_spec(ScanBody(tree_id="t", path="one", farthest_m=2.5), PATHS, SpeedCaps())
    assert spec.config.cluster.farthest_m == spec.config.canopy.pieces.farthest_m == 2.5
    assert spec_from(spec.scan_id, fields_of(spec)).config == spec.config


def test_requests_kept_before_trees_could_be_rooted_are_still_understood():
    spec = scan_spec(ScanBody(tree_id="t", path="one"), PATHS, SpeedCaps())
    fields = fields_of(spec)
    del fields["rooted"], fields["farthest_m"], fields["fragments"]
    assert spec_from(spec.scan_id, fields).config == spec.config


@pytest.mark.parametrize("asked", [{"rooted": True}, {"fragments": False}])
def test_what_is_for_method_canopy_is_refused_with_others(asked):
    with pytest.raises(ValidationError, match="are for method canopy; leave them out with paper"):
        ScanBody(tree_id="t", path="one", method="paper", **asked)


def test_an_unknown_segmenter_is_refused_before_anything_moves():
    with pytest.raises(ValidationError, match="segmenter"):
        ScanBody(tree_id="t", path="one", segmenter="maskrcnn9")
