"""`make demo`: a whole simulated scan through HTTP, and what came of it.

python -m service.demo OUT
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

from service.compose import free_port

CANOPY = Path(sys.executable).with_name("canopy")
DEMO = "demo"
READY_WITHIN_S = 120.0


def main() -> None:
    """Serve a simulated rig, scan with it, replay the recording, score the skeleton."""
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    options = ["--sim", "--port", port, "--data", out / "data", "--time-scale", 3]
    _say(f"Starting the service with a simulated arm, camera and apple tree at {url}")
    with (out / "service.log").open("w") as log:
        service = subprocess.Popen(_command("serve", *options), stdout=log, stderr=log)
        try:
            _wait_until_ready(url, service)
            _say("Scanning: 10 views; watch it in a browser at that address")
            scanned = json.loads(_run("scan", "--url", url, "-o", out, "--tree", "demo", "--json"))
        finally:
            service.terminate()
            service.wait()
    recording, live = (_named(Path(file), out) for file in scanned["files"])
    _run("replay", recording, "-o", out / "replayed")
    replayed = out / "replayed" / live.name
    if replayed.read_bytes() != live.read_bytes():
        sys.exit(f"{live} and {replayed} differ: the live skeleton is not that of its recording")
    _say("The skeleton that grew during the scan has the bytes that a replay of it gives")
    for name in ("skeleton.glb", "overlay.png"):
        (out / "replayed" / f"{DEMO}.{name}").replace(out / f"{DEMO}.{name}")
    scores = json.loads(_run("score", live, recording, "--json"))
    _say(
        f"Against the simulated truth: precision {scores['precision']:.3f},"
        f" recall {scores['recall']:.3f} of the tree, {scores['recall_masked']:.3f} of what the"
        " masks show (a simulation: no orchard was measured)"
    )
    _say(f"The recording: {recording}")
    _say(f"The skeleton:  {live}, and for viewers {out / DEMO}.skeleton.glb")
    _say(f"Its picture:   {out / DEMO}.overlay.png")


def _named(file: Path, out: Path) -> Path:
    """Give a result the demo's name instead of its scan's."""
    return file.replace(out / (DEMO + "".join(file.suffixes)))


def _wait_until_ready(url: str, service: subprocess.Popen[bytes]) -> None:
    until_s = time.perf_counter() + READY_WITHIN_S
    while service.poll() is None and time.perf_counter() < until_s:
        try:
            with urlopen(f"{url}/v1/rig") as answer:
                parts = json.load(answer)["parts"]
            if all(part["ready"] for part in parts):
                return
        except URLError:
            pass
        time.sleep(0.2)
    sys.exit("the service did not become ready; see service.log in the output folder")


def _run(*arguments: object) -> str:
    result = subprocess.run(_command(*arguments), stdout=subprocess.PIPE, text=True, check=False)
    if result.returncode != 0:
        sys.exit(f"canopy {arguments[0]} failed with {result.returncode}")
    return result.stdout


def _command(*arguments: object) -> list[str]:
    return [str(CANOPY), *map(str, arguments)]


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
