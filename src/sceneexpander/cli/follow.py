"""``sceneexpander follow``: mirror running adaptations into MLflow, so that their curves can be watched."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, entry_point
from sceneexpander.pipeline.project import LIVE_FOLDER, find_project
from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.follow import Follower
from sceneexpander.tracking.store import describe_experiments


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "follow",
        "Mirror running adaptations into MLflow, so that their curves can be watched.",
        examples=["", "--uri http://localhost:5000 --interval 10", "--once"],
    )
    parser.add_argument("--uri", default="local", help="of MLflow: local, or http://host:port")
    parser.add_argument("--interval", type=float, default=2.0, help="seconds between looks at the logs")
    parser.add_argument("--once", action="store_true", help="mirror what is there and end")
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Follow until interrupted."""
    options = make_parser().parse_args(arguments)
    if options.interval <= 0:
        raise UserError(f"must be above 0, is {options.interval}", where="--interval")
    logging.basicConfig(level=logging.INFO, format="%(levelname)s follow: %(message)s")
    root = find_project()
    config = TrackingConfig(uri=options.uri)
    follower = Follower(root / LIVE_FOLDER, root, config)
    try:
        describe_experiments(config, root)  # a store of an earlier version has no saved views yet
        while True:
            follower.poll()
            if options.once:
                return
            time.sleep(options.interval)
    except KeyboardInterrupt:
        return


if __name__ == "__main__":
    main()
