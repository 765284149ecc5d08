"""Damage valid files of every kind that is read, and look whether each reader gives a value or one line (`UserError`).

    python scripts/fuzz_readers.py [--inputs 100000] [--seed 0] [--only ply spz3]

Anything else that a reader raises is printed, and the input that did it is kept in the folder ``--keep``. Prints inputs and refusals per
kind, and by how much memory the process has grown; exits with 1 if anything was found. The tests run a few hundred of the same.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import random
import re
import resource
import sys
import tempfile
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from sceneexpander.artifacts.scene import Scene
from sceneexpander.errors import UserError
from sceneexpander.ingest import IngestConfig, load_photos, make_round, read_picture
from sceneexpander.ingest.archives import unpack_archive
from sceneexpander.ingest.depth_files import DepthFile, DepthFormat
from sceneexpander.ingest.scene_file import read_scene_file
from sceneexpander.ingest.sources import read_capture
from sceneexpander.splatting.ply import read_ply, write_ply
from sceneexpander.splatting.spz import read_spz, write_spz

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.worlds.captures import MAKERS, eth3d
from tests.worlds.random_gaussians import random_gaussians

CONFIG = IngestConfig(long_side_px=112)
WORDS = [
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e308",
    b"-1e-308",
    b"99999999999999999999",
    b"4294967296",
    b"",
    b"\0",
    b"\xff\xfe",
]
WORDS += [
    b"null",
    b"[]",
    b"{}",
    b'"x"',
    b"true",
    b"../../etc/passwd",
    b"a" * 300,
    b"<a>" * 50,
    b"[" * 200,
    b"\xe2\x80\xae",
    b" ",
]
NUMBER = re.compile(rb"-?[0-9]+(?:\.[0-9]+)?(?:e[-+]?[0-9]+)?")
MOST_MEGAPIXELS = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """One kind of file: where a valid one lies, and how it is read."""

    file: Path
    read: Callable[[], object]


def mutate(data: bytes, choose: random.Random) -> bytes:
    """A few changes: of bytes, numbers and words, pieces taken away, doubled or moved, the end cut off."""
    for _ in range(choose.randint(1, 4)):
        place = choose.randrange(len(data) + 1)
        match choose.randrange(8):
            case 0:
                data = data[:place] + bytes([choose.randrange(256)]) + data[place + 1 :]
            case 1:
                data = (
                    data[:place]
                    + choose.choice([b"\0", b"\xff", b"\x7f", b"\x80"]) * choose.choice([1, 2, 4, 8])
                    + data[place + 8 :]
                )
            case 2:
                data = data[:place] + choose.choice(WORDS) + data[place + choose.choice([0, 0, 4]) :]
            case 3:
                data = data[:place] + data[place + choose.choice([1, 4, 30, 300]) :]
            case 4:
                piece = data[place : place + choose.choice([4, 30, 300])]
                data = data[:place] + piece * choose.choice([2, 3]) + data[place + len(piece) :]
            case 5:
                data = data[:place]
            case 6:
                found = list(NUMBER.finditer(data[:20_000]))
                if found:
                    one = choose.choice(found)
                    data = data[: one.start()] + choose.choice(WORDS) + data[one.end() :]
            case 7:
                other = choose.randrange(len(data) + 1)
                data = data[:place] + data[other : other + 40] + data[place:]
    return data


@contextlib.contextmanager
def targets() -> Iterator[dict[str, Target]]:
    """Valid files of every kind, in a folder of their own."""
    with tempfile.TemporaryDirectory() as name:
        folder, found = Path(name), dict[str, Target]()
        scene = random_gaussians(5, sh_coefficients=4)
        write_ply(scene, folder / "a.ply")
        write_ply(scene, folder / "rgb.ply", rgb=True)
        write_spz(scene, folder / "3.spz")
        write_spz(scene, folder / "4.spz", version=4)
        readers: dict[str, tuple[str, Callable[[Path], object]]] = {
            "ply": ("a.ply", read_ply), "ply-rgb": ("rgb.ply", read_ply), "spz3": ("3.spz", read_spz), "spz4": ("4.spz", read_spz),
        }  # fmt: skip
        for title, (name_of_file, read) in readers.items():
            found[title] = Target(file=folder / name_of_file, read=partial(read, folder / name_of_file))
        for kind, make in MAKERS.items():
            place = folder / kind
            place.mkdir()
            make(place)
            for file in read_capture(place, CONFIG, kind).files[:2]:
                found[f"{kind}-{file.name}"] = Target(file=file, read=partial(read_capture, place, CONFIG, kind))
        binary = folder / "colmap_binary"
        if _write_binary_model(binary):
            for part in ("cameras.bin", "images.bin"):
                found[f"colmap-{part}"] = Target(
                    file=binary / "sparse" / "0" / part, read=lambda: read_capture(binary, CONFIG, "colmap")
                )
        (folder / "eth3d").mkdir()
        eth3d(folder / "eth3d", undistorted=False, depth=True)
        raw = folder / "eth3d" / "ground_truth_depth" / "dslr_images" / "DSC_0000.JPG"
        found["depth-raw"] = Target(file=raw, read=lambda: DepthFile(path=raw, format=DepthFormat.RAW).read((180, 240)))
        npy = folder / "camera_texts" / "depths" / "0.npy"
        found["depth-npy"] = Target(file=npy, read=lambda: DepthFile(path=npy, format=DepthFormat.NPY).read((180, 240)))
        pictures = (
            folder / "transforms" / "images" / "0.png",
            folder / "eth3d" / "images" / "dslr_images" / "DSC_0000.JPG",
        )
        for picture in pictures:
            found[f"picture{picture.suffix.lower()}"] = Target(
                file=picture, read=partial(read_picture, picture, max_megapixels=MOST_MEGAPIXELS)
            )
        (folder / "scene" / "captured").mkdir(parents=True)
        yaml = folder / "scene" / "scene.yaml"
        yaml.write_text(
            'name: a\nsource: auto\norder: [0.png]\nrounds:\n  - prompt: "A bench."\n    motion: turn left\n'
        )
        found["scene.yaml"] = Target(file=yaml, read=lambda: read_scene_file(yaml.parent))
        load_photos(folder / "colmap", [make_round("A bench.")], CONFIG).save(folder / "prepared")
        facts = next((folder / "prepared").glob("*.json"))
        found["artifact.json"] = Target(file=facts, read=lambda: Scene.load(facts.parent))
        archive = folder / "a.zip"
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
            packed.writestr("photos/0.txt", b"abc" * 50)
            packed.writestr("photos/1.txt", bytes(range(256)))
        found["zip"] = Target(file=archive, read=lambda: _unpack_and_remove(archive))
        yield found


def _write_binary_model(folder: Path) -> bool:
    """A model as COLMAP itself writes it; False without its package."""
    try:
        import pycolmap
    except ImportError:
        return False
    folder.mkdir()
    MAKERS["colmap"](folder)
    model = folder / "sparse" / "0"
    (model / "points3D.txt").write_text("")
    (model / "images.txt").write_text((model / "images.txt").read_text().replace("1.0 2.0 -1", ""))
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for path in model.glob("*.txt"):
        path.unlink()
    return True


def _unpack_and_remove(archive: Path) -> None:
    with tempfile.TemporaryDirectory(dir=archive.parent) as name:
        unpack_archive(archive, Path(name) / "unpacked")


def damage(target: Target, count: int, seed: int) -> tuple[int, list[tuple[bytes, str]]]:
    """(how many of ``count`` damaged files were refused, those that ended otherwise with what was raised)."""
    whole, choose = target.file.read_bytes(), random.Random(seed)  # noqa: S311
    refused, wrong = 0, []
    for _ in range(count):
        data = mutate(whole, choose)
        target.file.write_bytes(data)
        try:
            target.read()
        except UserError as error:
            refused += 1
            if "\n" in error.line():
                wrong.append((data, f"more than one line: {error.line()!r}"))
        except Exception:  # noqa: BLE001 - what must not happen is what is looked for
            wrong.append((data, traceback.format_exc()))
    target.file.write_bytes(whole)
    return refused, wrong


def main() -> None:
    """Damage, read, and say what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000, help="in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=None, help="these kinds")
    parser.add_argument("--keep", type=Path, default=Path("fuzz_findings"))
    args = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    failed = False
    with targets() as found:
        chosen = {name: target for name, target in found.items() if args.only is None or name in args.only}
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for name, target in chosen.items():
            count = -(-args.inputs // len(chosen))
            refused, wrong = damage(target, count, args.seed)
            print(f"{name}: {count} inputs, {refused} refused, {len(wrong)} tracebacks", flush=True)
            for number, (data, text) in enumerate(wrong[:3]):
                args.keep.mkdir(exist_ok=True)
                (args.keep / f"{name}_{number}").write_bytes(data)
                print(text)
            failed |= bool(wrong)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(f"peak memory grew by {grown:.0f} MiB")
    sys.stdout.flush()
    os._exit(int(failed))  # threads of decoders that were given damaged files are not waited for


if __name__ == "__main__":
    main()
