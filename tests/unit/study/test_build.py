"""Pages are blind and whole, videos are comparable, and a study that was changed is refused."""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import re
import stat
from pathlib import Path
from typing import Any

import av
import pytest
import torch
import yaml
from PIL import Image

from sceneexpander.errors import UserError
from sceneexpander.splatting.video import write_video
from sceneexpander.study.build import build_study
from sceneexpander.study.document import STUDY_NAME, Study
from sceneexpander.study.spec import read_spec
from tests.support.participants import METHODS, build, read_links, write_study

NASTY = '</script><script>alert(1)</script> & "quotes"'


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, Path]:
    return build(tmp_path_factory.mktemp("study"), title=NASTY, participants=3)


def pages(folder: Path) -> list[str]:
    return [path.read_text(encoding="utf-8") for path in sorted((folder / "pages").iterdir())]


def facts_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="facts">(.*?)</script>', page, re.S)
    assert found is not None
    return dict(json.loads(found[1]))


def test_nothing_that_a_participant_gets_names_a_method_or_a_scene(built: tuple[Study, Path]) -> None:
    study, folder = built
    # Titles of methods that people may know, and names of scenes and catch levels.
    secret = [*METHODS, "room_0", "room_1", "catch_1", "level_"]
    addresses = [*read_links(folder).values(), *(path.name for path in (folder / "videos").iterdir())]
    videos = [path.read_bytes().lower() for path in (folder / "videos").iterdir()]
    for word in secret:
        assert not [page for page in pages(folder) if word in page.replace(study.title, "").lower()], word
        assert not [address for address in addresses if word in address]
        assert not [video for video in videos if word.encode() in video]


def test_a_page_names_no_other_site_and_runs_its_own_script_only(built: tuple[Study, Path]) -> None:
    for page in pages(built[1]):
        assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", page)
        policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
        assert policy is not None
        assert policy[1].startswith("default-src 'none'")
        assert "unsafe" not in policy[1]
        for tag in ("style", "script"):
            text = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.S)
            assert len(text) == 1
            digest = base64.b64encode(hashlib.sha256(text[0].encode()).digest()).decode()
            assert f"{tag}-src 'sha256-{digest}'" in policy[1]


def test_text_from_users_cannot_leave_its_place(built: tuple[Study, Path]) -> None:
    for page in pages(built[1]):
        assert "<script>alert" not in page
        assert page.count("<script") == 2, "facts and program"


def test_a_page_holds_its_own_screens(built: tuple[Study, Path]) -> None:
    study, folder = built
    for participant, page in zip(study.participants, pages(folder), strict=True):
        shown = facts_of(page)["screens"]
        assert [(item["name"], tuple(item["videos"])) for item in shown] == [
            (screen.name, screen.videos) for screen in participant.screens
        ]
        assert len({screen.name for screen in participant.screens}) == 2 * (2 + 1)


def test_links_are_secret_and_all_different(built: tuple[Study, Path]) -> None:
    study, folder = built
    tokens = [link.split("/")[2] for link in read_links(folder).values()]
    assert len(set(tokens)) == 3
    assert min(map(len, tokens)) >= 32
    text = (folder / STUDY_NAME).read_text()
    assert not [token for token in tokens if token in text]
    for name in (STUDY_NAME, "links.csv"):
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o600
    hashes = [participant.token_sha256 for participant in study.participants]
    assert hashes == [hashlib.sha256(token.encode()).hexdigest() for token in tokens]


def pixels(path: Path) -> torch.Tensor:
    with av.open(str(path)) as container:
        frames = [torch.from_numpy(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    return torch.stack(frames).float() / 255


def test_videos_are_the_given_ones_without_their_metadata(built: tuple[Study, Path]) -> None:
    study, folder = built
    for index, scene in enumerate(scene for scene in study.scenes if not scene.catch):
        for method, name in scene.videos.items():
            copy = folder / "videos" / f"{name}.mp4"
            assert torch.equal(pixels(copy), pixels(folder.parent / "material" / f"{index}_{method}.mp4"))
            with av.open(str(copy)) as container:
                assert [stream.type for stream in container.streams] == ["video"]
                assert not set(container.metadata) - {"major_brand", "minor_version", "compatible_brands"}


def test_a_title_and_sound_do_not_reach_participants(tmp_path: Path) -> None:
    path = write_study(tmp_path / "in", scenes=1, catch={"scenes": 0})
    source = tmp_path / "in" / "0_worldmirror.mp4"
    spoken = tmp_path / "spoken.mp4"
    with av.open(str(source)) as original, av.open(str(spoken), "w") as marked:
        marked.metadata["title"] = "made by worldmirror"
        track = marked.add_stream_from_template(original.streams.video[0])
        marked.add_stream("aac", rate=8000)
        for packet in original.demux(video=0):
            if packet.dts is not None:
                packet.stream = track
                marked.mux(packet)
    spoken.replace(source)
    build_study(read_spec(path), path.parent, tmp_path / "study")
    for copy in (tmp_path / "study" / "videos").iterdir():
        assert b"worldmirror" not in copy.read_bytes()
        with av.open(str(copy)) as container:
            assert len(container.streams) == 1


def test_catch_videos_get_worse_from_the_original_to_noise(built: tuple[Study, Path]) -> None:
    study, folder = built
    catch = next(scene for scene in study.scenes if scene.catch)
    levels = [pixels(folder / "videos" / f"{name}.mp4") for name in catch.videos.values()]
    distances = [float((level - levels[0]).abs().mean()) for level in levels]
    assert distances == sorted(distances)
    assert min(second - first for first, second in itertools.pairwise(distances)) > 0.03
    # Of the last one nothing of the video is left: its frames are all the same.
    assert float((levels[-1][0] - levels[-1][-1]).abs().max()) < 0.1


def test_pictures_are_shown_without_what_their_files_say(tmp_path: Path) -> None:
    path = write_study(tmp_path / "in", scenes=1)
    exif = Image.Exif()
    exif[0x010E] = "secret place"
    Image.new("RGB", (2000, 1000), (10, 200, 30)).save(tmp_path / "in" / "wish.jpg", exif=exif)
    content = yaml.safe_load(path.read_text())
    content["scenes"][0]["picture"] = "wish.jpg"
    path.write_text(yaml.safe_dump(content))
    build_study(read_spec(path), path.parent, tmp_path / "study")
    (picture,) = {item["picture"] for item in facts_of(pages(tmp_path / "study")[0])["requests"]}
    data = base64.b64decode(picture.removeprefix("data:image/jpeg;base64,"))
    assert b"secret place" not in data
    assert len(data) < 100_000


def other_size(folder: Path) -> None:
    write_video((torch.zeros(3, 40, 64) for _ in range(6)), folder / "0_ttt3r.mp4", 12)


def shorter(folder: Path) -> None:
    write_video((torch.zeros(3, 36, 64) for _ in range(5)), folder / "0_ttt3r.mp4", 12)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda folder: (folder / "0_ttt3r.mp4").unlink(), "0_ttt3r.mp4: does not exist"),
        (lambda folder: (folder / "0_ttt3r.mp4").write_text("x"), "0_ttt3r.mp4: cannot be read as a video"),
        (other_size, "0_ttt3r.mp4: is 64 x 40, 6 frames at 12 per second, but"),
        (shorter, "0_ttt3r.mp4: is 64 x 36, 5 frames at 12 per second, but"),
    ],
)
def test_videos_that_cannot_be_compared_are_named(tmp_path: Path, spoil: Any, expected: str) -> None:
    path = write_study(tmp_path, scenes=1)
    spoil(tmp_path)
    with pytest.raises(UserError) as caught:
        build_study(read_spec(path), tmp_path, tmp_path / "study")
    assert caught.value.line().startswith(f"{tmp_path}/{expected}")
    assert not (tmp_path / "study").exists()
    assert not list(tmp_path.glob(".*.part"))


def test_a_study_is_never_built_over_another(built: tuple[Study, Path]) -> None:
    path = built[1].parent / "material" / "study.yaml"
    with pytest.raises(UserError, match="exists"):
        build_study(read_spec(path), path.parent, built[1])


@pytest.mark.parametrize("address", ["example.org", "http://a b", "https://a/?x=1"])
def test_addresses_must_be_whole(built: tuple[Study, Path], tmp_path: Path, address: str) -> None:
    path = built[1].parent / "material" / "study.yaml"
    with pytest.raises(UserError, match="--address"):
        build_study(read_spec(path), path.parent, tmp_path / "study", address=address)


def test_what_was_built_is_read_back(built: tuple[Study, Path]) -> None:
    assert Study.load(built[1], files=True) == built[0]


def test_a_changed_study_is_named(tmp_path: Path) -> None:
    _, folder = build(tmp_path, scenes=1, participants=1, methods=METHODS[:2])
    path = folder / STUDY_NAME
    original = path.read_text()
    for changed in (original.replace('"minimum_s": 0.0', '"minimum_s": 9.0'), original.replace("ttt", "x") + " "):
        path.write_text(changed)
        if json.loads(changed) != json.loads(original):
            with pytest.raises(UserError, match=r"study\.json: was changed after it was built"):
                Study.load(folder)
    content = json.loads(original)
    names = content["scenes"][0]["videos"]
    names["sceneexpander"], names["worldmirror"] = names["worldmirror"], names["sceneexpander"]
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"study\.json: was changed after it was built"):
        Study.load(folder)
    path.write_text(original)
    page = next((folder / "pages").iterdir())
    page.write_text(page.read_text() + " ")
    Study.load(folder)
    with pytest.raises(UserError, match=r"p01\.html: was changed"):
        Study.load(folder, files=True)
    video = next((folder / "videos").iterdir())
    video.unlink()
    with pytest.raises(UserError, match=r"\.mp4: does not exist"):
        Study.load(folder, files=True)
