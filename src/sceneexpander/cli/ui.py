"""``sceneexpander ui``: MLflow's interface over the local store, on loopback only; running adaptations show live."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Sequence

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, entry_point
from sceneexpander.pipeline.processes import ended_by_signals, kept
from sceneexpander.pipeline.project import LIVE_FOLDER, find_project
from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.describe import experiment_links
from sceneexpander.tracking.follow import Follower
from sceneexpander.tracking.server import SHELL_URI
from sceneexpander.tracking.store import (
    database_path,
    last_experiment,
    quiet_environment,
    set_damaged_aside,
    tracking_uri,
    without_foreign_settings,
)

HOST = "127.0.0.1"


def make_parser() -> CommandParser:
    """The options of the command."""
    description = "MLflow's interface over the local store, on this machine only; running adaptations show live."
    parser = CommandParser("ui", description, examples=["", "--port 5001"])
    parser.add_argument("--port", type=int, default=5000, help="default: 5000")
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Start the server and print links that open the numbers, the charts and the pictures. What it starts ends with it, however it ends."""
    port = make_parser().parse_args(arguments).port
    check_port(port)
    root = find_project()
    if os.environ.get(SHELL_URI):
        print(
            f"note: {SHELL_URI} is set: runs go to that server, this shows those of the project folder", file=sys.stderr
        )
    quiet_environment()
    set_damaged_aside(root)
    if not database_path(root).is_file():
        Follower(root / LIVE_FOLDER, root, TrackingConfig()).poll()  # the first run of all may still be under way
    if not database_path(root).is_file():
        raise UserError("does not exist yet", where=database_path(root), fix="run `make repro` first")
    # The landing page is about something else.
    for name, link in experiment_links(f"http://{HOST}:{port}", last_experiment(root)).items():
        print(f"{name + ':':9} {link}", flush=True)
    command = [sys.executable, "-m", "mlflow", "ui", "--host", HOST, "--port", str(port)]
    command += ["--backend-store-uri", tracking_uri(TrackingConfig(), root)]
    environment = without_foreign_settings(os.environ)
    follow = [sys.executable, "-m", "sceneexpander.cli.follow"]
    try:
        with (
            ended_by_signals(),
            kept(follow, cwd=root, env=environment),
            kept(command, cwd=root, env=environment) as server,
        ):
            raise SystemExit(server.wait())
    except KeyboardInterrupt:
        raise SystemExit(0) from None


def check_port(port: int) -> None:
    """Raise `UserError` unless a server can listen on this port of this machine."""
    if not 0 < port < 65536:
        raise UserError(f"must be between 1 and 65535, is {port}", where="--port")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise UserError(f"{port} cannot be used ({error.strerror})", where="--port", fix="choose another") from None


if __name__ == "__main__":
    main()
