"""Names, wire types and values of the RTDE variables, outputs and inputs."""

from collections.abc import Callable
from dataclasses import dataclass

from mock_hw.fake_ur.controller import REGISTERS, Controller, RuntimeState, SafetyMode

WIRE_FORMAT = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}

Value = float | int
Values = tuple[Value, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Output:
    """A variable the controller sends: its wire type and how to read it, always as a tuple."""

    type: str
    read: Callable[[Controller], Values]


def safety_status_bits(controller: Controller) -> int:
    """Return the RTDE safety status word."""
    mode = controller.safety_mode
    emergency = mode in (SafetyMode.SYSTEM_EMERGENCY_STOP, SafetyMode.ROBOT_EMERGENCY_STOP)
    bits = (
        mode == SafetyMode.NORMAL,
        mode == SafetyMode.REDUCED,
        mode == SafetyMode.PROTECTIVE_STOP,
        mode == SafetyMode.RECOVERY,
        mode == SafetyMode.SAFEGUARD_STOP,
        mode == SafetyMode.SYSTEM_EMERGENCY_STOP,
        mode == SafetyMode.ROBOT_EMERGENCY_STOP,
        emergency,
        mode == SafetyMode.VIOLATION,
        mode == SafetyMode.FAULT,
        mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED, SafetyMode.RECOVERY),
    )
    return sum(1 << index for index, is_set in enumerate(bits) if is_set)


def robot_status_bits(controller: Controller) -> int:
    """Return the RTDE robot status word: power on, program running."""
    power = controller.robot_mode > 4
    running = controller.runtime_state in (RuntimeState.PLAYING, RuntimeState.PAUSED)
    return int(power) | int(running) << 1


def _constant(*values: float) -> Callable[[Controller], Values]:
    return lambda controller: values


def _vector(name: str) -> Callable[[Controller], Values]:
    return lambda controller: tuple(getattr(controller, name))


def _outputs() -> dict[str, Output]:
    zeros = _constant(*(0.0,) * 6)
    typed: dict[str, tuple[str, Callable[[Controller], Values]]] = {
        "timestamp": ("DOUBLE", lambda c: (c.stamp_s,)),
        "target_q": ("VECTOR6D", _vector("joints")),
        "target_qd": ("VECTOR6D", _vector("joint_speeds")),
        "target_qdd": ("VECTOR6D", zeros),
        "target_current": ("VECTOR6D", zeros),
        "target_moment": ("VECTOR6D", zeros),
        "actual_q": ("VECTOR6D", _vector("joints")),
        "actual_qd": ("VECTOR6D", _vector("joint_speeds")),
        "actual_current": ("VECTOR6D", zeros),
        "joint_control_output": ("VECTOR6D", zeros),
        "actual_TCP_pose": ("VECTOR6D", _vector("tcp_pose")),
        "actual_TCP_speed": ("VECTOR6D", _vector("tcp_speed")),
        "actual_TCP_force": ("VECTOR6D", zeros),
        "target_TCP_pose": ("VECTOR6D", _vector("tcp_pose")),
        "target_TCP_speed": ("VECTOR6D", _vector("tcp_speed")),
        "actual_digital_input_bits": ("UINT64", lambda c: (c.digital_inputs,)),
        "joint_temperatures": ("VECTOR6D", _constant(*(30.0,) * 6)),
        "actual_execution_time": ("DOUBLE", _constant(0.0)),
        "robot_mode": ("INT32", lambda c: (int(c.robot_mode),)),
        "joint_mode": (
            "VECTOR6INT32",
            lambda c: (253 if c.robot_mode == 7 else 239 if c.robot_mode == 3 else 255,) * 6,
        ),
        "safety_mode": ("INT32", lambda c: (int(c.safety_mode),)),
        "safety_status": ("INT32", lambda c: (int(c.safety_mode),)),
        "actual_tool_accelerometer": ("VECTOR3D", _constant(0.0, 0.0, -9.81)),
        "speed_scaling": ("DOUBLE", lambda c: (float(c.runtime_state == RuntimeState.PLAYING),)),
        "target_speed_fraction": ("DOUBLE", lambda c: (c.speed_slider,)),
        "actual_momentum": ("DOUBLE", _constant(0.0)),
        "actual_main_voltage": ("DOUBLE", _constant(48.0)),
        "actual_robot_voltage": ("DOUBLE", lambda c: (48.0 if c.robot_mode > 4 else 0.0,)),
        "actual_robot_current": ("DOUBLE", lambda c: (0.5 if c.robot_mode > 4 else 0.0,)),
        "actual_joint_voltage": ("VECTOR6D", _constant(*(47.0,) * 6)),
        "actual_digital_output_bits": ("UINT64", lambda c: (c.digital_outputs,)),
        "runtime_state": ("UINT32", lambda c: (int(c.runtime_state),)),
        "standard_analog_input0": ("DOUBLE", _constant(0.0)),
        "standard_analog_input1": ("DOUBLE", _constant(0.0)),
        "standard_analog_output0": ("DOUBLE", lambda c: (c.analog_outputs[0],)),
        "standard_analog_output1": ("DOUBLE", lambda c: (c.analog_outputs[1],)),
        "robot_status_bits": ("UINT32", lambda c: (robot_status_bits(c),)),
        "safety_status_bits": ("UINT32", lambda c: (safety_status_bits(c),)),
        "payload": ("DOUBLE", lambda c: (c.payload_kg,)),
        "payload_cog": ("VECTOR3D", _vector("payload_cog_m")),
        "payload_inertia": ("VECTOR6D", zeros),
    }
    return {name: Output(type=kind, read=read) for name, (kind, read) in typed.items()}


def _register(name: str, kind: str, index: int) -> Output:
    return Output(type=kind, read=lambda c: (getattr(c, name)[index],))


_E_SERIES_OUTPUTS = {
    "ft_raw_wrench": Output(type="VECTOR6D", read=_constant(*(0.0,) * 6)),
    "actual_current_as_torque": Output(type="VECTOR6D", read=_constant(*(0.0,) * 6)),
}
_OUTPUTS = (
    _outputs()
    | {f"output_int_register_{i}": _register("output_ints", "INT32", i) for i in range(REGISTERS)}
    | {
        f"output_double_register_{i}": _register("output_doubles", "DOUBLE", i)
        for i in range(REGISTERS)
    }
)


def find_output(name: str, major_version: int) -> Output | None:
    """Return an output variable that this generation of controller has, or None."""
    found = _OUTPUTS.get(name)
    if found is None and major_version >= 5:
        found = _E_SERIES_OUTPUTS.get(name)
    return found


INPUT_TYPES = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}

_DIGITAL_OUTPUTS = (
    ("standard_digital_output", 0),
    ("configurable_digital_output", 8),
    ("tool_digital_output", 16),
)


def apply_inputs(controller: Controller, inputs: dict[str, Values]) -> None:
    """Write the values of one input package into the controller."""
    for name, values in inputs.items():
        kind, _, index = name.rpartition("_")
        if kind == "input_int_register":
            controller.input_ints[int(index)] = int(values[0])
            if controller.watchdog is not None and controller.watchdog.register == int(index):
                controller.watchdog.feed(controller.stamp_s)
        elif kind == "input_double_register":
            controller.input_doubles[int(index)] = float(values[0])
    for name, first_bit in _DIGITAL_OUTPUTS:
        if name in inputs:
            mask = int(inputs[f"{name}_mask"][0]) << first_bit
            level = int(inputs[name][0]) << first_bit
            controller.digital_outputs = controller.digital_outputs & ~mask | level & mask
    if inputs.get("speed_slider_mask", (0,))[0]:
        controller.speed_slider = min(1.0, max(0.0, float(inputs["speed_slider_fraction"][0])))
    analog_mask = int(inputs.get("standard_analog_output_mask", (0,))[0])
    for output in range(2):
        if analog_mask & 1 << output:
            ratio = float(inputs[f"standard_analog_output_{output}"][0])
            controller.analog_outputs[output] = ratio
