"""Rounds that are added, taken back and branched: what changes in a run's folder, and what is refused before anything does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.metrics import MetricsRow, ViewMetrics
from sceneexpander.cli import expand as command
from sceneexpander.cli import growing
from sceneexpander.cli.expand import expand, parse_arguments, read_arguments
from sceneexpander.cli.growing import RoundRequest, add_round, proposal_lines, quality_line, undo_round
from sceneexpander.errors import UserError
from sceneexpander.generation import Forecast
from sceneexpander.pipeline.preflight import CheckedScene
from sceneexpander.pipeline.selection import read_selection
from tests.worlds.expansions import everything, photos, picture, project, request, somebody_at_work
from tests.worlds.reports import view

__all__ = ["project"]


@pytest.fixture
def run(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A finished run ``room`` with one round, in a project whose pipeline does nothing."""
    checked: list[dict[str, Any]] = []

    def check(*_: Any, **given: Any) -> CheckedScene:
        checked.append(given)
        rounds = given["rounds"]
        return CheckedScene(rounds=rounds, forecasts=(Forecast(prompt="p"),) * rounds)

    monkeypatch.setattr(growing, "check_scene", check)
    monkeypatch.setattr(growing, "reproduce", lambda *_, **__: None)
    monkeypatch.setattr(growing.Run, "is_finished", property(lambda _: True))
    expand(request(photos(tmp_path / "photos"), tmp_path, name="room"), project=project)
    return project / "runs" / "room"


def rounds_of(run: Path, scene: str = "room") -> list[dict[str, str]]:
    content: dict[str, Any] = yaml.safe_load((run / "scenes" / scene / "scene.yaml").read_text())
    found: list[dict[str, str]] = content["rounds"]
    return found


def without_locks(folder: Path) -> dict[str, bytes]:
    """What lies there but the lock files, which say who was at work last."""
    return {name: content for name, content in everything(folder).items() if not name.endswith(".lock")}


LEFT = RoundRequest(motion="turn left 30 degrees", settings=("generator=reproject",))


def test_a_round_is_added_and_changes_none_of_the_others(run: Path, project: Path, tmp_path: Path) -> None:
    first, settings = rounds_of(run), read_selection(run)
    add_round("room", LEFT, project=project)
    assert rounds_of(run) == [*first, {"prompt": "turn left 30 degrees", "motion": "turn left 30 degrees"}]
    selection = read_selection(run)
    assert selection.round_overrides == ((), ("generator=reproject",))
    assert (selection.overrides, selection.methods) == (settings.overrides, settings.methods)
    add_round("room", RoundRequest(prompt="A lake.", inserted=picture(tmp_path / "lake.png")), project=project)
    assert read_selection(run).round_overrides == ((), ("generator=reproject",), ())
    place = run / "scenes" / "room" / rounds_of(run)[2]["inserted"]
    assert place.read_bytes() == (tmp_path / "lake.png").read_bytes()


def test_undo_is_the_inverse(run: Path, project: Path) -> None:
    before = everything(run)
    add_round("room", LEFT, project=project)
    made = run / "outputs" / "room" / "round_2" / "metrics"
    made.mkdir(parents=True)
    (made / "sceneexpander.json").write_text("{}")
    undo_round("room", project=project)
    assert everything(run) == before
    assert not made.parent.exists()
    with pytest.raises(UserError, match="one round only, nothing to undo"):
        undo_round("room", project=project)
    assert everything(run) == before


def test_branches_share_the_scene_and_what_came_before(run: Path, project: Path) -> None:
    add_round("room", LEFT, project=project)
    before = everything(run)
    for name, motion in (("a", "turn right 30 degrees"), ("b", "turn up 20 degrees")):
        branch = RoundRequest(motion=motion, settings=("generator=reproject",), from_round=1, branch=name)
        add_round("room", branch, project=project)
        folder = project / "runs" / name
        # Commands and paths of stages hold the scene's name: with another one nothing would be shared.
        assert read_selection(folder).scenes == ("room",)
        assert [item["prompt"] for item in rounds_of(folder)] == ["A bench.", motion]
        assert (folder / "scenes/room/captured/0.png").read_bytes() == (run / "scenes/room/captured/0.png").read_bytes()
    assert everything(run) == before
    with pytest.raises(UserError, match="exists already; choose another --as"):
        add_round("room", RoundRequest(prompt="x", from_round=1, branch="a"), project=project)


def test_a_branch_is_not_replaced_by_other_photos(run: Path, project: Path, tmp_path: Path) -> None:
    add_round(
        "room", RoundRequest(motion="turn left", settings=LEFT.settings, from_round=0, branch="b"), project=project
    )
    assert len(rounds_of(project / "runs" / "b")) == 1
    with pytest.raises(UserError, match="is a branch of the run room"):
        expand(request(tmp_path / "photos", tmp_path, name="b"), project=project)


def test_the_first_command_again_loses_no_added_round(run: Path, project: Path, tmp_path: Path) -> None:
    again = request(tmp_path / "photos", tmp_path, name="room")
    add_round("room", LEFT, project=project)
    before = without_locks(project)
    with pytest.raises(UserError, match="has rounds that were added to it; go on with --continue"):
        expand(again, project=project)
    assert without_locks(project) == before
    undo_round("room", project=project)
    expand(again, project=project)
    assert len(rounds_of(run)) == 1


@pytest.mark.parametrize(
    ("name", "asked", "line"),
    [
        ("rom", LEFT, "--continue: there is no run 'rom'; did you mean 'room'"),
        ("room", RoundRequest(), "--prompt: says not what to add; room is finished; add --prompt or --undo"),
        ("room", RoundRequest(settings=LEFT.settings), '--prompt: has no prompt; say what to add, e.g. --prompt "'),
        ("room", RoundRequest(prompt="A lake."), "--inserted: the new round has no picture"),
        (
            "room",
            RoundRequest(prompt="x", from_round=5, branch="b"),
            "--from-round: there is no round 5; room has only round 1",
        ),
        ("room", RoundRequest(prompt="x", from_round=-1, branch="b"), "--from-round: there is no round -1"),
        ("room", RoundRequest(prompt="x", from_round=0), "--from-round: needs a name for what begins there; add --as"),
        ("room", RoundRequest(prompt="x", branch="../b"), "--as: '../b' is no plain name"),
        ("room", RoundRequest(prompt="x", inserted=Path("gone.png")), "gone.png: does not exist"),
    ],
)
def test_what_cannot_be_is_one_line_and_changes_nothing(
    name: str, asked: RoundRequest, line: str, run: Path, project: Path
) -> None:
    before = without_locks(project)
    with pytest.raises(UserError) as caught:
        add_round(name, asked, project=project)
    assert caught.value.line().startswith(line)
    assert without_locks(project) == before


def test_a_refused_round_changes_nothing(
    run: Path, project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: str, scene: Path, **__: Any) -> CheckedScene:
        raise UserError("is unusable", where=next(scene.glob("inserted/round_2*"), scene))

    monkeypatch.setattr(growing, "check_scene", refuse)
    before = without_locks(project)
    lake = picture(tmp_path / "lake.png")
    for asked, where in (
        (LEFT, run / "scenes" / "room"),
        (RoundRequest(motion="turn left", settings=LEFT.settings, branch="b"), run / "scenes" / "room"),
        (RoundRequest(prompt="A lake.", inserted=lake), lake),
    ):
        with pytest.raises(UserError) as caught:
            add_round("room", asked, project=project)
        assert caught.value.line() == f"{where}: is unusable", "never the name of a copy"
    assert without_locks(project) == before


def test_somebody_elses_run_is_left_alone(run: Path, project: Path) -> None:
    before = everything(run)
    with somebody_at_work(run):
        with pytest.raises(UserError, match=r"is being worked on .*; wait for it or end it$"):
            add_round("room", LEFT, project=project)
        with pytest.raises(UserError, match="is being worked on"):
            undo_round("room", project=project)
    assert everything(run) == before


def test_an_unfinished_round_is_finished_first(run: Path, project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add_round("room", LEFT, project=project)
    monkeypatch.setattr(growing.Run, "is_finished", property(lambda _: False))
    with pytest.raises(UserError, match="round 2 of room is not finished; --continue room alone finishes it"):
        add_round("room", LEFT, project=project)
    started: list[Path] = []
    monkeypatch.setattr(growing, "reproduce", lambda folder, **_: started.append(folder))
    before = rounds_of(run)
    add_round("room", RoundRequest(), project=project)
    assert (started, rounds_of(run)) == ([run], before)


def finish_round(run: Path, *, posed: bool, before: dict[str, float], after: dict[str, float]) -> None:
    base = run / "outputs" / "room" / "round_1"
    inserted = view("n1", generated=True)
    provenance = Provenance(backend="replay", prompt="p", source="s", sha256="3" * 64)
    InsertedView(round=1, view=inserted, chosen=0, provenance=(provenance,)).save(base / "inserted")
    for method, values in (("captured", before), ("sceneexpander", after)):
        MetricsRow(
            scene="room",
            round=1,
            method=method,
            model="mini",
            weights_sha256="0",
            seed=0,
            values=values,
            views=(ViewMetrics(view_id="n1", generated=True, posed=posed),) if method != "captured" else (),
        ).save(base / "metrics" / f"{method}.json")


@pytest.mark.parametrize(
    ("posed", "after", "reason"),
    [
        (False, (24.9, 19.9), "no camera could be estimated for its inserted view"),
        (True, (21.5, 19.9), "the captured views lost 3.5 dB (at most 3 are allowed)"),
        (True, (24.9, 16.0), "the views inserted earlier lost 4.0 dB (at most 3 are allowed)"),
        (True, (22.5, 17.5), None),
    ],
)
def test_no_round_follows_one_that_failed(
    posed: bool, after: tuple[float, float], reason: str | None, run: Path, project: Path
) -> None:
    names = "psnr_captured_db", "psnr_earlier_inserted_db"
    finish_round(
        run, posed=posed, before=dict(zip(names, (25.0, 20.0), strict=True)), after=dict(zip(names, after, strict=True))
    )
    line = quality_line(growing.open_run("room", project), 1)
    assert line == (None if reason is None else f"round 1 failed quality control: {reason}")
    if reason is not None:
        before = everything(run)
        with pytest.raises(UserError, match=r"failed quality control.*--undo takes it away"):
            add_round("room", LEFT, project=project)
        assert everything(run) == before
        add_round(
            "room", RoundRequest(motion="turn left", settings=LEFT.settings, from_round=0, branch="b"), project=project
        )
    add_round("room", RoundRequest(motion="turn left", settings=LEFT.settings, anyway=True), project=project)
    assert len(rounds_of(run)) == 2


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("", "expand: the following arguments are required: PHOTOS"),
        ("photos --undo", "--undo: belongs to a finished run; name it with --continue"),
        ("photos --from-round 0", "--from-round: belongs to a finished run"),
        ("--continue room adapt.steps=5", "adapt.steps=5: a run goes on with its own photos and settings"),
        ("--continue room --name b", "--name: is the name of a new run"),
        ("--continue room --prompt a --prompt b", "--prompt: rounds are added one by one; give it once"),
        ("--continue room --undo --prompt a", "--undo: only takes the last round away"),
        ("--continue room --propose --prompt a", "--propose: only prints motions; leave out --prompt"),
    ],
)
def test_options_that_do_not_go_together_are_named(words: str, line: str) -> None:
    with pytest.raises(UserError) as caught:
        read_arguments(words.split())
    assert line in caught.value.line()


def test_the_words_become_a_round() -> None:
    words = "--continue room --motion left --generator reproject --from-round 1 --as b --yes"
    given = read_arguments(words.split())
    assert growing.round_of(given, command._settings(given)) == RoundRequest(
        motion="left", settings=("generator=reproject",), from_round=1, branch="b", unattended=True
    )
    assert parse_arguments(["photos", "adapt.steps=5"]).photos == Path("photos")


def test_proposals_of_a_round_that_has_none_are_refused(run: Path, project: Path) -> None:
    with pytest.raises(UserError, match="has no proposals after round 1; finish it"):
        proposal_lines("room", None, project=project)
    with pytest.raises(UserError, match="is the captured scene, and proposals are made after rounds; name round 1"):
        proposal_lines("room", 0, project=project)
