"""Many configurations at once: ``python -m sceneexpander.sweep --multirun ablation=baseline,anchor,full``.

Each combination runs as its own workspace; what they have in common runs once. The scenes and rounds are those of params.yaml.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneexpander.config.compose import compose
from sceneexpander.config.overrides import environment_hidden, key_of, written_out
from sceneexpander.config.parse import ConfigError
from sceneexpander.errors import UserError, did_you_mean, disk_full, entry_point
from sceneexpander.preflight import Checked, check_scene
from sceneexpander.processes import run_group
from sceneexpander.project import ROOT_ENV, find_project
from sceneexpander.selection import read_selection
from sceneexpander.typed import shorten
from sceneexpander.workspace import make_workspace, merged_overrides, remove_tree, reproduce_shared

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

INNER_ENV = "SCENEEXPANDER_SWEEP_RUNS"  # set in the process that runs Hydra, which ends with the one that the user sees
MOST_VALUES = 1000  # of one key: each is a run of its own
KEPT = ("outputs/report", "outputs/pages", "params.yaml", "dvc.lock")  # of a finished job; the rest is in the cache
_CHECKED = Checked()  # by the jobs that this process has run


def run_job(folder: Path, overrides: tuple[str, ...], project: Path, *, sweep: str | None = None) -> None:
    """One combination: make its workspace, run it, keep its pages.

    Raises:
        RuntimeError: the pipeline failed. (Not SystemExit: that would end the whole sweep.)
    """
    base = read_selection(project)
    selection = replace(base, overrides=merged_overrides(base.overrides, overrides))
    try:
        for scene in selection.scenes:
            check_scene(
                scene,
                project / "scenes" / scene,
                conf=project / "conf",
                overrides=selection.overrides,
                rounds=selection.rounds,
                methods=selection.methods,
                checked=_CHECKED,
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
    remove_tree(workspace)


def check_axes(arguments: Sequence[str], project: Path) -> list[str]:
    """The command line as Hydra gets it, after a look at every value of every axis.

    Args:
        arguments: options (``--multirun``) and overrides, as the user gave them.
        project: the project folder.

    Raises:
        UserError: one line about the first option, axis or value that there is not.
    """
    options = [item for item in arguments if item.startswith("-")]
    known = ("--multirun", "-m")
    for option in options:
        if option not in known:
            raise UserError(
                f"unknown option {option!r}", where="sceneexpander.sweep", fix=did_you_mean(option, known[:1])
            )
    given = [item for item in arguments if not item.startswith("-")]
    for item in given:
        if "=" not in item and not item.startswith("~"):
            raise UserError("is not a setting", where=item, fix="write key=value, e.g. ablation=baseline,full")
    items = list(written_out(given, absolute=True, sweep=True))
    base = read_selection(project).overrides
    axes = {
        item: [f"{item.partition('=')[0]}={value}" if "=" in item else item for value in values]
        for item, values in _axes(items, project / "conf").items()
        if key_of(item).partition("/")[0].partition(".")[0] != "hydra"
    }
    # Every value once, beside the first ones of the other axes: what is wrong with one is wrong in any company.
    first = {item: values[0] for item, values in axes.items()}
    jobs = [tuple({**first, item: value}.values()) for item, values in axes.items() for value in values]
    for job in dict.fromkeys(jobs):
        compose(project / "conf", merged_overrides(base, job))
    return [*options, *items]


def _axes(items: Sequence[str], conf: Path) -> dict[str, list[str]]:
    """Of every override the values that it stands for, each as Hydra would write it."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    found: dict[str, list[str]] = {}
    item = ""
    try:
        with environment_hidden(), initialize_config_dir(str(conf.resolve()), version_base="1.3"):
            loader = GlobalHydra.instance().config_loader()
            for item in items:
                (parsed,) = OverridesParser.create(config_loader=loader).parse_overrides([item])
                if parsed.is_sweep_override():
                    if not parsed.is_discrete_sweep():
                        raise UserError("is a range without steps", where=item, fix="name the values: key=1,2,3")
                    values = _values(parsed, item)
                    if not values:
                        raise UserError("stands for no value", where=item, fix="see the files of conf/")
                else:
                    values = [item.partition("=")[2]]
                found[item] = values
            # Hydra's own settings: where jobs run, and how.
            own = [f"{item.partition('=')[0]}={found[item][0]}" for item in items if key_of(item).startswith("hydra")]
            item = " ".join(own) or "conf"
            composed = hydra_compose("config", overrides=own, return_hydra_config=True)
            for key in ("run", "sweep"):
                OmegaConf.to_container(composed.hydra[key], resolve=False)
            if any("oc.env" in text for text in own):
                raise ConfigError("would read an environment variable", where=item, fix="write the value itself")
    except RecursionError:
        raise UserError("is nested too deeply", where=shorten(item)) from None
    # Beside its own errors, Hydra's parser lets those of very long and very large numbers through.
    except (
        HydraException,
        OmegaConfBaseException,
        OSError,
        ValueError,
        TypeError,
        LookupError,
        ArithmeticError,
    ) as error:
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise UserError(shorten(first.strip(), 200), where=shorten(item) or "sceneexpander.sweep") from None
    return found


def _values(axis: Override, item: str) -> list[str]:
    """What a sweep over one key stands for. A range is counted before it is written out: it may have no end."""
    from hydra.core.override_parser.types import RangeSweep

    span: Any = axis.value()
    if isinstance(span, RangeSweep) and span.start is not None and span.stop is not None:
        if span.step == 0:
            raise UserError("is a range whose step is 0", where=item)
        if abs((span.stop - span.start) / span.step) > MOST_VALUES:
            raise UserError(f"stands for more than {MOST_VALUES} values", where=shorten(item))
    return list(axis.sweep_string_iterator())


def run_hydra(arguments: Sequence[str], project: Path) -> None:
    """Hydra's command line over this project's ``conf/``.

    Raises:
        UserError: Hydra cannot start, e.g. because of the folder that it is to write to.
        RuntimeError: a job failed.
    """
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    def job(_: Any) -> None:
        settings = HydraConfig.get()
        folder = Path(settings.runtime.output_dir)
        overrides = tuple(item for item in settings.overrides.task if key_of(item) != "scene")
        sweep = None if folder.parent == folder or settings.mode.name == "RUN" else "_".join(folder.parts[-3:-1])
        run_job(folder, overrides, project, sweep=sweep)
        print(f"{' '.join(overrides) or 'default'}: {folder / 'outputs' / 'report' / 'index.html'}")

    # Otherwise Hydra prints errors in its own way and exits.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    sys.argv = [sys.argv[0], *arguments]
    try:
        hydra.main(config_path=str(project / "conf"), config_name="config", version_base="1.3")(job)()
    except (HydraException, OmegaConfBaseException, OSError) as error:
        if disk_full(error) is not None:
            raise
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise UserError(first.strip(), where="sceneexpander.sweep") from None


@entry_point
def main() -> None:
    """Check the axes, then run the jobs."""
    project = find_project()
    if os.environ.pop(INNER_ENV, None):
        try:
            run_hydra(sys.argv[1:], project)
        except RuntimeError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(1) from None
        return
    if not sys.argv[1:]:
        raise UserError(
            "nothing to sweep over", where="sceneexpander.sweep", fix="add --multirun ablation=baseline,full"
        )
    arguments = check_axes(sys.argv[1:], project)
    # Jobs run in processes of their own, some of which Hydra's launchers do not end: they end with this one.
    command = [sys.executable, "-m", "sceneexpander.sweep", *arguments]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("HYDRA_")}
    environment |= {INNER_ENV: "1", ROOT_ENV: str(project)}
    raise SystemExit(run_group(command, cwd=Path.cwd(), env=environment))


if __name__ == "__main__":
    main()
