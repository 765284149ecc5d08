"""resolve: compose conf/ for one scene, strictly, into the file whose sections all later stages read."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sceneexpander.catalogue.methods import known_methods
from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.files import write_settings
from sceneexpander.config.overrides import written_out
from sceneexpander.generation.config import ChoiceConfig, GeneratorConfig
from sceneexpander.judge.config import JudgeConfig
from sceneexpander.models.weights import named_file
from sceneexpander.pipeline.environment import usable_cpus
from sceneexpander.pipeline.selection import ROUND_SECTIONS, read_selection
from sceneexpander.typed import decode_dataclass
from stages import layout
from stages.runner import Cell, stage

CONF = Path("conf")


def read_overrides(path: Path) -> list[str]:
    """The ``overrides`` of params.yaml, as Hydra reads them."""
    return list(written_out(read_selection(path.parent).overrides))


def read_methods(path: Path) -> list[str]:
    """The ``methods`` of params.yaml, all of them known, and none without what it starts from."""
    return list(read_selection(path.parent).methods)


def named_files(values: Mapping[str, Any], rounds: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Path]]:
    """Files from outside that a configuration names: by kind and for some by round (see `layout.given`), then by the name of their link.

    Files that are not there are left out: the stage that needs one says so. Weights on a hub are named by their revision.

    Args:
        values: of the composed configuration.
        rounds: sections of each round.
    """
    judge = decode_dataclass(JudgeConfig, values["judge"])
    found: dict[str, dict[str, Path | None]] = {
        "judge": dict(judge.named_files()),
        "lpips": {"weights": named_file(values["evaluate"]["lpips_weights"])},
        "model": {"weights": named_file(values["model"]["weights"])},
    }
    for number, sections in enumerate(rounds, start=1):
        generator = decode_dataclass(GeneratorConfig, sections["generator"])
        choice = decode_dataclass(ChoiceConfig, sections["choose"])
        found[f"generator/{layout.round_key(number)}"] = {"file": generator.named_file(number)}
        found[f"choice/{layout.round_key(number)}"] = {"file": choice.named_file(number)}
    for rival, section in values["rivals"].items():
        found[rival] = {"weights": named_file(section["weights"])}
    return {
        kind: {name: path.absolute() for name, path in files.items() if path is not None and path.is_file()}
        for kind, files in found.items()
    }


def link_files(files: Mapping[str, Path], folder: Path) -> None:
    """Make ``folder`` hold a link to each of the files, and nothing else."""
    if folder.is_dir():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    for name, path in files.items():
        (folder / name).symlink_to(path)
    if not files:
        (folder / "none").touch()


@stage("scene")
def main(cell: Cell) -> None:
    """Compose, validate, write; link the files that it names; note for every method that is not always made whether it is wanted."""
    methods = read_methods(Path("params.yaml"))
    selected = read_selection(Path())
    overrides = [f"scene={scene_option(CONF, cell.scene)}", *read_overrides(Path("params.yaml"))]
    values = compose(CONF, overrides)
    values["threads"] = values["threads"] or usable_cpus()
    write_settings(layout.config(cell.scene), values)
    rounds = []
    for number in range(1, selected.rounds + 1):
        more = written_out(selected.overrides_of(number))
        of_round = compose(CONF, [*overrides, *more]) if more else values
        rounds.append({name: of_round[name] for name in ROUND_SECTIONS})
    keys = map(layout.round_key, range(1, len(rounds) + 1))
    write_settings(layout.round_settings(cell.scene), dict(zip(keys, rounds, strict=True)))
    for kind in ("generator", "choice"):
        shutil.rmtree(layout.given(cell.scene, kind), ignore_errors=True)  # of rounds that are no more
    for kind, files in named_files(values, rounds).items():
        link_files(files, layout.given(cell.scene, kind))
    write_settings(
        layout.selection(cell.scene),
        {method.name: method.name in methods for method in known_methods() if not method.always_made},
    )


if __name__ == "__main__":
    main()
