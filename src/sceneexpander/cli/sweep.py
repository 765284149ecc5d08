"""Many configurations at once: ``sceneexpander sweep --multirun ablation=baseline,anchor,paper``.

Each combination runs as its own workspace; what they have in common runs once. ``scene=a,b`` or ``scene=glob(*)`` makes jobs over
folders of ``scenes/``; without it the scenes are those of params.yaml, and so are rounds and methods in any case.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneexpander.artifacts.store import read_json, read_typed, to_plain, write_json_atomic
from sceneexpander.commandline import CommandParser
from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.overrides import environment_hidden, key_of, override, written_out
from sceneexpander.config.parse import ConfigError
from sceneexpander.errors import EXIT_BAD_INPUT, UserError, did_you_mean, disk_full, entry_point, printable
from sceneexpander.pipeline.disk import remove_tree
from sceneexpander.pipeline.locks import run_lock
from sceneexpander.pipeline.preflight import CHECKED_SECTIONS, Checked, check_scene
from sceneexpander.pipeline.processes import run_group
from sceneexpander.pipeline.project import ROOT_ENV, find_project
from sceneexpander.pipeline.selection import Selection, read_selection
from sceneexpander.pipeline.workspace import make_workspace, merged_overrides, reproduce_shared
from sceneexpander.report.sweep import SweptJob, write_sweep_page
from sceneexpander.typed import shorten

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

INNER_ENV = "SCENEEXPANDER_SWEEP_RUNS"  # in the process that runs Hydra, which ends with the one that the user sees: the sweep's folder
# Not as a program of its own: launchers send the jobs' classes to other processes by the name of their module, which must not be __main__.
_INNER = "from sceneexpander.cli.sweep import main; main()"
SCENE_KEY = "scene"  # the axis: folders of scenes/, while Hydra's group of this name holds settings
_JOB_KEY = "+swept_job"  # the one axis that Hydra gets: numbers of jobs, so that any of them can be started again
SWEEP_FILE, STATE_FILE = "sweep.json", "job.json"  # in the folders of a sweep and of a job
_DECIDED = (
    "hydra.sweep.subdir",
    "hydra.job.num",
    "hydra/sweeper",
    "hydra.mode",
)  # otherwise no job could be found again
MOST_VALUES = 1000  # of one key: each is a run of its own
REPORT, PAGES = "outputs/report", "outputs/pages"
KEPT = (REPORT, PAGES, "params.yaml", "dvc.lock")  # of a finished job; the rest is in the cache
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """What a sweep's folder says about it.

    Attributes:
        hydra: Hydra's own settings, e.g. which launcher.
        jobs: all combinations; the folder of each is its number.
    """

    hydra: tuple[str, ...]
    jobs: tuple[Job, ...]
    schema: str = "sweep/1"

    @classmethod
    def load(cls, folder: Path) -> Sweep:
        """Raises `UserError` if the folder is none of a sweep."""
        if not (folder / SWEEP_FILE).is_file():
            raise UserError("holds no sweep", where=folder, fix="name a folder of multirun/")
        return read_typed(cls, read_json(folder / SWEEP_FILE), folder / SWEEP_FILE)


@dataclass(frozen=True, slots=True, kw_only=True)
class JobState:
    """How far a job is. ``started`` without anything else: it runs, or was killed."""

    started: bool = False
    done: bool = False
    error: str = ""
    schema: str = "job/1"


def job_state(sweep: Path, number: int) -> JobState:
    """Of one job of a sweep's folder."""
    path = sweep / str(number) / STATE_FILE
    return read_typed(JobState, read_json(path), path) if path.is_file() else JobState()


def run_job(folder: Path, job: Job, project: Path, *, sweep: str | None = None) -> None:
    """One combination: make its workspace, run it, keep its pages.

    Raises:
        RuntimeError: the pipeline failed. (Not SystemExit: that would end the whole sweep.)
    """
    folder.mkdir(parents=True, exist_ok=True)
    with run_lock(folder / "workspace"):  # one that outlived its sweep may still be at work
        write_json_atomic(folder / STATE_FILE, to_plain(JobState(started=True)))
        try:
            _run_job(folder, job, project, sweep)
        except Exception as error:
            line = str(error).partition("\n")[0] or type(error).__name__
            write_json_atomic(folder / STATE_FILE, to_plain(JobState(started=True, error=line)))
            raise
        write_json_atomic(folder / STATE_FILE, to_plain(JobState(started=True, done=True)))


def _run_job(folder: Path, job: Job, project: Path, sweep: str | None) -> None:
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
            remove_tree(target)
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
    """A checked command line: the sweep, where it is to be, and jobs in which every value of every axis occurs."""

    sweep: Sweep
    folder: Path
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
    known = ("--multirun", "-m", "--retry")
    for option in options:
        if option not in known:
            raise UserError("unknown option", where=shorten(option), fix=did_you_mean(shorten(option), known))
    given = [item for item in arguments if not item.startswith("-")]
    for item in given:
        if "=" not in item and not item.startswith("~"):
            raise UserError("is not a setting", where=item, fix="write key=value, e.g. ablation=baseline,paper")
    scenes = [item for item in given if key_of(item) == SCENE_KEY and "=" in item]
    if len(scenes) > 1:
        raise UserError("is given twice", where=SCENE_KEY, fix="write scene=a,b")
    names = _scene_names(scenes[0], project) if scenes else []
    items = list(written_out([item for item in given if item not in scenes], absolute=True, sweep=True))
    for item in items:
        if key_of(item) in _DECIDED:
            raise UserError("is decided by the sweep", where=shorten(item), fix="leave it out")
    base = read_selection(project)
    found, folder = _axes(items, project / "conf")
    axes = {
        item: [f"{item.partition('=')[0]}={value}" if "=" in item else item for value in values]
        for item, values in found.items()
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
    every = tuple(
        Job(scene=scene, overrides=overrides)
        for scene in (names or (None,))
        for overrides in itertools.product(*axes.values())
    )
    hydra = tuple(item for item in items if item not in axes)
    return Axes(sweep=Sweep(hydra=hydra, jobs=every), folder=folder, jobs=tuple(jobs))


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


def _axes(items: Sequence[str], conf: Path) -> tuple[dict[str, list[str]], Path]:
    """Of every override the values that it stands for, each as Hydra would write it; and the folder that Hydra would write to."""
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
            folder = Path(composed.hydra.sweep.dir).absolute()
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
    return found, folder


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


def run_hydra(numbers: Sequence[int], folder: Path, project: Path) -> None:
    """Hydra's command line over this project's ``conf/``: its launcher runs the jobs of a sweep with these numbers.

    Raises:
        UserError: Hydra cannot start, e.g. because of the folder that it is to write to.
        RuntimeError: a job failed.
    """
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    sweep = Sweep.load(folder)

    def run_one(settings: Any) -> None:
        own = Path(HydraConfig.get().runtime.output_dir)
        job = sweep.jobs[settings.swept_job]
        run_job(own, job, project, sweep="_".join(own.parts[-3:-1]))
        print(f"{job.label()}: {own / REPORT / 'index.html'}")

    # Otherwise Hydra prints errors in its own way and exits.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    swept = f"{_JOB_KEY}={','.join(map(str, numbers))}"
    place = [override("hydra.sweep.dir", str(folder)), "hydra.sweep.subdir=${swept_job}"]
    given = [item for item in sweep.hydra if key_of(item) != "hydra.sweep.dir"]
    sys.argv = [sys.argv[0], "--multirun", swept, *given, *place]
    try:
        with _waiting_for_all():
            hydra.main(config_path=str(project / "conf"), config_name="config", version_base="1.3")(run_one)()
    except (HydraException, OmegaConfBaseException, OSError) as error:
        if disk_full(error) is not None:
            raise
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise UserError(first.strip(), where="sceneexpander sweep") from None


@contextlib.contextmanager
def _waiting_for_all() -> Iterator[None]:
    """Let Hydra's submitit launcher take a job that was killed for one that failed: it would not wait for those after it."""
    try:
        from submitit.core.core import Job as Submitted
        from submitit.core.utils import UncompletedJobError
    except ImportError:
        yield
        return
    from hydra.core.utils import JobReturn, JobStatus

    original = Submitted.results

    def results(self: Any) -> Any:
        try:
            return original(self)
        except UncompletedJobError as error:
            return [JobReturn(status=JobStatus.FAILED, _return_value=RuntimeError(str(error)))]

    Submitted.results = results
    try:
        yield
    finally:
        Submitted.results = original


def run_sweep(folder: Path, project: Path) -> int:
    """Run what is missing in a sweep's folder, and say at the end what failed and how to have only that again.

    Launchers end all their jobs when one of their processes is killed: those are started again as long as that gets any of them done.

    Returns:
        The exit code: 0 if every job is done.
    """
    sweep = Sweep.load(folder)
    states = [job_state(folder, number) for number in range(len(sweep.jobs))]
    left, code = [number for number, state in enumerate(states) if not state.done], 0
    for number in left:
        (folder / str(number) / STATE_FILE).unlink(missing_ok=True)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("HYDRA_")}
    while left:
        # Jobs run in processes of their own, some of which Hydra's launchers do not end: they end with this one.
        command = [sys.executable, "-c", _INNER, *map(str, left)]
        own = environment | {INNER_ENV: str(folder), ROOT_ENV: str(project)}
        code = run_group(command, cwd=Path.cwd(), env=own)
        states = [job_state(folder, number) for number in range(len(sweep.jobs))]
        before, left = left, [number for number in left if not (states[number].done or states[number].error)]
        if code == EXIT_BAD_INPUT or len(left) == len(before):
            break
        if left:
            print(f"note: {len(left)} jobs were cut off and are started again", file=sys.stderr)
    missing = {number: _why_missing(state) for number, state in enumerate(states) if not state.done}
    if len(states) > 1 and len(missing) < len(states):
        jobs = [
            SweptJob(label=job.label(), folder=str(number), error=missing.get(number, ""))
            for number, job in enumerate(sweep.jobs)
        ]
        print(f"all jobs: {write_sweep_page(jobs, folder, pages=PAGES, report=REPORT)}")
    if not missing:
        return 0
    print(f"error: {len(missing)} of {len(states)} jobs are not done:", file=sys.stderr)
    for number, why in missing.items():
        print(f"  {number} {sweep.jobs[number].label()}: {printable(why)}", file=sys.stderr)
    print(f"again, only these: sceneexpander sweep --retry {shlex.quote(str(folder))}", file=sys.stderr)
    return code or 1


def _why_missing(state: JobState) -> str:
    return state.error or ("was killed" if state.started else "was not started")


def make_parser() -> CommandParser:
    """The options of the command. What they mean is Hydra's grammar, which `check_axes` reads."""
    parser = CommandParser(
        "sweep",
        "Run the pipeline for every combination of settings. Each is a workspace of its own; what they have in common runs once.",
        examples=[
            "--multirun ablation=baseline,paper seed=0,1,2",
            "--multirun 'scene=glob(*)' profile=smoke",
            "--multirun hydra/launcher=slurm 'ablation=glob(*)'",
            "--retry multirun/2026-05-01/12-00-00",
        ],
    )
    parser.add_argument(
        "axes", nargs="*", metavar="key=value,...", help="settings, with several values those to combine"
    )
    parser.add_argument("--retry", metavar="FOLDER", help="instead: the jobs of an earlier sweep that are not done")
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
    inner = os.environ.pop(INNER_ENV, None)
    if inner is not None:
        try:
            run_hydra([int(number) for number in given], Path(inner), project)
        except RuntimeError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(1) from None
        return
    if not given:
        raise UserError(
            "nothing to sweep over", where="sceneexpander sweep", fix="add --multirun ablation=baseline,paper"
        )
    if given[0] == "--retry":
        if len(given) != 2:
            raise UserError("takes one folder of a sweep and nothing else", where="--retry")
        folder = Path(given[1]).absolute()
        check_inputs(Sweep.load(folder).jobs, project)
    else:
        axes = check_axes(given, project)
        check_inputs(axes.jobs, project)
        folder = axes.folder
        if (folder / SWEEP_FILE).exists() and Sweep.load(folder) != axes.sweep:
            raise UserError("holds another sweep", where=folder, fix="choose another hydra.sweep.dir")
        try:
            write_json_atomic(folder / SWEEP_FILE, to_plain(axes.sweep))
        except OSError as error:
            raise UserError(str(error.strerror), where=folder) from None
    raise SystemExit(run_sweep(folder, project))


if __name__ == "__main__":
    main()
