"""Everything that can be wrong with the user's input, found before anything runs: an earlier result is then never replaced."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError
from sceneexpander.evaluation.image import WINDOW
from sceneexpander.evaluation.visual import check_lpips_weights
from sceneexpander.generation import Forecast, GenerationContext, check_round
from sceneexpander.inference.config import RivalsConfig
from sceneexpander.ingest import hold_out, load_scene
from sceneexpander.ingest.truth import check_truth
from sceneexpander.judge.ask import make_judge
from sceneexpander.models.weights import HUB_ID
from sceneexpander.pipeline.project import GENERATED_FOLDER, JUDGED_FOLDER, find_project
from sceneexpander.reconstruction.loaded import ModelConfig, load_model
from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.server import require_server, where_runs_go


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckedScene:
    """A scene that can run: how many rounds, and what obtaining their pictures would take."""

    rounds: int
    forecasts: tuple[Forecast, ...] = ()


@dataclass(slots=True)
class Checked:
    """What this command has looked at already, so that scenes and jobs that share it do not wait for it again."""

    weights: set[ModelConfig] = field(default_factory=set)
    pictures: dict[Hashable, CheckedScene] = field(default_factory=dict)
    stores: set[TrackingConfig] = field(default_factory=set)
    lpips: set[str] = field(default_factory=set)


CHECKED_SECTIONS = (
    "seed",
    "scene",
    "generator",
    "choose",
    "judge",
    "model",
    "rivals",
    "evaluate",
)  # of the configuration, beside the device


def check_scene(
    name: str,
    folder: Path,
    *,
    conf: Path,
    overrides: Sequence[str],
    rounds: int | None = None,
    round_overrides: Sequence[Sequence[str]] = (),
    methods: Sequence[str] = (),
    device: bool = True,
    store: bool = True,
    checked: Checked | None = None,
) -> CheckedScene:
    """Compose the configuration for a scene and read all of its pictures; nothing is written, and no request is sent.

    Args:
        name: of the scene; selects its own option in ``conf/scene`` if there is one.
        folder: the scene folder, with scene.yaml.
        conf: the configuration folder.
        overrides: Hydra overrides.
        rounds: how many rounds are to run; None: all that the scene defines.
        round_overrides: further ones of each round, as far as it has any.
        methods: that are to run; reconstructors of others among them that have no weights will say so in their rows.
        device: whether the device must be there; not on a machine that only hands jobs to others.
        store: whether MLflow's server must be there, if runs go to one; not for a job that waited long: recording is made up for later.
        checked: of the same command's earlier calls; weights are loaded and pictures decoded once.

    Raises:
        UserError: one line about the first problem found.
    """
    common = [f"scene={scene_option(conf, name)}", *overrides]
    config = parse_dataclass(ProjectConfig, compose(conf, common))
    own = {
        number: parse_dataclass(ProjectConfig, compose(conf, [*common, *more]))
        for number, more in enumerate(round_overrides, start=1)
        if more
    }
    if device:
        check_device(config.device)
    judge = make_judge(config.judge, find_project() / JUDGED_FOLDER)
    if judge is not None:
        judge.require()
    checked = Checked() if checked is None else checked
    tracking = where_runs_go(config.tracking, os.environ)
    if store and tracking not in checked.stores:
        require_server(tracking)
        checked.stores.add(tracking)
    obtained = tuple((number, repr(item.generator), item.choose) for number, item in {0: config, **own}.items())
    pictures = folder, config.scene, config.evaluate.hold_out, obtained, rounds
    if pictures not in checked.pictures:
        checked.pictures[pictures] = _check_pictures(name, folder, config, own, rounds)
    needed = [config.model]
    for rival in (f.name for f in fields(RivalsConfig) if f.name in methods):
        section = config.rivals.of(rival)
        if section.weights is not None:
            needed.append(
                ModelConfig(
                    name=rival,
                    variant=section.variant,
                    weights=section.weights,
                    allow_download=section.allow_download,
                )
            )
    for model in needed:
        if model not in checked.weights:
            check_weights(model)
            checked.weights.add(model)
    lpips = config.evaluate.lpips_weights
    if lpips is not None and lpips not in checked.lpips:
        check_lpips_weights(Path(lpips))
        checked.lpips.add(lpips)
    return checked.pictures[pictures]


def _check_pictures(
    name: str, folder: Path, config: ProjectConfig, own: Mapping[int, ProjectConfig], rounds: int | None
) -> CheckedScene:
    """Read the photos, the pictures to insert that are there already, and what is known of the truth. ``own``: of rounds that have one."""
    whole = load_scene(folder, config.scene)
    # As the stages see it: what is asked of a service must be the same here.
    scene, _ = hold_out(whole, config.evaluate.hold_out)
    if min(scene.views.height, scene.views.width) < WINDOW:
        size = f"{scene.views.width} x {scene.views.height}"
        raise UserError(
            f"makes pictures of {size} pixels, fewer than {WINDOW} x {WINDOW}",
            where="scene.long_side_px",
            fix="raise it, or use photos that are less narrow",
        )
    count = len(scene.rounds) if rounds is None else rounds
    records, forecasts = [*whole.views.records], []
    for number in range(1, count + 1):
        context = GenerationContext(
            scene_folder=folder,
            scene=name,
            round_number=number,
            spec=scene.round_spec(number),
            captured=scene.views,
            cache=find_project() / GENERATED_FOLDER,
        )
        of_round = own.get(number, config)
        forecast, inserted = check_round(context, of_round.generator, of_round.choose)
        forecasts.append(forecast)
        if inserted is not None:
            records += inserted.view.records
    check_truth(folder, records)  # read by the last stages only, so a mistake in it would cost the whole run
    return CheckedScene(rounds=count, forecasts=tuple(forecasts))


def check_device(device: str) -> None:
    """Raise `UserError` if the device is not there."""
    import torch

    if not device.startswith("cuda"):
        return
    if not torch.cuda.is_available():
        raise UserError(f"is {device!r}, but no CUDA device is available", where="device", fix="use device=cpu")
    count, index = torch.cuda.device_count(), int(device.partition(":")[2] or 0)
    if index >= count:
        names = "cuda:0 is the only one" if count == 1 else f"there are cuda:0 to cuda:{count - 1}"
        raise UserError(f"is {device!r}, which is not there", where="device", fix=names)


def check_weights(config: ModelConfig) -> None:
    """Load the weights once, so that a file that is missing or does not fit is refused here.

    Weights that may be downloaded from a hub are left to the stage that does it; others must be in its local cache.
    """
    if config.allow_download and HUB_ID.fullmatch(config.weights):
        if importlib.util.find_spec("huggingface_hub") is None:
            raise UserError("names a hub, but huggingface-hub is not installed", where="model.weights")
        return
    load_model(config, "cpu")
