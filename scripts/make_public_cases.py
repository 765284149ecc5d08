"""Make the small conformance cases of the repository: ``python scripts/make_public_cases.py RECORDED``.

``RECORDED`` is the folder of the large recorded cases. The rasteriser's small case is cut out of its recordings: the numbers are those of
the reference. The networks' weights are megabytes, so theirs are made: a tiny configuration, weights by a rule
(`tests.support.seeded_weights`) and the outputs of this implementation, which is why the script first insists that it agrees with every
large case.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from sceneexpander.conformance import omnivggt, ttt3r, worldmirror
from sceneexpander.conformance.registry import find_cases
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.geometry.rigid import look_at, rigid_inverse
from tests.support.public_cases import CASES, prepared_case

SIDE = 28
WINDOW = (50, 36, 10, 8)  # x, y, width, height of the cut in the rasteriser's pictures


def _smooth(count: int, height: int, width: int, purpose: str) -> Tensor:
    """Pictures with some structure."""
    noise = torch.rand(count, 3, 5, 5, generator=child_generator(0, purpose))
    return torch.nn.functional.interpolate(noise, (height, width), mode="bicubic").clamp(0, 1)


def _cameras(count: int) -> Tensor:
    eye = torch.randn(count, 3, generator=child_generator(0, "eyes")) * 0.3
    poses = look_at(eye, torch.tensor([0.0, 0, 3]).expand(count, 3), torch.tensor([0.0, -1, 0]).expand(count, 3))
    return rigid_inverse(poses[:1]) @ poses


def _intrinsics(count: int) -> Tensor:
    return torch.tensor([[30.0, 0, 14], [0, 28, 13], [0, 0, 1]]).expand(count, 3, 3).clone()


def make_worldmirror(target: Path) -> None:
    dense = {"features": 8, "out_channels": [8, 8, 8, 8], "head_hidden": 8}
    heads = dict.fromkeys(("enable_pts", "enable_depth", "enable_norm", "enable_gs"), True)
    config = {
        "is_inference": True,
        "model": {"img_size": 42, "patch_size": 14, "embed_dim": 32, "enable_cond": True, **heads},
        "dino": {"depth": 2, "num_heads": 2},
        "trunk": {"depth": 4, "num_heads": 4, "num_register_tokens": 4, "rope_freq": 100, "intermediate_idxs": [0, 1, 2, 3]},
        "camera_head": {"trunk_depth": 1, "num_heads": 2, "steps": 4},
        "dpt_heads": dense,
        "gs_head": dense,
        "gs_renderer": {"feature_dim": 8, "scale_clamp_max": 0.3, "enable_prune": False, "voxel_size": 0.1},
        "inputs": {"cond_flags": [1, 1, 1]},
    }  # fmt: skip
    inputs = {
        "img": _smooth(2, SIDE, SIDE, "worldmirror")[None],
        "camera_poses": _cameras(2)[None],
        "camera_intrs": _intrinsics(2)[None],
        "depthmap": 1 + _smooth(2, SIDE, SIDE, "depth")[None, :, 0],
    }
    _write(target, config, inputs)
    with prepared_case(target) as case:
        outputs = worldmirror.model_outputs(case)[1]
    kept = ("camera_params", "camera_poses", "camera_intrs", "depth", "depth_conf", "pts3d", "normals", "gs_depth")
    _record(target, {name: outputs[name] for name in kept})


def make_omnivggt(target: Path) -> None:
    config = {
        "model": "OmniVGGT",
        "model_config": {
            "img_size": 42,
            "patch_size": 14,
            "embed_dim": 32,
            "dino": {"depth": 2, "num_heads": 4},
            "aggregator": {"depth": 4, "num_heads": 2, "num_register_tokens": 4, "rope_freq": 100},
            "camera_head": {"trunk_depth": 1, "num_heads": 4, "num_iterations": 4},
            "dpt_head": {"features": 8, "out_channels": [8, 8, 8, 8], "intermediate_layer_idx": [0, 1, 2, 3]},
        },
        "input_groups": {"g0": {"B": 1, "S": 2, "H": SIDE, "W": SIDE}},
        "runs": [
            {"name": "none", "inputs": "g0", "camera_gt_index": [], "depth_gt_index": []},
            {"name": "both", "inputs": "g0", "camera_gt_index": [0, 1], "depth_gt_index": [1]},
        ],
    }
    depth = 1 + _smooth(2, SIDE, SIDE, "depth")[None, :, 0, :, :, None]
    inputs = {
        "g0.images": _smooth(2, SIDE, SIDE, "omnivggt")[None],
        "g0.extrinsics": rigid_inverse(_cameras(2))[None, :, :3],
        "g0.intrinsics": _intrinsics(2)[None],
        "g0.depth": depth,
        "g0.mask": torch.ones_like(depth[..., 0]),
    }
    _write(target, config, inputs)
    with prepared_case(target) as case:
        outputs = omnivggt.model_outputs(case)
    kept = ("none.pose_enc", "none.depth", "both.pose_enc", "both.extrinsic", "both.intrinsic", "both.depth",
            "both.world_points", "both.inter.prior_pose_encoding")  # fmt: skip
    _record(target, {name: outputs[name] for name in kept})


def make_ttt3r(target: Path) -> None:
    steps = [{"frame": 0}, {"frame": 1}, {"frame": 2}]
    runs = [
        {
            "name": name,
            "update_type": kind,
            "entry": "recurrent",
            "encoder_rope_fp16": half,
            "steps": steps,
            "dense": [2],
        }
        for name, kind, half in (
            ("ttt3r", "ttt3r", True),
            ("ttt3r_fp32", "ttt3r", False),
            ("cut3r_fp32", "cut3r", False),
        )
    ]
    config = {
        "model": "ARCroco3DStereo (CUT3R) with TTT3R update",
        "model_config": {
            "img_size": [32, 32], "patch_size": 16, "enc_embed_dim": 64, "enc_depth": 2, "enc_num_heads": 4, "dec_embed_dim": 24,
            "dec_depth": 4, "dec_num_heads": 2, "state_size": 12, "state_dec_num_heads": 3, "local_mem_size": 6, "ray_enc_depth": 1,
            "dpt": {"feature_dim": 8, "last_dim": 8, "layer_dims": [8, 8, 12, 16]},
        },
        "frames": {"T": 3, "H": 32, "W": 32},
        "runs": runs,
    }  # fmt: skip
    _write(target, config, {"images": 2 * _smooth(3, 32, 32, "ttt3r") - 1})
    with prepared_case(target) as case:
        outputs, _ = ttt3r.stream_outputs(case)
    kept = [
        f"{run['name']}.{name}"
        for run in runs
        for name in ("camera_pose", "c2w", "mean_conf", "mean_pts3d_in_other_view")
    ]
    kept += ["ttt3r_fp32.inter.learning_rate", "ttt3r_fp32.inter.state_before", "ttt3r_fp32.step2.pts3d_in_other_view"]
    _record(target, {name: outputs[name] for name in kept})


def cut_gaussians(recorded: Path, target: Path) -> None:
    """A window of the first view: the Gaussians that reach it, and the recorded pixels. Its picture is made whole and looked at there."""
    x, y, width, height = WINDOW
    with safe_open(recorded, "pt") as file:
        metadata = dict(file.metadata())
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - safe_open is no mapping
    view, k = tensors["in.viewmats"][0], tensors["in.Ks"][0]
    points = tensors["in.means"] @ view[:3, :3].T + view[:3, 3]
    pixel = (points @ k.T)[:, :2] / points[:, 2:]
    # Far more than three standard deviations, seen as large as the nearest axis makes them.
    reach = 4 * tensors["in.scales"].amax(1) * k[[0, 1], [0, 1]].max() / points[:, 2].clamp(min=1e-3) + 4
    low, high = torch.tensor([x, y]), torch.tensor([x + width, y + height])
    near = ((pixel > low - reach[:, None]) & (pixel < high + reach[:, None])).all(1) & (points[:, 2] > 0)
    kept = {f"in.{name}": tensors[f"in.{name}"][near] for name in ("means", "quats", "scales", "opacities", "colors")}
    kept |= {"in.viewmats": view[None], "in.Ks": k[None]}
    if "in.backgrounds" in tensors:
        kept["in.backgrounds"] = tensors["in.backgrounds"][:1]
    kept |= {name: tensors[name][:1, y : y + height, x : x + width] for name in ("out.rgb", "out.alpha", "out.depth")}
    wanted = ("width", "height", "near", "far", "eps2d", "rasterize_mode", "sh_degree", "reference")
    metadata = {name: metadata[name] for name in wanted} | {"window": json.dumps(WINDOW)}
    save_file({name: value.contiguous() for name, value in kept.items()}, target, metadata=metadata)


def _write(target: Path, config: dict[str, Any], inputs: dict[str, Tensor]) -> None:
    target.mkdir(parents=True, exist_ok=True)
    (target / "config.json").write_text(json.dumps(config, indent=1) + "\n")
    save_file({name: value.contiguous() for name, value in inputs.items()}, target / "inputs.safetensors")


def _record(target: Path, outputs: dict[str, Tensor]) -> None:
    save_file({name: value.clone().contiguous() for name, value in outputs.items()}, target / "outputs.safetensors")


def require_agreement(recorded: Path) -> None:
    """Exit unless every recorded case agrees, with half of its tolerance to spare where the large tests ask for it."""
    for model in ("worldmirror", "omnivggt", "ttt3r", "gaussians"):
        for path, runner in find_cases(recorded / model):
            wrong = [check.name for check in runner.run(path) if not check.ok]
            if wrong:
                raise SystemExit(f"{path} disagrees in {wrong[:3]}: nothing is made")
            print(f"{model}/{path.name} agrees")


def main() -> None:
    recorded = Path(sys.argv[1])
    require_agreement(recorded)
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "cases"
        make_worldmirror(made / "worldmirror")
        make_omnivggt(made / "omnivggt")
        make_ttt3r(made / "ttt3r")
        for name in ("case_a", "case_b"):
            (made / "gaussians").mkdir(exist_ok=True)
            cut_gaussians(
                recorded / "gaussians" / f"{name}.safetensors", made / "gaussians" / f"{name}_window.safetensors"
            )
        if CASES.exists():
            shutil.rmtree(CASES)
        shutil.copytree(made, CASES)


if __name__ == "__main__":
    main()
