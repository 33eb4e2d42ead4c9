"""Run a fake UR controller: `python -m mock_hw.fake_ur --host 127.0.0.7 --time-scale 20`."""

import argparse
import asyncio
import logging
import re
import signal
import sys

from mock_hw.fake_ur import dashboard, rtde, upload
from mock_hw.fake_ur.controller import Controller
from mock_hw.fake_ur.faults import FaultServer
from mock_hw.fake_ur.network import Network

_DEFAULT_BUILD = {3: (3, 15, 8, 106339), 5: (5, 15, 0, 1210284)}


def _version(text: str) -> tuple[int, int, int, int]:
    """Return (major, minor, bugfix, build); what is not given is filled in."""
    if not re.fullmatch(r"[35](\.(\d+|x)){0,3}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a version such as 3.15, 5.x or 5.15.2")
    given = [int(part) for part in text.split(".") if part != "x"]
    major, minor, bugfix, build = (*given, *_DEFAULT_BUILD[given[0]][len(given) :])
    return major, minor, bugfix, build


def _arguments(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m mock_hw.fake_ur", description=__doc__)
    parser.add_argument("--host", default="127.0.0.2", help="address to listen on (one per arm)")
    parser.add_argument("--version", type=_version, default="3.15", help="PolyScope: 3.15 or 5.x")
    parser.add_argument("--time-scale", type=float, default=1.0, help="how much faster it moves")
    parser.add_argument("--fault-port", type=int, default=0, help="0: any free port")
    parser.add_argument("--parent", type=int, help="descriptor of a pipe: end when it is closed")
    arguments = parser.parse_args(argv)
    if arguments.time_scale <= 0:
        parser.error("--time-scale must be above 0")
    return arguments


async def _run(arguments: argparse.Namespace) -> None:
    controller = Controller(arguments.version, arguments.time_scale)
    network, control = Network(arguments.host), Network(arguments.host)
    streams = rtde.RtdeServer(controller, network)
    faults = FaultServer(controller, network)
    stopped = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    if arguments.parent is not None:
        asyncio.get_running_loop().add_reader(arguments.parent, stopped.set)
    try:
        await network.listen(dashboard.PORT, dashboard.Dashboard(controller, network).serve)
        for port in upload.PORTS:
            await network.listen(port, upload.ScriptServer(controller, network).serve)
        await network.listen(rtde.PORT, streams.serve)
        fault_port = await control.listen(arguments.fault_port, faults.serve)
    except OSError as error:
        sys.exit(f"cannot listen on {arguments.host}: {error}; choose another --host 127.0.0.N")
    version = ".".join(map(str, controller.version))
    sys.stdout.write(f"ready host={arguments.host} version={version} fault_port={fault_port}\n")
    sys.stdout.flush()
    _start_cycle(controller, network, streams)
    await stopped.wait()
    if arguments.parent is not None:
        asyncio.get_running_loop().remove_reader(arguments.parent)
    await network.close()
    await control.close()


def _start_cycle(controller: Controller, network: Network, streams: rtde.RtdeServer) -> None:
    """Tick as often as somebody looks, at the controller's rate at most.

    Cycles in between, and those missed on a busy host, are made up for at once.
    """
    loop = asyncio.get_running_loop()
    start_s = loop.time()

    def cycle() -> None:
        due = int((loop.time() - start_s) / controller.period_s)
        if due > controller.cycle:
            controller.tick(due - controller.cycle)
            if not network.frozen:
                streams.stream()
        next_s = controller.cycle * controller.period_s + streams.shortest_period_s()
        loop.call_at(start_s + next_s, cycle)

    cycle()


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="fake_ur: %(message)s")
    asyncio.run(_run(_arguments(sys.argv[1:])))
