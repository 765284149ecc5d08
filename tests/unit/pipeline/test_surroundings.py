"""Where a run takes place does not change it: folders of any name, any shell, no version control."""

from __future__ import annotations

import io
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneexpander.errors import UserError
from sceneexpander.pipeline.selection import Selection
from sceneexpander.pipeline.surroundings import local_config, pipeline_environment, settle_project
from sceneexpander.pipeline.workspace import make_workspace, workspace_environment

ROOT = Path(__file__).parents[3]
FOLDERS = [
    "a,b",
    "a#b",
    'q"q',
    "it's",
    "50%20",
    "what?",
    "{d}",
    "{",
    "${X}",
    "%(x)s",
    "a b ",
    "[x]=y",
    "写真",
    "Müller, A",
    "back\\slash",
    "semi;colon&",
    "'\"#,%?{d} ${X}",
]


def read_by_dvc(folder: Path) -> dict[str, dict[str, str]]:
    from dvc.config import Config

    return Config(dvc_dir=str(folder / ".dvc"), validate=True)


@settings(max_examples=300, deadline=None)
@given(name=st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1).filter(lambda name: "/" not in name))
def test_any_path_in_dvcs_configuration_comes_back_or_is_refused(name: str) -> None:
    from configobj import ConfigObj

    try:
        text = local_config(cache=f"/x/{name}", site=Path(f"/y/{name}"), no_scm=True)
    except UserError:
        # What the format has no way to write.
        assert "%(" in name or ("'" in name and '"' in name) or len(f"/{name}/".splitlines()) > 1
        return
    read = ConfigObj(io.StringIO(text.decode())).dict()
    assert read == {
        "core": {"no_scm": "true", "site_cache_dir": str(Path(f"/y/{name}"))},
        "cache": {"dir": f"/x/{name}"},
    }


@pytest.mark.parametrize("name", FOLDERS)
def test_a_workspace_finds_the_shared_cache(name: str, tmp_path: Path) -> None:
    project = tmp_path / name
    for part in ("conf", "src", "stages", ".dvc", "scenes/mine"):
        (project / part).mkdir(parents=True)
    (project / ".dvc" / "config").write_text((ROOT / ".dvc" / "config").read_text())
    folder = make_workspace(project / "runs" / "mine", Selection(scenes=("mine",), rounds=1), project=project)
    config = read_by_dvc(folder)
    assert Path(str(config["cache"]["dir"])).resolve() == (project / ".dvc" / "cache").resolve()
    assert config["core"]["no_scm"] is True


@pytest.mark.parametrize("name", ["{d} ${X}", "a,b#c", "%(x)s 'q' \"p\""])
def test_dvc_runs_a_pipeline_there(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    (folder / ".dvc").mkdir(parents=True)
    (folder / ".dvc" / "config").write_text((ROOT / ".dvc" / "config").read_text())
    (folder / "dvc.yaml").write_text("stages:\n  a:\n    cmd: mkdir o && echo x > o/x\n    outs: [o]\n")
    settle_project(folder)
    environment = pipeline_environment(folder, folder) | {"PYTHONPATH": str(ROOT / "src")}
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-m", "sceneexpander.pipeline"],
            cwd=folder,
            env=environment,
            text=True,
            capture_output=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert (folder / "o" / "x").read_text() == "x\n"


@pytest.mark.parametrize("before", [None, 0o777])
def test_nobody_else_can_replace_the_databases_of_dvc(before: int | None, tmp_path: Path) -> None:
    (tmp_path / ".dvc").mkdir()
    (tmp_path / ".dvc" / "config").write_text((ROOT / ".dvc" / "config").read_text())
    (tmp_path / "dvc.yaml").write_text("stages:\n  a:\n    cmd: mkdir o && echo x > o/x\n    outs: [o]\n")
    if before is not None:  # as DVC makes them itself
        for folder in ("tmp", "tmp/site", "tmp/site/repo"):
            (tmp_path / ".dvc" / folder).mkdir()
            (tmp_path / ".dvc" / folder).chmod(before)
    settle_project(tmp_path)
    environment = pipeline_environment(tmp_path, tmp_path) | {"PYTHONPATH": str(ROOT / "src")}
    command = [sys.executable, "-m", "sceneexpander.pipeline"]
    subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=True)
    databases = list((tmp_path / ".dvc" / "tmp" / "site").rglob("*.db"))
    assert databases
    for database in databases:
        for place in (database, *database.relative_to(tmp_path).parents):
            assert not (tmp_path / place).stat().st_mode & stat.S_IWOTH, place


def test_a_folder_without_version_control_is_settled_once(tmp_path: Path) -> None:
    settle_project(tmp_path)
    written = tmp_path / ".dvc" / "config.local"
    assert read_by_dvc(tmp_path)["core"]["no_scm"] is True
    written.write_text("[core]\n    no_scm = true\n# mine\n")
    settle_project(tmp_path)
    assert "# mine" in written.read_text()


def test_a_repository_is_left_as_it_is(tmp_path: Path) -> None:
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    settle_project(tmp_path)
    assert not (tmp_path / ".dvc").exists()


def test_an_empty_git_folder_is_no_repository(tmp_path: Path) -> None:
    (tmp_path / ".git").mkdir()
    settle_project(tmp_path)
    assert read_by_dvc(tmp_path)["core"]["no_scm"] is True


FOREIGN = {
    "MLFLOW_EXPERIMENT_NAME": "x",
    "MLFLOW_RUN_ID": "x",
    "HYDRA_FULL_ERROR": "1",
    "DVC_ROOT": "/x",
    "DVC_SITE_CACHE_DIR": "/x",
    "DVC_STUDIO_TOKEN": "x",
    "PYTHONSAFEPATH": "1",
    "PYTHONWARNINGS": "error",
    "PYTHONHOME": "/x",
    "GIT_DIR": "/x",
}
KEPT = {
    "MLFLOW_TRACKING_URI": "http://mlflow.lab:5000",
    "MLFLOW_TRACKING_USERNAME": "me",
    "MLFLOW_TRACKING_TOKEN": "t",
    "CUDA_VISIBLE_DEVICES": "0",
    "OMP_NUM_THREADS": "1",
    "TMPDIR": "/var/scratch",
    "HTTPS_PROXY": "http://x",
}


@pytest.mark.parametrize("name", list(FOREIGN))
def test_the_shell_does_not_redirect_a_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, FOREIGN[name])
    assert workspace_environment(tmp_path, tmp_path).get(name) != FOREIGN[name]


@pytest.mark.parametrize("name", list(KEPT))
def test_what_names_the_machine_stays(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, KEPT[name])
    assert workspace_environment(tmp_path, tmp_path)[name] == KEPT[name]


def test_no_stage_compiles_again_what_another_has_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.delenv("PYTHONPYCACHEPREFIX", raising=False)
    (tmp_path / "module.py").write_text("")
    environment = workspace_environment(tmp_path, tmp_path)
    subprocess.run([sys.executable, "-c", "import module"], cwd=tmp_path, env=environment, check=True)
    assert list((tmp_path / ".cache").rglob("module.*.pyc"))
    assert not (tmp_path / "__pycache__").exists()


def test_commands_run_by_a_shell_that_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHELL", "/bin/false")
    assert workspace_environment(tmp_path, tmp_path)["SHELL"] == "/bin/sh"


def test_the_separator_of_paths_may_be_in_one(tmp_path: Path) -> None:
    folder = tmp_path / "a:b"
    (folder / "src").mkdir(parents=True)
    (folder / "src" / "only_there.py").write_text("print('found')")
    done = subprocess.run(
        [sys.executable, "-m", "only_there"],
        cwd=folder,
        env=workspace_environment(folder, folder),
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.stdout == "found\n", done.stderr


def test_a_user_without_a_name_gets_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import getpass
    import pwd

    def nobody(_: int) -> None:
        raise KeyError("uid not found")

    monkeypatch.setattr(pwd, "getpwuid", nobody)
    for name in ("LOGNAME", "USER", "LNAME", "USERNAME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    environment = workspace_environment(tmp_path, tmp_path)
    for name in ("LOGNAME", "HOME"):
        monkeypatch.setenv(name, environment[name])
    assert getpass.getuser()
    assert Path.home().is_dir()


def test_checkouts_keep_every_byte() -> None:
    assert "* -text" in (ROOT / ".gitattributes").read_text().splitlines()
