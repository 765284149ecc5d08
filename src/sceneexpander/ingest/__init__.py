"""From folders of photos to prepared scenes."""

from sceneexpander.ingest.config import Fit, IngestConfig
from sceneexpander.ingest.decode import Picture, decode_picture, read_picture
from sceneexpander.ingest.fit import FittedPicture, FrameSize, common_frame, fit_picture
from sceneexpander.ingest.held_out import choose_held_out, hold_out
from sceneexpander.ingest.listing import recorded_files, safe_name, scene_files
from sceneexpander.ingest.load import LoadedViews, load_photos, load_scene, read_views
from sceneexpander.ingest.scene_file import make_round
from sceneexpander.ingest.survey import Survey, list_pictures, survey_pictures

__all__ = [
    "Fit",
    "FittedPicture",
    "FrameSize",
    "IngestConfig",
    "LoadedViews",
    "Picture",
    "Survey",
    "choose_held_out",
    "common_frame",
    "decode_picture",
    "fit_picture",
    "hold_out",
    "list_pictures",
    "load_photos",
    "load_scene",
    "make_round",
    "read_picture",
    "read_views",
    "recorded_files",
    "safe_name",
    "scene_files",
    "survey_pictures",
]
