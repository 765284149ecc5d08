"""A user's workflow, in a ComfyUI played on this machine."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sceneexpander.artifacts.scene import RoundSpec, Scene
from sceneexpander.config.compose import compose
from sceneexpander.config.overrides import override
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError
from sceneexpander.generation import GenerationContext, SceneSoFar, make_generator
from tests.support.loopback import Answer, Asked, Service, drawn, said, serving
from tests.worlds.rounds import context_of

CONF = Path(__file__).parents[3] / "conf"
WORKFLOW: dict[str, Any] = {
    "1": {"class_type": "LoadImage", "inputs": {"image": "x.png"}, "_meta": {"title": "SX_IMAGE_1"}},
    "2": {"class_type": "CLIPTextEncode", "inputs": {"clip": ["9", 0], "text": "old words"}, "_meta": {"title": "SX_PROMPT"}},
    "3": {"class_type": "KSampler", "inputs": {"seed": 1, "steps": 20}, "_meta": {"title": "SX_SEED"}},
    "4": {"class_type": "SaveImage", "inputs": {"images": ["3", 0]}, "_meta": {"title": "Save"}},
    "5": {"class_type": "CLIPTextEncode", "inputs": {"text": "ugly"}},
}  # fmt: skip


class Comfy:
    """The routes of a server, each with what it says."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self.pictures = 0
        self.polled = 0
        self.said: dict[str, Answer] = {}
        service.route = self.route

    def route(self, request: Asked) -> Answer:
        """Two looks at the history come too early."""
        path = request.path.partition("?")[0]
        for begin, answer in self.said.items():
            if path.startswith(begin):
                return answer
        if path == "/upload/image":
            return said({"name": "here.png", "subfolder": "sx", "type": "input"})
        if path == "/prompt":
            self.pictures += 1
            return said({"prompt_id": f"run{self.pictures}", "number": 1, "node_errors": {}})
        if path.startswith("/history/"):
            self.polled += 1
            run = path.rpartition("/")[2]
            image = {"filename": f"{run}.png", "subfolder": "", "type": "output"}
            done = {"outputs": {"4": {"images": [image]}}, "status": {"status_str": "success", "completed": True}}
            return said({} if self.polled % 3 else {run: done})
        if path == "/ws":
            return said({}, 404)
        if path == "/queue":
            return said({"queue_running": [], "queue_pending": []})
        assert path == "/view"
        return Answer(body=drawn(self.pictures), content_type="image/png")


@pytest.fixture
def comfy(monkeypatch: pytest.MonkeyPatch) -> Iterator[Comfy]:
    monkeypatch.setattr("sceneexpander.generation.backends.comfyui._POLL_S", 0.01)
    with serving() as service:
        yield Comfy(service)


@pytest.fixture
def context(so_far: SceneSoFar, tmp_path: Path) -> GenerationContext:
    spec = RoundSpec(prompt="Move back, a bench.")
    return context_of(Scene(name="s", views=so_far.views, rounds=(spec,)), tmp_path / "scene")


def generator(comfy: Comfy, folder: Path, *overrides: str, workflow: object = WORKFLOW) -> Any:
    path = folder / "my workflow.json"
    path.write_text(workflow if isinstance(workflow, str) else json.dumps(workflow))
    address = override("generator.base_url", comfy.service.address)
    given = ["generator=comfyui", override("generator.workflow", str(path)), address, "generator.attempts=1"]
    return make_generator(parse_dataclass(ProjectConfig, compose(CONF, [*given, *overrides])).generator)


def test_our_nodes_are_filled_and_the_others_stay(
    comfy: Comfy, so_far: SceneSoFar, context: GenerationContext, tmp_path: Path
) -> None:
    made = generator(comfy, tmp_path, "generator.seed=7")
    assert made.check(context).requests == 2
    assert comfy.service.asked == []
    candidates = made.generate(context, so_far).candidates
    assert [item.data for item in candidates] == [drawn(1), drawn(2)]
    queued = [json.loads(item.body)["prompt"] for item in comfy.service.asked if item.path == "/prompt"]
    for number, workflow in enumerate(queued):
        expected = json.loads(json.dumps(WORKFLOW))
        expected["1"]["inputs"]["image"] = "sx/here.png"
        expected["2"]["inputs"]["text"] = candidates[0].provenance.prompt
        expected["3"]["inputs"]["seed"] = 7 + number
        assert workflow == expected
    upload = next(item for item in comfy.service.asked if item.path == "/upload/image")
    assert b"\x89PNG" in upload.body
    view = next(item for item in comfy.service.asked if item.path.startswith("/view"))
    assert "filename=run1.png" in view.path
    assert candidates[1].provenance.parameters == {"seed": "8"}
    before = len(comfy.service.asked)
    assert generator(comfy, tmp_path, "generator.seed=7").generate(context, so_far).candidates == candidates
    assert len(comfy.service.asked) == before
    changed = json.loads(json.dumps(WORKFLOW))
    changed["3"]["inputs"]["steps"] = 21
    assert generator(comfy, tmp_path, "generator.seed=7", workflow=changed).check(context).requests == 2


@pytest.mark.parametrize(
    ("queue", "words"),
    [
        (
            {"queue_running": [[3, "other", {}]], "queue_pending": [[5, "run1", {}], [4, "next", {}], [6, "x", {}]]},
            "2 before it",
        ),
        ({"queue_running": [[5, "run1", {}]], "queue_pending": []}, "the workflow is running"),
        ({"queue_running": "?", "queue_pending": [[], ["a", "run1"], 7]}, None),
        (["x"], None),
    ],
)
def test_where_the_workflow_stands_is_said_once(
    queue: object, words: str | None, comfy: Comfy, so_far: SceneSoFar, context: GenerationContext, tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    comfy.said["/queue"] = said(queue)
    with caplog.at_level(logging.INFO):
        generator(comfy, tmp_path, "generator.candidates=1").generate(context, so_far)
    told = [record.getMessage() for record in caplog.records if record.getMessage().startswith("ComfyUI: ")]
    assert len(told) == (words is not None)
    assert words is None or words in told[0]


def progress(run: str, value: object, most: object = 20, node: object = "3") -> str:
    return json.dumps({"type": "progress", "data": {"value": value, "max": most, "prompt_id": run, "node": node}})


def executing(node: object) -> str:
    return json.dumps({"type": "executing", "data": {"node": node, "prompt_id": "run1"}})


@pytest.mark.parametrize(
    ("pushed", "words"),
    [
        ([progress("run1", 1), progress("run1", 7), progress("other", 9)], ["SX_SEED: step 7 of 20"]),
        ([executing("9"), b"a preview" * 99, executing(None)], ["node 9"]),
        ([executing("5")], ["CLIPTextEncode"]),
        (['{"type": "status", "data": {"sid": "x"}}', "[", "[" * 9999, "7", '{"data": 1}'], []),
        ([progress("run1", "?"), progress("run1", 1, None), progress("run1", 2, 3, [])[:40]], []),
    ],
)
def test_the_steps_that_the_server_pushes_are_said(
    pushed: list[str | bytes], words: list[str], comfy: Comfy, so_far: SceneSoFar, context: GenerationContext,
    tmp_path: Path, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    comfy.service.pushed = pushed
    with caplog.at_level(logging.INFO):
        made = generator(comfy, tmp_path, "generator.candidates=1").generate(context, so_far)
    assert made.candidates[0].data == drawn(1)
    assert [r.getMessage().removeprefix("ComfyUI: ") for r in caplog.records if "ComfyUI: " in r.getMessage()] == words
    opened = next(item.path for item in comfy.service.asked if item.path.startswith("/ws"))
    queued = next(json.loads(item.body) for item in comfy.service.asked if item.path == "/prompt")
    assert opened == f"/ws?clientId={queued['client_id']}", "messages of a run go to who queued it"


@pytest.mark.parametrize("pushed", [[], ["x" * 2**16] * 3])
def test_without_steps_the_picture_comes_all_the_same(
    pushed: list[str | bytes], comfy: Comfy, so_far: SceneSoFar, context: GenerationContext, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Of a server that refuses WebSockets, or sends more than is read, nothing is lost but the steps."""
    monkeypatch.setattr("sceneexpander.generation.backends.comfyui_steps._LARGEST_MESSAGE", 2**10)
    comfy.service.pushed = pushed
    made = generator(comfy, tmp_path, "generator.candidates=1").generate(context, so_far)
    assert made.candidates[0].data == drawn(1)


@pytest.mark.parametrize(
    ("workflow", "said_words"),
    [
        ("{", "my workflow.json: is not valid JSON"),
        ({"nodes": [], "links": []}, "is a workflow for the editor; use Workflow > Export (API)"),
        ([], "no workflow in API format"),
        ({}, "no workflow in API format"),
        ({"1": {"inputs": {}}}, "has no node with the title SX_PROMPT"),
        ({"1": {"inputs": {"text": ["2", 0]}, "_meta": {"title": "SX_PROMPT"}}}, "has no input text or prompt"),
    ],
)
def test_a_workflow_that_is_none_is_one_line(
    workflow: object, said_words: str, comfy: Comfy, context: GenerationContext, tmp_path: Path
) -> None:
    with pytest.raises(UserError) as caught:
        generator(comfy, tmp_path, workflow=workflow).check(context)
    assert said_words in caught.value.line()


ERROR = {"run1": {"outputs": {}, "status": {"status_str": "error", "messages": [
    ["execution_start", {}], ["execution_error", {"node_type": "KSampler", "exception_message": "out of memory"}]]}}}  # fmt: skip
REFUSED = {"error": {"message": "Prompt outputs failed validation"}, "node_errors": {
    "3": {"errors": [{"message": "Value not in list", "details": "model: 'x'"}]}}}  # fmt: skip


@pytest.mark.parametrize(
    ("path", "answer", "said_words"),
    [
        ("/history", said(ERROR), "the workflow failed: KSampler: out of memory"),
        ("/prompt", said(REFUSED, 400), "node 3: Value not in list model: 'x'"),
        ("/prompt", said({}), "queued nothing"),
        ("/history", said({"run1": {"outputs": {"9": {}}, "status": {}}}), "saved no picture"),
        ("/view", Answer(body=b"<html>", content_type="text/html"), "is not a picture"),
        ("/view", Answer(body=drawn(1, 1, 1), content_type="image/png"), "has only 1 x 1 pixels"),
        ("/view", Answer(body=drawn(1)[:900], content_type="image/png"), "damaged or truncated"),
        ("/view", said({"error": "gone"}, 500), "start the same command again later"),
        ("/prompt", Answer(body=b'{"prompt_id": "r' + b"1" * 500, cut=True), "no connection"),
        ("/upload", Answer(body=b"hello", content_type="text/plain"), "not valid JSON; is this ComfyUI?"),
        ("/upload", said({}, 302, location="http://127.0.0.2/"), "HTTP 302"),
    ],
)
def test_what_goes_wrong_is_one_line(
    path: str,
    answer: Answer,
    said_words: str,
    comfy: Comfy,
    so_far: SceneSoFar,
    context: GenerationContext,
    tmp_path: Path,
) -> None:
    comfy.said[path] = answer
    with pytest.raises(UserError) as caught:
        generator(comfy, tmp_path, "generator.candidates=1").generate(context, so_far)
    assert said_words in caught.value.line()


def test_a_server_that_is_not_there_or_does_not_finish(
    comfy: Comfy, so_far: SceneSoFar, context: GenerationContext, tmp_path: Path
) -> None:
    comfy.said["/history"] = said({})
    with pytest.raises(UserError, match=r"not finished within 0.1 s; raise generator.timeout_s"):
        generator(comfy, tmp_path, "generator.timeout_s=0.1").generate(context, so_far)
    comfy.service.address = "http://127.0.0.1:9"
    with pytest.raises(UserError, match=r"no connection .*; start ComfyUI at http://127.0.0.1:9"):
        generator(comfy, tmp_path).generate(context, so_far)
