"""The recorded training-loss case: which loss reads which tensor."""

from __future__ import annotations

from torch import Tensor

from sceneexpander.models.worldmirror.training_losses import (
    RegressionTerms,
    camera_loss,
    camera_vector_truth,
    depth_loss,
    normal_loss,
    point_loss,
    pseudo_normals,
    render_loss,
)

CONTEXT_VIEWS = 2  # of the render entry; the third view is a target


def computed_losses(tensors: dict[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """Every recorded loss with its terms."""
    gt = {name.removeprefix("gt."): value for name, value in tensors.items() if name.startswith("gt.")}
    pred = {name.removeprefix("pred."): value for name, value in tensors.items() if name.startswith("pred.")}
    mask = gt["valid_mask"].bool()
    translation, rotation, fov = camera_loss(pred["camera_params"], camera_truth(gt))
    normals, normals_mask = pseudo_normals(gt["depthmap"], gt["camera_intrs"], mask)
    depth, gs_depth = pred["depth"][..., 0], pred["gs_depth"][..., 0]
    angle = normal_loss(pred["normals"], normals, normals_mask)
    rendered = render_loss(pred["rendered_colors"], pred["gt_colors"], pred["valid_masks"].bool(), CONTEXT_VIEWS)
    return {
        "camera": {
            "total": translation + rotation + 0.5 * fov,
            "loss_T": translation,
            "loss_R": rotation,
            "loss_FL": fov,
        },
        "point": _terms(point_loss(pred["pts3d"], gt["pts3d"], mask, pred["pts3d_conf"]), "point"),
        "depth": _terms(depth_loss(depth, gt["depthmap"], mask, pred["depth_conf"]), "depth"),
        "normal": {"total": angle, "loss_normal": angle},
        "gs_depth": _terms(depth_loss(gs_depth, gt["depthmap"], mask, pred["gs_depth_conf"]), "gsdepth"),
        "render_mse_2ctx": {"total": rendered, "render_mse": rendered},
        "render_depth_boolmask": _terms(
            depth_loss(pred["rendered_depths"][..., 0], depth.detach(), pred["valid_masks"].bool(), None), "renderdepth"
        ),
    }


def computed_targets(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The recorded intermediate targets."""
    gt = {name.removeprefix("gt."): value for name, value in tensors.items() if name.startswith("gt.")}
    normals, valid = pseudo_normals(gt["depthmap"], gt["camera_intrs"], gt["valid_mask"].bool())
    return {
        "gt_camera_vector": camera_truth(gt),
        "pseudo_normals": normals.movedim(-1, 2),
        "pseudo_normal_mask": valid[:, :, None],
    }


def camera_truth(gt: dict[str, Tensor]) -> Tensor:
    """Ground-truth camera vectors of the case."""
    height, width = gt["depthmap"].shape[-2:]
    return camera_vector_truth(gt["camera_poses"], gt["camera_intrs"], height, width)


def _terms(terms: RegressionTerms, name: str) -> dict[str, Tensor]:
    return {
        "total": terms.total,
        f"loss_conf_{name}": terms.conf,
        f"loss_reg_{name}": terms.reg,
        f"loss_grad_{name}": terms.spatial,
    }
