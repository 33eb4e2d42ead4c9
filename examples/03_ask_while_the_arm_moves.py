"""A planner asks for the nearest wood while the scan is under way, and believes what is sure.

python examples/03_ask_while_the_arm_moves.py [URL of `canopy serve --sim`]; without a URL, a
simulated rig is started for the occasion.
"""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import uuid4

from service.compose import free_port
from service.scan_client import RefusedError, ScanClient

CANOPY = Path(sys.executable).with_name("canopy")
QUICKLY = ("--time-scale", "20", "--picture-scale", "0.25", "--leaves", "200")
GRIPPER_M = {"x": 1.5, "y": 0.1, "z": 0.2}
SURE = 0.9
PATIENCE_S = 60.0


@contextmanager
def simulated_rig() -> Iterator[str]:
    """Run `canopy serve --sim` and give its URL."""
    port = free_port()
    with TemporaryDirectory() as data:
        command = [str(CANOPY), "serve", "--sim", "--port", str(port), "--data", data, *QUICKLY]
        service = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            service.terminate()
            service.wait()


def wait_until_ready(client: ScanClient) -> None:
    """Wait for arm, camera and worker; a service that is not ready says 503 and why."""
    until_s = time.perf_counter() + PATIENCE_S
    while time.perf_counter() < until_s:
        with suppress(RefusedError):
            client.fetch("/readyz")
            return
        time.sleep(0.2)
    client.fetch("/readyz")


def scan_and_ask(client: ScanClient) -> None:
    """Start a scan, and ask again with every skeleton that is newer."""
    body = {"tree_id": "apple-7", "path": "orchard-10"}
    scan_id = client.start(body, key=str(uuid4()))
    place = "&".join(f"{axis}={value}" for axis, value in GRIPPER_M.items())
    for event in client.follow(scan_id):
        if event.kind != "skeleton":
            continue
        near = json.loads(client.fetch(f"/v1/scans/{scan_id}/skeleton/nearest?{place}"))
        how = "predicted" if near["occluded"] else "seen"
        print(
            f"after view {near['revision']}: wood {how} {near['distance_m']:.3f} m away,"
            f" radius {1000 * near['radius_m']:.0f} mm, confidence {near['confidence']:.2f}"
            + ("" if near["confidence"] >= SURE else ": not sure enough, ignored")
        )
    print(f"the scan is {client.status(scan_id).state}")


def main() -> None:
    """Use the service at the URL that is given, or one of our own."""
    if len(sys.argv) > 1:
        with ScanClient(sys.argv[1]) as client:
            scan_and_ask(client)
        return
    with simulated_rig() as url, ScanClient(url, patience_s=PATIENCE_S) as client:
        wait_until_ready(client)
        scan_and_ask(client)


if __name__ == "__main__":
    main()
