"""Who may ask the server for what; the page itself is tried in a browser in tests/pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import requests

from sceneexpander.errors import UserError
from sceneexpander.study.document import Study
from sceneexpander.study.server import bind, make_server
from tests.support.participants import METHODS, Person, build, people, served


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, Path]:
    return build(tmp_path_factory.mktemp("study"), scenes=1, methods=METHODS[:3], participants=6)


@pytest.fixture(scope="module")
def address(built: tuple[Study, Path]) -> Iterator[str]:
    with served(built[1]) as found:
        yield found


@pytest.fixture(scope="module")
def crowd(built: tuple[Study, Path], address: str) -> list[Person]:
    return people(*built, address)


def test_the_page_and_the_videos_of_a_link(crowd: list[Person], built: tuple[Study, Path]) -> None:
    study, folder = built
    page = requests.get(crowd[0].base, timeout=30)
    assert page.content == (folder / "pages" / "p01.html").read_bytes()
    assert page.headers["Cache-Control"] == "no-store"
    assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
    assert page.headers["X-Content-Type-Options"] == "nosniff"
    assert "Set-Cookie" not in page.headers
    name = study.participants[0].screens[0].videos[0]
    whole = requests.get(f"{crowd[0].base}videos/{name}.mp4", timeout=30)
    assert whole.content == (folder / "videos" / f"{name}.mp4").read_bytes()
    part = requests.get(f"{crowd[0].base}videos/{name}.mp4", headers={"Range": "bytes=10-19"}, timeout=30)
    assert (part.status_code, part.content) == (206, whole.content[10:20])


@pytest.mark.parametrize(
    "path",
    ["", "api/state", "videos/{video}.mp4", "videos/../study.json", "videos/..%2Fstudy.mp4", "videos/%2e%2e/x.mp4"],
)
def test_who_has_no_link_gets_nothing(address: str, built: tuple[Study, Path], crowd: list[Person], path: str) -> None:
    filled = path.format(video=built[0].participants[0].screens[0].videos[0])
    assert requests.get(f"{address}/p/{'x' * 32}/{filled}", timeout=30).status_code == 404
    if "study" in path or "%" in path:
        assert requests.get(f"{crowd[0].base}{filled}", timeout=30).status_code == 404


@pytest.mark.parametrize(
    "path", ["study.json", "answers.sqlite", "links.csv", "docs", "openapi.json", "pages/p01.html"]
)
def test_files_of_the_study_are_not_served(address: str, crowd: list[Person], path: str) -> None:
    assert requests.get(f"{address}/{path}", timeout=30).status_code == 404
    assert requests.get(f"{crowd[0].base}{path}", timeout=30).status_code == 404


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:{port}"},
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
    ],
)
def test_foreign_names_and_origins_are_refused(crowd: list[Person], address: str, headers: dict[str, str]) -> None:
    filled = {name: value.format(port=address.rpartition(":")[2]) for name, value in headers.items()}
    person = crowd[1]
    for reply in (
        requests.get(person.base, headers=filled, timeout=30),
        person.post("consent", {}, **filled),
        requests.options(f"{person.base}api/consent", headers=filled, timeout=30),
    ):
        assert reply.status_code == 403
        assert "study" in reply.text
        assert "Access-Control-Allow-Origin" not in reply.headers
    assert not requests.get(f"{person.base}api/state", timeout=30).json()["consented"]


def test_its_own_pages_are_answered(crowd: list[Person], address: str) -> None:
    assert crowd[2].post("consent", {}, Origin=address).status_code == 200
    named = requests.get(crowd[2].base, headers={"Host": address.replace("http://127.0.0.1", "localhost")}, timeout=30)
    assert named.status_code == 200


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data"])
def test_what_a_foreign_form_can_send_is_refused(crowd: list[Person], kind: str) -> None:
    reply = requests.post(f"{crowd[1].base}api/consent", data="{}", headers={"Content-Type": kind}, timeout=30)
    assert reply.status_code == 415


def test_bodies_are_bounded_and_strict(crowd: list[Person]) -> None:
    person = crowd[3]
    person.post("consent", {})
    person.post("open", {"screen": "s01"})
    good = person.ranks("s01")
    for body, status in (
        ({"screen": "s01", "ranks": good, "more": 1}, 422),
        ({"screen": "s01", "ranks": {name: str(rank) for name, rank in good.items()}}, 422),
        ({"screen": "s01", "ranks": dict.fromkeys(good, True)}, 422),
        ({"screen": "s01", "ranks": {f"{number}": number for number in range(11)}}, 422),
        ({"screen": "s01", "ranks": {**good, "x" * 20_000: 1}}, 413),
        ({"screen": "s" * 17, "ranks": good}, 422),
        ([], 422),
    ):
        assert person.post("answer", body).status_code == status
    endless = requests.post(
        f"{person.base}api/answer",
        data=iter([b"{", b"}"]),
        headers={"Content-Type": "application/json"},
        timeout=30,
    )
    assert endless.status_code == 411
    assert requests.get(f"{person.base}api/state", timeout=30).json()["done"] == []


def test_an_answer_over_http_is_kept_once(crowd: list[Person]) -> None:
    person = crowd[4]
    state = person.take_part(repeat=3)
    assert state["next"] is None
    assert state["code"]
    screen = person.participant.screens[0].name
    other = dict(zip(person.ranks(screen), reversed(person.ranks(screen).values()), strict=True))
    late = person.post("answer", {"screen": screen, "ranks": other})
    assert late.status_code == 409
    assert "first answer counts" in late.json()["detail"]


def test_nothing_about_requests_leaves_the_server(built: tuple[Study, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FASTAPI_OTEL_AUTO_CONFIGURE", "true")
    server = make_server(built[1])
    settings = server.config.app._telemetry  # type: ignore[union-attr]
    assert [name for name, value in settings.items() if value] == []
    assert server.config.access_log is False


def test_a_name_behind_a_proxy_has_to_be_allowed(built: tuple[Study, Path]) -> None:
    with served(built[1], hosts=["study.example.org"]) as address:
        (person,) = people(*built, address)[5:]
        headers = {"Host": "study.example.org", "Origin": "https://study.example.org"}
        assert person.post("consent", {}, **headers).status_code == 200
        assert person.post("consent", {}, **{**headers, "Host": "other.example.org"}).status_code == 403


def test_a_port_in_use_is_one_line() -> None:
    taken = bind("127.0.0.1", 0)
    taken.listen()
    try:
        with pytest.raises(UserError, match="cannot be opened"):
            bind("127.0.0.1", taken.getsockname()[1])
    finally:
        taken.close()
