"""Which topics and frames of a recording hold what, and how far apart in time may be paired."""

from dataclasses import dataclass, fields

from canopy_skel import messages

PICTURE_ROLES = ("color_image", "depth_image", "left_image", "right_image", "instances")
CALIBRATION_ROLES = ("color_calibration", "left_calibration", "right_calibration")
# What belongs to one exposure and is missing when that exposure was cut off.
EXPOSURE_ROLES = (*PICTURE_ROLES, "scores")


@dataclass(frozen=True, kw_only=True, slots=True)
class TopicOptions:
    """Topic names by role (defaults: the canopy recording), frames, and limits in time.

    base_frame: where the skeleton shall be. tool_frame: what is mounted on it does not move against
    it. max_pair_gap_ns: pictures of one exposure may differ by this. max_pose_gap_ns: poses are
    interpolated between neighbours no further apart. rectified: the pictures are undistorted
    already, and the P of their calibration holds (ROS `image_rect` topics).
    """

    color_image: str = messages.COLOR_IMAGE.name
    color_calibration: str = messages.COLOR_CALIBRATION.name
    depth_image: str = messages.DEPTH_IMAGE.name
    left_image: str = messages.LEFT_IMAGE.name
    left_calibration: str = messages.LEFT_CALIBRATION.name
    right_image: str = messages.RIGHT_IMAGE.name
    right_calibration: str = messages.RIGHT_CALIBRATION.name
    instances: str = messages.INSTANCES.name
    scores: str = messages.SCORES.name
    transforms: str = messages.TRANSFORMS.name
    static_transforms: str = "/tf_static"
    base_frame: str = messages.BASE_FRAME
    tool_frame: str = messages.TOOL_FRAME
    max_pair_gap_ns: int = 20_000_000
    max_pose_gap_ns: int = 100_000_000
    rectified: bool = False

    def role_of(self, topic: str) -> str | None:
        """Return the name of the field that holds this topic."""
        for one in fields(self):
            if one.name not in ("base_frame", "tool_frame") and getattr(self, one.name) == topic:
                return one.name
        return None


ROS2_TOPICS = TopicOptions(
    color_image="/camera/color/image_raw",
    color_calibration="/camera/color/camera_info",
    depth_image="/camera/aligned_depth_to_color/image_raw",
    left_image="/camera/left/image_raw",
    left_calibration="/camera/left/camera_info",
    right_image="/camera/right/image_raw",
    right_calibration="/camera/right/camera_info",
    base_frame="base_link",
)
