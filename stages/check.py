"""Not a stage: look at params.yaml, conf/ and the scene folders before the pipeline replaces anything. `make repro` starts with it."""

from __future__ import annotations

from pathlib import Path

from sceneexpander.config.overrides import written_out
from sceneexpander.errors import entry_point
from sceneexpander.pipeline.packages import installed_packages
from sceneexpander.pipeline.preflight import Checked, check_scene
from sceneexpander.pipeline.selection import read_selection
from stages import layout
from stages.resolve import CONF


@entry_point
def main() -> None:
    """Raise the first problem as one line."""
    installed_packages(Path())
    selection = read_selection(Path())
    checked = Checked()
    for scene in selection.scenes:
        check_scene(
            scene,
            layout.source(scene),
            conf=CONF,
            overrides=written_out(selection.overrides),
            rounds=selection.rounds,
            round_overrides=[written_out(more) for more in selection.round_overrides],
            methods=selection.methods,
            checked=checked,
        )


if __name__ == "__main__":
    main()
