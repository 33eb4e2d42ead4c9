import json
import time

import numpy as np
import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from scenes.bus import free_port, wait_for

from drivers.protocols import ToolPose
from service.broadcast import Broadcast
from service.bus import Keys, open_session
from service.rig import RigEvent

KEYS = Keys(site="orchard", rig="arm-1")


@pytest.fixture
def heard():
    """Two ends of a bus: the rig's session, and what another one hears."""
    samples = []
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session(listen=endpoint) as rig, open_session(connect=endpoint) as other:
        subscriber = other.declare_subscriber("canopy/v1/**", samples.append)
        publisher = rig.declare_publisher(KEYS.event("s1"))
        wait_for(lambda: publisher.matching_status.matching)
        yield rig, samples
        subscriber.undeclare()


def test_events_are_heard_by_whoever_listens(heard):
    session, samples = heard
    with Broadcast(session, KEYS, lambda: None) as broadcast:
        broadcast.event(RigEvent(scan_id="s1", kind="view", fields={"index": 3}))
        broadcast.event(RigEvent(scan_id="", kind="acknowledged", fields={"reason": "clear"}))
        (sample,) = wait_for(lambda: list(samples))
    assert str(sample.key_expr) == KEYS.event("s1")
    assert json.loads(sample.payload.to_bytes()) == {"kind": "view", "index": 3}


def test_the_pose_is_told_while_a_scan_is_under_way(heard):
    session, samples = heard
    turned = np.array([[0.0, -1, 0, 0.4], [1, 0, 0, 0.5], [0, 0, 1, 0.6], [0, 0, 0, 1]])
    here = [("s1", ToolPose(stamp_ns=1_000, base_from_tool0=turned))]
    with Broadcast(session, KEYS, lambda: here[0]):
        sample = wait_for(lambda: samples and samples[0])
        here[0] = None
        wait_for(lambda: _falls_silent(samples))
    assert str(sample.key_expr) == KEYS.pose("s1")
    message = PoseInFrame.FromString(sample.payload.to_bytes())
    assert message.frame_id == "base"
    pose = message.pose
    assert (pose.position.x, pose.position.y, pose.position.z) == (0.4, 0.5, 0.6)
    quaternion = pose.orientation
    assert [quaternion.x, quaternion.y, quaternion.z, quaternion.w] == pytest.approx(
        [0, 0, 0.5**0.5, 0.5**0.5]
    )


def _falls_silent(samples):
    count = len(samples)
    time.sleep(0.3)
    return len(samples) == count
