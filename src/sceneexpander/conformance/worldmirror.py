"""WorldMirror cases: whole models, preprocessing, training losses."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from sceneexpander.conformance.registry import CaseRunner, KeyFamily, has_config, read_config
from sceneexpander.conformance.sizes import backbone_sizes
from sceneexpander.conformance.worldmirror_trace import Trace
from sceneexpander.errors import UserError
from sceneexpander.geometry.checks import OutputCheck, compare_tensors
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.models.layers.dpt import DptConfig
from sceneexpander.models.preprocess import load_images
from sceneexpander.models.protocol import Head
from sceneexpander.models.weights import load_weights, read_tensors
from sceneexpander.models.worldmirror.config import GaussianConfig, WorldMirrorConfig
from sceneexpander.models.worldmirror.gaussians import PixelGaussians
from sceneexpander.models.worldmirror.merge import merge_voxels
from sceneexpander.models.worldmirror.model import BatchPrediction, GaussianOutput, WorldMirror
from sceneexpander.models.worldmirror.novel_view import predict_novel_views
from sceneexpander.models.worldmirror.priors import BatchPriors

ATOL, RTOL = 2e-5, 2e-4  # recommended by the fixtures; float32 noise is at most 0.14 of it
LOSS_RTOL = 1e-5
PIXEL = 1 / 255  # one grey level: what another Pillow version may change

SWITCHES = {
    "enable_pts": Head.POINTS,
    "enable_depth": Head.DEPTH,
    "enable_norm": Head.NORMALS,
    "enable_gs": Head.GAUSSIANS,
}


def config_from_case(case: dict[str, Any]) -> WorldMirrorConfig:
    """Our configuration from the constructor arguments that a case records."""
    public, encoder, trunk, camera = case["model"], case["dino"], case["trunk"], case["camera_head"]
    dense, splat_dense, splats = case["dpt_heads"], case["gs_head"], case["gs_renderer"]
    return WorldMirrorConfig(
        **backbone_sizes(public, encoder, trunk),
        collect=tuple(trunk["intermediate_idxs"]),
        prior_prompting=public["enable_cond"],
        camera_depth=camera["trunk_depth"],
        camera_heads=camera["num_heads"],
        camera_steps=camera["steps"],
        dpt=_dpt_config(dense),
        gaussian_dpt=_dpt_config(splat_dense),
        gaussian=GaussianConfig(
            hidden=splats["feature_dim"],
            max_scale=splats["scale_clamp_max"],
            merge=splats["enable_prune"],
            voxel_size=splats["voxel_size"],
        ),
        heads=frozenset({Head.CAMERA} | {head for switch, head in SWITCHES.items() if public[switch]}),
    )


def _dpt_config(section: dict[str, Any]) -> DptConfig:
    return DptConfig(
        features=section["features"], out_channels=tuple(section["out_channels"]), hidden=section["head_hidden"]
    )


def priors_from_case(inputs: dict[str, Tensor], flags: list[int]) -> BatchPriors | None:
    """The priors whose flag (pose, depth, intrinsics) is set and whose tensor is there."""
    names = ("camera_poses", "depthmap", "camera_intrs")
    pose, depth, intrinsics = (inputs.get(n) if flag else None for n, flag in zip(names, flags, strict=True))
    if pose is None and depth is None and intrinsics is None:
        return None
    return BatchPriors(world_from_cam=pose, depth=depth, intrinsics_px=intrinsics)


def run_model_case(path: Path) -> list[OutputCheck]:
    """Load the recorded weights strictly, run on the recorded inputs, compare every recorded tensor."""
    config, outputs = model_outputs(path)
    expected = read_tensors(path / "outputs.safetensors")
    checks = [_compare(name, outputs, expected[name]) for name in sorted(expected)]
    return checks + _merge_alone(config, expected)


def model_outputs(path: Path) -> tuple[WorldMirrorConfig, dict[str, Tensor]]:
    """Everything that a case can record, of this implementation."""
    case = read_config(path / "config.json")
    try:
        config = config_from_case(case)
        flags, is_inference = case["inputs"]["cond_flags"], case["is_inference"]
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"is not a complete configuration ({error})", where=path / "config.json") from None
    inputs = read_tensors(path / "inputs.safetensors")
    with torch.device("meta"):
        model = WorldMirror(config)
    load_weights(model, path / "weights.safetensors")
    priors = priors_from_case(inputs, flags)
    trace = Trace(model)
    with torch.inference_mode(), trace:
        if is_inference:
            outputs = _outputs(model(inputs["img"], priors))
        else:
            outputs = _novel_view_outputs(model, inputs, priors)
    return config, outputs | trace.tensors(inputs)


def _compare(name: str, outputs: dict[str, Tensor], expected: Tensor) -> OutputCheck:
    if name not in outputs:
        return OutputCheck(name=name, error=float("inf"), tolerance=1.0, detail="not computed by this implementation")
    return compare_tensors(name, outputs[name], expected, atol=ATOL, rtol=RTOL)


def _outputs(prediction: BatchPrediction) -> dict[str, Tensor]:
    """Predictions under their recorded names."""
    cameras = prediction.cameras
    named: dict[str, Tensor | None] = {
        "camera_params": cameras.vector,
        "camera_poses": cameras.world_from_cam,
        "camera_intrs": cameras.intrinsics_px,
        "depth": None if prediction.depth is None else prediction.depth[..., None],
        "depth_conf": prediction.depth_conf,
        "pts3d": prediction.points,
        "pts3d_conf": prediction.points_conf,
        "normals": prediction.normals,
        "normals_conf": prediction.normals_conf,
    }
    outputs = {name: value for name, value in named.items() if value is not None}
    return outputs if prediction.gaussians is None else outputs | _gaussian_outputs(prediction.gaussians)


def _gaussian_outputs(gaussians: GaussianOutput) -> dict[str, Tensor]:
    outputs = {"gs_depth": gaussians.depth[..., None], "gs_depth_conf": gaussians.conf}
    for name in ("means", "quats", "scales", "opacities", "sh", "residual_sh", "weights"):
        outputs[f"splats_dense.{name}"] = getattr(gaussians.pixels, name)
    for index, merged in enumerate(gaussians.merged):
        outputs |= _merged_outputs(merged, f"splats_merged.b{index}")
    return outputs


def _merged_outputs(merged: Gaussians, prefix: str) -> dict[str, Tensor]:
    return {
        f"{prefix}.means": merged.means,
        f"{prefix}.quats": merged.quat_wxyz,
        f"{prefix}.scales": merged.scales,
        f"{prefix}.opacities": merged.opacities,
        f"{prefix}.sh": merged.sh,
    }


def _novel_view_outputs(model: WorldMirror, inputs: dict[str, Tensor], priors: BatchPriors | None) -> dict[str, Tensor]:
    is_target = inputs["is_target"].bool() if "is_target" in inputs else None
    result = predict_novel_views(model, inputs["img"], is_target, priors)
    outputs = _outputs(result.prediction) | _gaussian_outputs(result.context)
    outputs["camera_poses"] = outputs["rendered_extrinsics"] = result.cameras.world_from_cam
    outputs["rendered_intrinsics"] = result.cameras.intrinsics_px
    outputs["valid_masks"] = result.valid
    return outputs


def _merge_alone(config: WorldMirrorConfig, expected: dict[str, Tensor]) -> list[OutputCheck]:
    """The voxel merge fed with the recorded per-pixel Gaussians: no discontinuity can hide an error of the merge itself."""
    names = ("means", "quats", "scales", "opacities", "sh", "residual_sh", "weights")
    if any(f"splats_dense.{name}" not in expected for name in names):
        return []
    pixels = PixelGaussians(**{name: expected[f"splats_dense.{name}"] for name in names})
    batch, count = pixels.weights.shape
    source, made = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.bool)
    checks = []
    for b in range(batch):
        merged = merge_voxels(pixels, b, voxel_size=config.gaussian.voxel_size, source_view=source, generated=made)
        for name, value in _merged_outputs(merged, f"splats_merged.b{b}").items():
            checks.append(compare_tensors(f"merge_alone.{name}", value, expected[name], atol=ATOL, rtol=RTOL))
    return checks


def run_preprocess_case(path: Path) -> list[OutputCheck]:
    """Image files to network input."""
    expected = read_tensors(path / "expected.safetensors")
    checks = []
    for case in read_config(path / "cases.json")["cases"]:
        files = [path / file for file in case["files"]]
        images = load_images(files, target=case["target_size"], strategy=case["resize_strategy"])
        checks.append(compare_tensors(case["name"], images[None], expected[case["name"]], atol=PIXEL, rtol=0.0))
    return checks


def run_losses_case(path: Path) -> list[OutputCheck]:
    """Training losses on fixed tensors."""
    from sceneexpander.conformance.worldmirror_losses import computed_losses, computed_targets

    tensors = read_tensors(path / "tensors.safetensors")
    recorded = read_config(path / "expected.json")["expected"]
    computed = computed_losses(tensors)
    checks = []
    for loss, terms in recorded.items():
        for term, value in terms.items():
            name = f"{loss}.{term}"
            if term not in computed.get(loss, {}):
                raise UserError(
                    f"names an unknown loss term {name}", where=path / "expected.json", fix="update the runner"
                )
            expected = torch.tensor(value, dtype=torch.float64)
            checks.append(compare_tensors(name, computed[loss][term], expected, atol=1e-12, rtol=LOSS_RTOL))
    for name, tensor in computed_targets(tensors).items():
        checks.append(compare_tensors(name, tensor, tensors[f"expect.{name}"], atol=ATOL, rtol=RTOL))
    return checks


def _is_worldmirror(config: dict[str, Any]) -> bool:
    sections = {"dino", "trunk", "camera_head", "dpt_heads", "gs_renderer"}
    return isinstance(config.get("model"), dict) and sections <= config.keys()


def _is_preprocess(config: dict[str, Any]) -> bool:
    cases = config.get("cases")
    return isinstance(cases, list) and all(isinstance(c, dict) and "resize_strategy" in c for c in cases)


def _is_losses(config: dict[str, Any]) -> bool:
    return isinstance(config.get("expected"), dict) and "render_mse_2ctx" in config["expected"]


def _config_test(test: Callable[[dict[str, Any]], bool], name: str) -> Callable[[Path], bool]:
    return lambda path: has_config(path, test, name)


def _is_released(names: Collection[str]) -> bool:
    return any(name.startswith("visual_geometry_transformer.") for name in names)


def _released() -> nn.Module:
    return WorldMirror(WorldMirrorConfig.large())


CASES = [
    CaseRunner(name="worldmirror", matches=_config_test(_is_worldmirror, "config.json"), run=run_model_case),
    CaseRunner(
        name="worldmirror preprocess", matches=_config_test(_is_preprocess, "cases.json"), run=run_preprocess_case
    ),
    CaseRunner(name="worldmirror losses", matches=_config_test(_is_losses, "expected.json"), run=run_losses_case),
]
KEYS = [KeyFamily(name="worldmirror", matches=_is_released, build=_released)]
