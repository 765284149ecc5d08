"""OmniVGGT cases: whole models with every kind of prior, preprocessing."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor, nn

from sceneexpander.conformance.recorder import Recorder
from sceneexpander.conformance.registry import CaseRunner, KeyFamily, has_config, read_config
from sceneexpander.conformance.sizes import backbone_sizes
from sceneexpander.errors import UserError
from sceneexpander.geometry.checks import OutputCheck, compare_tensors
from sceneexpander.geometry.rigid import rigid_from_parts, rigid_inverse
from sceneexpander.models.layers.dpt import DptConfig
from sceneexpander.models.omnivggt.config import OmniVGGTConfig
from sceneexpander.models.omnivggt.model import BatchPrediction, OmniVGGT
from sceneexpander.models.omnivggt.preprocess import PreparedViews, ViewCamera, prepare_views
from sceneexpander.models.omnivggt.priors import BatchPriors, encode_priors
from sceneexpander.models.weights import load_weights, read_tensors
from sceneexpander.models.worldmirror.gaussians import unproject_integer_pixels

# Recommended by the fixtures for |a - b| / (1 + |b|); float32 noise is at most 1e-5 (3e-5 for points from depth).
TOLERANCE, POINTS_TOLERANCE, CAMERA_TOLERANCE = 1e-4, 2e-4, 1e-6
POINTS_FROM_DEPTH = "world_points_from_depth"


class Trace(Recorder):
    """Records the intermediate tensors under their recorded names.

    Args:
        model: the model to observe.
    """

    def __init__(self, model: OmniVGGT) -> None:
        super().__init__()
        self.model = model

    def observe(self) -> None:
        """Attach to encoder, trunk and depth head."""
        trunk, head = self.model.aggregator, self.model.depth_head
        self.output(trunk.patch_embed, "inter.dino_patch_tokens")
        self.input(trunk.frame_blocks[0], "inter.tokens_in")
        self.output(head.get_submodule("scratch.output_conv1"), "inter.depth_head_fused")
        self.hook(trunk, self._layers)

    def _layers(self, _module: nn.Module, _inputs: tuple[Any, ...], output: Any) -> None:
        self.record("inter.agg_layer_first", output.collected[0])
        self.record("inter.agg_layer_last", output.collected[-1])


def config_from_case(case: dict[str, Any]) -> OmniVGGTConfig:
    """Our configuration from the constructor arguments that a case records."""
    public = case["model_config"]
    encoder, trunk, camera, dense = public["dino"], public["aggregator"], public["camera_head"], public["dpt_head"]
    return OmniVGGTConfig(
        **backbone_sizes(public, encoder, trunk),
        collect=tuple(dense["intermediate_layer_idx"]),
        camera_depth=camera["trunk_depth"],
        camera_heads=camera["num_heads"],
        camera_steps=camera["num_iterations"],
        dpt=DptConfig(features=dense["features"], out_channels=tuple(dense["out_channels"])),
    )


def run_model_case(path: Path) -> list[OutputCheck]:
    """Load the recorded weights strictly, do every run, compare every recorded tensor."""
    outputs, expected = model_outputs(path), read_tensors(path / "outputs.safetensors")
    return [_compare(name, outputs, expected[name]) for name in sorted(expected)]


def model_outputs(path: Path) -> dict[str, Tensor]:
    """Everything that a case can record, of this implementation."""
    case = read_config(path / "config.json")
    try:
        config, runs = config_from_case(case), case["runs"]
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"is not a complete configuration ({error})", where=path / "config.json") from None
    inputs = read_tensors(path / "inputs.safetensors")
    with torch.device("meta"):
        model = OmniVGGT(config)
    load_weights(model, path / "weights.safetensors")
    outputs: dict[str, Tensor] = {}
    for run in runs:
        group = {name: inputs[f"{run['inputs']}.{name}"] for name in ("images", *PRIOR_TENSORS)}
        outputs |= {f"{run['name']}.{name}": value for name, value in _run(model, group, run).items()}
    return outputs


PRIOR_TENSORS = ("extrinsics", "intrinsics", "depth", "mask")


def _run(model: OmniVGGT, group: dict[str, Tensor], run: dict[str, Any]) -> dict[str, Tensor]:
    extrinsics = group["extrinsics"]
    priors = BatchPriors(
        world_from_cam=rigid_inverse(rigid_from_parts(extrinsics[..., :3], extrinsics[..., 3])),
        intrinsics_px=group["intrinsics"],
        camera_views=tuple(run["camera_gt_index"]),
        depth=group["depth"][..., 0],
        depth_mask=group["mask"],
        depth_views=tuple(run["depth_gt_index"]),
    )
    trace = Trace(model)
    with torch.inference_mode(), trace:
        prediction = model(group["images"], priors)
    encoded = encode_priors(priors, *group["images"].shape[-2:])
    outputs = _outputs(prediction) | trace.records
    if encoded.cameras is not None:
        outputs["inter.prior_pose_encoding"] = encoded.cameras
    if encoded.depth is not None:
        outputs["inter.prior_depth_input"] = encoded.depth.flatten(0, 1)
    return outputs


def _outputs(prediction: BatchPrediction) -> dict[str, Tensor]:
    """Predictions under their recorded names."""
    cameras, depth, points = prediction.cameras, prediction.depth, prediction.points
    depth_conf, points_conf = prediction.depth_conf, prediction.points_conf
    assert depth is not None and points is not None and depth_conf is not None and points_conf is not None  # noqa: S101, PT018
    from_depth = unproject_integer_pixels(depth, cameras.intrinsics_px, cameras.world_from_cam)
    return {
        "pose_enc": cameras.vector,
        "extrinsic": rigid_inverse(cameras.world_from_cam)[..., :3, :],
        "intrinsic": cameras.intrinsics_px,
        "depth": depth[..., None],
        "depth_conf": depth_conf,
        "world_points": points,
        "world_points_conf": points_conf,
        POINTS_FROM_DEPTH: from_depth,
    } | {f"pose_enc_list.{step}": vector for step, vector in enumerate(prediction.iterates)}


def _compare(name: str, outputs: dict[str, Tensor], expected: Tensor) -> OutputCheck:
    if name not in outputs:
        return OutputCheck(name=name, error=float("inf"), tolerance=1.0, detail="not computed by this implementation")
    tolerance = POINTS_TOLERANCE if name.endswith(POINTS_FROM_DEPTH) else TOLERANCE
    return compare_tensors(name, outputs[name], expected, atol=tolerance, rtol=tolerance)


def run_preprocess_case(path: Path) -> list[OutputCheck]:
    """Images, cameras and depth maps to network input: exact but for the cameras' rounding."""
    inputs, expected = read_tensors(path / "inputs.safetensors"), read_tensors(path / "outputs.safetensors")
    checks = []
    for recorded in read_config(path / "config.json")["sets"]:
        name = recorded["name"]
        prepared = _prepared(recorded, {k.removeprefix(f"{name}."): v for k, v in inputs.items() if k.startswith(name)})
        priors = prepared.priors
        for kind in ("camera", "depth"):
            listed = getattr(priors, f"{kind}_views") == tuple(recorded[f"{kind}_gt_index"])
            checks.append(OutputCheck(name=f"{name}.{kind}_gt_index", error=float(not listed), tolerance=0.0))
        for output, value, tolerance in _prepared_outputs(prepared):
            full = f"{name}.{output}"
            checks.append(compare_tensors(full, value, expected[full], atol=tolerance, rtol=tolerance))
    return checks


def _prepared(recorded: dict[str, Any], inputs: dict[str, Tensor]) -> PreparedViews:
    pictures, cameras, depths = [], [], []
    for view in range(recorded["num_images"]):
        pixels = inputs[f"image.{view}"].numpy()
        pictures.append(Image.fromarray(pixels))
        pose, depth = inputs.get(f"camera_c2w.{view}"), inputs.get(f"depth.{view}")
        camera = None
        if pose is not None:
            whole = rigid_from_parts(pose[:, :3].double(), pose[:, 3].double())
            intrinsics = inputs[f"camera_K.{view}"].double()
            camera = ViewCamera(world_from_cam=whole.numpy(), intrinsics_px=intrinsics.numpy())
        cameras.append(camera)
        depths.append(None if depth is None else depth.numpy())
    return prepare_views(pictures, cameras, depths, target=recorded["target_size"])


def _prepared_outputs(prepared: PreparedViews) -> list[tuple[str, Tensor, float]]:
    """(recorded name, value, tolerance); views without a camera hold zeros in the official loader."""
    priors = prepared.priors
    poses, intrinsics = priors.world_from_cam, priors.intrinsics_px
    depth, mask = priors.depth, priors.depth_mask
    assert poses is not None and intrinsics is not None and depth is not None and mask is not None  # noqa: S101, PT018
    posed = torch.zeros(poses.shape[1])
    posed[list(priors.camera_views)] = 1
    extrinsics = rigid_inverse(poses)[..., :3, :]
    return [
        ("images", prepared.images, 0.0),
        ("extrinsics", extrinsics * posed[:, None, None], CAMERA_TOLERANCE),
        ("intrinsics", intrinsics * posed[:, None, None], CAMERA_TOLERANCE),
        ("depth", depth[..., None], 0.0),
        ("mask", mask, 0.0),
    ]


def _is_omnivggt(config: dict[str, Any]) -> bool:
    return config.get("model") == "OmniVGGT" and "model_config" in config


def _is_preprocess(config: dict[str, Any]) -> bool:
    sets = config.get("sets")
    return isinstance(sets, list) and all(isinstance(s, dict) and "camera_gt_index" in s for s in sets)


def _config_test(test: Callable[[dict[str, Any]], bool]) -> Callable[[Path], bool]:
    return lambda path: has_config(path, test)


def _is_released(names: Collection[str]) -> bool:
    return any(name.startswith("aggregator.pose_embeddings.") for name in names)


def _released() -> nn.Module:
    return OmniVGGT(OmniVGGTConfig.large())


CASES = [
    CaseRunner(name="omnivggt", matches=_config_test(_is_omnivggt), run=run_model_case),
    CaseRunner(name="omnivggt preprocess", matches=_config_test(_is_preprocess), run=run_preprocess_case),
]
KEYS = [KeyFamily(name="omnivggt", matches=_is_released, build=_released)]
