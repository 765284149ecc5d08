"""resolve: compose conf/ for one scene, strictly, into the file whose sections all later stages read."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sceneexpander.catalogue.methods import known_methods
from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.files import write_yaml
from sceneexpander.config.overrides import written_out
from sceneexpander.environment import usable_cpus
from sceneexpander.generation.config import ChoiceConfig, GeneratorConfig
from sceneexpander.judge.config import JudgeConfig
from sceneexpander.models.weights import named_file
from sceneexpander.selection import read_selection
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


def named_files(values: Mapping[str, Any], rounds: int) -> dict[str, dict[str, Path]]:
    """Files from outside that a configuration names: by kind (see `layout.given`), then by the name of their link.

    Files that are not there are left out: the stage that needs one says so. Weights on a hub are named by their revision.
    """
    generator = decode_dataclass(GeneratorConfig, values["generator"])
    choice = decode_dataclass(ChoiceConfig, values["choose"])
    judge = decode_dataclass(JudgeConfig, values["judge"])
    numbers = range(1, rounds + 1)
    found: dict[str, dict[str, Path | None]] = {
        "generator": {f"round_{number}": generator.named_file(number) for number in numbers},
        "choice": {f"round_{number}": choice.named_file(number) for number in numbers},
        "judge": dict(judge.named_files()),
        "model": {"weights": named_file(values["model"]["weights"])},
    }
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
    overrides = [f"scene={scene_option(CONF, cell.scene)}", *read_overrides(Path("params.yaml"))]
    values = compose(CONF, overrides)
    values["threads"] = values["threads"] or usable_cpus()
    write_yaml(layout.config(cell.scene), values)
    rounds = read_selection(Path()).rounds
    for kind, files in named_files(values, rounds).items():
        link_files(files, layout.given(cell.scene, kind))
    write_yaml(
        layout.selection(cell.scene),
        {method.name: method.name in methods for method in known_methods() if not method.always_made},
    )


if __name__ == "__main__":
    main()
