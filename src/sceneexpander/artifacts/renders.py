"""What a method's scene looks like: videos of one tour, some of its frames, and every view seen again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.store import ArtifactError, check_inside, load_artifact, load_fields, save_artifact
from sceneexpander.geometry.cameras import Cameras

SCHEMA = "renders/1"
_TENSORS = ("world_from_cam", "intrinsics_px")


@dataclass(frozen=True, slots=True, kw_only=True)
class Renders:
    """File names are relative to the artefact's folder.

    Attributes:
        method: whose scene it is.
        frames: frames of each video.
        fps: frames per second.
        height: rows of a video frame.
        width: columns of a video frame.
        videos: MP4 by layer (``rgb``, ``depth``, ``provenance``: generated parts tinted).
        stills: (frame index, picture by layer) of some frames.
        views: (view id, picture) of every view rendered at its own camera, in stored size.
        inserted_frame: the frame at which the tour stands at the inserted camera.
        inserted_camera: where that camera comes from: the method's own, or another method's after alignment.
        gaussians: number of Gaussians.
        scene: the Gaussians as a standard PLY.
        world_from_cam: the tour, in the frame of the method's reconstruction.
        intrinsics_px: of the video frames.
    """

    method: str
    frames: int
    fps: int
    height: int
    width: int
    videos: dict[str, str]
    stills: tuple[tuple[int, dict[str, str]], ...]
    views: tuple[tuple[str, str], ...]
    inserted_frame: int
    inserted_camera: str
    gaussians: int
    scene: str
    world_from_cam: Float[Tensor, "frame 4 4"]
    intrinsics_px: Float[Tensor, "frame 3 3"]

    @property
    def cameras(self) -> Cameras:
        """The tour."""
        return Cameras(self.world_from_cam, self.intrinsics_px, self.height, self.width)

    def save(self, folder: Path) -> None:
        """Write the facts beside the files. Raises `ArtifactError` if one of them is missing."""
        self._check(folder)
        facts = {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in _TENSORS}
        save_artifact(folder, SCHEMA, facts, {name: getattr(self, name) for name in _TENSORS})

    @classmethod
    def load(cls, folder: Path) -> Renders:
        """Read what `save` wrote. Raises `ArtifactError` if it or one of its files is missing or damaged."""
        facts, tensors = load_artifact(folder, SCHEMA)
        renders = cls(**load_fields(cls, facts, tensors, folder))
        renders._check(folder)
        return renders

    def _check(self, folder: Path) -> None:
        stills = [name for _, pictures in self.stills for name in pictures.values()]
        for name in (*self.videos.values(), *stills, *(name for _, name in self.views), self.scene):
            check_inside(name, folder)
            if not (folder / name).is_file():
                raise ArtifactError("is missing", where=folder / name, fix="rerun the render stage")
