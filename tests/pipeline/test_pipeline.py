"""The pipeline as users run it: a tiny scene, real stages, a workspace of its own."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from sceneexpander.pipeline.selection import Selection
from sceneexpander.pipeline.workspace import make_workspace
from stages import layout
from tests.worlds.project import METHODS, SMOKE, Project

pytestmark = pytest.mark.pipeline

ADAPT = ["-m", "stages.adapt", "room", "1", "0"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Project]:
    """A project after its first run."""
    project = Project(tmp_path_factory.mktemp("pipeline") / "project")
    executed = project.repro()
    assert executed[0] == "code"
    assert len(executed) == 28, executed
    yield project
    shutil.rmtree(project.folder, ignore_errors=True)


def test_everything_that_was_promised_is_there(finished: Project) -> None:
    outputs = finished.folder / "outputs"
    page = (outputs / "report" / "index.html").read_text()
    assert "To the right is more of the wall." in page
    assert not re.findall(r"(?:src|href)=\"https?:", page), "the page must work offline"
    for place in re.findall(r'(?:src|poster)="([^"#]+)"', page):
        assert (outputs / "report" / place).is_file(), place
    assert "WorldMirror" not in page
    assert re.findall(r"looks/(inserted_\d+|depth_\d+)\.jpg", page) == [
        f"{kind}_{step:04d}" for step in (0, 4) for kind in ("inserted", "depth")
    ]
    assert "captured views see" in page or "fits badly" in page, "the verdict on the inserted view"
    assert re.findall(r"Gaussians of [^<]* (\d) steps", page) == ["3", "4", "4", "4"], "a visit for every view"
    for method in METHODS:
        renders = outputs / "room" / "round_1" / "renders" / method
        assert (renders / "rgb.mp4").stat().st_size > 1000
        metrics = json.loads((outputs / "room" / "round_1" / "metrics" / f"{method}.json").read_text())
        assert metrics["model"] == "mini"
        assert 5 < metrics["values"]["psnr_captured_db"] < 100
        assert metrics["fit"] in ("fitted", "as predicted")
    numbers = json.loads((finished.folder / "results" / "metrics.json").read_text())
    assert set(numbers["room"]["round_1"]) == set(METHODS)
    log = json.loads((outputs / "room" / "round_1" / "sceneexpander" / "log.json").read_text())
    assert [record["step"] for record in log] == [1, 2, 3, 4]


def test_stages_read_what_they_depend_on_and_nothing_else(finished: Project) -> None:
    lock = yaml.safe_load((finished.folder / "dvc.lock").read_text())["stages"]
    notes = {path.name: path.read_text().splitlines() for path in finished.opened.iterdir()}
    unasked = {name for name in lock if name.startswith(("rival@", "optimise@", "gaussian_splatting@"))}
    assert set(notes) == set(lock) - unasked, "of what was not asked for no process is started"
    # By the hashes of the code, which each stage depends on its own of.
    hashes = {"outputs/code.json", "outputs/environment.json", "requirements.lock", "requirements-nodeps.lock"}
    # By hashes in the gathered folder: the Gaussians are too large to lie there as well.
    gathered = set(json.loads((finished.folder / layout.PAGES / "room" / layout.PAGE_GAUSSIANS).read_text()))
    for stage, files in notes.items():
        entry = lock[stage]
        known = {item["path"] for item in entry["deps"] + entry["outs"]} | set(entry.get("params", ())) | hashes
        known |= gathered if stage == "track" else set()
        for file in files:
            path = Path(file)
            if not path.is_relative_to(finished.folder) or path.suffix in {".py", ".pyc"}:
                continue
            inside = path.relative_to(finished.folder)
            if inside.parts[0] in {"src", "stages", ".dvc"} or any(part.startswith(".") for part in inside.parts):
                continue  # code, and what is being written
            assert {inside.as_posix(), *(parent.as_posix() for parent in inside.parents)} & known, f"{stage}: {inside}"


def test_nothing_changed_runs_nothing(finished: Project) -> None:
    assert finished.repro() == []


def test_a_comment_reruns_no_work_and_code_reruns_what_uses_it(finished: Project) -> None:
    source = finished.folder / "src" / "sceneexpander" / "report" / "words.py"
    before = source.read_text()
    try:
        source.write_text(before + "\n# a comment\n")
        assert finished.repro() == ["code"]
        source.write_text(before + "\nUNUSED = 1\n")
        # What they make is the same, so nothing after them runs.
        assert finished.repro() == ["code", "collect@room", "report"]
    finally:
        source.write_text(before)
        finished.repro()


def test_tracking_is_complete_and_records_once(finished: Project) -> None:
    assert finished.runs() == len(METHODS)
    shutil.rmtree(finished.folder / "mlflow")
    assert finished.repro(plain=True) == ["track"], "everything else comes from the cache"
    assert finished.runs() == len(METHODS)
    finished.run("-m", "stages.track")
    assert finished.runs() == len(METHODS)


def test_a_setting_reruns_only_what_reads_it(finished: Project) -> None:
    params = finished.folder / "params.yaml"
    before = params.read_text()
    try:
        params.write_text(before.replace("- profile=smoke", "- profile=smoke\n- ablation=baseline"))
        executed = finished.repro()
    finally:
        params.write_text(before)
    remade = {
        f"{stage}@room-round0-{method}"
        for stage in ("render", "pack", "evaluate")
        for method in ("corrected", "sceneexpander")
    }
    assert set(executed) == remade | {
        "resolve@room",
        "correct@room-round0",
        "adapt@room-round0",
        "judge@room-round0",
        "propose@room-round0",
        "collect@room",
        "report",
        "track",
    }
    assert finished.runs() == 2 * len(METHODS)
    # Its links to the user's files are of this machine and never from the cache, so the first stage runs whenever its settings change.
    assert finished.repro() == ["resolve@room", "track"], "going back is restored"
    assert finished.runs() == 2 * len(METHODS)


def test_a_killed_adaptation_resumes_with_the_same_bits(finished: Project) -> None:
    state = finished.folder / "outputs" / "room" / "round_1" / "sceneexpander"
    whole = (state / "weights" / "tensors.safetensors").read_bytes()
    log = (state / "log.json").read_bytes()
    checkpoints = finished.folder / ".cache" / "ckpt"
    # Stopped by a breakpoint in the library's own checkpoint writer: no guessing of times.
    script = (
        "import os, signal, sys\n"
        "from sceneexpander.adaptation.checkpoint import Checkpoint\n"
        "write = Checkpoint.save\n"
        "def save(self, folder):\n"
        "    write(self, folder)\n"
        "    if self.step == 2: os.kill(os.getpid(), signal.SIGKILL)\n"
        "Checkpoint.save = save\n"
        "sys.argv = ['adapt', 'room', '1', '0']\n"
        "from stages.adapt import main\n"
        "main()\n"
    )
    killed = finished.run("-c", script, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert len(list(checkpoints.iterdir())) == 1, "the resume point survives"
    assert (state / "log.json").read_bytes() == log, "the earlier result is untouched"
    resumed = finished.run(*ADAPT)
    assert "resumed the adaptation after step 2" in resumed.stderr
    assert (state / "weights" / "tensors.safetensors").read_bytes() == whole
    assert (state / "log.json").read_bytes() == log
    assert not list(checkpoints.iterdir()), "finished work leaves no resume point"


def broken_photo(scene: Path) -> str:
    path = scene / "captured" / "photo_1.png"
    path.write_bytes(path.read_bytes()[:200])
    return "photo_1.png"


def one_photo(scene: Path) -> str:
    for index in (1, 2):
        (scene / "captured" / f"photo_{index}.png").unlink()
    return "captured"


def no_prompt(scene: Path) -> str:
    (scene / "scene.yaml").write_text("name: room\nrounds:\n  - inserted: inserted/round_1.png\n")
    return "prompt"


@pytest.mark.parametrize("damage", [broken_photo, one_photo, no_prompt])
def test_bad_input_is_one_line_and_leaves_results_alone(finished: Project, damage, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    scene = finished.folder / "scenes" / "room"
    backup = tmp_path / "backup"
    shutil.copytree(scene, backup)
    page = (finished.folder / "outputs" / "report" / "index.html").read_bytes()
    try:
        named = damage(scene)
        checked = finished.run("-m", "stages.check", check=False)
        staged = finished.run("-m", "stages.prepare", "room", check=False)
    finally:
        shutil.rmtree(scene)
        shutil.copytree(backup, scene)
    for done in (checked, staged):
        assert done.returncode == 2
        errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1, done.stderr
        assert named in errors[0]
        assert "Traceback" not in done.stderr
    assert (finished.folder / "outputs" / "report" / "index.html").read_bytes() == page


def test_two_workspaces_share_what_they_have_in_common(finished: Project, tmp_path: Path) -> None:
    """A sweep's jobs: what another run has made is restored, not made again."""
    from sceneexpander.pipeline.workspace import reproduce_shared

    selection = Selection(scenes=("room",), rounds=1, overrides=(*SMOKE, "ablation=restore_interval_1"))
    folder = make_workspace(tmp_path / "job", selection, project=finished.folder)
    before = os.environ.copy()
    os.environ.update(finished.environment)
    started = time.time()
    try:
        reproduce_shared(folder, project=finished.folder)
    finally:
        os.environ.clear()
        os.environ.update(before)
    fresh = set()
    for path in (folder / "outputs" / "room").rglob("stats/*.json"):
        if json.loads(path.read_text())["started"] >= started:
            fresh.add(path.stem)
    made_from_it = {
        "optimise-sceneexpander_optimised",
        "render-sceneexpander",
        "pack-sceneexpander",
        "evaluate-sceneexpander",
    }
    assert fresh == {"adapt", "correct-corrected", "judge", "propose"} | made_from_it


def test_rivals_are_rows_like_any_other_and_say_so_when_they_cannot_be(finished: Project, tmp_path: Path) -> None:
    """Three more methods: one with weights (of no use), one without, and an optimisation; ours are not made again."""
    import torch
    from safetensors.torch import save_file

    from sceneexpander.models.omnivggt import OmniVGGT, OmniVGGTConfig

    model = OmniVGGT.create(OmniVGGTConfig.tiny(), generator=torch.Generator().manual_seed(0))
    weights = tmp_path / "omnivggt.safetensors"
    save_file({name: value.clone() for name, value in model.state_dict().items()}, weights)
    settings = [
        "rivals.omnivggt.variant=tiny",
        f"rivals.omnivggt.weights={weights}",
        "rivals.omnivggt.long_side_px=126",
    ]
    rows = ["gaussian_splatting", "omnivggt", "omnivggt_optimised", "ttt3r"]
    params = finished.folder / "params.yaml"
    before = params.read_text()
    try:
        changed = yaml.safe_load(before)
        changed["methods"] += rows
        changed["overrides"] += settings
        params.write_text(yaml.safe_dump(changed))
        executed = finished.repro()
        again = finished.repro()
        rounds = tmp_path / "round_1"
        shutil.copytree(finished.folder / "outputs" / "room" / "round_1", rounds)
        page = (finished.folder / "outputs" / "report" / "index.html").read_text()
        table = (finished.folder / "outputs" / "report" / "comparison.md").read_text()
        numbers = json.loads((finished.folder / "results" / "metrics.json").read_text())["room"]["round_1"]
    finally:
        params.write_text(before)
        finished.repro()
    remade = {name.partition("@")[0] for name in executed if not any(row in name for row in rows)}
    assert remade == {"resolve", "judge", "collect", "report", "track"}, executed
    assert again == []
    assert numbers["ttt3r"] == {"unavailable": "needs the public checkpoint"}
    for row in rows[:3]:
        assert 3 < numbers[row]["psnr_captured_db"] < 100
        assert numbers[row]["psnr_inserted_db"] > 3
    fits = {
        row: json.loads((rounds / row / "refinement.json").read_text())["steps"] for row in ("backbone", "omnivggt")
    }
    assert fits["omnivggt"] == fits["backbone"] == 4, "the same fit as ours: a visit for every view"
    assert numbers["gaussian_splatting"]["gaussians"] <= 3000, "what it started from, thinned, and its growth"
    assert "OmniVGGT, pixel-aligned" in page
    assert "needs the public checkpoint" in page
    assert "Livioni/OmniVGGT" in page, "whose weights they are"
    assert len([line for line in table.splitlines() if line.startswith("| ")]) == 2 + 8
