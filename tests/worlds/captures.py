"""Small captures of every kind, faithful in format: three pictures, whose cameras are `pose`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
from PIL import Image

from sceneexpander.ingest import IngestConfig
from tests.worlds.photos import texture

CONFIG = IngestConfig(long_side_px=112)
SIZE = (180, 240)


def pose(k: int) -> np.ndarray:
    """World from camera of picture k, OpenCV axes."""
    angle = 0.1 * k
    made = np.eye(4)
    made[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    made[:3, 3] = [100 + 0.3 * k, 0.1 * k, 2.0]
    return made


def pictures(folder: Path, names: list[str]) -> None:
    for seed, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        texture(seed, *SIZE).save(folder / name)


def quat_wxyz(rotation: np.ndarray) -> np.ndarray:
    w = np.sqrt(max(0, 1 + np.trace(rotation))) / 2
    skew = rotation - rotation.T
    return np.array([w, *(np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (4 * w))])


def colmap(folder: Path, camera: str = "PINHOLE 240 180 200 201 119 91") -> None:
    pictures(folder / "images", ["sub/0.png", "sub/1.png", "sub/2.png"])
    lines = ["# comment"]
    for k in (*range(3), 7):
        cam = np.linalg.inv(pose(k))
        numbers = " ".join(f"{value:.17g}" for value in (*quat_wxyz(cam[:3, :3]), *cam[:3, 3]))
        lines += [f"{k + 1} {numbers} 1 sub/{k}.png", "" if k else "1.0 2.0 -1"]
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "sparse" / "0" / "cameras.txt").write_text(f"# comment\n1 {camera}\n")


def transforms(folder: Path) -> None:
    pictures(folder / "images", ["0.png", "1.png", "2.png"])
    flip = np.diag([1.0, -1, -1, 1])
    frames = [{"file_path": f"images/{k}.png", "transform_matrix": (pose(k) @ flip).tolist()} for k in (0, 1, 2, 7)]
    frames[1] |= {"fl_x": 150.0, "fl_y": 151.0}
    shared = {"camera_model": "OPENCV", "fl_x": 200, "fl_y": 201, "cx": 119, "cy": 91, "w": 240, "h": 180}
    applied = {"applied_transform": np.eye(4)[:3].tolist()}
    (folder / "transforms.json").write_text(json.dumps({**shared, **applied, "frames": frames}))


def camera_texts(folder: Path) -> None:
    pictures(folder / "images", ["0.png", "1.png", "2.png"])
    (folder / "cameras").mkdir()
    (folder / "depths").mkdir()
    for k in (0, 2):
        rows = [*pose(k)[:3].tolist(), [200, 0, 119], [0, 201, 91], [0, 0, 1]]
        (folder / "cameras" / f"{k}.txt").write_text("\n".join("\t".join(map(repr, row)) for row in rows))
    np.save(folder / "depths" / "0.npy", np.full(SIZE, 2.5, np.float32))


def camera_params(folder: Path) -> None:
    pictures(folder, ["0.png", "1.png", "2.png"])
    content = {
        "num_cameras": 3,
        "extrinsics": [{"camera_id": k, "matrix": pose(k).tolist()} for k in range(3)],
        "intrinsics": [{"camera_id": "1", "matrix": [[200, 0, 119], [0, 201, 91], [0, 0, 1]]}],
    }
    (folder / "camera_params.json").write_text(json.dumps(content))


def seven_scenes(folder: Path) -> None:
    pictures(folder, [f"frame-{k:06d}.color.png" for k in range(3)])
    for k in range(3):
        text = "\n".join("\t ".join(f"{value:.7e}" for value in row) + "\t " for row in pose(k))
        (folder / f"frame-{k:06d}.pose.txt").write_text(text)
        Image.fromarray(np.full(SIZE, 1000, np.uint16)).save(folder / f"frame-{k:06d}.depth.png")


def reality_capture(folder: Path) -> None:
    pictures(folder, ["0.png", "1.png", "2.png"])
    for k in range(3):
        facts = 'xcr:DistortionModel="brown3" xcr:FocalLength35mm="30" xcr:PrincipalPointU="-0.01" xcr:PrincipalPointV="0.005"'
        rotation, position = (
            " ".join(map(repr, part.ravel().tolist())) for part in (pose(k)[:3, :3].T, pose(k)[:3, 3])
        )
        body = f"<xcr:Rotation>{rotation}</xcr:Rotation><xcr:Position>{position}</xcr:Position>"
        body += "<xcr:DistortionCoeficients>0.1 -0.02 0.003 0 0 0</xcr:DistortionCoeficients>"
        space = 'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"'
        inner = f"<rdf:Description {space} {facts}>{body}</rdf:Description>"
        rdf = f'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">{inner}</rdf:RDF>'
        (folder / f"{k}.xmp").write_text(f'<x:xmpmeta xmlns:x="adobe:ns:meta/">{rdf}</x:xmpmeta>')


def heading_pitch_roll(rotation: np.ndarray) -> tuple[float, float, float]:
    """Angles in degrees of a camera-from-world rotation, by the third column and second row of the vendor's matrix."""
    heading = np.arctan2(-rotation[1, 0], -rotation[1, 1])
    roll = np.arctan2(-rotation[0, 2], -rotation[2, 2])
    return float(np.degrees(heading)), float(np.degrees(np.arcsin(-rotation[1, 2]))), float(np.degrees(roll))


def reality_capture_csv(folder: Path, lens: str = "30,-0.01,0.005,0.1,-0.02,0.003,0,0,0") -> None:
    pictures(folder, ["0.png", "1.png", "2.png"])
    rows = ["#cameras 4", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for k in (*range(3), 7):
        numbers = [*pose(k)[:3, 3].tolist(), *heading_pitch_roll(pose(k)[:3, :3].T)]
        rows.append(",".join([f"{k}.png", *(f"{value:.16g}" for value in numbers), lens]))
    (folder / "cameras.csv").write_text("\n".join(rows) + "\n")


def metashape(folder: Path, world: str = "") -> None:
    pictures(folder, ["0.png", "1.png", "2.png"])
    cameras = "".join(
        f'<camera id="{k}" sensor_id="0" label="{k}"><transform>{" ".join(map(repr, pose(k).ravel().tolist()))}</transform></camera>'
        for k in range(3)
    )
    sensor = '<sensor id="0" type="frame"><resolution width="240" height="180"/>'
    sensor += '<calibration type="frame"><f>200</f><cx>-1</cx><cy>1</cy></calibration></sensor>'
    body = f'<chunk label="c"><sensors>{sensor}</sensors><cameras>{cameras}</cameras>{world}</chunk>'
    (folder / "cameras.xml").write_text(f'<?xml version="1.0"?><document version="2.0">{body}</document>')


def video(folder: Path, *, quarter_turn: bool = False) -> None:
    path = folder / "walk.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = SIZE[1], SIZE[0], "yuv420p"
        for k in range(30):
            made = texture(k // 10, *SIZE)
            blurred = made if k % 10 == 4 else made.resize((24, 18)).resize(SIZE[::-1], Image.Resampling.BILINEAR)
            frame = av.VideoFrame.from_image(blurred)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    if quarter_turn:  # the display matrix of the track header: shown a quarter turn clockwise
        data = bytearray(path.read_bytes())
        place = data.index(b"tkhd") + 4 + 40
        one = 1 << 16
        for index, value in enumerate((0, one, 0, -one, 0, 0, 0, 0, 1 << 30)):
            data[place + 4 * index : place + 4 * index + 4] = value.to_bytes(4, "big", signed=True)
        path.write_bytes(bytes(data))


def eth3d(folder: Path, *, undistorted: bool, depth: bool) -> np.ndarray:
    """A scene as the data set has it: pictures and model in folders of their own, ground-truth depth as raw floats named ``.JPG``."""
    kind = "dslr_images_undistorted" if undistorted else "dslr_images"
    names = [f"{kind}/DSC_{k:04d}.JPG" for k in range(3)]
    pictures(folder / "images", names)
    camera = "PINHOLE 240 180 200 201 119 91"
    if not undistorted:
        camera = "THIN_PRISM_FISHEYE 240 180 200 201 119 91 0.05 -0.02 0.001 0.002 0.003 0.002 0.001 0.002"
    lines = ["# Image list with two lines of data per image:"]
    for k, name in enumerate(names):
        cam = np.linalg.inv(pose(k))
        numbers = " ".join(f"{value:.17g}" for value in (*quat_wxyz(cam[:3, :3]), *cam[:3, 3]))
        lines += [f"{k + 1} {numbers} 0 {name}", "12.5 17.25 -1 100 90.5 7"]
    model = folder / ("dslr_calibration_undistorted" if undistorted else "dslr_calibration_jpg")
    model.mkdir(parents=True)
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "cameras.txt").write_text(f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n0 {camera}\n")
    (model / "points3D.txt").write_text("# 3D point list\n")
    values = np.full(SIZE, np.inf, np.float32)
    values[::2] = np.linspace(1, 3, SIZE[1], dtype=np.float32)
    if depth:
        (folder / "ground_truth_depth" / "dslr_images").mkdir(parents=True)
        for k in range(3):
            path = folder / "ground_truth_depth" / "dslr_images" / f"DSC_{k:04d}.JPG"
            path.write_bytes(values.astype("<f4").tobytes())
    return values


MAKERS: dict[str, Callable[[Path], None]] = {
    "colmap": colmap,
    "transforms": transforms,
    "camera_texts": camera_texts,
    "camera_params": camera_params,
    "seven_scenes": seven_scenes,
    "metashape": metashape,
    "reality_capture": reality_capture,
    "reality_capture_csv": reality_capture_csv,
}
