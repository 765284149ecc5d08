"""Many configurations at once: ``python -m sceneexpander.sweep --multirun ablation=baseline,anchor,full``.

Each combination runs as its own workspace; what they have in common runs once. The scenes and rounds are those of params.yaml.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

from sceneexpander.errors import UserError, entry_point
from sceneexpander.preflight import check_scene
from sceneexpander.project import find_project
from sceneexpander.workspace import Selection, make_workspace, merged_overrides, read_selection, reproduce_shared

KEPT = ("outputs/report", "outputs/pages", "params.yaml", "dvc.lock")  # of a finished job; the rest is in the cache


def run_job(folder: Path, overrides: tuple[str, ...], project: Path, *, sweep: str | None = None) -> None:
    """One combination: make its workspace, run it, keep its pages.

    Raises:
        RuntimeError: the pipeline failed. (Not SystemExit: that would end the whole sweep.)
    """
    base = read_selection(project)
    selection = Selection(
        scenes=base.scenes,
        rounds=base.rounds,
        methods=base.methods,
        overrides=merged_overrides(base.overrides, overrides),
    )
    try:
        for scene in selection.scenes:
            check_scene(
                scene,
                project / "scenes" / scene,
                conf=project / "conf",
                overrides=selection.overrides,
                rounds=selection.rounds,
            )
        workspace = make_workspace(folder / "workspace", selection, project=project)
        reproduce_shared(workspace, project=project, sweep=sweep)
    except UserError as error:
        raise RuntimeError(error.line()) from None
    for name in KEPT:
        source, target = workspace / name, folder / name
        if source.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(source, target)
    shutil.rmtree(workspace)


@entry_point
def main() -> None:
    """Hydra's command line over this project's ``conf/``."""
    import hydra
    from hydra.core.hydra_config import HydraConfig

    project = find_project()

    def job(_: Any) -> None:
        settings = HydraConfig.get()
        folder = Path(settings.runtime.output_dir)
        overrides = tuple(item for item in settings.overrides.task if item.partition("=")[0] != "scene")
        sweep = None if folder.parent == folder or settings.mode.name == "RUN" else "_".join(folder.parts[-3:-1])
        run_job(folder, overrides, project, sweep=sweep)
        print(f"{' '.join(overrides) or 'default'}: {folder / 'outputs' / 'report' / 'index.html'}")

    if not sys.argv[1:]:
        raise UserError(
            "nothing to sweep over", where="sceneexpander.sweep", fix="add --multirun ablation=baseline,full"
        )
    hydra.main(config_path=str(project / "conf"), config_name="config", version_base="1.3")(job)()


if __name__ == "__main__":
    main()
