"""A workflow of the user's in ComfyUI: the nodes that carry our titles are filled, the rest is as it was saved.

The workflow is in API format (*Workflow > Export (API)*). Titles: ``SX_PROMPT`` (a node with a text), ``SX_IMAGE_1``, ``SX_IMAGE_2``, ...
(nodes that load an image; the nearest view comes first), ``SX_SEED`` (a node with a seed), ``SX_OUTPUT`` (what is taken; without it the
first picture that the workflow saves).
"""

from __future__ import annotations

import copy
import json
import logging
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from sceneexpander.errors import UserError
from sceneexpander.generation.backends.comfyui_steps import Steps, listening
from sceneexpander.generation.config import ServiceConfig, picture_path
from sceneexpander.generation.service import Question, Reply, ServiceGenerator, plain_settings
from sceneexpander.plainfiles import read_plain_file
from sceneexpander.ranges import Range
from sceneexpander.services.transport import ServiceError, http_error, retry_after_s

logger = logging.getLogger(__name__)
_LARGEST_WORKFLOW = 16 * 2**20
_TEXTS, _SEEDS = ("text", "prompt", "value", "string"), ("seed", "noise_seed", "value")
_POLL_S = 0.5
_SAY_S = 5.0  # steps of a fast server are not all said
_CONNECT_S = 10.0

Workflow = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ComfyUIConfig(ServiceConfig):
    """Settings of ``comfyui``.

    Attributes:
        base_url: of the server.
        workflow: file of the workflow, in API format.
        seed: of the first candidate; the next ones count up.
    """

    backend: str = "comfyui"
    base_url: str
    workflow: str
    seed: Annotated[int, Range(0, 2**53)]

    def named_file(self, round_number: int) -> Path | None:
        """The workflow."""
        return picture_path(self.workflow, round_number)


def make_comfyui(config: ComfyUIConfig) -> ServiceGenerator:
    """The generator with these settings."""
    return ServiceGenerator(config, ComfyUIService(config))


@dataclass(frozen=True, slots=True)
class ComfyUIService:
    """See `Service`."""

    config: ComfyUIConfig

    def require(self) -> None:
        """The workflow, with a node for the words."""
        read_workflow(picture_path(self.config.workflow, 0))

    def identity(self) -> Mapping[str, object]:
        """Address, seed, and the workflow itself."""
        workflow = read_workflow(picture_path(self.config.workflow, 0))
        return plain_settings(self.config, "base_url", "seed") | {"workflow": workflow}

    def secrets(self) -> tuple[str, ...]:
        """None."""
        return ()

    def ask(self, question: Question) -> Reply:
        """Upload the views, queue the filled workflow, wait for it, fetch what it saved."""
        deadline = time.monotonic() + self.config.timeout_s
        workflow = read_workflow(picture_path(self.config.workflow, 0))
        wanted = sorted(title for title in titles(workflow).values() if re.fullmatch(r"SX_IMAGE_[1-9][0-9]*", title))
        most = max((int(title.rpartition("_")[2]) for title in wanted), default=0)
        if most > len(question.references):
            problem = f"the workflow wants {most} images, and there are {len(question.references)} views to show"
            raise ServiceError(
                "failed_final", problem, fix="raise generator.max_references, or use fewer SX_IMAGE nodes"
            )
        images = {}
        for title in wanted:
            reference = question.references[int(title.rpartition("_")[2]) - 1]
            files = {"image": (f"sx_{reference.pixels_sha256[:16]}.png", reference.png, "image/png")}
            uploaded = self._json("POST", "/upload/image", files=files, data={"overwrite": "true"})
            images[title] = "/".join(part for part in (uploaded.get("subfolder"), uploaded.get("name")) if part)
        seed = self.config.seed + question.number
        filled = fill_workflow(workflow, prompt=question.prompt, seed=seed, images=images)
        with listening(self.config.base_url) as steps:
            queued = self._json("POST", "/prompt", json={"prompt": filled, "client_id": steps.client_id})
            run = queued.get("prompt_id")
            if not isinstance(run, str):
                fix = "try the workflow in ComfyUI itself"
                raise ServiceError("failed_final", "the server queued nothing", fix=fix)
            place = self._finished(run, workflow, steps, deadline)
        response = self._request("GET", "/view", params=place)
        return Reply(data=response.content, model="ComfyUI workflow", request_id=run, parameters={"seed": str(seed)})

    def _finished(self, run: str, workflow: Workflow, steps: Steps, deadline: float) -> dict[str, str]:
        """Where the run's picture lies on the server, once it is there. What becomes of it until then is said."""
        shown, step, next_step_s = "", "", 0.0
        names = {key: str(node.get("class_type", f"node {key}")) for key, node in workflow.items()} | titles(workflow)
        while True:
            entry = self._json("GET", f"/history/{run}").get(run)
            status = entry.get("status", {}) if isinstance(entry, dict) else {}
            if isinstance(status, dict) and status.get("status_str") == "error":
                problem = f"the workflow failed: {_failure(status)}"
                raise ServiceError("failed_final", problem, fix="try the workflow in ComfyUI itself")
            if isinstance(entry, dict) and entry.get("outputs"):
                return _saved_picture(entry["outputs"], workflow)
            if isinstance(entry, dict) and isinstance(status, dict) and status.get("completed"):
                raise ServiceError("failed_final", "the workflow saved no picture", fix="end it with a SaveImage node")
            if time.monotonic() > deadline:
                fix = "raise generator.timeout_s, or look at the server"
                raise ServiceError("failed_final", f"not finished within {self.config.timeout_s:g} s", fix=fix)
            words = self._progress(run)
            if words and words != shown:
                logger.info("ComfyUI: %s", words)
                shown = words
            step = steps.wait(_POLL_S, run, names) or step
            if step and time.monotonic() >= next_step_s:
                logger.info("ComfyUI: %s", step)
                step, next_step_s = "", time.monotonic() + _SAY_S

    def _progress(self, run: str) -> str:
        """Where a run stands in the server's queue, in words; empty if the server does not say."""
        try:
            queue = self._json("GET", "/queue")
        except ServiceError:  # it is only for people: the run may go on all the same
            return ""
        numbers: dict[str, list[tuple[float, str]]] = {}
        for key in ("queue_running", "queue_pending"):
            entries = queue.get(key)
            rows = (
                [row for row in entries if isinstance(row, list) and len(row) > 1] if isinstance(entries, list) else []
            )
            numbers[key] = [(row[0], str(row[1])) for row in rows if isinstance(row[0], (int, float))]
        if any(name == run for _, name in numbers["queue_running"]):
            return "the workflow is running"
        own = next((number for number, name in numbers["queue_pending"] if name == run), None)
        if own is None:
            return ""
        before = len(numbers["queue_running"]) + sum(number < own for number, _ in numbers["queue_pending"])
        return f"the workflow waits, {before} before it"

    def _json(self, method: str, path: str, **arguments: Any) -> dict[str, Any]:
        try:
            content = self._request(method, path, **arguments).json()
        except ValueError:
            raise ServiceError("failed_retryable", "the answer is not valid JSON", fix="is this ComfyUI?") from None
        if not isinstance(content, dict):
            raise ServiceError(
                "failed_final", "the answer is JSON, but none of ComfyUI's", fix="check generator.base_url"
            )
        return content

    def _request(self, method: str, path: str, **arguments: Any) -> Any:
        import requests

        url, timeout = self.config.base_url.rstrip("/") + path, (_CONNECT_S, self.config.timeout_s)
        try:
            response = requests.request(method, url, timeout=timeout, allow_redirects=False, **arguments)
        except requests.exceptions.RequestException as error:
            fix = f"start ComfyUI at {self.config.base_url}, or set generator.base_url"
            raise ServiceError("failed_retryable", f"no connection ({type(error).__name__})", fix=fix) from None
        if response.status_code != 200:
            wait = retry_after_s({name.lower(): value for name, value in response.headers.items()})
            message = _complaint(response)
            raise http_error(response.status_code, "", message, key_variable=None, wait_s=wait)
        return response


def read_workflow(path: Path) -> Workflow:
    """A workflow in API format, with a node for the words.

    Raises:
        UserError: the file is missing, no JSON, in the other format, or has no such node.
    """
    try:
        content = json.loads(read_plain_file(path, limit_bytes=_LARGEST_WORKFLOW))
    except (ValueError, RecursionError):
        raise UserError("is not valid JSON", where=path, fix="export the workflow again, in API format") from None
    if isinstance(content, dict) and "nodes" in content and "links" in content:
        raise UserError("is a workflow for the editor", where=path, fix="use Workflow > Export (API) in ComfyUI")
    nodes = content.values() if isinstance(content, dict) else ()
    if not nodes or not all(isinstance(node, dict) and isinstance(node.get("inputs"), dict) for node in nodes):
        raise UserError("is no workflow in API format", where=path, fix="use Workflow > Export (API) in ComfyUI")
    found = titles(content)
    if "SX_PROMPT" not in found.values():
        fix = "give the node with the text that title, and export it again"
        raise UserError("has no node with the title SX_PROMPT", where=path, fix=fix)
    fill_workflow(content, prompt="", seed=0, images={}, where=path)
    return dict(content)


def titles(workflow: Workflow) -> dict[str, str]:
    """The titles of nodes, by their number; untitled ones are left out."""
    named = {key: node.get("_meta", {}) for key, node in workflow.items()}
    return {key: str(meta["title"]) for key, meta in named.items() if isinstance(meta, dict) and "title" in meta}


def fill_workflow(
    workflow: Workflow, *, prompt: str, seed: int, images: Mapping[str, str], where: Path | None = None
) -> Workflow:
    """A copy with our nodes filled. Raises `UserError` if a node of ours has no input for what it is to hold."""
    filled = copy.deepcopy(workflow)
    for key, title in titles(workflow).items():
        inputs = filled[key]["inputs"]
        if title == "SX_PROMPT":
            inputs[_input(inputs, _TEXTS, str, title, where)] = prompt
        elif title == "SX_SEED":
            inputs[_input(inputs, _SEEDS, int, title, where)] = seed
        elif title in images:
            inputs[_input(inputs, ("image",), str, title, where)] = images[title]
    return filled


def _input(inputs: Mapping[str, Any], names: tuple[str, ...], kind: type, title: str, where: Path | None) -> str:
    for name in names:
        if isinstance(inputs.get(name), kind):  # a list is a wire from another node, and stays
            return name
    raise UserError(f"node {title} has no input {' or '.join(names)} of its own", where=where, fix="title another node")


def _saved_picture(outputs: Mapping[str, Any], workflow: Workflow) -> dict[str, str]:
    chosen = [key for key, title in titles(workflow).items() if title == "SX_OUTPUT"]
    for key in chosen or outputs:
        entry = outputs.get(key)
        for image in (entry.get("images") if isinstance(entry, dict) else None) or ():
            if (
                isinstance(image, dict)
                and isinstance(image.get("filename"), str)
                and (chosen or image.get("type") == "output")
            ):
                return {name: str(image.get(name, "")) for name in ("filename", "subfolder", "type")}
    raise ServiceError("failed_final", "the workflow saved no picture", fix="end it with a SaveImage node")


def _failure(status: Mapping[str, Any]) -> str:
    for message in status.get("messages") or ():
        if (
            isinstance(message, list)
            and len(message) == 2
            and message[0] == "execution_error"
            and isinstance(message[1], dict)
        ):
            return f"{message[1].get('node_type', 'a node')}: {message[1].get('exception_message', 'no reason given')}"
    return "no reason given"


def _complaint(response: Any) -> str:
    """What the server says about a workflow that it does not take."""
    try:
        content = response.json()
    except ValueError:
        return ""
    if not isinstance(content, dict):
        return ""
    error = content.get("error")
    parts = [str(error.get("message", "")) if isinstance(error, dict) else str(error or "")]
    nodes = content.get("node_errors")
    for key, node in nodes.items() if isinstance(nodes, dict) else ():
        for item in (node.get("errors") if isinstance(node, dict) else None) or ():
            parts.append(f"node {key}: {item.get('message', '')} {item.get('details', '')}")
    return "; ".join(part for part in parts if part)
