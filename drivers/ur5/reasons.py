"""What holds a UR5, as a mode and as an error with the mend in its message."""

from drivers.errors import (
    ArmStoppedError,
    EmergencyStopError,
    NotPoweredError,
    ProtectiveStopError,
    SafeguardStopError,
    SafetyFaultError,
)
from drivers.protocols import ArmMode
from drivers.ur5.messages import ENDED, ROBOT_RUNNING, SafetyMode, Sample

Hold = tuple[ArmMode, ArmStoppedError]

_PROTECTIVE = "protective stop: look for the cause, clear it, then acknowledge"
_SAFEGUARD = "safeguard stop: close the safeguard, then acknowledge"
_EMERGENCY = "emergency stop: release the button, then acknowledge"
_FAULT = "safety violation or fault: restart safety at the pendant, then acknowledge"
_POWER = "the arm is not powered or its brakes are engaged: acknowledge to power it"


def safety_hold(sample: Sample) -> Hold | None:
    """Return the safety stop the controller reports, None where it reports none."""
    match sample.safety_mode:
        case SafetyMode.NORMAL | SafetyMode.REDUCED:
            return None
        case SafetyMode.PROTECTIVE_STOP:
            return ArmMode.PROTECTIVE_STOP, ProtectiveStopError(_PROTECTIVE)
        case SafetyMode.SAFEGUARD_STOP:
            return ArmMode.SAFEGUARD_STOP, SafeguardStopError(_SAFEGUARD)
        case SafetyMode.SYSTEM_EMERGENCY_STOP | SafetyMode.ROBOT_EMERGENCY_STOP:
            return ArmMode.EMERGENCY_STOP, EmergencyStopError(_EMERGENCY)
        case _:
            return ArmMode.SAFETY_FAULT, SafetyFaultError(_FAULT)


def power_hold(sample: Sample) -> Hold | None:
    """Return the hold of an arm without power or with engaged brakes, None when it can move."""
    if sample.robot_mode == ROBOT_RUNNING:
        return None
    return ArmMode.NOT_POWERED, NotPoweredError(_POWER)


def anothers_program(sample: Sample) -> bool:
    """Say whether a program that is not ours runs on the controller, or is paused there."""
    return not sample.program_is_ours and sample.runtime_state not in ENDED
