"""``sceneexpander export SCENE --format ply colmap mesh``: a finished scene in the forms that other programs open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, did_you_mean, entry_point
from sceneexpander.exports.formats import FORMATS, check_formats
from sceneexpander.pipeline.project import find_project

DEFAULT_METHOD = "sceneexpander"
_PARTS = ("all", "generated", "captured")


def make_parser() -> CommandParser:
    """The options of the command."""
    width = max(len(item.name) for item in FORMATS)
    listed = "\n".join(f"  {item.name:{width}}  {item.summary}" for item in FORMATS)
    parser = CommandParser(
        "export",
        f"Write a finished scene in the forms that other programs open.\n\nformats:\n{listed}",
        examples=[
            "courtyard --format ply spz",
            "runs/terrace --format colmap nerfstudio --round 2",
            "outputs/courtyard --format ply --part generated --out bench",
            "courtyard --format mesh collider --keep-confident 0.9",
        ],
    )
    parser.add_argument("scene", help="name of a scene or run, runs/NAME, or outputs/SCENE")
    parser.add_argument("--format", nargs="+", required=True, metavar="FORMAT", help="see the list above")
    parser.add_argument(
        "--round", type=int, help="number of the round (default: the last one); 0: before any insertion"
    )
    parser.add_argument("--method", default=DEFAULT_METHOD, help="whose reconstruction (default: %(default)s)")
    parser.add_argument("--part", default="all", help="of the Gaussians: all, generated or captured")
    parser.add_argument(
        "--box", type=float, nargs=6, metavar="M", help="only Gaussians in it: least x y z, greatest x y z"
    )
    parser.add_argument(
        "--keep-confident", type=float, default=1.0, metavar="SHARE", help="only that share, the most confident ones"
    )
    parser.add_argument("--count", type=int, help="at most so many Gaussians: the most visible ones")
    parser.add_argument("--out", type=Path, help="folder to write into (default: exports/SCENE)")
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Write each format and print where it is."""
    given = make_parser().parse_args(arguments)
    check_formats(given.format, where="--format")
    if given.part not in _PARTS:
        raise UserError(f"unknown {given.part!r}", where="--part", fix=did_you_mean(given.part, _PARTS))
    if not 0 < given.keep_confident <= 1:
        raise UserError(f"must be above 0 and at most 1, is {given.keep_confident}", where="--keep-confident")
    if given.count is not None and given.count < 1:
        raise UserError(f"must be at least 1, is {given.count}", where="--count")
    box = None if given.box is None else tuple(given.box)
    if box is not None and not all(math.isfinite(a) and a < b for a, b in zip(box[:3], box[3:], strict=True)):
        raise UserError("is empty or not finite", where="--box", fix="least x y z first, then greatest x y z")
    folder = find_scene(given.scene, find_project())
    number = given.round if given.round is not None else last_round(folder, given.method)
    # Only now: torch takes seconds to import.
    from sceneexpander.exports.scene import Crop, crop_scene, load_scene
    from sceneexpander.exports.write import write_exports

    scene = load_scene(folder, number, given.method)
    scene = crop_scene(scene, Crop(part=given.part, box=box, keep_confident=given.keep_confident, most=given.count))
    out = given.out if given.out is not None else Path("exports") / folder.name
    if out.exists() and not out.is_dir():
        raise UserError("is a file, expected a folder", where=out)
    print(scene.statement.sentence())
    for name in given.format:
        for path in write_exports(scene, [name], out):
            print(f"{name}: {path}", flush=True)


def find_scene(name: str, project: Path) -> Path:
    """The folder ``outputs/SCENE`` that a name stands for: of a run, of a scene of the project, or a path to either.

    Raises:
        UserError: there is none; names the nearest one.
    """
    for candidate in (Path(name), project / "outputs" / name, project / "runs" / name):
        try:
            if (candidate / "scene").is_dir():
                return candidate
            inside = sorted(p.parent for p in (candidate / "outputs").glob("*/scene"))
        except (OSError, ValueError):
            raise UserError("cannot be the name of a scene", where=name[:80]) from None
        if len(inside) > 1:
            raise UserError("holds several scenes", where=candidate, fix=f"name one: {', '.join(map(str, inside))}")
        if inside:
            return inside[0]
    known = {p.parent.name for p in project.glob("outputs/*/scene")} | {
        p.parent.parent.parent.name for p in project.glob("runs/*/outputs/*/scene")
    }
    fix = did_you_mean(name, known) if known else "run `make repro` or `sceneexpander expand` first"
    raise UserError("is no finished scene", where=name, fix=fix)


def last_round(folder: Path, method: str) -> int:
    """Number of the last round that this method finished; 0 without one, which is refused with a reason later."""
    made = folder.glob(f"round_*/{method}/reconstruction/artifact.json")
    numbers = [path.parents[2].name.removeprefix("round_") for path in made]
    every = [path.name.removeprefix("round_") for path in folder.glob("round_*")]
    return max((int(number) for number in numbers or every if number.isdecimal()), default=0)


if __name__ == "__main__":
    main()
