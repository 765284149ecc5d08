"""A method that nobody asked for costs no process, and leaves what its own stage would leave."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from sceneexpander.artifacts.page import StageRun
from sceneexpander.artifacts.store import read_json, read_typed
from sceneexpander.config.files import write_settings
from sceneexpander.pipeline.declared import read_pipeline
from sceneexpander.pipeline.unasked import METHODS_FILE, answer_unasked

ROOT = Path(__file__).parents[3]
UNASKED = [stage for stage in read_pipeline(ROOT) if any(Path(file).name == METHODS_FILE for file in stage.parameters)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("dvc.yaml", "params.yaml", "requirements.lock", "requirements-nodeps.lock"):
        shutil.copyfile(ROOT / name, tmp_path / name)
    for stage in UNASKED:
        for file, keys in stage.parameters.items():
            if Path(file).name == METHODS_FILE:
                asked = {key: False for other in UNASKED for key in other.parameters[file]}
                write_settings(tmp_path / file, asked | dict.fromkeys(keys, False))
    return tmp_path


@pytest.mark.parametrize("stage", UNASKED, ids=lambda stage: stage.address)
def test_what_it_leaves_is_what_the_stage_would(stage, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    parameters = {Path(file): keys for file, keys in stage.parameters.items()}
    outputs = [Path(output.path) for output in stage.outputs]
    assert answer_unasked(parameters, outputs)
    made = {path: path.read_bytes() for path in outputs[0].rglob("*") if path.is_file()}
    statistics = read_typed(StageRun, read_json(outputs[1]), outputs[1], extra=True)
    assert statistics.wall_s == 0
    shutil.rmtree(outputs[0])
    _, _, module, *arguments = stage.command.replace("'", "").split()
    monkeypatch.setattr(sys, "argv", [module, *arguments])
    import_module(module).main()
    assert made == {path: path.read_bytes() for path in outputs[0].rglob("*") if path.is_file()}
    assert made


_SAY_SO = """
import importlib, sys
for command in sys.argv[1:]:
    module, *sys.argv[1:] = command.split()
    importlib.import_module(module).main()
print(sorted({"torch", "numpy", "cv2", "mlflow", "hydra", "rich"} & set(sys.modules)))
"""


def test_a_stage_that_only_says_so_starts_in_no_time(folder: Path) -> None:
    """With plain ``dvc repro`` each is a process: what takes seconds there is the import of torch."""
    (judge,) = [stage for stage in read_pipeline(ROOT) if stage.name == "judge"]
    (settings,) = [file for file in judge.parameters if file.endswith("config.json")]
    write_settings(folder / settings, {"judge": {"backend": "none"}})
    commands = [stage.command.replace("'", "").removeprefix("python -m ") for stage in (*UNASKED, judge)]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'src'}"}
    script = [sys.executable, "-c", _SAY_SO, *commands]
    done = subprocess.run(script, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert all(Path(output.path).exists() for stage in (*UNASKED, judge) for output in stage.outputs)


def test_the_stages_are_those_of_methods_that_can_be_left_out() -> None:
    assert {stage.name for stage in UNASKED} == {"correct", "rival", "gaussian_splatting", "optimise"}


@pytest.mark.parametrize("asked", ['{"m": true}', '{"other": false}', '["m"]', '{"m": 0}', "{"])
def test_everything_else_is_the_stages_own(asked: str, tmp_path: Path) -> None:
    (tmp_path / METHODS_FILE).write_text(asked)
    outputs = [tmp_path / "m", tmp_path / "m.json"]
    assert not answer_unasked({tmp_path / METHODS_FILE: ["m"]}, outputs)
    assert not answer_unasked({tmp_path / "config.json": ["m"]}, outputs)
    (tmp_path / METHODS_FILE).write_text('{"m": false}')
    assert not answer_unasked({tmp_path / METHODS_FILE: ["m"]}, [tmp_path / "other"])
    assert not (tmp_path / "m").exists()
