"""What other people's programs show of our files.

    PYTHONPATH=.:benchmarks python scripts/other_viewers.py RECONSTRUCTION VIEWS --modules node_modules

RECONSTRUCTION and VIEWS are folders of a run (``.../captured/reconstruction`` and ``.../views``). The scene is written as PLY and SPZ, and
drawn at one captured view's camera at multiples of the stored size by

- gsplat's own torch reference (``pip install --no-deps gsplat==1.5.3``), and
- two WebGL viewers in a headless Chromium (``npm install @mkkellogg/gaussian-splats-3d@0.4.7 @sparkjsdev/spark@2.2.0 three@0.180.0``)
  on Mesa's software renderer (``apt-get install libegl1 libgl1-mesa-dri``),

each with opacities compensated for its blur on the screen, as the scene is meant, and without. Every picture is compared with the photo
brought to its size, and with our own render. The viewers read the files by themselves; gsplat is given what our reader finds in them.
"""

from __future__ import annotations

import argparse
import base64
import functools
import http.server
import importlib.util
import io
import json
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlencode

import gsplat_reference
import numpy as np
import splat_scene
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn import functional

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet, save_png
from sceneexpander.errors import entry_point
from sceneexpander.evaluation.image import psnr
from sceneexpander.evaluation.sizes import OPEN_ALPHA
from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.splatting import render
from sceneexpander.splatting.ply import read_ply, write_ply
from sceneexpander.splatting.spz import read_spz, write_spz
from sceneexpander.splatting.torch_backend import shade
from tests.support.browser import Page, browser_page

Picture = Float[Tensor, "3 height width"]

_BLUR = 0.3  # pixels^2, what all of these programs add to the covariance on the screen
_SETTLE_S = 3.0  # viewers sort beside the drawing: a picture counts when the next one, so much later, is the same
_PATIENCE_S = 580.0  # for one frame, drawn without a graphics card
# Mesa's llvmpipe: Chromium's own software renderer takes minutes for a frame of so many instances.
_GRAPHICS = ("--use-gl=angle", "--use-angle=gl-egl")
_HEAD = """<!doctype html><style>body{margin:0;background:#000}canvas{display:block}</style><script type="importmap">{"imports":{
"three":"/node_modules/three/build/three.module.js","three/addons/":"/node_modules/three/examples/jsm/",
"mkkellogg":"/node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js",
"spark":"/node_modules/@sparkjsdev/spark/dist/spark.module.js",
"fflate":"/node_modules/fflate/esm/browser.js"}}</script><script>
const say = (state) => { document.documentElement.dataset.state = state; };
window.onerror = (message) => say("failed: " + message);
window.onunhandledrejection = (event) => say("failed: " + (event.reason && event.reason.stack || event.reason));
</script><script type="module">
import * as THREE from "three";
const ask = new URLSearchParams(location.search), compensated = ask.get("compensated") === "1";
const c = JSON.parse(ask.get("camera")), w = innerWidth, h = innerHeight;
const fullW = 2 * Math.max(c.cx, w - c.cx), fullH = 2 * Math.max(c.cy, h - c.cy);
const camera = new THREE.PerspectiveCamera(2 * Math.atan(fullH / 2 / c.fy) * 180 / Math.PI, fullW / c.fx / (fullH / c.fy), 0.01, 500);
if (fullW !== w || fullH !== h) camera.setViewOffset(fullW, fullH, fullW / 2 - c.cx, fullH / 2 - c.cy, w, h);
camera.position.set(...c.eye); camera.up.set(...c.up); camera.lookAt(...c.at); camera.updateMatrixWorld();
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(1); renderer.setSize(w, h); document.body.appendChild(renderer.domElement);
"""
VIEWERS = {
    "mkkellogg": """
import * as GS from "mkkellogg";
const viewer = new GS.Viewer({ selfDrivenMode: false, renderer, camera, useBuiltInControls: false, sharedMemoryForWorkers: false,
  gpuAcceleratedSort: false, antialiased: compensated, sceneRevealMode: GS.SceneRevealMode.Instant });
await viewer.addSplatScene("/" + ask.get("file"), { showLoadingUI: false, progressiveLoad: false });
window.draw = () => { viewer.update(); viewer.render(); };
say("ready");
</script>""",
    "spark": """
import { SparkRenderer, SplatMesh } from "spark";
const scene = new THREE.Scene();
const BLUR_IS = compensated ? { preBlurAmount: 0, blurAmount: BLUR } : { preBlurAmount: BLUR, blurAmount: 0 };
scene.add(new SparkRenderer({ renderer, ...BLUR_IS }));
const mesh = new SplatMesh({ url: "/" + ask.get("file") });
await mesh.initialized;
scene.add(mesh);
window.draw = () => { renderer.render(scene, camera); };
say("ready");
</script>""".replace("BLUR,", f"{_BLUR},").replace("BLUR }", f"{_BLUR} }}"),
}  # fmt: skip
READS_SPZ = {"spark"}


class Scene:
    """A reconstruction's Gaussians in files, one of its cameras, and the photo that was taken there."""

    def __init__(self, reconstruction: Reconstruction, views: ViewSet, view: int, folder: Path) -> None:
        self.gaussians, self._views, self._view = reconstruction.gaussians, views, view
        self.world_from_cam = reconstruction.world_from_cam[view]
        self._lens = reconstruction.intrinsics_px[view]
        self.folder = folder
        write_ply(self.gaussians, folder / "scene.ply")
        write_spz(self.gaussians, folder / "scene.spz")

    def size(self, times: int) -> tuple[int, int]:
        """(height, width) at a multiple of the stored size."""
        return times * self._views.height, times * self._views.width

    def lens(self, times: int) -> Float[Tensor, "3 3"]:
        """Intrinsics there."""
        return resize_intrinsics(self._lens, times, times)

    def photo(self, times: int) -> Picture:
        """The photo at that size."""
        photo = self._views.photo(self._view)
        wanted = functional.interpolate(photo[None], size=self.size(times), mode="bicubic", antialias=True)
        return wanted[0].clamp(0, 1)

    @torch.no_grad()
    def ours(self, gaussians: Gaussians, times: int) -> Picture:
        """Our own render."""
        camera = Cameras(self.world_from_cam[None], self.lens(times)[None], *self.size(times))
        return render(gaussians, camera).rgb[0].clamp(0, 1)

    @torch.no_grad()
    def gsplat(self, gaussians: Gaussians, times: int, *, compensated: bool) -> tuple[Picture, float]:
        """gsplat's reference, and the share that it leaves open."""
        height, width = self.size(times)
        cam_from_world = rigid_inverse(self.world_from_cam)
        frame = splat_scene.Scene(
            means=gaussians.means,
            quats=gaussians.quat_wxyz,
            scales=gaussians.scales,
            opacities=gaussians.opacities,
            colours=shade(gaussians.means, gaussians.sh, cam_from_world),
            viewmat=cam_from_world,
            intrinsics=self.lens(times),
            width=width,
            height=height,
            target=torch.zeros(height, width, 3),
        )
        image, alpha, _ = gsplat_reference.draw_gsplat(frame, frame.leaves(), None, antialiased=compensated)
        return image.permute(2, 0, 1).clamp(0, 1), float((alpha < OPEN_ALPHA).double().mean())

    def camera(self, times: int, file: str) -> dict[str, float | list[float]]:
        """For the viewers' pages, in the axes of the file: the format SPZ has y up and z backwards."""
        pose, k = self.world_from_cam.double(), self.lens(times).double()
        if file.endswith("spz"):
            pose = torch.diag(torch.tensor([1, -1, -1, 1]).double()) @ pose
        eye, right_down_forward = pose[:3, 3], pose[:3, :3]
        return {
            "fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2]),
            "eye": eye.tolist(), "up": (-right_down_forward[:, 1]).tolist(), "at": (eye + right_down_forward[:, 2]).tolist(),
        }  # fmt: skip


def drawn_by(tab: Page, address: str, width: int, height: int) -> Picture:
    """A viewer's picture, when it no longer changes."""
    tab.open(address, width, height)
    state = tab.wait("document.documentElement.dataset.state", seconds=_PATIENCE_S)
    if state != "ready":
        raise RuntimeError(f"{address}: {state} {tab.messages}")
    last, now = "", _frame(tab)
    while now != last:
        time.sleep(_SETTLE_S)
        last, now = now, _frame(tab)
    with Image.open(io.BytesIO(base64.b64decode(last.split(",")[1]))) as picture:
        pixels = np.asarray(picture.convert("RGB")).copy()
    return torch.from_numpy(pixels).permute(2, 0, 1).float() / 255


def _frame(tab: Page) -> str:
    tab.value("window.draw()")
    return str(tab.value("document.querySelector('canvas').toDataURL('image/png')"))


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The folder's address on this machine."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()


def compare(scene: Scene, modules: Path, times: list[int], pictures: Path | None) -> None:
    """Print a line per program, file, way of drawing and size."""
    files = {"scene.ply": read_ply(scene.folder / "scene.ply"), "scene.spz": read_spz(scene.folder / "scene.spz")}
    print("PSNR against the photo, and against our own render of the scene, in dB")

    def report(program: str, file: str, compensated: bool, n: int, picture: Picture, more: str = "") -> None:
        ours = scene.ours(scene.gaussians, n)
        how = "compensating" if compensated else "classic"
        ahead = psnr(picture, scene.photo(n)) - psnr(ours, scene.photo(n))
        print(f"{program:10s} {file} {how:12s} x{n}: photo {psnr(picture, scene.photo(n)):.2f} ({ahead:+.2f})  "
              f"ours {psnr(picture, ours):.2f} {more}", flush=True)  # fmt: skip
        if pictures is not None:
            save_png(pictures / f"{program}_{file[-3:]}_{how}_{n}.png", picture)

    with_gsplat = importlib.util.find_spec("gsplat") is not None
    if not with_gsplat:
        print("gsplat is not installed: left out")
    for n in times:
        print(f"ours, x{n}: photo {psnr(scene.ours(scene.gaussians, n), scene.photo(n)):.2f}", flush=True)
        for file, gaussians in files.items() if with_gsplat else ():
            for compensated in (True, False):
                picture, through = scene.gsplat(gaussians, n, compensated=compensated)
                report("gsplat", file, compensated, n, picture, f"open {100 * through:.1f} %")
    os.environ.setdefault("EGL_PLATFORM", "surfaceless")  # Mesa's, where there is no screen
    (scene.folder / "node_modules").symlink_to(modules.resolve(), target_is_directory=True)
    for name, script in VIEWERS.items():
        (scene.folder / f"{name}.html").write_text(_HEAD + script, encoding="utf-8")
    with served(scene.folder) as address, browser_page(scene.folder / "profile", _PATIENCE_S, _GRAPHICS) as tab:
        for name in VIEWERS:
            for file in files if name in READS_SPZ else ("scene.ply",):
                for compensated in (True, False):
                    for n in times:
                        height, width = scene.size(n)
                        facts = {
                            "camera": json.dumps(scene.camera(n, file)),
                            "file": file,
                            "compensated": int(compensated),
                        }
                        shown = drawn_by(tab, f"{address}/{name}.html?{urlencode(facts)}", width, height)
                        report(name, file, compensated, n, shown)


@entry_point
def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reconstruction", type=Path)
    parser.add_argument("views", type=Path)
    parser.add_argument("--modules", type=Path, required=True, help="node_modules with the two viewers")
    parser.add_argument("--view", type=int, default=0, help="number of the captured view")
    parser.add_argument("--times", type=int, nargs="+", default=[2, 4], help="of the stored size")
    parser.add_argument("--pictures", type=Path, help="folder for what the programs drew")
    options = parser.parse_intermixed_args()
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp())
    try:
        scene = Scene(Reconstruction.load(options.reconstruction), ViewSet.load(options.views), options.view, folder)
        compare(scene, options.modules, options.times, options.pictures)
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
