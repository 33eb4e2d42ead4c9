"""The whole service at a controller that was there before and outlives it.

python served_at.py --host HOST --data DIR --port PORT
"""

from argparse import ArgumentParser
from pathlib import Path

from live_rig import hardware_at, options_for

from service.compose import composed
from service.server import make_server


def main():
    parser = ArgumentParser()
    parser.add_argument("--host", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--port", type=int, required=True)
    given = parser.parse_args()
    with composed(options_for(given.data), lambda _: hardware_at(given.host)) as app:
        make_server(app, port=given.port, log_level="warning").run()


if __name__ == "__main__":
    main()
