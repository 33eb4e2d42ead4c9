"""The fault port: JSON lines that do to the arm what the world may do to it.

`{"do": "protective_stop"}` is answered by `{"ok": true, "state": {...}}`, anything wrong by
`{"ok": false, "error": "..."}`. This port belongs to the simulation and is never frozen or cut.
"""

import asyncio
import json
from collections.abc import Callable
from typing import Any

from mock_hw.fake_ur.controller import Controller, RefusedError
from mock_hw.fake_ur.network import Network


class FaultServer:
    """Does what a test asks for."""

    def __init__(self, controller: Controller, network: Network) -> None:
        self._controller = controller
        self._network = network
        self._actions: dict[str, Callable[..., None]] = {
            "state": lambda: None,
            "protective_stop": lambda: controller.protective_stop("fault port"),
            "unlock": controller.unlock_protective_stop,
            "emergency_stop": lambda: controller.emergency_stop(pressed=True),
            "release_emergency_stop": lambda: controller.emergency_stop(pressed=False),
            "safeguard_stop": lambda: controller.safeguard_stop(active=True),
            "close_safeguard": lambda: controller.safeguard_stop(active=False),
            "power_off": controller.power_off,
            "freeze": network.freeze,
            "thaw": network.thaw,
            "cut_link": network.cut,
            "mend_link": network.mend,
            "slow_packets": self._slow,
            "refuse_scripts": self._refuse,
            "local_control": self._local_control,
            "home": controller.place_at_home,
            "set_tcp": lambda x, y, z: controller.set_tcp((x, y, z, 0.0, 0.0, 0.0)),
            "reset": self._reset,
        }

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one client, line by line."""
        while line := await reader.readline():
            writer.write(json.dumps(self._answer(line)).encode() + b"\n")

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            action = self._actions[request.pop("do")]
            action(**request)
        except (ValueError, KeyError, TypeError, AttributeError, RefusedError) as error:
            names = ", ".join(sorted(self._actions))
            return {"ok": False, "error": f"{error!r}; this port can do: {names}"}
        return {"ok": True, "state": self._state()}

    def _state(self) -> dict[str, Any]:
        controller = self._controller
        return {
            "stamp_s": controller.stamp_s,
            "robot_mode": controller.robot_mode.name,
            "safety_mode": controller.safety_mode.name,
            "runtime_state": controller.runtime_state.name,
            "moving": not controller.steady,
            "moving_s": controller.moving_s,
            "joints_rad": controller.joints.tolist(),
            "tcp_pose": list(controller.tcp_pose),
            "payload_kg": controller.payload_kg,
            "speed_slider": controller.speed_slider,
            "digital_outputs": controller.digital_outputs,
            "watchdog": controller.watchdog is not None,
        }

    def _slow(self, period_s: float) -> None:
        self._network.slow_period_s = float(period_s)

    def _refuse(self) -> None:
        self._controller.refuses_scripts = True

    def _local_control(self) -> None:
        self._controller.remote_control = False

    def _reset(self) -> None:
        self._network.mend()
        self._controller.restore()
