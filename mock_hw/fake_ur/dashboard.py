"""Port 29999: the dashboard server, one line in, one line out."""

import asyncio
from collections.abc import Callable

from mock_hw.fake_ur.controller import Controller, RefusedError, RuntimeState
from mock_hw.fake_ur.network import Network

PORT = 29999
SERIAL_NUMBER = "20205500001"


class Dashboard:
    """Answers dashboard lines."""

    def __init__(self, controller: Controller, network: Network) -> None:
        self._controller = controller
        self._network = network
        self._answers = self._cb3_answers()
        if controller.version[:2] >= (5, 6):
            self._answers |= self._e_series_answers()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Talk to one client until it quits or goes away."""
        await self._network.answering()
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            await self._network.answering()
            text = line.decode(errors="replace").strip()
            if text == "quit":
                writer.write(b"Disconnected\n")
                return
            writer.write(self.answer(text).encode() + b"\n")

    def answer(self, line: str) -> str:
        """Return the answer to one line."""
        if line.startswith("popup "):
            self._controller.popup = line.removeprefix("popup ")
            return "showing popup"
        known = self._answers.get(line)
        if known is None:
            return f"could not understand: '{line}'"
        try:
            return known()
        except RefusedError as refused:
            return str(refused)

    def _cb3_answers(self) -> dict[str, Callable[[], str]]:
        arm = self._controller
        version = ".".join(map(str, arm.version))
        return {
            "PolyscopeVersion": lambda: f"URSoftware {version} (Jan 01 2024)",
            "robotmode": lambda: f"Robotmode: {arm.robot_mode.name}",
            "get robot model": lambda: "UR5",
            "safetymode": lambda: f"Safetymode: {arm.safety_mode.name}",
            "safetystatus": lambda: f"Safetystatus: {arm.safety_mode.name}",
            "running": lambda: f"Program running: {str(_running(arm)).lower()}",
            "programState": lambda: f"{arm.runtime_state.name} rtde_control.urp",
            "get loaded program": lambda: "No program loaded",
            "isProgramSaved": lambda: "true rtde_control.urp",
            "stop": lambda: _did("Stopped", arm.stop_program),
            "pause": lambda: _did("Pausing program", arm.pause_program),
            "play": lambda: _did("Starting program", arm.play_program),
            "power on": lambda: _did("Powering on", arm.power_on),
            "power off": lambda: _did("Powering off", arm.power_off),
            "brake release": lambda: _did("Brake releasing", arm.release_brakes),
            "unlock protective stop": lambda: _did(
                "Protective stop releasing", arm.unlock_protective_stop
            ),
            "close popup": lambda: _did("closing popup", self._close_popup),
            "close safety popup": lambda: _did("closing safety popup", self._close_popup),
            "restart safety": lambda: _did("Restarting safety", arm.power_off),
        }

    def _e_series_answers(self) -> dict[str, Callable[[], str]]:
        return {
            "get serial number": lambda: SERIAL_NUMBER,
            "is in remote control": lambda: str(self._controller.remote_control).lower(),
        }

    def _close_popup(self) -> None:
        self._controller.popup = None


def _running(controller: Controller) -> bool:
    return controller.runtime_state in (RuntimeState.PLAYING, RuntimeState.PAUSED)


def _did(answer: str, action: Callable[[], None]) -> str:
    action()
    return answer
