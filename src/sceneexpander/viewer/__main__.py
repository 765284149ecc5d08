"""``sceneexpander view outputs/<scene>``: walk through the scene of a round in the browser, on this machine only."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import Scene
from sceneexpander.artifacts.unavailable import unavailable_in
from sceneexpander.catalogue import MAIN
from sceneexpander.catalogue.methods import known_methods
from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, entry_point
from sceneexpander.viewer.gate import check_authority
from sceneexpander.viewer.live import HOST, LiveViewer

LIMIT = 400_000
LAST_PORT = 64_535  # a thousand below the end: the next free one is taken if it is in use


def load_round(folder: Path, number: int) -> tuple[str, list[Reconstruction], dict[str, Tensor]]:
    """Name of the scene, its reconstructions in a round and the pictures of their views.

    Args:
        folder: what the pipeline made of one scene, ``outputs/<scene>``.
        number: of the round.

    Raises:
        UserError: nothing was made there yet, or not this round.
    """
    if not (folder / "scene").is_dir():
        raise UserError("holds no scene", where=folder, fix="run `make repro` first, or name another scene")
    base = folder / f"round_{number}"
    # The last one that exists is shown first.
    names = sorted((method.name for method in known_methods()), key=lambda name: name == MAIN)
    found = [base / name / "reconstruction" for name in names]
    found = [path for path in found if path.is_dir() and unavailable_in(path) is None]
    if not found:
        rounds = sorted(path.name.removeprefix("round_") for path in folder.glob("round_[1-9]*"))
        fix = f"there are rounds {', '.join(rounds)}" if rounds else "run `make repro` first"
        raise UserError("holds no reconstruction", where=base, fix=fix)
    scene = Scene.load(folder / "scene")
    pictures = dict(zip(scene.views.view_ids, scene.views.images, strict=True))
    for earlier in range(1, number + 1):
        place = folder / f"round_{earlier}" / "inserted"
        if place.is_dir():
            view = InsertedView.load(place).view
            pictures[view.view_ids[0]] = view.images[0]
    return scene.name, [Reconstruction.load(path) for path in found], pictures


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "view",
        "Walk through the scene of a round in the browser, on this machine only.",
        examples=[
            "outputs/courtyard",
            "outputs/courtyard --round 2 --limit 50000",
            "outputs/a --allow-host localhost:9000",
        ],
    )
    parser.add_argument("folder", type=Path, help="outputs/<scene>")
    parser.add_argument("--round", type=int, default=1)
    parser.add_argument("--port", type=int, default=8080)
    parser.add_argument("--limit", type=int, default=LIMIT, help="Gaussians per method; fewer for a weak machine")
    parser.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME[:PORT]",
        help="answer to this name too, as the address bar shows it behind a tunnel or a proxy; may be repeated",
    )
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Serve until interrupted."""
    given = make_parser().parse_args(arguments)
    if given.limit < 1:
        raise UserError(f"must be at least 1, is {given.limit}", where="--limit")
    if not 0 <= given.port <= LAST_PORT:
        raise UserError(f"is {given.port}, must be from 0 to {LAST_PORT}", where="--port")
    hosts = [check_authority(name) for name in given.allow_host]
    title, reconstructions, pictures = load_round(given.folder, given.round)
    viewer = LiveViewer(reconstructions, pictures, title=title, port=given.port, limit=given.limit, hosts=hosts)
    print(f"viewer: http://{HOST}:{viewer.port} (stop with Ctrl-C)", flush=True)
    try:
        viewer.serve()
    except KeyboardInterrupt:
        viewer.stop()
        sys.exit(0)


if __name__ == "__main__":
    main()
