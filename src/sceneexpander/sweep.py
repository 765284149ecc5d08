"""Many configurations at once: ``sceneexpander sweep --multirun ablation=baseline,anchor,paper``.

Each combination runs as its own workspace; what they have in common runs once. ``scene=a,b`` or ``scene=glob(*)`` makes jobs over
folders of ``scenes/``; without it the scenes are those of params.yaml, and so are rounds and methods in any case.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneexpander.commandline import CommandParser
from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.overrides import environment_hidden, key_of, written_out
from sceneexpander.config.parse import ConfigError
from sceneexpander.errors import UserError, did_you_mean, disk_full, entry_point
from sceneexpander.pipeline.disk import remove_tree
from sceneexpander.pipeline.preflight import CHECKED_SECTIONS, Checked, check_scene
from sceneexpander.pipeline.workspace import make_workspace, merged_overrides, reproduce_shared
from sceneexpander.processes import run_group
from sceneexpander.project import ROOT_ENV, find_project
from sceneexpander.selection import Selection, read_selection
from sceneexpander.typed import shorten

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

INNER_ENV = "SCENEEXPANDER_SWEEP_RUNS"  # set in the process that runs Hydra, which ends with the one that the user sees
SCENE_KEY = "scene"  # the axis as people write it
_HYDRA_SCENE_KEY = "+swept_scene"  # as Hydra gets it: its own group ``scene`` holds settings, not folders
MOST_VALUES = 1000  # of one key: each is a run of its own
KEPT = ("outputs/report", "outputs/pages", "params.yaml", "dvc.lock")  # of a finished job; the rest is in the cache
_CHECKED = Checked()  # by this process: pictures and weights that jobs share are read once


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One combination of the axes: a scene, if they name one, and settings."""

    scene: str | None = None
    overrides: tuple[str, ...] = ()

    def label(self) -> str:
        """For people, e.g. "scene=courtyard seed=1"."""
        scene = () if self.scene is None else (f"{SCENE_KEY}={self.scene}",)
        return " ".join((*scene, *self.overrides)) or "default"

    def selection(self, base: Selection, project: Path) -> Selection:
        """What the job runs, where the project itself would run ``base``."""
        scenes = base.scenes if self.scene is None else (self.scene,)
        return replace(base, scenes=scenes, overrides=merged_overrides(base.overrides, self.overrides, project=project))


def run_job(folder: Path, job: Job, project: Path, *, sweep: str | None = None) -> None:
    """One combination: make its workspace, run it, keep its pages.

    Raises:
        RuntimeError: the pipeline failed. (Not SystemExit: that would end the whole sweep.)
    """
    selection = job.selection(read_selection(project), project)
    try:
        _check(selection, project, device=True, store=False)
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


def _check(selection: Selection, project: Path, *, device: bool, store: bool) -> None:
    for scene in selection.scenes:
        check_scene(
            scene,
            project / "scenes" / scene,
            conf=project / "conf",
            overrides=selection.overrides,
            rounds=selection.rounds,
            round_overrides=selection.round_overrides,
            methods=selection.methods,
            device=device,
            store=store,
            checked=_CHECKED,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Axes:
    """A checked command line: as Hydra gets it, and jobs in which every value of every axis occurs."""

    arguments: list[str]
    jobs: tuple[Job, ...]


def check_axes(arguments: Sequence[str], project: Path) -> Axes:
    """The command line after a look at every value of every axis; no picture and no weights are read.

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
            raise UserError("unknown option", where=shorten(option), fix=did_you_mean(shorten(option), known[:1]))
    given = [item for item in arguments if not item.startswith("-")]
    for item in given:
        if "=" not in item and not item.startswith("~"):
            raise UserError("is not a setting", where=item, fix="write key=value, e.g. ablation=baseline,paper")
    scenes = [item for item in given if key_of(item) == SCENE_KEY and "=" in item]
    if len(scenes) > 1:
        raise UserError("is given twice", where=SCENE_KEY, fix="write scene=a,b")
    names = _scene_names(scenes[0], project) if scenes else []
    items = list(written_out([item for item in given if item not in scenes], absolute=True, sweep=True))
    base = read_selection(project)
    axes = {
        item: [f"{item.partition('=')[0]}={value}" if "=" in item else item for value in values]
        for item, values in _axes(items, project / "conf").items()
        if key_of(item).partition("/")[0].partition(".")[0] != "hydra"
    }
    several = next((item for item, values in axes.items() if len(values) > 1), scenes[0] if len(names) > 1 else None)
    if several is not None and not options:
        raise UserError("holds several values", where=shorten(several), fix="add --multirun")
    # Every value once, beside the first ones of the other axes: what is wrong with one is wrong in any company.
    first = {item: values[0] for item, values in axes.items()}
    settings = [tuple({**first, item: value}.values()) for item, values in axes.items() for value in values] or [()]
    jobs = [Job(scene=names[0] if names else None, overrides=overrides) for overrides in dict.fromkeys(settings)]
    jobs += [replace(jobs[0], scene=name) for name in names[1:]]
    for job in jobs:
        selection = job.selection(base, project)
        for scene in selection.scenes:
            compose(project / "conf", [f"scene={scene_option(project / 'conf', scene)}", *selection.overrides])
    swept = [f"{_HYDRA_SCENE_KEY}={','.join(names)}"] if names else []
    return Axes(arguments=[*options, *swept, *items], jobs=tuple(jobs))


def check_inputs(jobs: Sequence[Job], project: Path) -> None:
    """Read the pictures and weights of jobs, so that none runs if another cannot. Devices are asked for where each job runs.

    Raises:
        UserError: one line about the first problem found.
    """
    base = read_selection(project)
    seen = set()
    for job in jobs:
        selection = job.selection(base, project)
        for scene in selection.scenes:
            composed = compose(
                project / "conf", [f"scene={scene_option(project / 'conf', scene)}", *selection.overrides]
            )
            key = (scene, repr([composed[section] for section in CHECKED_SECTIONS]))
            if key not in seen:
                seen.add(key)
                _check(replace(selection, scenes=(scene,)), project, device=False, store=True)


def _scene_names(item: str, project: Path) -> list[str]:
    """The folders of ``scenes/`` that an axis stands for."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import Glob
    from hydra.errors import HydraException

    known = sorted(path.parent.name for path in (project / "scenes").glob("*/scene.yaml"))
    try:
        parsed = OverridesParser.create().parse_override(item.lstrip("+"))
        value = parsed.value()
        if isinstance(value, Glob):
            names = value.filter(known)
        elif parsed.is_sweep_override():
            names = list(parsed.sweep_string_iterator()) if parsed.is_discrete_sweep() else []
        else:
            names = [item.partition("=")[2]]
    # Beside its own errors, the parser lets those of very long and very large numbers through.
    except (HydraException, ValueError, TypeError, LookupError, ArithmeticError, RecursionError):
        names = [item.partition("=")[2]]
    if not names:
        raise UserError("stands for no scene", where=shorten(item), fix=f"known: {', '.join(known)}")
    for name in names:
        if name not in known:
            raise UserError(f"there is no scene {shorten(name)!r}", where=SCENE_KEY, fix=did_you_mean(name, known))
    return list(dict.fromkeys(names))


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
    own: list[str] = []
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
        at_fault = next((text for text in own if key_of(text) in str(error)), None)
        fix = None if at_fault is None else _hydra_fix(at_fault, conf)
        where = shorten(at_fault or item) or "sceneexpander sweep"
        raise UserError(shorten(first.strip(), 200), where=where, fix=fix) from None
    return found


def _hydra_fix(item: str, conf: Path) -> str | None:
    """What is like an option, a group or a key of Hydra's own settings that there is not."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    key, _, value = item.lstrip("+~").partition("=")
    with environment_hidden(), initialize_config_dir(str(conf.resolve()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        options = loader.get_group_options(key)
        if options:
            return did_you_mean(value, options)
        known = [f"hydra/{group}" for group in loader.list_groups("hydra")]
        if "/" not in key:
            known = _keys(hydra_compose("config", return_hydra_config=True).hydra, "hydra.")
    fix = did_you_mean(key, known)
    return fix if fix.startswith("did you mean") else None  # all keys together would be a page


def _keys(node: DictConfig, prefix: str) -> list[str]:
    from omegaconf import DictConfig

    found = []
    for name in map(str, node):
        found.append(f"{prefix}{name}")
        child = node._get_node(name)
        if isinstance(child, DictConfig) and not child._is_none():
            found += _keys(child, f"{prefix}{name}.")
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

    def run_one(_: Any) -> None:
        settings = HydraConfig.get()
        folder = Path(settings.runtime.output_dir)
        given = {key_of(item): item for item in settings.overrides.task}
        scene = given.pop(key_of(_HYDRA_SCENE_KEY), "").partition("=")[2] or None
        job = Job(scene=scene, overrides=tuple(given.values()))
        sweep = None if folder.parent == folder or settings.mode.name == "RUN" else "_".join(folder.parts[-3:-1])
        run_job(folder, job, project, sweep=sweep)
        print(f"{job.label()}: {folder / 'outputs' / 'report' / 'index.html'}")

    # Otherwise Hydra prints errors in its own way and exits.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    sys.argv = [sys.argv[0], *arguments]
    try:
        hydra.main(config_path=str(project / "conf"), config_name="config", version_base="1.3")(run_one)()
    except (HydraException, OmegaConfBaseException, OSError) as error:
        if disk_full(error) is not None:
            raise
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise UserError(first.strip(), where="sceneexpander sweep") from None


def make_parser() -> CommandParser:
    """The options of the command. What they mean is Hydra's grammar, which `check_axes` reads."""
    parser = CommandParser(
        "sweep",
        "Run the pipeline for every combination of settings. Each is a workspace of its own; what they have in common runs once.",
        examples=[
            "--multirun ablation=baseline,paper seed=0,1,2",
            "--multirun 'scene=glob(*)' profile=smoke",
            "--multirun hydra/launcher=slurm 'ablation=glob(*)'",
        ],
    )
    parser.add_argument(
        "axes", nargs="+", metavar="key=value,...", help="settings, with several values those to combine"
    )
    parser.add_argument("-m", "--multirun", action="store_true", help="some settings have several values")
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Check the axes, then run the jobs."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if {"-h", "--help"} & set(given):
        make_parser().print_help()
        return
    project = find_project()
    if os.environ.pop(INNER_ENV, None):
        try:
            run_hydra(given, project)
        except RuntimeError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(1) from None
        return
    if not given:
        raise UserError(
            "nothing to sweep over", where="sceneexpander sweep", fix="add --multirun ablation=baseline,paper"
        )
    axes = check_axes(given, project)
    check_inputs(axes.jobs, project)
    # Jobs run in processes of their own, some of which Hydra's launchers do not end: they end with this one.
    command = [sys.executable, "-m", "sceneexpander.sweep", *axes.arguments]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("HYDRA_")}
    environment |= {INNER_ENV: "1", ROOT_ENV: str(project)}
    raise SystemExit(run_group(command, cwd=Path.cwd(), env=environment))


if __name__ == "__main__":
    main()
