"""Simulated people who take part in a study over HTTP, and a study that is small enough to be built in a test."""

from __future__ import annotations

import contextlib
import csv
import json
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import requests
import torch
import yaml

from sceneexpander.splatting.video import write_video
from sceneexpander.study.build import build_study, enrol_participants
from sceneexpander.study.document import Participant, Study, StudyScene
from sceneexpander.study.server import bind, make_server
from sceneexpander.study.spec import Criterion, StudySpec, read_spec
from sceneexpander.typed import decode_dataclass

METHODS = ("sceneexpander", "worldmirror", "omnivggt", "ttt3r", "gaussian_splatting")
# How much a simulated person likes a method, in units of the person's own uncertainty.
LIKED = dict(zip(METHODS, (3.0, 1.8, 0.6, 0.6, -1.0), strict=True))


def write_study(folder: Path, *, methods: Sequence[str] = METHODS, scenes: int = 2, **settings: Any) -> Path:
    """``study.yaml`` with videos of a coloured square that moves; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    listed = []
    for scene in range(scenes):
        videos = {}
        for index, method in enumerate(methods):
            path = folder / f"{scene}_{method}.mp4"
            frames = torch.full((6, 3, 36, 64), 0.15 + 0.1 * scene)
            for frame in range(6):
                frames[frame, index % 3, 8:28, 6 * frame + 4 : 6 * frame + 20] = 0.4 + 0.1 * index
            write_video(frames, path, 12)
            videos[method] = path.name
        listed.append({"name": f"room_{scene}", "prompt": f"Behind table {scene} is a bench.", "videos": videos})
    content = {
        "title": "Which video is better?",
        "contact": "A. Researcher, study@example.org",
        "consent": "You will see short videos.\n\nNo names are kept.",
        "participants": 4,
        "minimum_s": 0,
        "scenes": listed,
        **settings,
    }
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def build(folder: Path, **settings: Any) -> tuple[Study, Path]:
    """A small study and its folder."""
    path = write_study(folder / "material", **settings)
    return build_study(read_spec(path), path.parent, folder / "study"), folder / "study"


def bare_study(**settings: Any) -> Study:
    """A study without files, for what needs none: two scenes, one catch scene, three methods, four participants."""
    methods = ("a", "b", "c")
    content: dict[str, Any] = {
        "title": "t",
        "contact": "c",
        "consent": "c",
        "participants": 4,
        "minimum_s": 0,
        "scenes": [{"name": name, "prompt": "p", "videos": dict.fromkeys(methods, "x")} for name in ("one", "two")],
        **settings,
    }
    spec = decode_dataclass(StudySpec, content)
    names = [scene.name for scene in spec.scenes]
    scenes = [
        StudyScene(name=name, prompt="p", catch=False, videos={method: f"{name}-{method}" for method in spec.compared})
        for name in names
    ]
    for number in range(1, spec.catch.scenes + 1):
        videos = {f"level_{level}": f"catch-{number}-{level}" for level in range(len(spec.compared))}
        scenes.append(StudyScene(name=f"catch_{number}", prompt="p", catch=True, videos=videos))
    return Study(
        version="0",
        title=spec.title,
        seed=spec.seed,
        minimum_s=spec.minimum_s,
        catch=spec.catch,
        methods=spec.compared,
        scenes=tuple(scenes),
        participants=enrol_participants(spec, scenes, [f"token {index}" for index in range(spec.participants)]),
        video_sha256={},
        page_sha256={},
        key="00" * 32,
    )


def read_links(folder: Path) -> dict[str, str]:
    """Paths of links by participant."""
    with (folder / "links.csv").open(newline="") as file:
        return {line["participant"]: "/p/" + line["link"].partition("/p/")[2] for line in csv.DictReader(file)}


@contextlib.contextmanager
def served(folder: Path, port: int = 0, hosts: Sequence[str] = ()) -> Iterator[str]:
    """The study's server in a thread; gives ``http://127.0.0.1:PORT``."""
    listener = bind("127.0.0.1", port)
    server = make_server(folder, hosts)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        server.force_exit = True
        thread.join(30)
        listener.close()


@dataclass
class Person:
    """A participant with an opinion. ``careless``: answers without looking."""

    study: Study
    participant: Participant
    base: str
    seed: int
    careless: bool = False
    session: requests.Session = field(default_factory=requests.Session)

    def post(self, path: str, body: object, **headers: str) -> requests.Response:
        """A request as the page sends it."""
        return self.session.post(
            f"{self.base}api/{path}",
            data=json.dumps(body),
            headers={"Content-Type": "application/json", **headers},
            timeout=30,
        )

    def ranks(self, screen_name: str) -> dict[str, int]:
        """This person's answer to a screen: the same whenever asked."""
        screen = next(item for item in self.participant.screens if item.name == screen_name)
        scene = self.study.scene(screen.scene)
        rng = np.random.default_rng([self.seed, int(screen_name[1:])])
        method_of = {video: method for method, video in scene.videos.items()}
        if self.careless:
            order = list(screen.videos)
            rng.shuffle(order)
            if scene.catch:
                order = list(scene.videos.values())[::-1]
        elif scene.catch:
            order = list(scene.videos.values())
        else:
            weight = 1.0 if screen.criterion is Criterion.INSERTION else 0.7
            value = {video: weight * LIKED[method_of[video]] + rng.gumbel() for video in screen.videos}
            order = sorted(screen.videos, key=lambda video: -value[video])
        return {video: place for place, video in enumerate(order, start=1)}

    def take_part(self, *, screens: int | None = None, repeat: int = 1) -> dict[str, Any]:
        """Consent, and answer all screens or so many; each answer is sent ``repeat`` times."""
        state = dict(self.post("consent", {}).json())
        while state["next"] is not None and (screens is None or len(state["done"]) < screens):
            name = state["next"]
            assert self.post("open", {"screen": name}).status_code == 200
            for _ in range(repeat):
                reply = self.post("answer", {"screen": name, "ranks": self.ranks(name)})
                assert reply.status_code == 200, reply.text
            state = dict(reply.json())
        return state


def people(study: Study, folder: Path, address: str) -> list[Person]:
    """One person for each participant of a study."""
    links = read_links(folder)
    return [
        Person(study, participant, address + links[participant.name], seed)
        for seed, participant in enumerate(study.participants)
    ]
