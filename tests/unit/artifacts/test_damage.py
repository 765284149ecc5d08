"""Whatever stands in an artefact, reading it gives a valid value or one line that names it."""

from __future__ import annotations

import copy
import dataclasses
import json
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from sceneexpander.adaptation.checkpoint import Checkpoint as AdaptationCheckpoint
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.cameras import CameraReport, ViewCamera
from sceneexpander.artifacts.held_out_seen import HeldOutSeen
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.metrics import MetricsRow, UnavailableRow, ViewMetrics, load_row
from sceneexpander.artifacts.page import (
    BaseModel,
    Judgement,
    LookPage,
    LooksPage,
    MethodPage,
    MissingMethod,
    Photo,
    Refinement,
    RoundPage,
    ScenePage,
    ShownView,
    StageRun,
    Steps,
    Still,
)
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.renders import Renders
from sceneexpander.artifacts.scene import KnownCameras, RoundSpec, Scene
from sceneexpander.artifacts.state import WeightsChange, load_priors, save_priors
from sceneexpander.artifacts.store import FACTS_NAME, TENSORS_NAME, ArtifactError, read_json
from sceneexpander.artifacts.truth import SceneTruth, ViewTruth
from sceneexpander.artifacts.unavailable import Unavailable
from sceneexpander.artifacts.views import LensFacts, ViewSet
from sceneexpander.geometry.priors import Priors
from sceneexpander.optimisation.checkpoint import OptimisationCheckpoint
from sceneexpander.viewer.packed import PackedSplats, pack_splats
from tests.worlds.artifacts import make_reconstruction, make_views
from tests.worlds.wall import made_reconstruction


def lens_views() -> ViewSet:
    views = make_views(2)
    lens = LensFacts(camera="Maker", focal_mm=4.2, exif_size=(120, 160))
    return dataclasses.replace(views, records=(dataclasses.replace(views.records[0], lens=lens), views.records[1]))


def inserted() -> InsertedView:
    made = Provenance(backend="file", prompt="p", source="x.png", sha256="0", parameters={"a": "b"}, refusal="r")
    return InsertedView(round=1, view=make_views(1, generated=True), chosen=0, provenance=(made,))


def anchors() -> Anchors:
    scene = make_reconstruction()
    names = ("camera_vector", "depth", "depth_conf", "normals", "normals_conf")
    return Anchors(weights_sha256="ab", view_ids=scene.view_ids, **{name: getattr(scene, name) for name in names})


def save_renders(folder: Path) -> None:
    for name in ("rgb.mp4", "still.png", "v.png", "gaussians.ply"):
        (folder / name).write_bytes(b"x")
    Renders(
        method="backbone", frames=2, fps=24, height=4, width=6, videos={"rgb": "rgb.mp4"}, stills=((0, {"rgb": "still.png"}),),
        views=(("v", "v.png"),), inserted_frame=1, inserted_camera="own", gaussians=3, scene="gaussians.ply",
        world_from_cam=torch.eye(4).repeat(2, 1, 1), intrinsics_px=torch.eye(3).repeat(2, 1, 1),
    ).save(folder)  # fmt: skip


def camera_report() -> CameraReport:
    view = ViewCamera(
        view_id="v", name="a.jpg", generated=False, posed=True, rough=False, reason="", warnings=("cropped",), focal_ratio=0.8,
        focal_source="exif", distortion=(0.1, 0.0), inliers=20, error_px=None,
    )  # fmt: skip
    return CameraReport(views=(view,), notes=("one",))


def scene() -> Scene:
    known = KnownCameras(world_from_cam=torch.eye(4).repeat(2, 1, 1), intrinsics_px=None, metric=True)
    return Scene(
        name="room", views=make_views(2), rounds=(RoundSpec(prompt="a bench", inserted="i/a.png"),), known=known
    )


def truth() -> SceneTruth:
    camera = {"world_from_cam": torch.eye(4), "intrinsics_px": torch.eye(3)}
    return SceneTruth(views={"1" * 64: ViewTruth(**camera, depth=torch.ones(2, 3)), "2" * 64: ViewTruth(**camera)})


def metrics() -> MetricsRow:
    view = ViewMetrics(view_id="v", generated=False, posed=True, values={"psnr_captured_db": 20.0})
    return MetricsRow(
        scene="room", round=1, method="backbone", model="mini", weights_sha256="a", seed=0,
        values={"psnr_captured_db": 20.0, "camera_ate": 0.1}, spread={"psnr_captured_db": 0.1}, views=(view,), versions={"torch": "2"},
    )  # fmt: skip


def save_page(folder: Path) -> None:
    method = MethodPage(
        name="backbone", model="mini", weights_sha256="a", licence=None, refinement=Refinement(steps=3, before=0.2, after=0.1),
        views=(ShownView(view_id="v", generated=False, posed=True),), videos={"rgb": "rgb.mp4"},
        stills=(Still(frame=0, pictures={"rgb": "s.png"}),), view_pictures={"v": "v.png"}, frames=2, fps=24, inserted_frame=1,
        inserted_camera="own", width=6, height=4, gaussians=3, metrics="m.json", map="<svg/>", held_out_pictures={"h": "h.png"},
    )  # fmt: skip
    look = LookPage(step=0, values={"captured_psnr": 20.0}, drift={"a": 0.1}, pictures={"depth": "d.jpg"})
    one = RoundPage(
        number=1, prompt="a bench", motion="", new_object="", full_prompt="a bench", backend="replay", origin="a.png",
        source_type=None, ranking=(), parameters={"warning": "w"}, candidates=1, inserted="i.jpg", inserted_id="v2",
        viewer="viewer.html", sheet=None, methods=(method,),
        unavailable=(MissingMethod(name="ttt3r", model="ttt3r", reason="r", metrics="n.json"),),
        steps=Steps(inserted=(True, False), values={"loss": (1.0, 2.0)}),
        looks=LooksPage(identity="abc", looks=(look,), warnings=()), cameras=camera_report(), problems="cameras.txt",
        proposals=None,
        judgement=Judgement(overlap=0.5, depth_conflict=None, colour_conflict=0.1, cameras_moved_deg=0.0, reasons=()),
        statistics={"adapt": StageRun(started=1.0, wall_s=2.0, peak_rss_mb=3.0)}, warnings=("w",),
    )  # fmt: skip
    ScenePage(
        scene="room", settings={"seed": "0"}, overrides=("seed=0",),
        model=BaseModel(model="mini", weights_sha256="a", licence="free"),
        captured=(Photo(view_id="v", name="a.jpg", picture="a.jpg", original=(6, 4), sha256="a"),), cameras=None,
        statistics={}, rounds=(one,), held_out=(Photo(view_id="h", name="h.jpg", picture="h.jpg", original=(6, 4), sha256="b"),),
    ).save(folder)  # fmt: skip
    # The tests below change the file of this name.
    (folder / "page.json").rename(folder / FACTS_NAME)
    (folder / "page.json").symlink_to(FACTS_NAME)


def save_seen(folder: Path) -> None:
    (folder / "h.png").write_bytes(b"png")
    HeldOutSeen(pictures={"h": "h.png"}).save(folder)


def save_row(row: MetricsRow | UnavailableRow) -> Callable[[Path], None]:
    return lambda folder: row.save(folder / FACTS_NAME)


def read_row(folder: Path) -> object:
    return load_row(folder / FACTS_NAME)


UNAVAILABLE = UnavailableRow(scene="room", round=1, method="ttt3r", model="ttt3r", seed=0, reason="needs views")
ASKED = RoundSpec(prompt="a bench", inserted="i/a.png", inserted_sha256="1" * 64)
PRIORS = Priors(depth=torch.ones(2, 4, 4), posed=torch.tensor([True, False]))
KINDS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "scene": (lambda folder: scene().save(folder), Scene.load),
    "asked": (lambda folder: ASKED.save(folder), RoundSpec.load),
    "truth": (lambda folder: truth().save(folder), SceneTruth.load),
    "views": (lambda folder: lens_views().save(folder), ViewSet.load),
    "inserted": (lambda folder: inserted().save(folder), InsertedView.load),
    "anchors": (lambda folder: anchors().save(folder), Anchors.load),
    "priors": (lambda folder: save_priors(folder, PRIORS), load_priors),
    "weights": (
        lambda folder: WeightsChange(base_sha256="a", change={"w": torch.ones(2)}).save(folder),
        WeightsChange.load,
    ),
    "renders": (save_renders, Renders.load),
    "held out, seen": (save_seen, HeldOutSeen.load),
    "packed": (lambda folder: pack_splats(made_reconstruction()).save(folder), PackedSplats.load),
    "unavailable": (lambda folder: Unavailable(method="m", model="m", reason="r").save(folder), Unavailable.load),
    "reconstruction": (lambda folder: make_reconstruction().save(folder), Reconstruction.load),
    "cameras": (lambda folder: camera_report().save(folder), CameraReport.load),
    "metrics": (save_row(metrics()), read_row),
    "no metrics": (save_row(UNAVAILABLE), read_row),
    "page": (save_page, ScenePage.load),
}
WITH_TENSORS = ["scene", "anchors", "priors", "renders", "packed", "reconstruction"]
ODD = [
    None,
    True,
    0,
    -1,
    3,
    1.5,
    1e308,
    10**400,
    "",
    "x",
    "../x",
    "a\0b",
    "\ud800",
    [],
    [[]],
    [1, 2],
    {},
    {"a": 1},
    "y" * 300,
]


@cache
def saved(kind: str, root: Path) -> Path:
    folder = root / kind
    folder.mkdir()
    KINDS[kind][0](folder)
    KINDS[kind][1](folder)
    return folder


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("artefacts")


def read(kind: str, folder: Path, text: str | bytes) -> str | None:
    """The line that reading ends in with other facts, None if they are valid; the facts are put back."""
    path = folder / FACTS_NAME
    before = path.read_bytes()
    refused = None
    try:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        KINDS[kind][1](folder)
    except ArtifactError as error:
        refused = error
    finally:
        path.write_bytes(before)
    if refused is None:
        return None
    assert str(folder) in str(refused.where)
    assert len(refused.line()) < 600 + len(str(refused.where))
    return refused.line()


def places(value: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [way] if way else []
    if isinstance(value, dict):
        for key in value:
            found += places(value[key], (*way, key))
    if isinstance(value, list):
        for index, item in enumerate(value):
            found += places(item, (*way, index))
    return found


@pytest.mark.parametrize("kind", sorted(KINDS))
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(data=st.data())
def test_changed_facts_are_valid_or_refused(kind: str, root: Path, data: st.DataObject) -> None:
    folder = saved(kind, root)
    facts = json.loads((folder / FACTS_NAME).read_text())
    for _ in range(data.draw(st.integers(1, 2))):
        *way, last = data.draw(st.sampled_from(places(facts)))
        holder = facts
        for step in way:
            holder = holder[step]
        change = data.draw(st.sampled_from(["drop", "rename", "retype", "retype"]))
        if change == "retype" or not isinstance(holder, dict):
            holder[last] = copy.deepcopy(data.draw(st.sampled_from(ODD)))
        elif change == "drop":
            del holder[last]
        else:
            holder[f"{last}_"] = holder.pop(last)
        if not facts or not places(facts):
            break
    read(kind, folder, json.dumps(facts))


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_fact_that_is_missing_renamed_or_of_another_type_is_named(kind: str, root: Path) -> None:
    folder = saved(kind, root)
    facts = json.loads((folder / FACTS_NAME).read_text())
    for key in facts.keys() - {"schema"}:
        renamed = {(f"{name}_" if name == key else name): value for name, value in facts.items()}
        line = read(kind, folder, json.dumps(renamed))
        assert line is not None
        assert key in line
        other = 5 if isinstance(facts[key], (str, list, dict)) else "five"
        line = read(kind, folder, json.dumps({**facts, key: other}))
        assert line is not None
        assert key in line


@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize(
    "text",
    ["", "[]", "3", "null", '"x"', "{", "[" * 100_000, '{"a":' * 50_000, '{"schema": NaN}', '{"schema": ' + "9" * 5000 + "}",
     '{"schema": {}}', b"\xff\xfe{\x00}\x00", b"\x00"],
    ids=lambda text: repr(text[:12]),
)  # fmt: skip
def test_text_that_is_no_artefact_is_one_line(kind: str, root: Path, text: str | bytes) -> None:
    assert read(kind, saved(kind, root), text) is not None


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_something_else_in_place_of_the_facts_is_one_line(kind: str, tmp_path: Path) -> None:
    for make in (Path.mkdir, os.mkfifo, lambda path: path.symlink_to(path), lambda path: None):
        folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        make(folder / FACTS_NAME)
        with pytest.raises(ArtifactError):
            KINDS[kind][1](folder)
    with pytest.raises(ArtifactError):
        KINDS[kind][1](tmp_path / ("x" * 300))
    (tmp_path / "file").write_text("x")
    with pytest.raises(ArtifactError):
        KINDS[kind][1](tmp_path / "file")


@pytest.mark.parametrize("kind", WITH_TENSORS)
def test_every_tensor_that_is_missing_or_of_another_kind_is_refused(kind: str, root: Path) -> None:
    folder = saved(kind, root)
    path = folder / TENSORS_NAME
    before = path.read_bytes()
    try:
        tensors = load_file(str(path))
        for name, value in tensors.items():
            turned = value.double().to(torch.complex64) if value.dtype.is_floating_point else value.float()
            for other in (value[None].contiguous(), torch.zeros(()), turned):
                save_file({**tensors, name: other}, str(path))
                with pytest.raises(ArtifactError, match=name):
                    KINDS[kind][1](folder)
            if kind not in ("priors", "scene"):  # theirs may be absent
                save_file({key: item for key, item in tensors.items() if key != name}, str(path))
                with pytest.raises(ArtifactError, match=name):
                    KINDS[kind][1](folder)
    finally:
        path.write_bytes(before)


@pytest.mark.parametrize("name", ["../../outside.png", "/etc/passwd", "", "a/../../b", "x" * 2000])
def test_no_artefact_leads_to_files_outside_of_it(root: Path, name: str) -> None:
    for kind, key in (("renders", "scene"), ("views", "records"), ("page", "rounds")):
        folder = saved(kind, root)
        facts = json.loads((folder / FACTS_NAME).read_text())
        if kind == "views":
            facts["records"][0]["view_id"] = name
        elif kind == "page":
            facts["rounds"][0]["methods"][0]["metrics"] = name
        else:
            facts[key] = name
        assert read(kind, folder, json.dumps(facts)) is not None


def test_a_path_that_is_no_path_is_one_line() -> None:
    for path in (Path("a\0b"), Path("x" * 5000), Path("/dev/null/x"), Path("/dev/zero")):
        with pytest.raises(ArtifactError):
            read_json(path)


RESUME: dict[str, Any] = {
    "adaptation": AdaptationCheckpoint(
        run_key="k", step=3, buckets=[(("w",), {"theta": torch.ones(2)})], records=[{"loss": 1.0}], looks=[]
    ),
    "optimisation": OptimisationCheckpoint(
        run_key="k", step=3, losses=[1.0], splats={"means": torch.ones(2)}, density={}, cameras={}
    ),
}


@pytest.mark.parametrize("kind", sorted(RESUME))
def test_a_damaged_resume_point_is_reported_and_ignored(
    kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    checkpoint, folder = RESUME[kind], tmp_path / "resume"
    load = type(checkpoint).load
    checkpoint.save(folder)
    assert load(folder, "k").step == 3
    assert load(folder, "another") is None
    path = folder / FACTS_NAME
    facts = json.loads(path.read_text())
    for key in facts.keys() - {"schema", "run_key"}:
        for changed in ({k: v for k, v in facts.items() if k != key}, {**facts, key: "x"}, {**facts, key: [[3]]}):
            caplog.clear()
            path.write_text(json.dumps(changed))
            assert load(folder, "k") is None
            assert "ignoring a damaged checkpoint" in caplog.text
    path.write_text(json.dumps(facts))
    save_file({"9/theta": torch.ones(2), "x": torch.ones(1)}, str(folder / TENSORS_NAME))
    assert load(folder, "k") is None
