"""Drive an arm within limits: a move, a refusal, a stop that wants an acknowledgement.

The driver is the real one, with ur-rtde; only the controller at the other end is a fake.
"""

import time

import numpy as np

from canopy_skel.geometry import FloatArray, transform_from
from drivers.errors import ProtectiveStopError, WorkspaceError
from drivers.guarded_arm import GuardedArm, Limits
from drivers.protocols import Arm, LinearMove, wait_settled
from drivers.ur5.arm import Ur5Arm
from drivers.ur5.messages import Ur5Config
from mock_hw.fake_ur.process import FakeUr, free_host

TIME_SCALE = 5
LOOK_S = 6.0 / TIME_SCALE
"""Controllers unlock 5 s after a protective stop and no sooner: somebody is to look."""
LIMITS = Limits(box_min_m=(-0.9, -0.9, 0.0), box_max_m=(0.9, 0.9, 1.1))


def flange(arm: Arm) -> FloatArray:
    """Return where the flange is, (4, 4)."""
    return arm.state().pose.base_from_tool0


def lower(arm: Arm, by_m: float) -> None:
    """Begin to move the flange straight down."""
    goal = transform_from(np.eye(3), [0.0, 0.0, -by_m]) @ flange(arm)
    arm.start_move(LinearMove(base_from_tool0=goal, speed_mps=0.1, acceleration_mps2=0.5))


def main() -> None:
    """What an operator meets sooner or later."""
    with (
        FakeUr(free_host(), time_scale=TIME_SCALE) as controller,
        GuardedArm(Ur5Arm(Ur5Config(host=controller.host, payload_kg=0.6)), LIMITS) as arm,
    ):
        print(f"the flange is at z = {flange(arm)[2, 3]:.3f} m")
        lower(arm, 0.05)
        wait_settled(arm, timeout_s=5.0)
        print(f"moved: z = {flange(arm)[2, 3]:.3f} m")

        try:
            lower(arm, 0.5)
        except WorkspaceError as error:
            print(f"refused, nothing moved: {error}")

        lower(arm, 0.2)
        controller.do("protective_stop")
        try:
            wait_settled(arm, timeout_s=5.0)
        except ProtectiveStopError as error:
            print(f"stopped on the way: {error}")

        time.sleep(LOOK_S)
        arm.acknowledge("the branch is bent aside, the way is clear")
        lower(arm, 0.05)
        wait_settled(arm, timeout_s=5.0)
        print(f"and on: z = {flange(arm)[2, 3]:.3f} m")


if __name__ == "__main__":
    main()
