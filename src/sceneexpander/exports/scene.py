"""A finished scene, read from what the pipeline left, and the parts of it that one can ask for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import Scene
from sceneexpander.artifacts.store import FACTS_NAME, ArtifactError
from sceneexpander.artifacts.unavailable import unavailable_in
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.exports.statement import GeneratedView, Statement
from sceneexpander.geometry.camera import camera_vector_from_pose, resize_intrinsics
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.rigid import quat_wxyz_from_rotation, rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.splatting.torch_backend import sh_basis
from sceneexpander.viewer.packed import visible_weight

Part = Literal["all", "generated", "captured"]
PARTS: tuple[Part, ...] = ("all", "generated", "captured")
Box = tuple[float, float, float, float, float, float]
_SH_DIRECTIONS = 64  # more than the 16 coefficients need


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportView:
    """A view with a camera: what cameras' formats hold. Pixels are those of ``picture``."""

    view_id: str
    name: str  # of the original file
    generated: bool
    picture: Path  # PNG, as the pipeline keeps it
    height: int
    width: int
    world_from_cam: Float[Tensor, "4 4"]  # float64
    intrinsics_px: Float[Tensor, "3 3"]  # float64


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportScene:
    """What is exported, all of it in one frame: Gaussians, cameras and depths.

    ``images`` are the views' pictures at the size of the reconstruction's maps, in its order.
    """

    reconstruction: Reconstruction
    views: tuple[ExportView, ...]  # those with a camera, in the reconstruction's order
    images: Float[Tensor, "view 3 height width"]
    statement: Statement


@dataclass(frozen=True, slots=True, kw_only=True)
class Crop:
    """What of a scene is wanted.

    Attributes:
        part: everything, or only what comes from generated or from captured views.
        box: corners (least x y z, greatest x y z) in the export's frame; None: everywhere.
        keep_confident: share of Gaussians kept, those whose depth the reconstruction is surest of.
        most: number of Gaussians at most; those that are seen least go first. None: no limit.
    """

    part: Part = "all"
    box: Box | None = None
    keep_confident: float = 1.0
    most: int | None = None


def load_scene(folder: Path, number: int, method: str) -> ExportScene:
    """Read a round's reconstruction by one method, in the world of the capture where that is known, else in the scene's own frame.

    Args:
        folder: what the pipeline made of one scene, ``outputs/<scene>``.
        number: of the round; 0 is the captured scene, which ``sceneexpander`` alone has.
        method: whose reconstruction.

    Raises:
        UserError: nothing was made there yet, or not this round or method; names what there is.
    """
    if not (folder / "scene" / FACTS_NAME).is_file():
        raise UserError("holds no finished scene", where=folder, fix="name outputs/SCENE, or run the pipeline first")
    rounds = sorted(int(p.name[6:]) for p in folder.glob("round_*") if p.name[6:].isdecimal())
    base = folder / f"round_{number}"
    made = sorted(p.parent.parent.name for p in base.glob(f"*/reconstruction/{FACTS_NAME}"))
    if not made:
        known = ", ".join(map(str, rounds)) or "none"
        raise UserError(f"has no round {number}", where=folder, fix=f"there are rounds {known}")
    if method not in made:
        raise UserError(f"has no method {method!r}", where=base, fix=did_you_mean(method, made))
    lacking = unavailable_in(base / method / "reconstruction")
    if lacking is not None:
        raise UserError(f"{method} {lacking.reason}", where=base, fix=f"there are {', '.join(made)}")
    reconstruction = Reconstruction.load(base / method / "reconstruction")
    captured = Scene.load(folder / "scene")
    places, how = _pictures(captured, folder, number)
    missing = [view for view in reconstruction.view_ids if view not in places]
    if missing:
        raise ArtifactError(f"no picture of view {missing[0]}", where=folder, fix="rerun the pipeline")
    images = torch.stack([places[view][2] for view in reconstruction.view_ids])
    posed = reconstruction.posed.tolist()
    views = tuple(
        _view(reconstruction, index, *places[view][:2])
        for index, view in enumerate(reconstruction.view_ids)
        if posed[index]
    )
    statement = Statement(
        scene=captured.name,
        round=number,
        method=method,
        part="all",
        gaussians=len(reconstruction.gaussians),
        generated_gaussians=int(reconstruction.gaussians.generated.sum()),
        generated_views=tuple(how[view] for view in reconstruction.view_ids if view in how),
        unposed_views=tuple(v for v, known in zip(reconstruction.view_ids, posed, strict=True) if not known),
    )
    scene = ExportScene(reconstruction=reconstruction, views=views, images=images, statement=statement)
    given = captured.known
    if given is None:
        return scene
    capture_from_scene = given.similarity_from(reconstruction.world_from_cam, reconstruction.posed)
    return scene if capture_from_scene is None else place_scene(scene, capture_from_scene, metric=given.metric)


_Pictures = dict[str, tuple[ViewRecord, Path, Tensor]]


def _pictures(scene: Scene, folder: Path, number: int) -> tuple[_Pictures, dict[str, GeneratedView]]:
    """(record, folder and stored picture of every view, what is known about the generated ones)."""
    places = _places(scene.views, folder / "scene" / "views")
    how: dict[str, GeneratedView] = {}
    for earlier in range(1, number + 1):
        place = folder / f"round_{earlier}" / "inserted"
        if not place.is_dir():
            continue
        inserted = InsertedView.load(place)
        places |= _places(inserted.view, place / "view")
        [record] = inserted.view.records
        how[record.view_id] = GeneratedView(
            view=record.view_id,
            round=earlier,
            sha256=record.sha256,
            provenance=inserted.provenance[inserted.chosen],
        )
    return places, how


def _places(views: ViewSet, folder: Path) -> _Pictures:
    finest = "images" if views.photos is None else "photos"
    return {
        record.view_id: (record, folder / finest / f"{record.view_id}.png", image)
        for record, image in zip(views.records, views.images, strict=True)
    }


def _view(made: Reconstruction, index: int, record: ViewRecord, picture: Path) -> ExportView:
    with Image.open(picture) as opened:
        width, height = opened.size
    stored_height, stored_width = made.depth.shape[1:]
    intrinsics = made.intrinsics_px[index].double()
    return ExportView(
        view_id=record.view_id,
        name=record.name,
        generated=bool(made.generated[index]),
        picture=picture,
        height=height,
        width=width,
        world_from_cam=made.world_from_cam[index].double(),
        intrinsics_px=resize_intrinsics(intrinsics[None], width / stored_width, height / stored_height)[0],
    )


def place_scene(scene: ExportScene, world_from_scene: Similarity, *, metric: bool = False) -> ExportScene:
    """The scene in another frame: Gaussians, cameras and depths alike. ``metric``: that frame's lengths are metres."""
    exact = Similarity(
        scale=world_from_scene.scale,
        rotation=world_from_scene.rotation.double(),
        translation=world_from_scene.translation.double(),
    )
    made = scene.reconstruction
    poses = exact.poses(made.world_from_cam.double())
    height, width = made.depth.shape[1:]
    moved = replace(
        made,
        world_from_cam=poses.to(made.world_from_cam),
        camera_vector=camera_vector_from_pose(poses, made.intrinsics_px.double(), height, width).to(made.camera_vector),
        depth=made.depth * exact.scale,
        gaussians=_place_gaussians(made.gaussians, exact),
    )
    views = tuple(replace(view, world_from_cam=exact.poses(view.world_from_cam)) for view in scene.views)
    return replace(scene, reconstruction=moved, views=views, statement=replace(scene.statement, metric=metric))


def _place_gaussians(scene: Gaussians, to: Similarity) -> Gaussians:
    rotations = to.rotation @ rotation_from_quat_wxyz(scene.quat_wxyz.double())
    # Harmonics of a turned scene: whatever they are, in every direction they must say what the old ones said in the direction before.
    generator = torch.Generator().manual_seed(0)
    after = torch.nn.functional.normalize(
        torch.randn(_SH_DIRECTIONS, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    count = scene.sh.shape[1]
    turn = torch.linalg.lstsq(sh_basis(after, count), sh_basis(after @ to.rotation, count)).solution
    return replace(
        scene,
        means=to.points(scene.means.double()).to(scene.means),
        quat_wxyz=quat_wxyz_from_rotation(rotations).to(scene.quat_wxyz),
        scales=scene.scales * to.scale,
        sh=torch.einsum("ij,gjc->gic", turn, scene.sh.double()).to(scene.sh),
    )


def crop_scene(scene: ExportScene, crop: Crop) -> ExportScene:
    """The scene with only the Gaussians that are wanted; cameras, pictures and depths stay.

    Raises:
        UserError: nothing is left.
    """
    made = scene.reconstruction
    gaussians = made.gaussians
    if crop.part != "all":
        gaussians = gaussians.select(gaussians.generated == (crop.part == "generated"))
    if crop.box is not None:
        low, high = gaussians.means.new_tensor(crop.box).view(2, 3)
        gaussians = gaussians.select(((gaussians.means >= low) & (gaussians.means <= high)).all(-1))
    if crop.keep_confident < 1 and len(gaussians):
        gaussians = gaussians.select(
            _heaviest(_confidence(gaussians, made), round(crop.keep_confident * len(gaussians)))
        )
    if crop.most is not None and len(gaussians) > crop.most:
        weight = visible_weight(replace(made, gaussians=gaussians))
        gaussians = gaussians.select(_heaviest(weight, crop.most))
    if not len(gaussians):
        raise UserError("no Gaussian is left", where=f"{scene.statement.scene}: part {crop.part}", fix="crop less")
    statement = replace(
        scene.statement,
        part=crop.part,
        gaussians=len(gaussians),
        generated_gaussians=int(gaussians.generated.sum()),
    )
    return replace(scene, reconstruction=replace(made, gaussians=gaussians, counts=None), statement=statement)


def _heaviest(weight: Float[Tensor, "gaussian"], count: int) -> Tensor:
    """Indices of the largest weights, in the Gaussians' order."""
    return weight.argsort(descending=True, stable=True)[: max(count, 1)].sort().values


def _confidence(gaussians: Gaussians, made: Reconstruction) -> Float[Tensor, "gaussian"]:
    """What the reconstruction's depth confidence is where a Gaussian lies: in its own view, or where that is not known in the best one."""
    there, place = made.cameras.look_up(gaussians.means, made.depth_conf[:, None])
    found = there[:, 0].where(place.in_frame, made.depth_conf.new_zeros(()))
    own = found.gather(0, gaussians.source_view.clamp(min=0)[None])[0]
    return torch.where(gaussians.source_view >= 0, own, found.amax(0))
