"""The live viewer: reconstructions of one place in the browser, served to this machine only."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.errors import UserError
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.viewer.cameras import ShownCameras, alignment, frustum_length, up_direction
from sceneexpander.viewer.gate import check_authority, gate
from sceneexpander.viewer.packed import visible_weight
from sceneexpander.viewer.viser_axes import enlargement, viser_camera, viser_picture, viser_splats, widen_gaussians

HOST = "127.0.0.1"  # never another: the server has no accounts
CAPTURED_COLOUR = (98, 188, 195)
GENERATED_COLOUR = (255, 155, 82)
_BRAND_COLOUR = (200, 86, 10)
_COMPARE = "Before / after"
_INSIDE = 1.2  # lengths of a frustum within which its camera is not drawn: its picture would hide what one came to see


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveMethod:
    """One method, ready to show: Gaussians by falling visibility, and the way into the common frame."""

    name: str
    gaussians: Gaussians
    cameras: ShownCameras  # in the frame that is shown: the common one, enlarged
    shown_from_method: Similarity

    @classmethod
    def of(cls, reconstruction: Reconstruction, main: ShownCameras, *, factor: float, limit: int) -> LiveMethod:
        """Order, align, enlarge by ``factor``. The weights are only computed where something must be left out."""
        gaussians, cameras = reconstruction.gaussians, ShownCameras.of(reconstruction)
        if len(gaussians) > limit:
            weight = visible_weight(reconstruction)
            gaussians = gaussians.select(torch.argsort(weight, descending=True, stable=True)[:limit])
        gaussians = widen_gaussians(gaussians, cameras)
        transform = alignment(cameras, main).enlarged(factor)
        return cls(
            name=reconstruction.method,
            gaussians=gaussians,
            cameras=cameras.transformed(transform),
            shown_from_method=transform,
        )


@dataclass(slots=True, kw_only=True)
class _Shown:
    """What the controls ask for."""

    method: str
    before: str | None  # what the comparison goes back to
    tint: bool = False
    frusta: bool = True
    opacity: float = 1.0
    eye: tuple[float, float, float]  # where the person stands, common frame
    splats: dict[str, Any] = field(default_factory=dict)  # handles by method
    frames: dict[str, list[Any]] = field(default_factory=dict)


class LiveViewer:
    """A running viser server. `port` is where it really listens.

    Args:
        reconstructions: of one round; the last one is shown first, and all are brought into its frame.
        pictures: by view id, for the frusta.
        title: name in the browser's tab.
        port: to listen on; the next free one is taken if it is in use.
        limit: Gaussians to show per method at most, the most visible ones.
        hosts: names (``NAME`` or ``NAME:PORT``) it answers to besides the loopback ones with its own port, for tunnels and proxies.

    Raises:
        UserError: viser is not installed, or something among ``hosts`` is no such name.
    """

    def __init__(
        self,
        reconstructions: Sequence[Reconstruction],
        pictures: Mapping[str, Float[Tensor, "3 height width"]],
        *,
        title: str,
        port: int = 8080,
        limit: int,
        hosts: Sequence[str] = (),
    ) -> None:
        if not reconstructions:
            raise ValueError("nothing to show")
        try:
            import viser
        except ImportError:
            raise UserError("viser is not installed", where="viewer", fix="pip install -e .[viewer]") from None
        common, factor = ShownCameras.of(reconstructions[-1]), enlargement(reconstructions[-1].gaussians)
        self._methods = {
            item.method: LiveMethod.of(item, common, factor=factor, limit=limit) for item in reconstructions
        }
        names = list(self._methods)
        main = self._methods[names[-1]].cameras
        self._shown = _Shown(
            method=names[-1], before=names[-2] if len(names) > 1 else None, eye=viser_camera(main, 0).position
        )
        self._totals = {item.method: len(item.gaussians) for item in reconstructions}
        with gate([check_authority(host) for host in hosts]):
            self._server: Any = viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
        self._length = frustum_length(main)
        # The share button would open a tunnel to a server elsewhere.
        self._server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=_BRAND_COLOUR
        )
        scene = self._server.scene
        scene.set_up_direction(tuple(up_direction(main).tolist()))
        scene.world_axes.visible = False
        for method in self._methods.values():
            self._add_method(method, pictures)
        self._add_controls()
        self._place_camera()
        self._server.on_client_connect(lambda client: client.camera.on_update(self._follow))
        self._refresh()

    @property
    def port(self) -> int:
        """Where the server listens."""
        return int(self._server.get_port())

    def cameras(self, method: str) -> ShownCameras:
        """Cameras of a method in the frame that is shown."""
        return self._methods[method].cameras

    def show_cameras(self, shown: bool) -> None:
        """Draw the frusta or not."""
        self._shown.frusta = shown
        self._refresh_frames()

    def wait_for_client(self, seconds: float) -> Any:
        """The first browser that is connected.

        Raises:
            TimeoutError: none came in time.
        """
        deadline = time.monotonic() + seconds
        while not (clients := self._server.get_clients()):
            if time.monotonic() > deadline:
                raise TimeoutError(f"no browser connected within {seconds} s")
            time.sleep(0.1)
        return next(iter(clients.values()))

    def serve(self) -> None:
        """Wait until interrupted."""
        self._server.sleep_forever()

    def stop(self) -> None:
        """End the server."""
        self._server.stop()

    def _add_method(self, method: LiveMethod, pictures: Mapping[str, Tensor]) -> None:
        scene, cameras = self._server.scene, method.cameras
        splats = viser_splats(method.gaussians, method.shown_from_method)
        self._shown.splats[method.name] = scene.add_gaussian_splats(
            f"/{method.name}/splats", splats.centers, splats.covariances, splats.rgbs, splats.opacities, visible=False
        )
        frames = self._shown.frames.setdefault(method.name, [])
        for index, view in enumerate(cameras.view_ids):
            if not bool(cameras.posed[index]):
                continue
            camera = viser_camera(cameras, index)
            handle = scene.add_camera_frustum(
                f"/{method.name}/cameras/{view}",
                fov=camera.fov,
                aspect=camera.aspect,
                scale=self._length,
                thickness=1.5,
                thickness_units="screen",
                color=GENERATED_COLOUR if bool(cameras.generated[index]) else CAPTURED_COLOUR,
                image=viser_picture(pictures[view]) if view in pictures else None,
                wxyz=camera.wxyz,
                position=camera.position,
                visible=False,
            )
            handle.on_click(lambda event, camera=camera: self._stand(event.client, camera))
            frames.append(handle)

    def _add_controls(self) -> None:
        gui, shown = self._server.gui, self._shown
        self._picker = gui.add_dropdown("Method", tuple(self._methods), initial_value=shown.method)
        compare = gui.add_button(_COMPARE, visible=shown.before is not None)
        tint = gui.add_checkbox("Generated parts orange", initial_value=shown.tint)
        frusta = gui.add_checkbox("Cameras", initial_value=shown.frusta)
        opacity = gui.add_slider("Opacity", min=0.1, max=1.0, step=0.05, initial_value=1.0)
        self._note = gui.add_markdown("")

        def pick(_: object) -> None:
            if self._picker.value != shown.method:
                shown.before, shown.method = shown.method, self._picker.value
                self._refresh()

        def go_back(_: object) -> None:
            self._picker.value = shown.before

        def colour(_: object) -> None:
            shown.tint, shown.opacity = tint.value, opacity.value
            self._recolour()

        self._picker.on_update(pick)
        compare.on_click(go_back)
        tint.on_update(colour)
        opacity.on_update(colour)
        frusta.on_update(lambda _: self.show_cameras(frusta.value))

    def _place_camera(self) -> None:
        main = self._methods[self._shown.method].cameras
        camera, initial = viser_camera(main, 0), self._server.initial_camera
        initial.position, initial.look_at, initial.fov = camera.position, camera.look_at, camera.fov
        initial.up = tuple(up_direction(main).tolist())
        initial.near = 0.01

    def _stand(self, client: Any, camera: Any) -> None:
        """Bring a person's camera to where a photo was taken."""
        with client.atomic():
            client.camera.wxyz, client.camera.position = camera.wxyz, camera.position
            client.camera.look_at, client.camera.fov = camera.look_at, camera.fov

    def _refresh(self) -> None:
        shown = self._shown
        with self._server.atomic():
            for name, handle in shown.splats.items():
                handle.visible = name == shown.method
        self._refresh_frames()
        method = self._methods[shown.method]
        total = self._totals[shown.method]
        self._note.content = (
            f"{len(method.gaussians):,} of {total:,} Gaussians, the most visible ones; colours do not change with direction. "
            "Not drawn: what is narrower than about half a pixel of this window.\n\n"
            "Frames: photos blue-green, the generated picture orange. Click one to stand there."
        )

    def _follow(self, camera: Any) -> None:
        """A person moved."""
        x, y, z = (float(value) for value in camera.position)
        self._shown.eye = (x, y, z)
        self._refresh_frames()

    def _refresh_frames(self) -> None:
        shown = self._shown
        for name, frames in shown.frames.items():
            for frame in frames:
                away = math.dist(tuple(frame.position), shown.eye)
                visible = shown.frusta and name == shown.method and away > _INSIDE * self._length
                if frame.visible != visible:
                    frame.visible = visible

    def _recolour(self) -> None:
        shown = self._shown
        for name, handle in shown.splats.items():
            method = self._methods[name]
            splats = viser_splats(method.gaussians, method.shown_from_method, tint=shown.tint, opacity=shown.opacity)
            handle.rgbs, handle.opacities = splats.rgbs, splats.opacities
