"""PLY files: what we write we read, what others write we open, what is broken is refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sceneexpander.errors import UserError
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.splatting import render
from sceneexpander.splatting.ply import read_ply, write_ply
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians

XYZ, NORMALS, DC = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
SHAPE = ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
LAYOUTS = {  # property order of other programs
    "inria": lambda rest: [*XYZ, *NORMALS, *DC, *rest, "opacity", *SHAPE],
    "gsplat": lambda rest: [*XYZ, *DC, *rest, "opacity", *SHAPE],
    "nerfstudio": lambda rest: [*XYZ, *NORMALS, *DC, *rest, "opacity", *SHAPE[:3], *SHAPE[3:]],
    "shuffled": lambda rest: ["opacity", *SHAPE[::-1], *rest[::-1], *DC[::-1], "z", "y", "x"],
}


def foreign_file(path: Path, scene: Gaussians, layout: Callable[[list[str]], list[str]], encoding: str) -> None:
    """Write the scene as another program would, property by property."""
    higher = scene.sh[:, 1:].permute(0, 2, 1).reshape(len(scene), -1)
    values: dict[str, torch.Tensor] = {f"f_rest_{i}": higher[:, i] for i in range(higher.shape[1])}
    values |= dict(zip(XYZ, scene.means.T, strict=True)) | dict.fromkeys(NORMALS, torch.zeros(len(scene)))
    values |= dict(zip(DC, scene.sh[:, 0].T, strict=True)) | {"opacity": torch.logit(scene.opacities)}
    values |= dict(zip(SHAPE, [*scene.scales.log().T, *scene.quat_wxyz.T], strict=True))
    names = layout([f"f_rest_{i}" for i in range(higher.shape[1])])
    header = f"ply\nformat {encoding} 1.0\ncomment made elsewhere\nelement vertex {len(scene)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    table = torch.stack([values[name] for name in names], 1).numpy()
    if encoding == "ascii":
        body = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in table).encode()
    else:
        body = table.astype("<f4" if "little" in encoding else ">f4").tobytes()
    path.write_bytes(header.encode() + body)


def assert_same_scene(a: Gaussians, b: Gaussians) -> None:
    torch.testing.assert_close(a.means, b.means, rtol=0, atol=0)
    torch.testing.assert_close(a.sh, b.sh, rtol=0, atol=0)
    torch.testing.assert_close(a.scales, b.scales)  # through log and exp
    torch.testing.assert_close(a.opacities, b.opacities, rtol=0, atol=1e-5)  # through the logit
    unit = torch.nn.functional.normalize
    torch.testing.assert_close(unit(a.quat_wxyz, dim=-1), unit(b.quat_wxyz, dim=-1))


@pytest.mark.parametrize("sh_coefficients", [1, 4, 9, 16])
def test_written_scenes_come_back_and_render_the_same(tmp_path: Path, sh_coefficients: int) -> None:
    scene = random_gaussians(200, sh_coefficients=sh_coefficients)
    scene = replace(scene, opacities=torch.cat([torch.tensor([0.0, 1.0]), scene.opacities[2:]]))
    path = tmp_path / "folder" / "scene.ply"
    write_ply(scene, path)
    again = read_ply(path)
    assert_same_scene(again, scene)
    assert torch.equal(again.source_view, scene.source_view)
    assert torch.equal(again.generated, scene.generated)
    pictures = [render(s, Cameras(cameras(1), intrinsics(1, 40, 50), 40, 50)) for s in (scene, again)]
    assert (pictures[0].rgb - pictures[1].rgb).abs().max() < 1 / 255
    assert (pictures[0].generated - pictures[1].generated).abs().max() < 1 / 255
    assert [p.name for p in path.parent.iterdir()] == ["scene.ply"]  # no scratch files


def test_values_on_disk_are_what_viewers_expect(tmp_path: Path) -> None:
    scene = random_gaussians(3, sh_coefficients=4)
    path = tmp_path / "scene.ply"
    write_ply(scene, path)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float")]
    assert names[:9] == [*XYZ, *NORMALS, *DC]
    row = dict(zip(names, np.frombuffer(body, "<f4", len(names)), strict=True))
    assert row["opacity"] == pytest.approx(torch.logit(scene.opacities[0]).item(), abs=1e-5)
    assert row["scale_1"] == pytest.approx(scene.scales[0, 1].log().item(), abs=1e-6)
    assert row["f_rest_3"] == scene.sh[0, 1, 1].item()  # channel by channel: green begins after the 3 of red
    assert names[-2:] == ["source_view", "generated"]
    assert len(body) == 3 * 4 * len(names)  # floats throughout


def test_empty_scene_round_trip(tmp_path: Path) -> None:
    write_ply(random_gaussians(0), tmp_path / "empty.ply")
    assert len(read_ply(tmp_path / "empty.ply")) == 0


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("sh_coefficients", [1, 4, 16])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_foreign_files_open(tmp_path: Path, layout: str, sh_coefficients: int, encoding: str) -> None:
    scene = random_gaussians(17, sh_coefficients=sh_coefficients)
    foreign_file(tmp_path / "foreign.ply", scene, LAYOUTS[layout], encoding)
    again = read_ply(tmp_path / "foreign.ply")
    assert_same_scene(again, scene)
    assert not again.generated.any()
    assert (again.source_view == -1).all()


def test_other_elements_and_windows_line_ends_are_skipped(tmp_path: Path) -> None:
    scene = random_gaussians(2, sh_coefficients=1)
    foreign_file(tmp_path / "a.ply", scene, LAYOUTS["gsplat"], "binary_little_endian")
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    camera = b"element camera 2\r\nproperty uchar id\r\nproperty double t\r\nelement vertex"
    header = header.replace(b"\n", b"\r\n").replace(b"element vertex", camera)
    header += b"element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
    (tmp_path / "a.ply").write_bytes(header + bytes(18) + body + b"\x01\x00\x00\x00\x00")
    assert_same_scene(read_ply(tmp_path / "a.ply"), scene)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda raw: raw[:-7], "is truncated: 5 vertices take"),
        (lambda raw: raw + b"1234", "is longer than its 5 vertices"),
        (lambda raw: b"", "is not a PLY file"),
        (lambda raw: b"PK\x03\x04" + raw, "is not a PLY file"),
        (lambda raw: raw[:200], "has no end_header"),
        (lambda raw: raw.replace(b"property float opacity\n", b""), "vertices lack opacity"),
        (lambda raw: raw.replace(b"f_rest_8", b"f_what_8"), "has 8 f_rest properties"),
        (lambda raw: raw.replace(b"element vertex 5", b"element vertex x"), "has a header line that is no PLY"),
        (lambda raw: raw.replace(b"element vertex 5", b"element points 5"), "has no vertices"),
        (lambda raw: raw.replace(b"binary_little_endian", b"binary_middle_endian"), "unknown format"),
        (lambda raw: raw.replace(b"float nx", b"list uchar int nx"), "has lists in or before its vertices"),
        (lambda raw: raw.replace(b"float ny", b"float nx"), "names a vertex property twice"),
        (lambda raw: raw.replace(b"element vertex 5", b"element vertex 99999999999"), "is truncated"),
    ],
)
def test_malformed_files_are_refused_in_one_line(
    tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "scene.ply"
    write_ply(random_gaussians(5), path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UserError, match=message) as caught:
        read_ply(path)
    assert str(path) in caught.value.line()
    assert "\n" not in caught.value.line()


def test_values_that_are_not_finite_are_refused_by_row(tmp_path: Path) -> None:
    scene = random_gaussians(5, sh_coefficients=1)
    scene.means[3, 1] = float("nan")
    with pytest.raises(ValueError, match="means row 3"):
        write_ply(scene, tmp_path / "scene.ply")
    assert not list(tmp_path.iterdir())
    foreign_file(tmp_path / "scene.ply", scene, LAYOUTS["inria"], "binary_little_endian")
    with pytest.raises(UserError, match="vertex 3 has means that are not finite"):
        read_ply(tmp_path / "scene.ply")


def test_missing_file_and_wrong_ascii_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        read_ply(tmp_path / "nothing.ply")
    foreign_file(tmp_path / "a.ply", random_gaussians(3), LAYOUTS["inria"], "ascii")
    raw = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(raw.rstrip(b"\n").rsplit(b"\n", 1)[0])
    with pytest.raises(UserError, match="declares 3 vertices and holds 2"):
        read_ply(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes(raw.rstrip(b"\n") + b" 7\n")
    with pytest.raises(UserError, match="vertex 2 does not hold"):
        read_ply(tmp_path / "a.ply")


def linear_file(path: Path, scene: Gaussians, quantities: set[str]) -> None:
    """The scene as programs write it that store some quantities as they are."""
    logits = {name: getattr(scene, name) for name in ("opacities", "scales")}
    if "opacity" in quantities:
        logits["opacities"] = scene.opacities.sigmoid()
    if "scale" in quantities:
        logits["scales"] = scene.scales.exp()
    foreign_file(path, replace(scene, **logits), LAYOUTS["inria"], "binary_little_endian")


@pytest.mark.parametrize("opacity", [None, 0.88, 1.0])
@pytest.mark.parametrize("quantities", [{"opacity"}, {"scale"}, {"opacity", "scale"}])
@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
def test_linear_values_are_refused_and_read_when_asked_for(
    tmp_path: Path, quantities: set[str], unit: float, opacity: float | None
) -> None:
    scene = random_gaussians(400, sh_coefficients=1)
    scene = replace(scene, means=scene.means * unit, scales=scene.scales * unit)
    if opacity is not None:
        scene = replace(scene, opacities=torch.full((400,), opacity if "opacity" in quantities else 0.9))
    path = tmp_path / "linear.ply"
    linear_file(path, scene, quantities)
    with pytest.raises(UserError) as caught:
        read_ply(path)
    for name, said in (("opacity", "opacities"), ("scale", "scales")):
        assert (f"its {said} (all" in caught.value.line()) == (name in quantities)
    again = read_ply(path, linear=quantities)  # type: ignore[arg-type]
    torch.testing.assert_close(again.opacities, scene.opacities, rtol=0, atol=1e-6)
    torch.testing.assert_close(again.scales, scene.scales)


@pytest.mark.parametrize(
    "change",
    [
        {"opacities": torch.full((400,), 0.3)},
        {"opacities": torch.full((400,), 0.5)},  # logits of exactly 0: as they are, nothing would be seen
        {"opacities": torch.linspace(0.4, 0.99, 400)},
        # A place in millimetres: every Gaussian is larger than one of them, and none covers its neighbours.
        {"means": 3000 * random_gaussians(400).means, "scales": 30 + 10 * random_gaussians(400).scales},
    ],
    ids=["faint", "half", "most", "millimetres"],
)
def test_logits_and_logarithms_are_taken_for_what_they_are(tmp_path: Path, change: dict[str, torch.Tensor]) -> None:
    scene = replace(random_gaussians(400, sh_coefficients=1), **change)
    foreign_file(tmp_path / "a.ply", scene, LAYOUTS["inria"], "binary_little_endian")
    assert_same_scene(read_ply(tmp_path / "a.ply"), scene)


def test_of_a_few_gaussians_and_large_units_the_doubt_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    few = replace(random_gaussians(3, sh_coefficients=1), opacities=torch.tensor([0.55, 0.6, 0.7]))
    foreign_file(tmp_path / "few.ply", few, LAYOUTS["inria"], "binary_little_endian")
    assert_same_scene(read_ply(tmp_path / "few.ply"), few)
    assert "taken for logits" in caplog.text


def test_what_was_written_here_is_never_in_doubt(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = replace(random_gaussians(400), opacities=torch.linspace(0.51, 0.72, 400), scales=torch.full((400, 3), 1.5))
    write_ply(scene, tmp_path / "a.ply")
    assert_same_scene(read_ply(tmp_path / "a.ply"), scene)
    assert not caplog.text


@pytest.mark.parametrize(("quantity", "column"), [("opacity", {"opacities": torch.tensor([0.2, 0.9])}), ("scale", {})])
def test_values_that_are_not_linear_are_refused_where_linear_ones_are_asked_for(
    tmp_path: Path, quantity: str, column: dict[str, torch.Tensor]
) -> None:
    scene = replace(random_gaussians(2, sh_coefficients=1), **column)
    foreign_file(tmp_path / "a.ply", scene, LAYOUTS["inria"], "binary_little_endian")
    with pytest.raises(UserError, match="they are not linear"):
        read_ply(tmp_path / "a.ply", linear=[quantity])  # type: ignore[list-item]


def test_a_compressed_ply_is_named(tmp_path: Path) -> None:
    header = "ply\nformat binary_little_endian 1.0\nelement chunk 1\n"
    header += "".join(f"property float {bound}_{axis}\n" for bound in ("min", "max") for axis in "xyz")
    header += "element vertex 256\n"
    header += "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    (tmp_path / "a.ply").write_bytes((header + "end_header\n").encode() + bytes(24 + 16 * 256))
    with pytest.raises(UserError, match=r"is a compressed PLY \(SuperSplat\), which is not read; convert it"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ["binary_little_endian", "ascii"])
@pytest.mark.parametrize("element", ["vertex", "camera"])
@pytest.mark.parametrize("count", ["9" * 5000, "9" * 16, "9" * 15, "4294967296", "²", "٣"])
def test_a_count_that_no_file_holds_is_one_line(tmp_path: Path, encoding: str, element: str, count: str) -> None:
    foreign_file(tmp_path / "a.ply", random_gaussians(5, sh_coefficients=1), LAYOUTS["gsplat"], encoding)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    if element == "vertex":
        header = header.replace(b"vertex 5", b"vertex " + count.encode())
    else:
        header = header.replace(
            b"element vertex", f"element camera {count}\nproperty uchar id\nelement vertex".encode()
        )
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + body)
    with pytest.raises(UserError) as caught:
        read_ply(tmp_path / "a.ply")
    assert len(caught.value.line()) < 300 + len(str(tmp_path))


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "."])
def test_a_name_that_is_no_file_is_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError):
        read_ply(tmp_path / name)


@pytest.mark.parametrize("antialiased", [False, True])
def test_how_opacities_are_meant_travels_with_the_file(tmp_path: Path, antialiased: bool) -> None:
    write_ply(replace(random_gaussians(5), antialiased=antialiased), tmp_path / "a.ply")
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)[0].decode()
    # The spelling that gsplat, nerfstudio, Brush and splat-transform share.
    assert f"comment SplatRenderMode: {'mip' if antialiased else 'default'}" in header.splitlines()
    assert read_ply(tmp_path / "a.ply").antialiased is antialiased


@pytest.mark.parametrize(
    ("comment", "antialiased"),
    [
        ("SplatRenderMode: mip", True),
        ("SplatRenderMode: default", False),
        ("antialiased 1", True),
        ("made by me", False),
    ],
)
def test_other_programs_say_it_in_their_own_words(tmp_path: Path, comment: str, antialiased: bool) -> None:
    foreign_file(tmp_path / "a.ply", random_gaussians(5), LAYOUTS["gsplat"], "binary_little_endian")
    raw = (tmp_path / "a.ply").read_bytes().replace(b"comment made elsewhere", f"comment {comment}".encode())
    (tmp_path / "a.ply").write_bytes(raw)
    assert read_ply(tmp_path / "a.ply").antialiased is antialiased


@pytest.mark.parametrize(("comments", "readable"), [(60_000, True), (70_000, False)])
def test_a_header_may_be_long_but_not_without_end(tmp_path: Path, comments: int, readable: bool) -> None:
    path = tmp_path / "a.ply"
    write_ply(random_gaussians(3), path)
    raw = path.read_bytes()
    path.write_bytes(raw.replace(b"\nelement", b"\ncomment " + b"x" * comments + b"\nelement", 1))
    if readable:
        assert len(read_ply(path)) == 3
    else:
        with pytest.raises(UserError, match="end_header"):
            read_ply(path)
