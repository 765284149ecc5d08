"""The commands. A module of a command has ``make_parser()`` and ``main(arguments)``; it is imported when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Command:
    """One word after ``sceneexpander``.

    Attributes:
        name: the word.
        module: where its ``make_parser`` and ``main`` are.
        summary: one line for the list of commands.
    """

    name: str
    module: str
    summary: str


COMMANDS = (
    Command("expand", "sceneexpander.cli.expand", "expand the scene of a folder of photos by a picture and a sentence"),
    Command("run", "sceneexpander.pipeline.plain", "bring the project's pipeline up to date without DVC"),
    Command("status", "sceneexpander.cli.status", "say which stages of the pipeline would run, and why"),
    Command("sweep", "sceneexpander.cli.sweep", "run the pipeline for many combinations of settings"),
    Command("ablation", "sceneexpander.cli.ablation", "measure what each part of the method does, against known truth"),
    Command(
        "expandbench",
        "sceneexpander.cli.benchmark",
        "score expansions of any program on worlds whose truth is known exactly",
    ),
    Command("plan", "sceneexpander.cli.plan", "tell memory and operations in advance, without a GPU or weights"),
    Command("judge", "sceneexpander.cli.judge_run", "have a vision-language model judge finished scenes"),
    Command("table", "sceneexpander.cli.tables", "fill the paper's two tables with what was measured here"),
    Command("view", "sceneexpander.viewer.__main__", "walk through a reconstructed scene in the browser"),
    Command(
        "study", "sceneexpander.study.__main__", "let people rank videos of methods blindly, and compute what they said"
    ),
    Command(
        "export", "sceneexpander.cli.export", "write a finished scene as PLY, SPZ, GLB, mesh, COLMAP, nerfstudio, ..."
    ),
    Command("ui", "sceneexpander.cli.ui", "open all recorded runs in the browser, running ones live"),
    Command("follow", "sceneexpander.cli.follow", "mirror running adaptations into MLflow without the browser"),
    Command(
        "conformance",
        "sceneexpander.conformance.__main__",
        "compare with recorded outputs of reference implementations",
    ),
    Command(
        "convert",
        "sceneexpander.cli.convert_checkpoint",
        "convert a PyTorch checkpoint to safetensors, running no code",
    ),
    Command("check", "sceneexpander.cli.check", "look at params.yaml, conf/, photos and weights; run nothing"),
    Command(
        "completion", "sceneexpander.cli.completion", "print a script that completes commands in bash, zsh or tcsh"
    ),
)
