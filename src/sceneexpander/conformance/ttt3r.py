"""TTT3R and CUT3R cases: whole streams, image loading, post-processing."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor, nn

from sceneexpander.conformance.registry import CaseRunner, KeyFamily, has_config, read_config
from sceneexpander.errors import UserError
from sceneexpander.geometry.checks import OutputCheck, compare_tensors
from sceneexpander.geometry.rigid import transform_points
from sceneexpander.models.layers.rope import grid_positions
from sceneexpander.models.ttt3r.cameras import chain_resets, focal_from_points, world_from_camera_pose
from sceneexpander.models.ttt3r.config import TTT3RConfig, cut3r_dpt
from sceneexpander.models.ttt3r.images import preprocess_image, ray_map, signed_rgb
from sceneexpander.models.ttt3r.model import TTT3R
from sceneexpander.models.ttt3r.network import POSE_POSITION, StepOutput, StreamStep
from sceneexpander.models.weights import load_weights, read_tensors

# Recommended by the fixtures, for |a - b| / (1 + |b|).
SINGLE, HALF_ROPE, POST = 2e-4, 2e-3, 1e-5
# Mean error of the encoder tokens with float16 rounding; without the rounding it is 1e-4.
MEAN_TOKENS = 4e-5
RAYS = 1e-6  # float32 rounding of values of size one
RAY_HEADS = 16  # fixed in the reference


def config_from_case(sizes: dict[str, Any], run: dict[str, Any]) -> TTT3RConfig:
    """Our configuration from the constructor arguments that a case records and the mode of one of its runs."""
    dense = sizes["dpt"]
    return TTT3RConfig(
        patch=sizes["patch_size"],
        encoder_dim=sizes["enc_embed_dim"],
        encoder_depth=sizes["enc_depth"],
        encoder_heads=sizes["enc_num_heads"],
        ray_depth=sizes["ray_enc_depth"],
        ray_heads=RAY_HEADS,
        dim=sizes["dec_embed_dim"],
        depth=sizes["dec_depth"],
        heads=sizes["dec_num_heads"],
        state_heads=sizes["state_dec_num_heads"],
        state_tokens=sizes["state_size"],
        memory_slots=sizes["local_mem_size"],
        dpt=cut3r_dpt(features=dense["feature_dim"], out_channels=tuple(dense["layer_dims"]), hidden=dense["last_dim"]),
        update=run["update_type"],
        encoder_rope_fp16=run["encoder_rope_fp16"],
    )


def run_stream_case(path: Path) -> list[OutputCheck]:
    """Load the recorded weights strictly, run every recorded stream, compare every recorded tensor."""
    outputs, tolerances = stream_outputs(path)
    expected = read_tensors(path / "outputs.safetensors")
    checks = [_compare(name, outputs, expected[name], tolerances.get(name, SINGLE)) for name in sorted(expected)]
    for name, value in outputs.items():
        if name.endswith("inter.enc_tokens") and name in expected and tolerances[name] == HALF_ROPE:
            checks.append(_mean_check(name, value, expected[name]))
    return checks + _ray_checks(read_tensors(path / "inputs.safetensors"))


def stream_outputs(path: Path) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Everything that a case can record, of this implementation, and the tolerance of each."""
    case = read_config(path / "config.json")
    inputs = read_tensors(path / "inputs.safetensors")
    outputs: dict[str, Tensor] = {}
    tolerances: dict[str, float] = {}
    try:
        for run in case["runs"]:
            config = config_from_case(case["model_config"], run)
            for name, value in _run_stream(path, config, run, inputs).items():
                outputs[f"{run['name']}.{name}"] = value
                tolerances[f"{run['name']}.{name}"] = HALF_ROPE if run["encoder_rope_fp16"] else SINGLE
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"is not a complete configuration ({error!r})", where=path / "config.json") from None
    rows, columns = config.state_grid
    positions = grid_positions(rows, columns, specials=0, origin=POSE_POSITION)[: config.state_tokens]
    outputs["state_pos"], tolerances["state_pos"] = torch.from_numpy(positions), 0.0
    return outputs, tolerances


def _run_stream(path: Path, config: TTT3RConfig, run: dict[str, Any], inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    with torch.device("meta"):
        model = TTT3R(config)
    load_weights(model, path / "weights.safetensors")
    steps = [_step(step, inputs) for step in run["steps"]]
    # The batched path fills in for absent inputs as soon as any view has a ray map.
    fill_absent = run["entry"] == "forward" and any(step.rays is not None for step in steps)
    with torch.inference_mode():
        outputs = list(model.stream(steps, fill_absent=fill_absent))
    return _recorded(steps, outputs)


def _step(step: dict[str, Any], inputs: dict[str, Tensor]) -> StreamStep:
    frame, shows_image = step["frame"], step.get("img", True)
    return StreamStep(
        image=inputs["images"][frame][None] if shows_image else None,
        rays=inputs[f"ray_maps.{frame}"][None] if step.get("ray", False) else None,
        update=step.get("update", shows_image),
        reset=step.get("reset", False),
    )


def _recorded(steps: list[StreamStep], outputs: list[StepOutput]) -> dict[str, Tensor]:
    """Predictions and intermediate values under their recorded names."""
    named: dict[str, list[Tensor]] = {}
    dense: dict[str, Tensor] = {}
    for k, output in enumerate(outputs):
        maps, decoded = output.maps, output.decoded
        of_step = {
            "pts3d_in_self_view": maps.points_self,
            "conf_self": maps.conf_self,
            "pts3d_in_other_view": maps.points_world,
            "conf": maps.conf_world,
            "rgb": maps.rgb,
        }
        present = {name: value[0] for name, value in of_step.items() if value is not None}
        dense |= {f"step{k}.{name}": value for name, value in present.items()}
        summary = {
            "camera_pose": maps.camera_pose[0],
            "mean_pts3d_in_self_view": present["pts3d_in_self_view"].mean((0, 1)),
            "mean_pts3d_in_other_view": present["pts3d_in_other_view"].mean((0, 1)),
            "mean_conf": torch.stack([present["conf_self"].mean(), present["conf"].mean()]),
            "inter.enc_tokens": output.features[0],
            "inter.learning_rate": decoded.rate[0],
            "inter.pose_token_in": decoded.pose_query[0],
            "inter.pose_token_out": decoded.pose_token[0],
            "inter.state_new": decoded.state_tokens[0],
            "inter.state_before": output.before.tokens[0],
            "inter.mem_before": output.before.memory[0],
        }
        for name, value in summary.items():
            named.setdefault(name, []).append(value)
    named["inter.state_before"].append(outputs[-1].after.tokens[0])
    named["inter.mem_before"].append(outputs[-1].after.memory[0])
    kept = [k for k in range(len(steps)) if k == 0 or not steps[k - 1].reset]
    stacked = {name: torch.stack(values) for name, values in named.items()}
    poses = world_from_camera_pose(stacked["camera_pose"][kept])
    stacked["c2w"] = chain_resets(poses, [steps[k].reset for k in kept])
    stacked["kept_steps"] = torch.tensor(kept)
    return stacked | dense


def _compare(name: str, outputs: dict[str, Tensor], expected: Tensor, tolerance: float) -> OutputCheck:
    if name not in outputs:
        return OutputCheck(name=name, error=float("inf"), tolerance=1.0, detail="not computed by this implementation")
    return compare_tensors(name, outputs[name], expected, atol=tolerance, rtol=tolerance)


def _mean_check(name: str, actual: Tensor, expected: Tensor) -> OutputCheck:
    error = ((actual - expected).abs() / (1 + expected.abs())).double().mean()
    return OutputCheck(name=f"{name}.mean_error", error=float(error), tolerance=MEAN_TOKENS, detail="mean error")


def _ray_checks(inputs: dict[str, Tensor]) -> list[OutputCheck]:
    """The recorded ray maps, from the recorded cameras."""
    checks = []
    for name, expected in sorted(inputs.items()):
        if name.startswith("ray_maps."):
            frame = name.removeprefix("ray_maps.")
            rays = ray_map(inputs[f"ray_c2w.{frame}"], inputs[f"ray_K.{frame}"], *expected.shape[:2])
            checks.append(compare_tensors(name, rays, expected, atol=RAYS, rtol=RAYS))
    return checks


def run_post_case(path: Path) -> list[OutputCheck]:
    """Raw pixels to network input; camera vectors to poses, pointmaps to focal lengths, resets to one frame."""
    case = read_config(path / "config.json")
    inputs, expected = read_tensors(path / "inputs.safetensors"), read_tensors(path / "outputs.safetensors")
    outputs: dict[str, Tensor] = {}
    for group in case["sets"]:
        for k in range(group["num_images"]):
            pixels = inputs[f"{group['name']}.image.{k}"]
            picture = preprocess_image(Image.fromarray(pixels.numpy()), size=group["size"])
            outputs[f"{group['name']}.img.{k}"] = signed_rgb(picture)
            outputs[f"{group['name']}.true_shape.{k}"] = torch.tensor([picture.shape[1:]])
    exact = set(outputs)
    poses, points = world_from_camera_pose(inputs["post.camera_pose"]), inputs["post.pts3d_in_self_view"]
    chained = chain_resets(poses, inputs["post.reset_of_kept_views"])
    outputs["post.c2w"] = poses
    outputs["post.c2w_chained"] = chained
    outputs["post.focal_weiszfeld"] = focal_from_points(points)
    outputs["post.pts3d_world"] = transform_points(chained, points.flatten(1, 2)).view(points.shape)
    return [_compare(n, outputs, expected[n], 0.0 if n in exact else POST) for n in sorted(expected)]


def _is_stream(config: dict[str, Any]) -> bool:
    sizes, runs = config.get("model_config"), config.get("runs")
    return isinstance(sizes, dict) and isinstance(runs, list) and "local_mem_size" in sizes


def _is_post(config: dict[str, Any]) -> bool:
    return isinstance(config.get("sets"), list) and isinstance(config.get("post"), dict)


def _is_released(names: Collection[str]) -> bool:
    return "pose_retriever.mem" in names


def _released() -> nn.Module:
    return TTT3R(TTT3RConfig.large())


CASES = [
    CaseRunner(name="ttt3r", matches=lambda path: has_config(path, _is_stream), run=run_stream_case),
    CaseRunner(name="ttt3r image loading", matches=lambda path: has_config(path, _is_post), run=run_post_case),
]
KEYS = [KeyFamily(name="ttt3r", matches=_is_released, build=_released)]
