"""A study as it is held: 39 people and five methods, most of them over HTTP, some in a real browser, with all that goes wrong."""

from __future__ import annotations

import contextlib
import json
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import requests

from sceneexpander.study.agreement import Measured, compute_agreement
from sceneexpander.study.document import ANSWERS_NAME, Study
from sceneexpander.study.results import StudyResults, collect_rankings, compute_results, load_rankings
from sceneexpander.study.spec import Criterion
from sceneexpander.study.store import read_answers
from tests.support.browser import Page, browser_page
from tests.support.participants import LIKED, METHODS, Person, build, people, served

pytestmark = pytest.mark.pipeline

PEOPLE = 39
IN_BROWSER = ("p01", "p02", "p03", "p04")
CARELESS, UNFINISHED, WITHDRAWN = "p10", "p11", "p12"
TASK = "!$('task').hidden && screen !== null && document.querySelectorAll('video').length === 5 && !busy"
SEEN = "watched.every(Boolean)"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, Path]:
    return build(tmp_path_factory.mktemp("study"), participants=PEOPLE, scenes=2)


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser_page(tmp_path_factory.mktemp("browser") / "profile") as page:
        yield page


@pytest.fixture(scope="module")
def crowd(built: tuple[Study, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Person]]:
    """The server, in a thread, and everybody who was invited."""
    with served(built[1]) as address:
        yield {person.participant.name: person for person in people(*built, address)}


def kept(built: tuple[Study, Path], name: str) -> dict[str, dict[str, int]]:
    """Answers of one person as they are on disk."""
    answers = read_answers(built[1] / ANSWERS_NAME, built[0]).answers
    mine = [answer for answer in answers if answer.participant == name]
    assert len({answer.screen for answer in mine}) == len(mine)
    return {answer.screen: answer.ranks for answer in mine}


def begin(tab: Page, person: Person, width: int = 390, height: int = 844) -> None:
    tab.open(person.base, width, height)
    tab.wait("!$('consent').hidden")
    tab.value("$('begin').click()")
    assert "tick the box" in tab.value("$('notice').textContent")
    tab.value("$('agree').click(); $('begin').click()")
    tab.wait(TASK)


def place(tab: Page, person: Person) -> str:
    """Watch the videos of the screen and give them their places; returns its name."""
    tab.wait(TASK)
    name = str(tab.value("screen.name"))
    tab.value("$('together').click()")
    tab.wait(SEEN)
    screen = next(item for item in person.participant.screens if item.name == name)
    ranks = person.ranks(name)
    for index, video in enumerate(screen.videos):
        button = (
            f"document.querySelectorAll('fieldset')[{index}].querySelectorAll('.places button')[{ranks[video] - 1}]"
        )
        tab.value(f"if (places[{index}] !== {ranks[video]}) {button}.click()")  # a second click takes a place back
    return name


def send(tab: Page, name: str) -> None:
    tab.value("$('next').click()")
    tab.wait(f"state.done.includes('{name}') && !busy")


def finish(tab: Page, person: Person) -> None:
    while tab.value("state.next") is not None:
        send(tab, place(tab, person))
    tab.wait("!$('done').hidden")


def expected(person: Person) -> dict[str, dict[str, int]]:
    return {screen.name: person.ranks(screen.name) for screen in person.participant.screens}


def test_somebody_with_a_phone(tab: Page, crowd: dict[str, Person], built: tuple[Study, Path]) -> None:
    person = crowd["p01"]
    tab.requested.clear()
    tab.messages.clear()
    begin(tab, person)
    assert tab.value("document.documentElement.scrollWidth") == 390, "nothing is wider than the window"
    small = tab.value(
        "[...document.querySelectorAll('main button, footer button, input')].filter(item => item.offsetParent && "
        "item.getBoundingClientRect().height < 24).length"
    )
    assert small == 0
    # What is missing is said instead of sent.
    tab.value("$('next').click()")
    assert tab.value("$('missing').textContent") == "Watch to the end: A, B, C, D, E. Give a place to: A, B, C, D, E."
    finish(tab, person)
    assert tab.value("$('code').textContent") == requests.get(f"{person.base}api/state", timeout=30).json()["code"]
    assert kept(built, "p01") == expected(person)
    hosts = {address.split("/p/")[0] for address in tab.requested if not address.startswith(("data:", "about:"))}
    assert hosts == {person.base.split("/p/")[0]}
    assert tab.messages == []


def test_somebody_with_a_keyboard(tab: Page, crowd: dict[str, Person], built: tuple[Study, Path]) -> None:
    person = crowd["p02"]

    def press(key: str, code: int, text: str = "") -> None:
        for kind in ("keyDown", "keyUp"):
            tab.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                windowsVirtualKeyCode=code,
                text=text if kind == "keyDown" else "",
            )

    tab.open(person.base, 1280, 860)
    tab.wait("!$('consent').hidden")
    press("Tab", 9)
    assert tab.value("document.activeElement.id") == "agree"
    press(" ", 32, " ")
    press("Tab", 9)
    press("Enter", 13, "\r")
    tab.wait(TASK)
    assert tab.value("document.activeElement.id") == "question", "readers begin with the question"
    press("Tab", 9)
    assert tab.value("document.activeElement.id") == "together"
    press("Enter", 13, "\r")
    tab.wait(SEEN)
    name = str(tab.value("screen.name"))
    screen = next(item for item in person.participant.screens if item.name == name)
    for video in screen.videos:
        press("Tab", 9)
        while not tab.value("document.activeElement.matches('.places button')"):
            press("Tab", 9)
        rank = person.ranks(name)[video]
        press(str(rank), 48 + rank, str(rank))
        # Past the other places of this video.
        for _ in METHODS[1:]:
            press("Tab", 9)
    press("Tab", 9)
    assert tab.value("document.activeElement.id") == "next"
    press("Enter", 13, "\r")
    tab.wait(f"state.done.includes('{name}')")
    assert kept(built, "p02") == {name: person.ranks(name)}
    finish(tab, person)
    assert kept(built, "p02") == expected(person)


def test_places_stay_a_ranking_whatever_is_pressed(tab: Page, crowd: dict[str, Person]) -> None:
    begin(tab, crowd["p03"])
    rng = np.random.default_rng(0)
    for index, rank in rng.integers(5, size=(60, 2)):
        tab.value(f"give({index}, {rank + 1})")
        places = [value for value in tab.value("places") if value]
        assert len(set(places)) == len(places)
    pressed = tab.value(
        "[...document.querySelectorAll('fieldset')].map(box => [...box.querySelectorAll('.places button')]"
        ".findIndex(item => item.getAttribute('aria-pressed') === 'true') + 1)"
    )
    assert pressed == tab.value("places")


def test_the_network_is_cut_in_the_middle(tab: Page, crowd: dict[str, Person], built: tuple[Study, Path]) -> None:
    person = crowd["p03"]
    tab.open(person.base, 390, 844)
    offline = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
    first = place(tab, person)
    tab.call("Network.emulateNetworkConditions", offline=True, **offline)
    tab.value("$('next').click()")
    tab.wait("$('notice').textContent.startsWith('No connection')")
    assert first not in kept(built, "p03")
    # The page is closed while its answer waits, and opened again when there is a network: the answer goes out by itself.
    tab.call("Page.navigate", url="about:blank")
    tab.call("Network.emulateNetworkConditions", offline=False, **offline)
    tab.open(person.base, 390, 844)
    tab.wait(f"state && state.done.includes('{first}') && !busy")
    assert kept(built, "p03") == {first: person.ranks(first)}
    # The answer arrives and its receipt is lost: it is sent again, and is there once.
    second = place(tab, person)
    tab.value(
        "const real = fetch; let lost = 0; window.fetch = async (...given) => { const reply = await real(...given); "
        "if (String(given[0]).endsWith('answer') && lost++ < 2) throw new TypeError('cut'); return reply; }"
    )
    send(tab, second)
    assert tab.value("lost") == 3
    assert kept(built, "p03") == {name: person.ranks(name) for name in (first, second)}
    # Half a ranking survives a closed page.
    tab.wait(TASK)
    tab.value("give(2, 1); give(0, 5)")
    tab.open(person.base, 390, 844)
    tab.wait(TASK)
    assert tab.value("places") == [5, 0, 1, 0, 0]
    finish(tab, person)
    assert kept(built, "p03") == expected(person)
    tab.messages.clear()  # the browser's own complaints about the cut


def test_two_tabs_and_a_double_click(tab: Page, crowd: dict[str, Person], built: tuple[Study, Path]) -> None:
    person = crowd["p04"]
    begin(tab, person)
    name = place(tab, person)
    # Another tab, with another opinion, is faster.
    order = person.ranks(name)
    other = dict(zip(order, [*list(order.values())[1:], next(iter(order.values()))], strict=True))
    assert person.post("answer", {"screen": name, "ranks": other}).status_code == 200
    tab.value("$('next').click(); $('next').click()")
    tab.wait(f"state.done.includes('{name}') && !busy")
    assert "The first answer counts" in tab.value("$('notice').textContent")
    second = place(tab, person)
    assert second != name
    tab.value("$('next').click(); $('next').click(); send(); send()")
    tab.wait(f"state.done.includes('{second}') && !busy")
    assert kept(built, "p04") == {name: other, second: person.ranks(second)}
    # A tab that was left behind notices when it is looked at again.
    third = str(tab.value("state.next"))
    assert person.post("answer", {"screen": third, "ranks": person.ranks(third)}).status_code == 200
    tab.value("document.dispatchEvent(new Event('visibilitychange'))")
    tab.wait(f"state.done.includes('{third}')")
    finish(tab, person)
    assert kept(built, "p04") == {**expected(person), name: other}


def test_somebody_withdraws(tab: Page, crowd: dict[str, Person], built: tuple[Study, Path]) -> None:
    person = crowd[WITHDRAWN]
    begin(tab, person)
    send(tab, place(tab, person))
    tab.value("$('withdraw').click()")
    assert tab.value("document.activeElement.id") == "no", "the harmless answer comes first"
    tab.value("$('yes').click()")
    tab.wait("!$('withdrawn').hidden")
    assert kept(built, WITHDRAWN) == {}
    tab.open(person.base, 390, 844)
    tab.wait("!$('withdrawn').hidden")


@pytest.fixture(scope="module")
def results(crowd: dict[str, Person], built: tuple[Study, Path]) -> StudyResults:
    """Everybody else takes part, six at a time, and every answer is sent twice."""
    crowd[CARELESS].careless = True
    rest = [person for name, person in crowd.items() if name not in (*IN_BROWSER, WITHDRAWN)]
    with ThreadPoolExecutor(6) as pool:
        list(
            pool.map(
                lambda person: person.take_part(screens=3 if person.participant.name == UNFINISHED else None, repeat=2),
                rest,
            )
        )
    return compute_results(*load_rankings(built[1]))[0]


def test_nothing_is_lost_and_nothing_counts_twice(
    results: StudyResults, crowd: dict[str, Person], built: tuple[Study, Path]
) -> None:
    answers = read_answers(built[1] / ANSWERS_NAME, built[0]).answers
    per_person = Counter(answer.participant for answer in answers)
    screens = len(built[0].participants[0].screens)
    assert per_person == {name: 3 if name == UNFINISHED else screens for name in crowd if name != WITHDRAWN}
    for answer in answers:
        if answer.participant not in IN_BROWSER:
            assert answer.ranks == crowd[answer.participant].ranks(answer.screen)
    assert [(item.participant, item.reason.split()[0]) for item in results.excluded] == [
        (CARELESS, "failed"),
        (UNFINISHED, "did"),
        (WITHDRAWN, "withdrew,"),
    ]
    assert len(results.included) == PEOPLE - 3


def test_the_results_are_what_these_people_think(results: StudyResults) -> None:
    for item in results.criteria:
        means = {method.method: method.mean for method in item.methods}
        assert sum(means.values()) == pytest.approx(15)
        # All but two methods are liked differently.
        order = sorted(METHODS, key=lambda method: -means[method])
        assert [LIKED[method] for method in order] == sorted(LIKED.values(), reverse=True)
        assert item.friedman is not None
        assert item.friedman.p_permutation <= 0.0002
        alike = next(pair for pair in item.pairs if {pair.first, pair.second} == {"omnivggt", "ttt3r"})
        assert alike.p_holm == max(pair.p_holm for pair in item.pairs)
        assert max(pair.p_holm for pair in item.pairs if pair is not alike) < 0.05
        assert max(item.letter_scores) - min(item.letter_scores) < 1


def test_measures_agree_with_people_as_far_as_they_should(results: StudyResults, built: tuple[Study, Path]) -> None:
    ranked, _ = collect_rankings(*load_rankings(built[1]))
    rng = np.random.default_rng(0)
    measured = [
        Measured(scene=scene, method=method, measure=name, better=better, value=value)
        for scene in ranked.scenes
        for method in METHODS
        for name, better, value in (
            ("judge", "higher", LIKED[method]),
            ("error", "lower", -LIKED[method]),
            ("upside down", "lower", LIKED[method]),
            ("noise", "higher", float(rng.normal())),
        )
    ]
    found = {
        item.measure: item for item in compute_agreement(ranked, measured) if item.criterion is Criterion.INSERTION
    }
    tau = {name: item.tau for name, item in found.items()}
    assert all(value is not None for value in tau.values())
    assert tau["judge"] == tau["error"] == -(tau["upside down"] or 0)
    assert (tau["judge"] or 0) > 0.9
    assert abs(tau["noise"] or 0) < 0.9
    assert 0.3 < (tau["one participant"] or 0) < 0.9


def test_a_server_that_dies_is_followed_by_one_that_knows_everything(tmp_path: Path, tab: Page) -> None:
    study, folder = build(tmp_path, participants=1, scenes=1, minimum_s=1)
    with served(folder) as address:
        port = int(address.rpartition(":")[2])
        (person,) = people(study, folder, address)
        begin(tab, person)
        name = place(tab, person)
    tab.value("$('next').click()")
    tab.wait("$('notice').textContent.startsWith('No connection')")
    with served(folder, port):
        tab.wait(f"state.done.includes('{name}') && !busy")
        # The next screen was opened just now: its answer waits for the minimum time and goes then.
        second = place(tab, person)
        tab.value("$('next').click()")
        tab.wait(f"state.done.includes('{second}')")
        kept_answers = read_answers(folder / ANSWERS_NAME, study).answers
        assert [answer.screen for answer in kept_answers] == [name, second]
        assert all(answer.sent_s - answer.opened_s >= 1 for answer in kept_answers)
    with contextlib.suppress(requests.ConnectionError):
        assert requests.get(person.base, timeout=5).status_code != 200
    assert json.loads((folder / "study.json").read_text())["digest"] == study.digest
    assert time.time() > kept_answers[-1].sent_s
