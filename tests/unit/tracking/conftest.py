"""An MLflow store for every test."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sceneexpander.tracking import TrackingConfig, record_runs
from tests.worlds.runs import record


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty store: making one takes seconds, copying it none."""
    root = tmp_path_factory.mktemp("store")
    record_runs([record(root, "made with the template")], TrackingConfig(experiment="template"), root)
    return root


@pytest.fixture
def root(template: Path, tmp_path: Path) -> Path:
    shutil.copytree(template, tmp_path / "project")
    return tmp_path / "project"
