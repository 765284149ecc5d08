"""What settings, weights and surroundings can do to a run ends as one line that says what to change."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from sceneexpander.errors import UserError
from sceneexpander.geometry.priors import Priors
from sceneexpander.inference.artefact import as_reconstruction
from sceneexpander.models.weights import load_weights
from sceneexpander.optimisation.config import RatesConfig
from sceneexpander.optimisation.splats import Splats
from sceneexpander.pipeline.preflight import check_scene
from sceneexpander.tracking.store import KEY_TAG, database_path, last_experiment
from tests.support.tiny_model import TinyReconstructor
from tests.worlds.artifacts import make_views
from tests.worlds.random_gaussians import random_gaussians

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(tmp_path: Path, value: float) -> None:
    model = nn.Linear(2, 2)
    weights = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    weights["bias"][1] = value
    save_file(weights, tmp_path / "w.safetensors")
    with pytest.raises(UserError, match=r"w\.safetensors: 1 tensors hold values that are not finite \(bias\)"):
        load_weights(model, tmp_path / "w.safetensors")


@pytest.mark.parametrize("broken", ["depth", "camera_vector", "normals", "means"])
def test_a_prediction_that_is_not_finite_names_the_photo(broken: str) -> None:
    views = make_views(3)
    with torch.no_grad():
        prediction = TinyReconstructor().predict(views.images)
    if broken == "means":
        assert prediction.gaussians is not None
        means = prediction.gaussians.means.clone()
        means[4, 1] = float("nan")
        prediction = replace(prediction, gaussians=replace(prediction.gaussians, means=means))
        expected = "Gaussians whose means are not finite"
    else:
        value = getattr(prediction, broken).clone()
        value[1, *(0,) * (value.ndim - 1)] = float("inf")
        prediction = replace(prediction, **{broken: value})
        expected = f"a {broken} that is not finite for {views.records[1].name}"
    with pytest.raises(UserError, match=expected):
        as_reconstruction(prediction, views, Priors(), method="backbone", model="tiny", weights_sha256="0")


def test_a_fit_that_leaves_the_numbers_says_which_rate() -> None:
    splats = Splats.of(random_gaussians(5), RatesConfig(), extent=1.0, sh_degree=0)
    for name in splats.optimisers:
        splats.params[name].grad = torch.zeros_like(splats.params[name])
    splats.step()
    with torch.no_grad():
        splats.params["scales"][2, 0] = 200.0  # e^200 is no float any more
    for name in splats.optimisers:
        splats.params[name].grad = torch.zeros_like(splats.params[name])
    with pytest.raises(UserError, match="fit: scales of the Gaussians are no longer finite; lower its learning rates"):
        splats.step()


def test_pictures_too_small_to_compare_are_refused_before_anything_runs() -> None:
    overrides = ["scene.long_side_px=8", "scene.multiple=1"]
    with pytest.raises(UserError, match=r"scene\.long_side_px: makes pictures of 8 x 6 pixels, fewer than 11 x 11"):
        check_scene("courtyard", ROOT / "scenes" / "courtyard", conf=ROOT / "conf", overrides=overrides)


@pytest.mark.parametrize(("tagged", "expected"), [(("2",), "2"), ((), "3"), (("2", "4"), "4")])
def test_the_interface_opens_the_pipelines_own_experiment(
    tmp_path: Path, tagged: tuple[str, ...], expected: str
) -> None:
    """A training recorded in the same store, first or last, is not what one wants to see."""
    path = database_path(tmp_path)
    path.parent.mkdir()
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE experiments (experiment_id INTEGER, name TEXT)")
        database.execute(
            "CREATE TABLE runs (run_uuid TEXT, experiment_id INTEGER, lifecycle_stage TEXT, start_time INTEGER)"
        )
        database.execute("CREATE TABLE tags (run_uuid TEXT, key TEXT, value TEXT)")
        names = {"1": "mini-training", "2": "mine", "3": "sceneexpander", "4": "other"}
        database.executemany("INSERT INTO experiments VALUES (?, ?)", names.items())
        runs = [("a", 2, 10), ("b", 4, 20), ("c", 1, 30)]
        database.executemany("INSERT INTO runs VALUES (?, ?, 'active', ?)", runs)
        tags = [(run, KEY_TAG, "x") for run, experiment, _ in runs if str(experiment) in tagged]
        database.executemany("INSERT INTO tags VALUES (?, ?, ?)", tags)
        database.commit()
    assert last_experiment(tmp_path) == expected


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
@pytest.mark.parametrize("python", ["/bin/false", "/nowhere/python3"])
def test_make_says_which_python_it_needs(tmp_path: Path, python: str) -> None:
    kernel = [f"src/sceneexpander/splatting/kernel/{name}" for name in ("rasteriser.cpp", "recipe.py")]
    for name in ("Makefile", "requirements.lock", "requirements-nodeps.lock", "pyproject.toml", "setup.py", *kernel):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    done = subprocess.run(
        ["make", "setup", f"PYTHON={python}"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    first = done.stderr.splitlines()[0]
    assert first == f'error: PYTHON: "{python}" is not Python 3.11 or newer; make PYTHON=/path/to/python3.11'
    assert done.returncode == 2
    assert not (tmp_path / ".venv").exists()
