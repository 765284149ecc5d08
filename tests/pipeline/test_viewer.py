"""The viewers in a real browser: what it draws from a known camera is what our own rasteriser draws."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import save_png
from sceneexpander.geometry.camera import camera_vector_from_pose, unproject_to_world
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians, concatenate, sh_from_rgb
from sceneexpander.geometry.rigid import look_at, quat_wxyz_from_rotation
from sceneexpander.splatting import render
from sceneexpander.splatting.video import tint_generated, write_video
from sceneexpander.viewer.live import HOST, LiveViewer
from sceneexpander.viewer.packed import pack_splats
from sceneexpander.viewer.page import ShownMethod, viewer_page
from sceneexpander.viewer.viser_axes import viser_camera
from tests.support.browser import Page, browser_page
from tests.support.tiny_model import tiny_images

pytestmark = pytest.mark.pipeline

ROOT = Path(__file__).parents[2]
HEIGHT, WIDTH = SIZE = 96, 128
BACKGROUND = 0.08
READY = "document.documentElement.dataset.state === 'ready'"
REDRAWN = "Number(document.documentElement.dataset.drawn) >= 2"


def room(method: str, *, seed: int = 0, scale: float = 1.0) -> Reconstruction:
    """Four cameras on an arc, none level, before a bent wall; one Gaussian per pixel of each, thin along the viewing ray."""
    eyes = torch.tensor([[0.0, 0.0, 0.0], [0.5, -0.2, 0.1], [1.0, 0.1, 0.4], [1.6, -0.1, 0.9]])
    poses = look_at(eyes * scale, torch.tensor([0.4, 0.1, 3.0]) * scale, torch.tensor([0.1, -1.0, 0.05]))
    # The principal point is off the middle in a way that a wrong sign would show.
    lens = torch.tensor([[118.0, 0, 61.0], [0, 112.0, 50.0], [0, 0, 1]]).repeat(4, 1, 1)
    x, y = torch.arange(WIDTH)[None], torch.arange(HEIGHT)[:, None]
    # Fine stripes that differ between the views' surfaces: one pixel of shift must show.
    stripes = 0.25 * torch.sin(0.6 * x) * torch.sin(0.5 * y + seed)
    pictures = (0.7 * tiny_images(4, HEIGHT, WIDTH, seed=seed) + 0.15 + stripes).clamp(0, 1)
    wave = torch.linspace(0, 4 * math.pi, WIDTH).sin()[None, None] * 0.2
    depth = (3 + wave + torch.linspace(0.3, -0.3, HEIGHT)[None, :, None]).expand(4, HEIGHT, WIDTH) * scale
    means = unproject_to_world(depth, lens, poses)
    parts = []
    for view in range(4):
        count = HEIGHT * WIDTH
        size = (depth[view] / 118).reshape(count, 1) * torch.tensor([0.9, 0.6, 0.1])
        parts.append(
            Gaussians(
                means=means[view].reshape(count, 3),
                quat_wxyz=quat_wxyz_from_rotation(poses[view, :3, :3]).expand(count, 4),
                scales=size,
                opacities=torch.full((count,), 0.8),
                sh=sh_from_rgb(pictures[view].permute(1, 2, 0).reshape(count, 1, 3)),
                source_view=torch.full((count,), view),
                generated=torch.full((count,), view == 3),
            )
        )
    return Reconstruction(
        method=method,
        model="mini",
        weights_sha256="0" * 64,
        view_ids=("v0", "v1", "v2", "new"),
        generated=torch.tensor([False, False, False, True]),
        posed=torch.ones(4, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(poses, lens, HEIGHT, WIDTH),
        world_from_cam=poses,
        intrinsics_px=lens,
        depth=depth,
        depth_conf=torch.full_like(depth, 2.0),
        normals=torch.tensor([0.0, 0, -1]).expand(4, HEIGHT, WIDTH, 3).clone(),
        normals_conf=torch.full_like(depth, 2.0),
        gaussians=concatenate(parts),
    )


def compensated(scene: Reconstruction) -> Reconstruction:
    """The same scene for rasterisers that compensate opacities for the screen blur: another picture altogether."""
    return replace(scene, gaussians=replace(scene.gaussians, antialiased=True))


BEFORE, AFTER = room("backbone", seed=5, scale=1.3), compensated(room("sceneexpander"))


def ours(
    scene: Reconstruction, view: int, *, tinted: bool = False, lens: Tensor | None = None, size: tuple[int, int] = SIZE
) -> Tensor:
    seen = render(
        scene.gaussians,
        Cameras(
            scene.world_from_cam[view : view + 1],
            scene.intrinsics_px[view : view + 1] if lens is None else lens[None],
            *size,
        ),
        background=torch.full((3,), BACKGROUND),
    )
    rgb = seen.rgb[0].clamp(0, 1)
    return tint_generated(rgb, seen.generated[0] * seen.alpha[0]) if tinted else rgb


def psnr(first: Tensor, second: Tensor) -> float:
    return -10 * math.log10(float(((first - second) ** 2).mean()) + 1e-12)


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser_page(tmp_path_factory.mktemp("browser") / "profile") as page:
        yield page


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "viewer.html"
    shown = [ShownMethod(splats=pack_splats(item), label=item.method) for item in (BEFORE, AFTER)]
    pictures = dict(zip(AFTER.view_ids, tiny_images(4), strict=True))
    path.write_text(viewer_page("room", "A wall.", shown, pictures, background=BACKGROUND))
    return path


@pytest.mark.parametrize(
    ("scene", "view", "tinted"),
    [(AFTER, 0, False), (AFTER, 3, True), (BEFORE, 1, False)],
    ids=["first", "new", "before"],
)
def test_the_page_shows_what_we_render(tab: Page, html: Path, scene: Reconstruction, view: int, tinted: bool) -> None:
    wish = f"method={scene.method}&view={scene.view_ids[view]}&tint={int(tinted)}&frusta=0&bare=1"
    tab.open(f"file://{html}#{wish}", WIDTH, HEIGHT)
    tab.wait(f"{READY} && {REDRAWN}")
    shot, wanted = tab.screenshot(), ours(scene, view, tinted=tinted)
    other = ours(AFTER, (view + 1) % 4)
    # 8-bit packing and blending cost some grey levels: about 45 dB measured. A pixel of shift or another view does not come near.
    assert psnr(shot, wanted) > 35
    assert psnr(wanted.roll(1, 2), wanted) < 30
    assert psnr(shot, other) < 30


@pytest.mark.parametrize(("width", "height"), [(640, 400), (390, 844)], ids=["desk", "phone"])
def test_a_window_of_any_size_shows_the_whole_view(tab: Page, html: Path, width: int, height: int) -> None:
    tab.open(f"file://{html}#view=v0&frusta=0&bare=1", width, height)
    tab.wait(f"{READY} && {REDRAWN}")
    # The view fits: as large as the window allows, in its middle, and what lies beside it is drawn as well.
    scale = min(width / WIDTH, height / HEIGHT)
    lens = AFTER.intrinsics_px[0] * torch.tensor([scale, scale, 1.0])[:, None]
    lens[0, 2] += (width - scale * WIDTH) / 2
    lens[1, 2] += (height - scale * HEIGHT) / 2
    assert psnr(tab.screenshot(), ours(AFTER, 0, lens=lens, size=(height, width))) > 33


def test_the_page_asks_nobody_and_complains_about_nothing(tab: Page, html: Path, tmp_path: Path) -> None:
    tab.requested.clear()
    tab.messages.clear()
    tab.open(f"file://{html}", 480, 320)
    tab.wait(f"{READY} && {REDRAWN}")
    assert {address.partition(":")[0] for address in tab.requested} <= {"file", "data"}
    assert [address for address in tab.requested if address.startswith("file")] == [f"file://{html}"]
    whole = tab.screenshot()
    tab.value(
        "orbit(0.4, 0.2); approach(2.0); moved(); $('share').value = 0.5; $('share').dispatchEvent(new Event('input'))"
    )
    before = tab.value("Number(document.documentElement.dataset.drawn)")
    tab.wait(f"Number(document.documentElement.dataset.drawn) > {before}")
    assert psnr(whole, tab.screenshot()) < 40, "it moves"
    half, total = len(AFTER.gaussians) // 2, len(AFTER.gaussians)
    assert tab.value("$('count').textContent").startswith(f"{half:,} of {total:,} Gaussians; the {half:,} left out")
    tab.value("$('compare').click()")
    tab.wait("state.method.name === 'backbone'")
    assert tab.messages == []


def test_videos_play(tab: Page, tmp_path: Path) -> None:
    colours = torch.linspace(0.2, 0.9, 12)
    write_video((torch.full((3, 48, 64), float(c)) for c in colours), tmp_path / "tour.mp4", 24)
    page = tmp_path / "page.html"
    page.write_text("<body style='margin:0'><video muted src='tour.mp4' style='display:block'></video>")
    tab.open(f"file://{page}", 64, 48)
    video = "document.querySelector('video')"
    tab.wait(f"{video}.readyState >= 2 || {video}.error")
    assert tab.value(f"{video}.error && {video}.error.message") is None
    assert tab.value(f"[{video}.videoWidth, {video}.videoHeight]") == [64, 48]
    assert tab.value(f"{video}.duration") == pytest.approx(0.5, abs=0.05)
    tab.value(f"{video}.play()")
    tab.wait(f"{video}.ended")
    shown = float(tab.screenshot().mean())
    assert shown == pytest.approx(0.9, abs=0.03), "its last frame, in the colours that were given"


def test_the_live_viewer_shows_what_we_render(tab: Page, tmp_path: Path) -> None:
    # So small a scene has Gaussians whose covariances are zero as 16-bit floats, which is how viser sends them.
    small = room("sceneexpander", scale=0.02)
    central = replace(small, intrinsics_px=small.intrinsics_px.clone())  # viser's lenses have no other principal point
    central.intrinsics_px[:, 0, 2], central.intrinsics_px[:, 1, 2] = WIDTH / 2, HEIGHT / 2
    central.intrinsics_px[:, 0, 0] = central.intrinsics_px[:, 1, 1]  # and square pixels
    viewer = LiveViewer([BEFORE, central], {}, title="room", port=8765, limit=10**6)
    try:
        tab.requested.clear()
        tab.open(f"http://{HOST}:{viewer.port}/", WIDTH, HEIGHT)
        client = viewer.wait_for_client(300)
        viewer.show_cameras(False)
        camera = viser_camera(viewer.cameras("sceneexpander"), 1)
        # The browser draws when it gets to it: ask until the Gaussians have arrived.
        wanted, best, shot = ours(central, 1), 0.0, torch.zeros(3, HEIGHT, WIDTH)
        for _ in range(10):
            drawn = client.get_render(
                HEIGHT,
                WIDTH,
                wxyz=camera.wxyz,
                position=camera.position,
                fov=camera.fov,
                transport_format="png",
                timeout=300,
            )
            shot = torch.from_numpy(drawn[..., :3].copy()).permute(2, 0, 1).float() / 255
            best = psnr(shot, wanted)
            if best > 25:
                break
        save_png(tmp_path / "live.png", torch.cat([shot, wanted], 2))
        assert best > 25, tmp_path / "live.png"
        tab.value("1")  # reads what was noted meanwhile
        assert all(address.startswith((f"http://{HOST}:{viewer.port}", "blob:", "data:")) for address in tab.requested)
    finally:
        tab.call("Page.navigate", url="about:blank")
        viewer.stop()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["{tmp}/nowhere"], "nowhere: holds no scene; run `make repro` first"),
        (["{tmp}", "--limit", "0"], "--limit: must be at least 1"),
    ],
)
def test_nothing_to_show_is_one_line(tmp_path: Path, arguments: list[str], said: str) -> None:
    filled = [item.format(tmp=tmp_path) for item in arguments]
    done = subprocess.run(
        [sys.executable, "-m", "sceneexpander.viewer", *filled],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": "src"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.strip().count("\n") == 0
