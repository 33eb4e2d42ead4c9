"""A real rig is what its file says, and without a whole file it is refused."""

import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_rig import CANOPY, Service, problem, rig_file, served, wait_until_ready, waypoint

from canopy_skel.errors import UsageError
from canopy_skel.recording import read_recording
from drivers.oak.camera import OakCamera
from drivers.oak.messages import OakConfig
from mock_hw.fake_ur.process import FakeUr, free_host
from mock_hw.replay import read_track
from service.compose import SIMULATED_PATHS, real
from service.rig_file import read_rig_file

FAKE_OAK = Path(__file__).parents[1] / "drivers/fake_oak_child.py"


def test_the_documented_file_says_what_it_seems_to_say(tmp_path):
    rig = read_rig_file(rig_file(tmp_path))
    assert rig.arm_config().host == "192.168.0.10"
    assert rig.arm_config().payload_kg == 0.62
    assert rig.arm_config().payload_cog_m == (0.0, -0.02, 0.045)
    assert rig.camera_config() == OakConfig()
    limits = rig.guard()
    assert limits.box_min_m == (-0.9, -0.9, -0.4)
    assert [one.name for one in limits.keep_outs] == ["tree row", "cart"]
    assert limits.tool_points_in_tool0.shape == (3, 3)
    tool_from_camera = rig.camera.tool_from_camera.matrix()
    np.testing.assert_allclose(tool_from_camera[:3, 3], [-0.045, 0.0, 0.06])
    np.testing.assert_allclose(tool_from_camera[:3, 0], [0, 1, 0], atol=1e-9)
    first = rig.waypoints()["look"][0]
    np.testing.assert_allclose(first[:3, 2], [1, 0, 0], atol=1e-9)  # the tool looks along +x


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('host = "192.168.0.10"', "", r"arm\.host: Field required"),
        ("payload_kg = 0.62", "", r"arm\.payload_kg: Field required"),
        ("payload_kg = 0.62", "payload_kg = 7", r"arm\.payload_kg: .* less than or equal to 5"),
        ("payload_kg = 0.62", "payload_kg = nan", r"arm\.payload_kg: .*finite"),
        ("tool_from_camera =", "camera_from_tool =", r"camera\.tool_from_camera: Field required"),
        ("0.70711, 0.70711]", "0.70711, 0.5]", r"quaternion_xyzw: .*has length 0\.866"),
        ('eye = "color"', 'eye = "right"', r"camera\.eye: .*'color' or 'left'"),
        ("box_max_m = [0.9", "box_max_m = [-0.9", r"limits: .*box_min_m must be below box_max_m"),
        ("speed_mps = 0.25", "speed_mps = 0", r"limits\.speed_mps: .*or equal to 0\.005"),
        ("speed_mps = 0.25", "speed_mps = 250", r"limits\.speed_mps: .*less than or equal to 1"),
        ("joint_speed_rps = 1.0", "joint_speed_rps = 57.3", r"joint_speed_rps: .*to 3\.14"),
        ("position = [-0.045, 0.0, 0.060]", "position = [-45, 0, 60]", r"tool_from_camera\.pos"),
        ("box_max_m = [0.9, 0.9, 1.1]", "box_max_m = [900, 900, 1100]", r"limits\.box_max_m\.0"),
        ("offset_m = -0.75", "offset_m = -750", r"keep_outs\.0\.offset_m"),
        ("[[-0.10, 0.0, 0.09]", "[[-100, 0.0, 90]", r"limits\.tool_points_m\.0\.0"),
        ("body_radius_m = 0.15", "body_radius_m = 1e-9", r"limits\.body_radius_m: .*to 0\.05"),
        (
            "payload_cog_m = [0.0, -0.02, 0.045]",
            "payload_cog_m = [0, -20, 45]",
            r"arm\.payload_cog",
        ),
        ("payload_kg = 0.62", "payload_kg = true", r"arm\.payload_kg: .*valid number"),
        ('host = "192.168.0.10"', 'host = " "', r"arm\.host: .*match pattern"),
        ("normal = [-1.0", "normal = [-2.0", r"keep_outs\.0\.normal: .*has length 2"),
        ("tool_points_m = [[-0.10, 0.0, 0.09]", "tool_points_m = [[1]", r"limits\.tool_points_m"),
        ("body_radius_m", "body_radius", r"limits\.body_radius: Extra inputs are not permitted"),
        ("position = [0.30, 0.20, 0.40]", "", r"paths\.look\.0\.position: Field required"),
        ("[arm]", "[arm", "is not TOML"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(old, new, complaint, tmp_path):
    path = rig_file(tmp_path, (old, new))
    with pytest.raises(UsageError, match=complaint) as refusal:
        read_rig_file(path)
    assert str(path) in str(refusal.value)


def test_a_file_that_is_not_there_or_not_text_is_refused(tmp_path):
    with pytest.raises(UsageError, match="no rig file"):
        read_rig_file(tmp_path / "192.168.0.10")
    with pytest.raises(UsageError, match="no rig file"):
        read_rig_file(tmp_path)
    (tmp_path / "rig.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match="is not TOML"):
        read_rig_file(tmp_path / "rig.toml")


def test_a_served_rig_has_the_limits_and_paths_of_its_file_and_wants_its_key(tmp_path):
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
    with FakeUr(free_host()) as controller:
        path = rig_file(
            tmp_path,
            ("192.168.0.10", controller.host),
            ("speed_mps = 0.25", "speed_mps = 0.12"),
        )
        key = tmp_path / "key"
        key.write_text("0123456789abcdef\n")
        command = [CANOPY, "serve", "--robot", path, "--data", tmp_path / "data"]
        command += ["--key-file", key, "--name", "rig-3"]
        service = Service(tmp_path / "data", command, controller)
        rig = service.launch()
        try:
            shown = rig.http.get("/v1/rig").json()
            assert shown["paths"] == {"look": 2}
            assert shown["caps"] == {"speed_mps": 0.12, "acceleration_mps2": 0.5}
            assert rig.http.get("/v1/rig", headers={"Host": "rig-3:8000"}).status_code == 200
            assert problem(rig.post("look"), 401) == "key_required"
            rig.http.headers["Authorization"] = "Bearer 0123456789abcdef"
            plan = rig.http.post("/v1/plans", json={"path": "look"}).json()
            assert plan["feasible"], plan
            below = np.array(SIMULATED_PATHS["orchard-10"][0])
            below[:3, 3] = [0.3, 0.2, -0.30]  # where the simulated cell lets it be
            body = {"waypoints": [waypoint(below)]}
            verdict = rig.http.post("/v1/plans", json=body).json()["waypoints"][0]
            assert "keep-out 'cart'" in verdict["reason"]
            assert rig.part("arm")["ready"]
            faster = rig.http.post("/v1/plans", json={"path": "look", "speed_mps": 0.2})
            assert problem(faster, 422) == "plan_refused"
        finally:
            assert service.end() == 0


def test_a_scan_has_the_payload_the_hand_eye_transform_and_the_file_itself(tmp_path):
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
    (tmp_path / "behaviour").write_text("well")
    child = (sys.executable, str(FAKE_OAK), str(tmp_path / "behaviour"))
    camera = OakCamera(OakConfig(open_timeout_s=10.0), child)

    @contextmanager
    def hardware_at(host, camera):
        rig = read_rig_file(rig_file(tmp_path, ("192.168.0.10", host)))
        with real(rig) as hardware:
            yield replace(hardware, camera=camera)

    with served(tmp_path / "data", camera, hardware_at=hardware_at) as rig:
        wait_until_ready(rig.http)
        scan_id = rig.start(path="look")
        assert rig.wait(scan_id, "done")["views_done"] == 2
        assert rig.http.get(f"/v1/scans/{scan_id}").json()["request"]["segmenter"] == "unet"
        state = rig.controller.do("state")
        assert state["payload_kg"] == 0.62
        recording = read_recording(tmp_path / "data" / "scans" / scan_id / f"{scan_id}.mcap")
    expected = read_rig_file(tmp_path / "rig.toml")
    assert recording.attachment("rig.json") == expected.model_dump_json(indent=1).encode()
    np.testing.assert_allclose(
        read_track(recording).tool_from_camera, expected.camera.tool_from_camera.matrix(), atol=1e-9
    )
