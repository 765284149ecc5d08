"""Scores of results whose errors are known, what may be handed in, and tables that compare equal cases only."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from sceneexpander.cli import benchmark
from sceneexpander.errors import UserError
from sceneexpander.expandbench import leaderboard
from sceneexpander.expandbench.dataset import CAPTURED_VIEWS, INTENDED, Seen, TrueScene, generate, load_truth
from sceneexpander.expandbench.entries import Entry, read_entry
from sceneexpander.expandbench.leaderboard import Board, CaseScore, document, measure_methods, table
from sceneexpander.expandbench.scenes import VIEWS
from sceneexpander.expandbench.score import GEOMETRY, METRICS, chamfer, score
from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.splatting.ply import write_ply

NAME, GRADE, SHRINK = "courtyard_1", "clean", 4
CASE = ("--scenes", NAME, "--grades", GRADE)
# Another frame and scale than the truth's.
ELSEWHERE = Similarity(
    scale=0.37,
    rotation=torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], dtype=torch.float64),
    translation=torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64),
)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    generate(folder, [NAME], shrink=SHRINK, grades=[GRADE])
    return folder


@pytest.fixture(scope="module")
def truth(bench: Path) -> TrueScene:
    return load_truth(bench, NAME)


def perfect(truth: TrueScene) -> Entry:
    return Entry(
        captured=truth.captured_poses,
        posed=torch.ones(len(CAPTURED_VIEWS), dtype=torch.bool),
        inserted=truth.views[INTENDED].world_from_cam,
        renders={name: view.image for name, view in truth.views.items()},
        depths={name: view.depth for name, view in truth.views.items()},
    )


def moved(entry: Entry, by: Similarity) -> Entry:
    """The same result in another frame and scale."""
    gaussians = entry.gaussians
    assert entry.inserted is not None
    return replace(
        entry,
        captured=by.poses(entry.captured),
        inserted=by.poses(entry.inserted[None])[0],
        depths={name: depth * by.scale for name, depth in entry.depths.items()},
        gaussians=None
        if gaussians is None
        else replace(gaussians, means=by.points(gaussians.means.double()).float(), scales=gaussians.scales * by.scale),
    )


def write_case(folder: Path, entry: Entry, *, opengl: bool = False) -> Path:
    """An entry as somebody hands it in."""
    folder.mkdir(parents=True, exist_ok=True)
    named = [*zip(CAPTURED_VIEWS, entry.captured, strict=True)]
    if entry.inserted is not None:
        named.append(("inserted", entry.inserted))
    if opengl:
        turn = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        frames = [
            {"file_path": f"images/{name}.png", "transform_matrix": (pose @ turn).tolist()} for name, pose in named
        ]
        (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    else:
        cameras = [{"name": f"{name}.png", "world_from_cam": pose.tolist()} for name, pose in named]
        (folder / "cameras.json").write_text(json.dumps({"convention": "opencv", "cameras": cameras}))
    if entry.gaussians is not None:
        write_ply(entry.gaussians, folder / "gaussians.ply")
    for name, picture in entry.renders.items():
        (folder / "renders").mkdir(exist_ok=True)
        pixels = (picture.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        cv2.imwrite(str(folder / "renders" / f"{name}.png"), pixels[..., ::-1])
    for name, depth in entry.depths.items():
        (folder / "depths").mkdir(exist_ok=True)
        np.save(folder / "depths" / f"{name}.npy", depth.numpy())
    return folder


def is_perfect(values: dict[str, float], *, but: tuple[str, ...] = ()) -> None:
    for metric in METRICS:
        if metric.name in but:
            continue
        value = values[metric.name]
        if metric.name.endswith("normal_deg"):
            assert value < 1.0  # normals of a depth on a grid
        elif metric.better == "lower":
            assert value < 1e-5, metric.name
        else:
            assert value == pytest.approx(60.0 if metric.name.endswith("db") else 1.0, abs=1e-4), metric.name


@pytest.mark.parametrize("opengl", [False, True])
def test_the_truth_handed_in_has_no_error_in_whatever_frame_and_scale(
    truth: TrueScene, tmp_path: Path, opengl: bool
) -> None:
    height, width = truth.views[INTENDED].depth.shape
    plain = read_entry(write_case(tmp_path / "plain", perfect(truth), opengl=opengl), height, width)
    is_perfect(score(plain, truth))
    there = read_entry(write_case(tmp_path / "there", moved(perfect(truth), ELSEWHERE), opengl=opengl), height, width)
    is_perfect(score(there, truth))


def test_a_fault_in_the_new_region_is_found_there_and_nowhere_else(truth: TrueScene) -> None:
    depths = {
        name: torch.where(view.seen == Seen.EXPANDED, view.depth * 1.1, view.depth)
        for name, view in truth.views.items()
    }
    values = score(moved(replace(perfect(truth), depths=depths), ELSEWHERE), truth)
    assert values["expanded_depth_abs_rel"] == pytest.approx(0.1, abs=1e-5)
    assert values["expanded_chamfer_rel"] > 0.01
    is_perfect(values, but=("expanded_depth_abs_rel", "expanded_chamfer_rel", "expanded_normal_deg"))


def test_a_fault_everywhere_in_the_captured_depth_is_not_taken_for_scale(truth: TrueScene) -> None:
    """The similarity is that of the cameras: depths that do not go with them are errors."""
    depths = {name: view.depth * 1.1 for name, view in truth.views.items()}
    values = score(replace(perfect(truth), depths=depths), truth)
    assert values["captured_depth_abs_rel"] == pytest.approx(0.1, abs=1e-5)


def test_camera_errors_are_those_that_were_made(truth: TrueScene) -> None:
    entry = perfect(truth)
    assert entry.inserted is not None
    pose = entry.inserted.clone()
    turn = Similarity(scale=1.0, rotation=_about_y(4.0), translation=torch.zeros(3, dtype=torch.float64))
    pose[:3, :3] = pose[:3, :3] @ turn.rotation
    pose[:3, 3] += torch.tensor([0.03 * truth.size_m, 0.0, 0.0], dtype=torch.float64)
    values = score(moved(replace(entry, inserted=pose), ELSEWHERE), truth)
    assert values["inserted_rotation_deg"] == pytest.approx(4.0, abs=1e-4)
    assert values["inserted_centre_rel"] == pytest.approx(0.03, abs=1e-5)
    assert values["captured_rotation_deg"] < 1e-4


def _about_y(degrees: float) -> torch.Tensor:
    angle = np.deg2rad(degrees)
    rows = [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    return torch.tensor(rows, dtype=torch.float64)


def test_gaussians_of_the_truth_are_nearly_right_and_wrong_where_they_are_moved(
    truth: TrueScene, tmp_path: Path
) -> None:
    """One small opaque ball per pixel of the photographs and the intended view: discretisation is the only error."""
    points, colours, new = [], [], []
    for name in (*CAPTURED_VIEWS, INTENDED):
        view = truth.views[name]
        solid = view.seen == (Seen.EXPANDED if name == INTENDED else Seen.CAPTURED)
        points.append(unproject_to_world(view.depth.double(), view.intrinsics_px, view.world_from_cam)[solid])
        colours.append(view.image.permute(1, 2, 0)[solid])
        new.append(torch.full((int(solid.sum()),), name == INTENDED))
    means, rgb, generated = torch.cat(points).float(), torch.cat(colours), torch.cat(new)
    focal = float(truth.views[INTENDED].intrinsics_px[0, 0])
    size = means.norm(dim=-1, keepdim=True).expand(-1, 3) * 0.5 / focal
    count = len(means)
    gaussians = Gaussians(
        means=means,
        quat_wxyz=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=size,
        opacities=torch.full((count,), 0.99),
        sh=sh_from_rgb(rgb)[:, None],
        source_view=torch.zeros(count, dtype=torch.int64),
        generated=generated,
    )
    entry = replace(perfect(truth), renders={}, depths={}, gaussians=gaussians)
    there = moved(entry, ELSEWHERE)
    folder = write_case(tmp_path, there)
    values = score(read_entry(folder, *truth.views[INTENDED].depth.shape), truth)
    assert values["captured_depth_abs_rel"] < 0.03
    assert values["expanded_depth_abs_rel"] < 0.03
    assert values["captured_drawn"] > 0.95
    assert values["captured_psnr_db"] > 20
    assert values["expanded_psnr_db"] > 20
    assert values["expanded_normal_deg"] < 20

    apart = replace(gaussians, means=torch.where(generated[:, None], means * 1.2, means))
    wrong = score(moved(replace(entry, gaussians=apart), ELSEWHERE), truth)
    assert wrong["expanded_depth_abs_rel"] > values["expanded_depth_abs_rel"] + 0.05
    assert wrong["captured_depth_abs_rel"] < values["captured_depth_abs_rel"] + 0.03


def test_nothing_drawn_is_the_worst_chamfer_and_no_depth(truth: TrueScene) -> None:
    depths = {name: torch.zeros_like(view.depth) for name, view in truth.views.items()}
    values = score(replace(perfect(truth), depths=depths), truth)
    assert values["captured_drawn"] == values["expanded_drawn"] == 0
    assert values["expanded_chamfer_rel"] == 1.0
    assert "expanded_depth_abs_rel" not in values


def test_chamfer_by_hand() -> None:
    own = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]], dtype=torch.float64)
    true = torch.tensor([[0.0, 0, 0], [5.0, 0, 0]], dtype=torch.float64)
    # There: 0 and 1 of 10; back: 0 and 4 of 10.
    assert chamfer(own, true, 10.0) == pytest.approx((0.05 + 0.2) / 2)
    assert chamfer(own, true, 2.0) == pytest.approx((0.25 + 0.5) / 2), "4 of 2 counts as 1"


def test_views_that_were_not_placed_take_no_part_in_the_alignment(truth: TrueScene, tmp_path: Path) -> None:
    folder = write_case(tmp_path, moved(perfect(truth), ELSEWHERE))
    content = json.loads((folder / "cameras.json").read_text())
    for camera in content["cameras"][2:5]:
        camera["world_from_cam"] = None
    (folder / "cameras.json").write_text(json.dumps(content))
    entry = read_entry(folder, *truth.views[INTENDED].depth.shape)
    assert entry.posed.tolist() == [True, True, False, False, False]
    values = score(entry, truth)
    assert values["captured_placed"] == pytest.approx(0.4)
    is_perfect(values, but=("captured_placed",))
    with pytest.raises(ValueError, match="1 of 5 captured cameras placed"):
        score(replace(entry, posed=torch.tensor([True, False, False, False, False])), truth)


def test_exports_of_this_program_can_be_handed_in(truth: TrueScene, tmp_path: Path) -> None:
    """Their names are numbered, the inserted picture's is its file's, and the convention is a sentence."""
    entry = moved(perfect(truth), ELSEWHERE)
    folder = write_case(tmp_path, entry, opengl=True)
    content = json.loads((folder / "transforms.json").read_text())
    for index, frame in enumerate(content["frames"]):
        frame["file_path"] = f"images/{index:03d}_{Path(frame['file_path']).name}"
        frame["generated"] = index == len(CAPTURED_VIEWS)
    content["frames"][-1]["file_path"] = "images/round_1.png"
    content["convention"] = "transform_matrix is world_from_cam with OpenGL camera axes (x right, y up, z backwards)"
    (folder / "transforms.json").write_text(json.dumps(content))
    is_perfect(score(read_entry(folder, *truth.views[INTENDED].depth.shape), truth))


def change_json(name: str, change: Callable[[Any], None]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        change(content)
        (folder / name).write_text(json.dumps(content))

    return apply


def change_depth(change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / "depths" / "intended.npy"
        np.save(path, change(np.load(path)))

    return apply


def put_ply(header: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        for part in ("renders", "depths"):
            for path in (folder / part).iterdir():
                path.unlink()
        (folder / "gaussians.ply").write_bytes(header.encode())

    return apply


def with_nan(depth: np.ndarray) -> np.ndarray:
    depth[3, 4] = np.nan
    return depth


WITHOUT_OPACITY = "\n".join(
    ["ply", "format ascii 1.0", "element vertex 0"]
    + [
        f"property float {name}"
        for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "scale_0", "scale_1", "scale_2")
    ]
    + [f"property float rot_{index}" for index in range(4)]
    + ["end_header\n"]
)
FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "four cameras": (
        change_json("cameras.json", lambda c: c["cameras"].pop(2)),
        "has 4 of the 5 photographs' cameras: captured_3 missing",
    ),
    "six cameras": (
        change_json("cameras.json", lambda c: c["cameras"].append({**c["cameras"][0], "name": "captured_6.png"})),
        "'captured_6'",
    ),
    "twice": (change_json("cameras.json", lambda c: c["cameras"].append(c["cameras"][0])), "second one of captured_1"),
    "convention": (change_json("cameras.json", lambda c: c.update(convention="pytorch3d")), "unknown convention"),
    "no rotation": (
        change_json("cameras.json", lambda c: c["cameras"][0].update(world_from_cam=np.ones((3, 4)).tolist())),
        "rotation is none",
    ),
    "NaN camera": (
        change_json("cameras.json", lambda c: c["cameras"][0]["world_from_cam"][0].__setitem__(0, float("nan"))),
        "not finite",
    ),
    "no cameras": (lambda folder: (folder / "cameras.json").unlink(), "holds neither"),
    "NaN depth": (change_depth(with_nan), "negative or not finite"),
    "size": (change_depth(lambda depth: depth[::2]), "expected 84 x 112"),
    "integers": (change_depth(lambda depth: depth.astype(np.int32)), "floating-point"),
    "name": (lambda folder: (folder / "renders" / "intended.png").rename(folder / "renders" / "new.png"), "no view"),
    "picture": (lambda folder: (folder / "renders" / "intended.png").write_bytes(b"no"), "intended.png"),
    "opacity": (put_ply(WITHOUT_OPACITY), "vertices lack opacity"),
    "both": (lambda folder: (folder / "gaussians.ply").write_bytes(b"ply\n") and None, "as well as"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_cannot_be_scored_is_one_line_and_exit_code_2(
    bench: Path, truth: TrueScene, tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str
) -> None:
    spoil, said = FAULTS[fault]
    spoil(write_case(tmp_path / NAME / GRADE, perfect(truth)))
    given = ["leaderboard", str(bench), "--results", f"theirs={tmp_path}", "--scenes", NAME, "--grades", GRADE]
    with pytest.raises(SystemExit) as caught:
        benchmark.main(given)
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert said in line


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["leaderboard", "{bench}"], "no method is given"),
        (["leaderboard", "{bench}", "--results", "theirs"], "is not NAME=FOLDER"),
        (["leaderboard", "{bench}", "--results", "theirs={bench}/nowhere", *CASE], "does not exist"),
        (["leaderboard", "{bench}", "--results", "theirs={bench}/courtyard_1", *CASE], "holds none of the scenes"),
        (["leaderboard", "{bench}", "--results", "a={bench}"], "holds no test scene"),
        (["leaderboard", "{bench}", "--results", "a={bench}", "--scenes", "room_2"], "holds no scene room_2"),
        (["leaderboard", "{bench}", "--results", "a={bench}", "--scenes", NAME, "--grades", "zoom_5"], "zoom_5"),
        (["generate", "{bench}", "--scenes", "rom_1"], "did you mean 'room_1'"),
        (["generate", "{bench}", "--shrink", "0"], "--shrink: is 0"),
        (["verify", "{bench}/nowhere"], "holds no expandbench.json"),
        (["verify", "{bench}", "--rows", "default"], "means nothing to 'verify'"),
        (["leaderbord", "{bench}"], "did you mean 'leaderboard'"),
    ],
)
def test_what_cannot_be_meant_is_one_line(
    bench: Path, capsys: pytest.CaptureFixture[str], given: list[str], said: str
) -> None:
    with pytest.raises(SystemExit) as caught:
        benchmark.main([word.format(bench=bench) for word in given])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_one_command_makes_the_table_of_what_was_handed_in(
    bench: Path, truth: TrueScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_case(tmp_path / "whole" / NAME / GRADE, perfect(truth))
    write_case(tmp_path / "posed" / NAME / GRADE, replace(perfect(truth), renders={}, depths={}))
    given = ["leaderboard", str(bench), "--scenes", NAME, "--grades", GRADE, "--out", str(tmp_path / "out")]
    for name in ("whole", "posed"):
        given += ["--results", f"{name}={tmp_path / name}"]
    benchmark.main(given)
    shown = capsys.readouterr().out
    assert "for trying things out only" in shown
    assert "| whole | 1/1 | 100 | 0.00 |" in shown
    (nowhere,) = [line for line in shown.splitlines() if line.startswith("- posed: nowhere ")]
    assert "PSNR, expanded, held out" in nowhere
    assert "rotation" not in nowhere
    saved = json.loads((tmp_path / "out" / "leaderboard.json").read_text())
    assert saved["content"]
    assert saved["version"]
    with (tmp_path / "out" / "leaderboard.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["method"] for line in lines] == ["whole", "posed"]
    assert float(lines[0]["expanded_depth_abs_rel"]) < 1e-6
    assert lines[1]["expanded_depth_abs_rel"] == ""
    assert (tmp_path / "out" / "leaderboard.md").read_text() in shown


def test_true_cameras_are_placed_where_the_scores_are_taken(bench: Path, truth: TrueScene, tmp_path: Path) -> None:
    folder = write_case(tmp_path / NAME / GRADE, moved(perfect(truth), ELSEWHERE))
    benchmark.main(["place", str(bench), "--results", f"theirs={tmp_path}"])
    placed = json.loads((folder / "evaluation_cameras.json").read_text())["cameras"]
    assert [camera["name"] for camera in placed] == list(VIEWS)
    for camera in placed:
        wanted = ELSEWHERE.poses(truth.views[camera["name"]].world_from_cam[None])[0]
        torch.testing.assert_close(torch.tensor(camera["world_from_cam"], dtype=torch.float64), wanted)


def case(method: str, scene: str, value: float | None, problem: str = "") -> CaseScore:
    values = {} if value is None else {"captured_depth_abs_rel": value}
    return CaseScore(method=method, scene=scene, grade=GRADE, values=values, problem=problem)


def test_means_are_over_common_cases_and_what_is_missing_is_named() -> None:
    board = Board(
        version="1.0",
        content="0" * 64,
        complete=True,
        shrink=1,
        methods=("one", "other", "poses"),
        scenes=("room_101", "room_102", "open_101", "room_1"),
        grades=(GRADE,),
        cases=(
            case("one", "room_101", 0.1),
            case("one", "room_102", 0.3),
            case("one", "open_101", 0.8),
            case("one", "room_1", 0.9),
            case("other", "room_101", 0.2),
            case("other", "room_102", 0.2),
            case("other", "open_101", None, "not handed in"),
            case("other", "room_1", 0.9),
            *(case("poses", scene, None) for scene in ("room_101", "room_102", "open_101", "room_1")),
        ),
    )
    depth = [metric for metric in GEOMETRY if metric.name == "captured_depth_abs_rel"]
    assert table(board, "test", GRADE, depth).lines == (
        ("one", "3/3", "20.00"),
        ("other", "2/3", "20.00"),
        ("poses", "3/3", "\u2013"),
        ("cases in common", "", "2"),
    )
    page = document(board)
    assert "- other: open_101, clean: not handed in" in page
    assert "## Test scenes (3)" in page
    assert "## Development scenes (1)" in page, "splits are never in one mean"


def test_own_rows_are_scored_like_results_of_others_and_once(
    bench: Path, truth: TrueScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def make(name: str, wanted: Any, seed: int, settings: Any) -> Any:
        for grade, row, _ in wanted:
            made.append(f"{name} {grade} {row} {seed}")
            yield moved(perfect(truth), ELSEWHERE)

    monkeypatch.setattr(leaderboard, "make_scenes", make)
    monkeypatch.setattr(leaderboard, "entry_of", lambda entry: entry)
    settings: Any = type("S", (), {"model": None, "frontend": None, "warmup": None, "shrink": SHRINK})()
    settings.refine = type("R", (), {"visits": 3})()
    settings.model = type("M", (), {"name": "mini"})()
    settings.cache, settings.code = tmp_path, "code"
    monkeypatch.setattr(leaderboard, "to_plain", lambda value: repr(type(value).__name__))
    rows = leaderboard.Rows(rows={"captured": None, "baseline": None}, settings=settings, seed=2)
    for _ in range(2):
        board = measure_methods(bench, [NAME], [GRADE], {}, rows)
        assert [one.method for one in board.cases] == ["captured", "baseline"]
        is_perfect(dict(board.cases[1].values))
    assert made == [f"{NAME} {GRADE} captured 2", f"{NAME} {GRADE} baseline 2"]


def test_a_benchmark_that_is_not_finished_is_no_benchmark(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not finished"):
        measure_methods(tmp_path, [NAME], [GRADE], {})
