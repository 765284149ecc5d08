import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.scene import KnownCameras, RoundSpec, Scene
from sceneexpander.artifacts.state import ExpansionState, WeightsChange
from sceneexpander.artifacts.store import ArtifactError, sha256_of_tensors
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.files import directory_being_written
from sceneexpander.geometry.priors import Priors
from tests.worlds.artifacts import make_reconstruction, make_views


def test_views_and_scene_round_trip(tmp_path: Path) -> None:
    scene = Scene(
        name="room",
        views=make_views(3),
        rounds=(
            RoundSpec(prompt="a bench", motion="move back", new_object="a bench", inserted="inserted/round_1.png"),
        ),
        known=KnownCameras(world_from_cam=torch.eye(4).expand(3, 4, 4), intrinsics_px=None, metric=True),
    )
    scene.save(tmp_path / "scene")
    back = Scene.load(tmp_path / "scene")
    assert back.views.records == scene.views.records
    assert torch.equal(back.views.images, scene.views.images)
    scene.rounds[0].save(tmp_path / "round_1")
    assert RoundSpec.load(tmp_path / "round_1") == scene.rounds[0]
    assert back.rounds == (), "another round must leave the artefact of the scene as it is"
    assert back.known is not None
    assert back.known.metric
    assert torch.equal(back.known.world_from_cam, scene.known.world_from_cam)


def test_the_affine_map_inverts() -> None:
    record = make_views(1).records[0]
    forward, backward = record.stored_from_original, record.original_from_stored()
    x, y = 37.25, 81.5
    u = forward[0][0] * x + forward[0][1] * y + forward[0][2]
    v = forward[1][0] * x + forward[1][1] * y + forward[1][2]
    assert backward[0][0] * u + backward[0][1] * v + backward[0][2] == pytest.approx(x)
    assert backward[1][0] * u + backward[1][1] * v + backward[1][2] == pytest.approx(y)


def test_reconstruction_round_trip_is_exact(tmp_path: Path) -> None:
    original = make_reconstruction()
    original.save(tmp_path / "r")
    back = Reconstruction.load(tmp_path / "r")
    for name in ("camera_vector", "depth", "normals", "generated"):
        assert torch.equal(getattr(back, name), getattr(original, name))
    assert torch.equal(back.gaussians.means, original.gaussians.means)
    assert back.counts == original.counts
    assert back.gaussians.generated.sum() == len(original.gaussians) // 2


@pytest.mark.parametrize("field", ["depth", "normals", "camera_vector"])
def test_non_finite_values_are_refused_with_the_view_named(field: str) -> None:
    original = make_reconstruction()
    broken = getattr(original, field).clone()
    broken[(1, *([0] * (broken.ndim - 1)))] = float("nan")
    with pytest.raises(ValueError, match=rf"{field} is not finite in view 1 \(001_b\)"):
        replace(original, **{field: broken})


def test_inserted_view_round_trip(tmp_path: Path) -> None:
    provenance = Provenance(backend="replay", prompt="p", source="x.png", sha256="00", reference_sha256=("1", "2"))
    view = InsertedView(round=1, view=make_views(1, generated=True), chosen=0, provenance=(provenance,))
    view.save(tmp_path / "i")
    back = InsertedView.load(tmp_path / "i")
    assert back.provenance == view.provenance
    assert back.view.generated.tolist() == [True]


def test_state_round_trip_with_absent_priors(tmp_path: Path) -> None:
    base = {"a": torch.zeros(3), "b": torch.ones(2)}
    weights = WeightsChange.between(base, {"a": torch.ones(3), "b": torch.ones(2)})
    priors = Priors(depth=torch.ones(2, 4, 4), posed=torch.tensor([True, False]))
    state = ExpansionState(views=make_views(2), priors=priors, weights=weights)
    state.save(tmp_path / "s")
    back = ExpansionState.load(tmp_path / "s")
    assert back.priors.world_from_cam is None
    assert torch.equal(back.priors.posed, priors.posed)
    assert set(back.weights.change) == {"a"}, "unchanged tensors are left out"
    assert torch.equal(back.weights.applied_to(base)["a"], torch.ones(3))


def test_an_empty_change_is_the_base_bit_for_bit() -> None:
    base = {"a": torch.randn(5), "b": torch.randn(2, 2)}
    change = WeightsChange.between(base, {k: v.clone() for k, v in base.items()})
    assert change.change == {}
    assert sha256_of_tensors(change.applied_to(base)) == sha256_of_tensors(base)


def test_a_change_refuses_another_base() -> None:
    base = {"a": torch.zeros(3)}
    change = WeightsChange.between(base, {"a": torch.ones(3)})
    with pytest.raises(ArtifactError, match="belongs to base weights"):
        change.applied_to({"a": torch.full((3,), 2.0)})


def test_a_failed_write_leaves_the_old_artefact_and_no_scraps(tmp_path: Path) -> None:
    target = tmp_path / "views"
    with directory_being_written(target) as scratch:
        make_views(2).save(scratch)

    class Interrupted(Exception):
        pass

    with pytest.raises(Interrupted), directory_being_written(target) as scratch:
        make_views(1).save(scratch)
        raise Interrupted
    assert len(ViewSet.load(target)) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["views"]


def test_damage_is_named_and_not_taken_for_a_result(tmp_path: Path) -> None:
    make_reconstruction().save(tmp_path / "r")
    tensors = tmp_path / "r" / "tensors.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:1000])
    with pytest.raises(ArtifactError, match=r"tensors\.safetensors: cannot be read"):
        Reconstruction.load(tmp_path / "r")
    facts = json.loads((tmp_path / "r" / "artifact.json").read_text())
    (tmp_path / "r" / "artifact.json").write_text(json.dumps({**facts, "schema": "reconstruction/0"}))
    with pytest.raises(ArtifactError, match="expected 'reconstruction/1'"):
        Reconstruction.load(tmp_path / "r")
    with pytest.raises(ArtifactError, match="does not exist"):
        Anchors.load(tmp_path / "nowhere")


def test_the_tensor_hash_sees_names_shapes_and_values() -> None:
    a = torch.arange(6.0)
    hashes = {
        sha256_of_tensors(t)
        for t in ({"a": a}, {"b": a}, {"a": a.view(2, 3)}, {"a": a + 1}, {"a": a.double()}, {"a": a, "b": a})
    }
    assert len(hashes) == 6
    assert sha256_of_tensors({"a": a, "b": a}) == sha256_of_tensors({"b": a, "a": a})


def _killed_while_writing(target: Path, content: str) -> None:
    """As a process leaves it that was ended in the middle of `directory_being_written`."""
    scratch = target.with_name(f".{target.name}.0123abcd.part")
    scratch.mkdir(parents=True)
    (scratch / "half").write_text(content)


@pytest.mark.parametrize("name", ["state", "a[b]", "x y"])
def test_what_a_killed_writer_left_is_cleared_by_the_next(name: str, tmp_path: Path) -> None:
    target = tmp_path / name
    _killed_while_writing(target, "half")
    _killed_while_writing(tmp_path / "other", "of another target")
    (tmp_path / f".{name}.json.0123abcd.part").write_text("of a file that somebody is writing")
    with directory_being_written(target) as folder:
        (folder / "whole").write_text("x")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [".other.0123abcd.part", f".{name}.json.0123abcd.part", name]
    )


def test_a_folder_moved_aside_by_a_killed_writer_is_not_lost(tmp_path: Path) -> None:
    target = tmp_path / "state"
    (tmp_path / ".state.0123abcd.old").mkdir()
    (tmp_path / ".state.0123abcd.old" / "whole").write_text("x")
    with pytest.raises(RuntimeError), directory_being_written(target):
        raise RuntimeError
    assert (target / "whole").read_text() == "x"
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def test_half_written_folders_are_no_input_of_the_pipeline() -> None:
    ignored = (Path(__file__).parents[3] / ".dvcignore").read_text().splitlines()
    assert {".*.part", ".*.old"} <= set(ignored)
