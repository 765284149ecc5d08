"""What a pipeline run takes from the user's shell, and what not: the same command makes the same run on every desk.

Decided variable by variable. What names the user's machine stays (PATH, HOME, TMPDIR, CUDA_*, OMP_*, proxies, keys that a setting
names, the server of MLflow). What would quietly turn a run into another one is left out: settings of Hydra, DVC and MLflow that `conf/`
and `.dvc/` decide, where Python looks for modules, where git looks for its repository, and a login shell that may be no shell.
"""

from __future__ import annotations

import getpass
import io
import os
import re
import stat
import sys
from pathlib import Path

from configobj import ConfigObj, ConfigObjError

from sceneexpander.errors import UserError
from sceneexpander.files import write_bytes_atomic
from sceneexpander.pipeline.project import ERROR_FILE_ENV, ROOT_ENV
from sceneexpander.tracking.server import SHELL_URI
from sceneexpander.tracking.store import without_foreign_settings

_LEFT_OUT = ("HYDRA_", "DVC_", "PYTHON", "GIT_")
_KEPT = frozenset({"PYTHONHASHSEED", "PYTHONUNBUFFERED", "PYTHONPYCACHEPREFIX"})
LOCAL_CONFIG = Path(".dvc") / "config.local"


def pipeline_environment(folder: Path, project: Path, *, error_file: Path | None = None) -> dict[str, str]:
    """Environment in which the stages of a pipeline folder run its own copy of the sources with this interpreter.

    Args:
        folder: of the pipeline, which is also where its commands start.
        project: the main project folder, for resume points and tracking.
        error_file: where a stage that refuses its input leaves the line; None: nowhere.
    """
    environment = {name: value for name, value in os.environ.items() if name in _KEPT or not name.startswith(_LEFT_OUT)}
    server = {name: value for name, value in environment.items() if name == SHELL_URI}  # for the last stage to look at
    environment = without_foreign_settings(environment) | server
    # Within a path the separator cannot be written; commands start in the folder, so its relative name does as well.
    places = ["src", "."] if os.pathsep in str(folder) else [str(folder / "src"), str(folder)]
    environment |= {
        ROOT_ENV: str(project),
        "PYTHONPATH": os.pathsep.join(places),
        "PYTHONUTF8": "1",
        # Not resolved: a virtual environment's python is a link, and its folder is what selects the environment.
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)]),
        "SHELL": "/bin/sh",  # DVC runs commands with it, and a login shell may be /usr/sbin/nologin
        "DVC_NO_ANALYTICS": "true",
        "DVC_SITE_CACHE_DIR": str(make_site_folder(project)),
        "MLFLOW_DISABLE_TELEMETRY": "true",
    }
    if os.environ.get("PYTHONDONTWRITEBYTECODE"):
        # Nothing is wanted beside the sources. But a run starts several interpreters, and to compile torch costs each of them seconds.
        environment.setdefault("PYTHONPYCACHEPREFIX", str(project / ".cache" / "bytecode"))
    environment.pop(ERROR_FILE_ENV, None)
    if error_file is not None:
        environment[ERROR_FILE_ENV] = str(error_file)
    return _with_a_user(environment, project)


def make_site_folder(project: Path) -> Path:
    """The folder of DVC's databases in a project, where nobody writes who may not write in the project.

    They hold pickles, so who writes them runs code as the user (CVE-2025-69872). DVC's own choice is a folder below ``/var/tmp`` in which
    every user of the machine may replace those of others, and it makes such a folder wherever there is none.
    """
    site = project / ".dvc" / "tmp" / "site"
    (site / "repo").mkdir(parents=True, exist_ok=True)
    for folder in (site.parent, site, site / "repo"):
        status = folder.stat()
        if status.st_mode & stat.S_IWOTH and status.st_uid == os.getuid():
            folder.chmod(stat.S_IMODE(status.st_mode) & ~stat.S_IWOTH)
    return site


def _with_a_user(environment: dict[str, str], project: Path) -> dict[str, str]:
    """A name and a home folder, for a user id that has neither (``docker run -u 12345``): DVC asks for both."""
    try:
        getpass.getuser()
    except (KeyError, OSError):
        environment["LOGNAME"] = f"user-{os.getuid()}"
    try:
        Path.home()
    except RuntimeError:
        environment["HOME"] = str(project / ".cache" / "home")
        (project / ".cache" / "home").mkdir(parents=True, exist_ok=True)
    return environment


def local_config(*, cache: Path | str | None, site: Path | None, no_scm: bool) -> bytes:
    """The text of ``.dvc/config.local``, with paths of any characters.

    Args:
        cache: DVC's cache; relative to the file's folder if it is a text; None: DVC's own choice.
        site: DVC's folder for its databases; None: DVC's own choice.
        no_scm: whether the pipeline is outside of version control.

    Raises:
        UserError: a path that the format has no way to write.
    """
    core = {"no_scm": str(no_scm).lower()} | ({} if site is None else {"site_cache_dir": str(site)})
    content = {"core": core} | ({} if cache is None else {"cache": {"dir": str(cache)}})
    lines = []
    for section, values in content.items():
        lines += [f"[{section}]", *(f"    {key} = {_quoted(value)}" for key, value in values.items())]
    text = "\n".join(lines) + "\n"
    try:
        read = ConfigObj(io.StringIO(text)).dict()  # as DVC reads it
        data = text.encode()
    except (ConfigObjError, UnicodeError):
        read, data = None, b""
    if read != content:
        raise UserError("cannot be written into DVC's configuration", where=cache or site, fix="rename the folder")
    return data


def _quoted(value: str) -> str:
    if re.fullmatch(r"[A-Za-z0-9_./-]+", value):
        return value
    # Whatever it is: bare values lose spaces at their ends, also those that only Unicode knows.
    mark = next((mark for mark in ('"', "'", "'''") if mark not in value), '"""')
    return f"{mark}{value}{mark}"


def is_under_version_control(project: Path) -> bool:
    """Whether DVC can work with the repository that a project folder is in.

    A downloaded archive is in none, and git refuses one that belongs to somebody else.
    """
    from sceneexpander.pipeline.dvc_adapter import can_use_repository

    return any((folder / ".git").exists() for folder in (project, *project.parents)) and can_use_repository(project)


def settle_project(project: Path) -> None:
    """Let the pipeline of the project folder itself run where it is, under version control or not.

    Writes ``.dvc/config.local`` where that is needed and nobody has written one; one that is there is the user's.
    """
    path = project / LOCAL_CONFIG
    if path.exists() or is_under_version_control(project):
        return
    write_bytes_atomic(path, local_config(cache=None, site=None, no_scm=True))
