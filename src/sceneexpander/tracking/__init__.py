"""Runs recorded in MLflow, mirrored from files that the pipeline wrote."""

from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.mirror import scene_runs, variant_name
from sceneexpander.tracking.record import RunRecord, run_key
from sceneexpander.tracking.store import record_runs

__all__ = ["RunRecord", "TrackingConfig", "record_runs", "run_key", "scene_runs", "variant_name"]
