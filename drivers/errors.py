"""Everything that can go wrong between this program and the hardware.

DriverError
├── ArmError
│   ├── MoveRefusedError            nothing moved; the message says why
│   │   ├── UnreachableError        no joints bring the tool there, or not along that line
│   │   ├── JointLimitError         a joint would leave ±360°
│   │   ├── WorkspaceError          outside the workspace box or beyond a keep-out plane
│   │   ├── SpeedCapError           faster, or accelerating harder, than allowed
│   │   └── ArmBusyError            another move is under way
│   ├── MoveInterruptedError        the move ended before its target; a new one may be started
│   ├── SettleTimeoutError          the arm did not come to rest in time
│   ├── ArmStoppedError             nothing moves until somebody has acknowledged
│   │   ├── ProtectiveStopError
│   │   ├── SafeguardStopError
│   │   ├── EmergencyStopError
│   │   ├── SafetyFaultError
│   │   ├── NotPoweredError
│   │   ├── NotInRemoteControlError
│   │   └── NotAcknowledgedError    the cause is gone, but nobody has said so yet
│   └── ArmLinkError                the arm cannot be asked
│       ├── NotConnectedError       outside the `with` block, or no such controller
│       ├── ArmTakenError           another client or program has the controller
│       ├── LinkLostError           the connection broke
│       ├── ControllerFrozenError   connected, but the controller says nothing
│       └── DriverProcessError      the process that talks to the controller died or hangs
└── CameraError
    ├── NoCameraError               there is no such camera
    └── CameraTimeoutError          no picture in time
"""


class DriverError(Exception):
    """Base of all hardware errors; the message names the thing and the mend."""


class ArmError(DriverError):
    """Base of everything an arm can answer instead of doing as told."""


class MoveRefusedError(ArmError):
    """The move was not begun; the arm stands where it stood."""


class UnreachableError(MoveRefusedError):
    """No joints bring the tool to the target, or not along the straight line to it."""


class JointLimitError(MoveRefusedError):
    """A joint would have to leave its range."""


class WorkspaceError(MoveRefusedError):
    """The arm would leave its workspace or reach into a keep-out zone."""


class SpeedCapError(MoveRefusedError):
    """The move is faster, or accelerates harder, than this arm may."""


class ArmBusyError(MoveRefusedError):
    """Another move is under way."""


class MoveInterruptedError(ArmError):
    """The move ended before its target; nothing continues it, a new move may be started."""


class SettleTimeoutError(ArmError):
    """The arm did not come to rest in time; it has not been stopped."""


class ArmStoppedError(ArmError):
    """The controller holds the arm; an operator must look, mend and acknowledge."""


class ProtectiveStopError(ArmStoppedError):
    """The controller stopped by itself: a collision, or a path it could not follow."""


class SafeguardStopError(ArmStoppedError):
    """A safeguard (door, light curtain) is open."""


class EmergencyStopError(ArmStoppedError):
    """The emergency stop is pressed."""


class SafetyFaultError(ArmStoppedError):
    """The safety system found a violation or a fault."""


class NotPoweredError(ArmStoppedError):
    """The arm has no power or its brakes are engaged."""


class NotInRemoteControlError(ArmStoppedError):
    """The controller is in local control and takes commands from its pendant only."""


class NotAcknowledgedError(ArmStoppedError):
    """A stop is over, but nobody has acknowledged it."""


class ArmLinkError(ArmError):
    """The arm cannot be asked."""


class NotConnectedError(ArmLinkError):
    """The arm was used outside its `with` block, or there is no controller at that address."""


class ArmTakenError(ArmLinkError):
    """Another client or program has the controller; nothing was done to it."""


class LinkLostError(ArmLinkError):
    """The connection to the controller broke."""


class ControllerFrozenError(ArmLinkError):
    """The connection stands, but the controller says nothing."""


class DriverProcessError(ArmLinkError):
    """The process that talks to the controller died or hangs."""


class CameraError(DriverError):
    """Base of everything a camera can answer instead of a picture."""


class NoCameraError(CameraError):
    """There is no such camera, or it is in use."""


class CameraTimeoutError(CameraError):
    """No picture arrived in time."""
