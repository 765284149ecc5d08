"""Results belong to code, data and environment: change one of them, and the pipeline names exactly the stages that read it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sceneexpander.catalogue import METHODS, Kind
from sceneexpander.catalogue.methods import methods_of
from sceneexpander.errors import UserError
from sceneexpander.pipeline import packages
from sceneexpander.pipeline.environment import Environment
from sceneexpander.pipeline.fingerprint import SourceTree
from sceneexpander.pipeline.packages import LOCKS, installed_packages
from sceneexpander.pipeline.selection import ROUND_SECTIONS, Selection
from stages import layout, runner
from stages.fingerprint import stage_names
from stages.resolve import link_files, named_files

ROOT = Path(__file__).parents[3]
SCENE = "room"
SECTIONS = (
    "seed",
    "device",
    "threads",
    "scene",
    "model",
    "frontend",
    "warmup",
    "adapt",
    "corrections",
    "refine",
    "optimise",
    "render",
)


def hashes(tree: SourceTree, environment: Environment) -> dict[str, str]:
    return {name: environment.identify(tree, f"stages.{name}") for name in stage_names(ROOT / "stages")}


HERE = Environment(packages="p", kernel="v3")
TREE = SourceTree(packages={"sceneexpander": ROOT / "src" / "sceneexpander", "stages": ROOT / "stages"})


class Tiny:
    """The project's own dvc.yaml after a run, with a word in every output that takes the real stages minutes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        selection = Selection(scenes=(SCENE,), rounds=1)
        scene = folder / "scenes" / SCENE
        scene.mkdir(parents=True)
        for path, text in (
            ("dvc.yaml", (ROOT / "dvc.yaml").read_text()),
            ("params.yaml", selection.to_yaml()),
            (".dvc/config", "[core]\n    no_scm = true\n    analytics = false\n"),
            ("src/a.py", ""),
            ("stages/a.py", ""),
            ("conf/config.yaml", ""),
            *((lock, "") for lock in LOCKS),
            (f"scenes/{SCENE}/photo.png", "photo"),
            ("away/picture.png", "picture"),
            ("away/chosen.png", "chosen"),
            ("away/weights.safetensors", "weights"),
        ):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text)
        self.write(
            layout.config(SCENE),
            dict.fromkeys(SECTIONS, 1)
            | {"evaluate": {"hold_out": 1}, "judge": 1, "rivals": dict.fromkeys(methods_of(Kind.RIVAL), 1)},
        )
        self.write(layout.round_settings(SCENE), {layout.round_key(1): dict.fromkeys(ROUND_SECTIONS, 1)})
        self.write(layout.asked(SCENE, 1) / "facts.json", {})
        self.write(layout.selection(SCENE), {method.name: True for method in METHODS if not method.always_made})
        self.write(layout.CODE, hashes(TREE, HERE))
        for kind in ("judge", "lpips", "model", *methods_of(Kind.RIVAL)):
            link_files({}, folder / layout.given(SCENE, kind))
        link_files({"file": folder / "away/picture.png"}, folder / layout.given(SCENE, "generator") / "round_1")
        link_files({"file": folder / "away/chosen.png"}, folder / layout.given(SCENE, "choice") / "round_1")
        link_files({"weights": folder / "away/weights.safetensors"}, folder / layout.given(SCENE, "model"))

    def write(self, path: Path, content: dict[str, Any]) -> None:
        """An output whose content matters."""
        target = self.folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(json.dumps(content))  # JSON is YAML, too

    def finish(self) -> None:
        """Make what is missing of all outputs, and have DVC take it for the result of a run."""
        from dvc.repo import Repo

        with Repo(str(self.folder)) as repo:
            for path in (Path(out.fs_path) for stage in repo.index.stages for out in stage.outs):
                if not path.exists():
                    target = path if path.suffix else path / "views" / "made"
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_text("made")
            repo.commit(force=True)

    def changed(self) -> set[str]:
        """Stages that would run next, without those after them."""
        from dvc.repo import Repo

        with Repo(str(self.folder)) as repo:
            return {name.partition("@")[0] for name in repo.status()}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tiny]:
    project = Tiny(tmp_path_factory.mktemp("belonging"))
    before = Path.cwd()
    os.chdir(project.folder)
    try:
        project.finish()
        assert project.changed() == set()
        yield project
    finally:
        os.chdir(before)


FIRST_HAND_MODEL = {"resolve", "reconstruct", "precompute_anchors", "reconstruct_inserted", "adapt"}


@pytest.mark.parametrize(
    ("file", "stages"),
    [
        ("away/picture.png", {"resolve", "generate_view"}),
        ("away/chosen.png", {"resolve", "choose_view"}),
        ("away/weights.safetensors", FIRST_HAND_MODEL),
        ("requirements.lock", {"code"}),
        ("requirements-nodeps.lock", {"code"}),
        (f"scenes/{SCENE}/photo.png", {"prepare"}),
    ],
)
def test_other_bytes_of_the_same_name_and_size_rerun_what_reads_them(tiny: Tiny, file: str, stages: set[str]) -> None:
    path = tiny.folder / file
    kept = path.read_text()
    try:
        path.write_text(kept[:-1] + "!" if kept else "torch==0\n")
        assert tiny.changed() == stages
    finally:
        path.write_text(kept)


def rerun_by(tiny: Tiny, code: dict[str, str]) -> set[str]:
    path = tiny.folder / layout.CODE
    kept = path.read_text()
    try:
        path.write_text(json.dumps(code))
        return tiny.changed() - {"code"}
    finally:
        path.write_text(kept)


FITTING = {"precompute_anchors", "reconstruct_inserted", "correct", "adapt", "rival"}
DRAWING = {
    "reconstruct",
    "generate_view",
    "choose_view",
    "gaussian_splatting",
    "optimise",
    "render",
    "pack",
    "evaluate",
} | FITTING


def test_another_build_of_the_rasteriser_reruns_what_draws(tiny: Tiny) -> None:
    changed = rerun_by(tiny, hashes(TREE, Environment(packages="p", kernel="v4")))
    assert changed >= DRAWING
    assert not changed & {"prepare", "track"}


def test_other_packages_rerun_everything(tiny: Tiny) -> None:
    assert rerun_by(tiny, hashes(TREE, Environment(packages="q", kernel="v3"))) == set(stage_names(ROOT / "stages"))


@pytest.mark.parametrize(
    ("edited", "rerun", "kept"),
    [
        ("splatting/kernel/rasteriser.cpp", DRAWING, {"prepare"}),
        (
            "adaptation/loop.py",
            {"adapt", "correct"},
            {"prepare", "reconstruct", "precompute_anchors", "reconstruct_inserted", "rival", "render"},
        ),
        (
            "frontend/sfm.py",
            {"reconstruct", "reconstruct_inserted", "evaluate"},
            {"prepare", "gaussian_splatting", "render"},
        ),
        (
            "models/mini/weights/mini.safetensors",
            {"reconstruct", "adapt", "rival"},
            {"prepare", "gaussian_splatting", "evaluate"},
        ),
    ],
)
def test_an_edit_of_code_reruns_what_runs_it(
    tiny: Tiny, tmp_path: Path, edited: str, rerun: set[str], kept: set[str]
) -> None:
    shutil.copytree(ROOT / "src" / "sceneexpander", tmp_path / "sceneexpander", ignore=shutil.ignore_patterns("*.so"))
    file = tmp_path / "sceneexpander" / edited
    file.write_bytes(file.read_bytes() + (b"\nEDITED = 1\n" if file.suffix == ".py" else b"\n"))
    tree = SourceTree(packages={"sceneexpander": tmp_path / "sceneexpander", "stages": ROOT / "stages"})
    changed = rerun_by(tiny, hashes(tree, HERE))
    assert rerun <= changed
    assert not changed & kept


def test_a_configuration_names_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("p_1.png", "p_2.png", "w.safetensors"):
        Path(name).touch()
    values = {
        "model": {"weights": "w.safetensors"},
        "evaluate": {"lpips_weights": None},
        "judge": {"backend": "none"},
        "rivals": {"omnivggt": {"weights": None}, "ttt3r": {"weights": "org/name@main"}},
    }
    auto = {"candidate": "auto", "fit": "crop"}
    stored = {"generator": {"backend": "file", "file": "p_{round}.png"}, "choose": auto}
    own = {"generator": {"backend": "replay"}, "choose": {"candidate": "p_{round}.png", "fit": "crop"}}
    found = named_files(values, [stored, own, stored])
    assert found["generator/round_1"] == {"file": tmp_path / "p_1.png"}
    assert found["choice/round_2"] == {"file": tmp_path / "p_2.png"}
    assert found["generator/round_2"] == found["generator/round_3"] == found["choice/round_1"] == {}
    assert found["model"] == {"weights": tmp_path / "w.safetensors"}
    assert found["omnivggt"] == found["ttt3r"] == {}
    link_files(found["generator/round_1"], Path("given"))
    link_files(found["model"], Path("given"))
    assert [path.name for path in Path("given").iterdir()] == ["weights"]


def test_a_lock_that_is_not_installed_is_one_line(tmp_path: Path) -> None:
    (tmp_path / LOCKS[0]).write_text("# a comment\nnumpy==0.0.1  # old\nno-such-thing==2\n")
    with pytest.raises(
        UserError, match=r"numpy is \d.*locked is 0.0.1; no-such-thing is missing.*make setup"
    ) as refused:
        installed_packages(tmp_path)
    assert "\n" not in refused.value.line()


def test_the_build_of_a_locked_version_is_the_machines_choice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / LOCKS[0]).write_text("torch==2.0\n")
    found = []
    for build in ("2.0+cpu", "2.0+cu128"):
        monkeypatch.setattr(packages, "_installed", lambda _, build=build: build)
        found.append(installed_packages(tmp_path))
    assert found == [["torch==2.0+cpu"], ["torch==2.0+cu128"]], "but results belong to it"


def test_a_resume_point_of_other_code_is_said_and_not_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SCENEEXPANDER_ROOT", str(tmp_path))
    layout.CODE.parent.mkdir()
    layout.CODE.write_text(json.dumps({"adapt": "a" * 64}))
    Path("input").mkdir()
    run = runner.run_identity("adapt", {"steps": 3}, [Path("input")])
    folder = runner.checkpoint_folder(run)
    folder.mkdir(parents=True)
    assert runner.checkpoint_folder(run) == folder
    assert folder.is_dir()
    assert not caplog.records
    layout.CODE.write_text(json.dumps({"adapt": "b" * 64}))
    other = runner.run_identity("adapt", {"steps": 3}, [Path("input")])
    assert runner.live_folder(other) != runner.live_folder(run)
    assert runner.checkpoint_folder(other) != folder
    assert not folder.exists()
    (line,) = [record.getMessage() for record in caplog.records]
    assert "starts again" in line


def test_logs_of_earlier_runs_are_pruned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENEEXPANDER_ROOT", str(tmp_path))
    kept = runner.RunIdentity(work="w", code="c")
    for number in range(runner.LIVE_KEPT + 5):
        folder = runner.live_folder(kept).parent / f"{number:02d}"
        folder.mkdir(parents=True)
        os.utime(folder, (number, number))
    runner.live_folder(kept).mkdir()
    runner.live_folder(kept)
    names = sorted(path.name for path in runner.live_folder(kept).parent.iterdir())
    assert len(names) == runner.LIVE_KEPT
    assert names[0] == "06"
