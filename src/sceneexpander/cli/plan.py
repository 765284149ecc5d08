"""``sceneexpander plan KEY=VALUE...``: memory and operations of an adaptation, without a GPU and without weights."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sceneexpander.adaptation.config import AdaptConfig, EngineConfig, Precision
from sceneexpander.commandline import CommandParser
from sceneexpander.config.compose import compose
from sceneexpander.config.parse import parse_dataclass
from sceneexpander.errors import UserError, did_you_mean, entry_point
from sceneexpander.pipeline.project import find_project
from sceneexpander.planning import PlanRequest, adaptation_cost, inference_cost
from sceneexpander.planning.models import planned_model
from sceneexpander.typed import shorten

KEYS = ("model", "views", "width", "height", "options", "tflops")
PAPER = "paper"
MAX_VIEWS = 64  # a plan takes about a second of one core for each
MAX_SIDE = 4096
MAX_TFLOPS = 1_000_000
MAX_DIGITS = 10
GIGA = 1e9
HELP = """Memory and operations of an adaptation, without a GPU and without weights. Settings:

    model=worldmirror/large   or worldmirror/mid, worldmirror/tiny, mini
    views=9                   all views, the inserted one included; at most 64
    width=518 height=518      pixels, at most 4096; the height is the width unless given
    options=gpu24             a profile of conf/profile (gpu24 is made for 24 GB), or `paper`: the plain way to run the method
    tflops=60                 what the device really reaches; gives times
    adapt.KEY=VALUE           any key of conf/adapt

Memory is that of tensors, in units of 10^9 bytes: a GPU's runtime takes up to one more. A step is planned at the largest batch
that the configuration can draw.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """What was asked on the command line."""

    model: str = "worldmirror/large"
    views: int = 9
    width: int = 518
    height: int = 518
    options: str = "gpu24"
    tflops: float | None = None
    overrides: tuple[str, ...] = ()


DEFAULT = Question()


def parse(arguments: Sequence[str]) -> Question:
    """The question in ``KEY=VALUE`` arguments. Raises `UserError` for anything that is not one."""
    given: dict[str, str] = {}
    overrides = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not value:
            raise UserError("is not KEY=VALUE", where=shorten(argument), fix=f"keys: {', '.join(KEYS)}, adapt.*")
        if key.startswith("adapt."):
            overrides.append(argument)
        elif key not in KEYS:
            raise UserError("unknown key", where=shorten(argument), fix=did_you_mean(shorten(key), [*KEYS, "adapt.*"]))
        else:
            given[key] = value
    width = _whole(given, "width", DEFAULT.width, least=1, most=MAX_SIDE)
    return Question(
        model=given.get("model", DEFAULT.model),
        views=_whole(given, "views", DEFAULT.views, least=2, most=MAX_VIEWS),
        width=width,
        height=_whole(given, "height", width, least=1, most=MAX_SIDE),
        options=given.get("options", DEFAULT.options),
        tflops=_positive(given, "tflops"),
        overrides=tuple(overrides),
    )


def _whole(given: Mapping[str, str], key: str, default: int, *, least: int, most: int) -> int:
    text = given.get(key, str(default))
    # Its length first: Python refuses to read numbers of thousands of digits.
    if not (text.isascii() and text.isdecimal() and len(text) <= MAX_DIGITS and least <= int(text) <= most):
        raise UserError(f"is {shorten(text)!r}", where=key, fix=f"give a whole number from {least} to {most}")
    return int(text)


def _positive(given: Mapping[str, str], key: str) -> float | None:
    if key not in given:
        return None
    try:
        value = float(given[key])
    except ValueError:
        value = 0.0
    if not 0 < value <= MAX_TFLOPS:
        raise UserError(f"is {shorten(given[key])!r}", where=key, fix=f"give a number above 0 and at most {MAX_TFLOPS}")
    return value


def request_of(question: Question) -> PlanRequest:
    """What to simulate. Raises `UserError` for an unknown model or option, or a size that does not fit the model."""
    model = planned_model(question.model)
    for side in ("width", "height"):
        if getattr(question, side) % model.multiple:
            raise UserError(
                f"{getattr(question, side)} is no multiple of {model.multiple}",
                where=side,
                fix=f"give {getattr(question, side) // model.multiple * model.multiple or model.multiple}",
            )
    conf = find_project() / "conf"
    profiles = sorted(path.stem for path in (conf / "profile").glob("*.yaml"))
    if question.options not in (*profiles, PAPER):
        raise UserError(
            "unknown",
            where=f"options={shorten(question.options)}",
            fix=did_you_mean(shorten(question.options), [*profiles, PAPER]),
        )
    profile = "gpu" if question.options == PAPER else question.options
    values = compose(conf, [f"profile={profile}", *question.overrides])
    config = parse_dataclass(AdaptConfig, values["adapt"])
    if question.options == PAPER:
        # What the released code offers: bfloat16 passes and recomputed blocks in training mode, and nothing else.
        config = replace(config, precision=Precision.BF16, engine=EngineConfig(checkpoint_activations=True))
    plain = question.options == PAPER
    return PlanRequest(
        build=model.build,
        prepared=model.prepared,
        views=question.views,
        height=question.height,
        width=question.width,
        config=config,
        resident_anchor=plain,
        all_heads=plain,
        gpu=str(values["device"]).startswith("cuda"),
    )


def answer(question: Question) -> dict[str, Any]:
    """The plan as plain values."""
    request = request_of(question)
    step = adaptation_cost(request)
    whole = inference_cost(request, planned_model(question.model).heads)
    plan: dict[str, Any] = {
        "model": question.model,
        "options": question.options,
        "views": question.views,
        "width": question.width,
        "height": question.height,
        "parameters": step.parameters,
        "adapted_parameters": step.adapted,
        "step_views": step.step_views,
        "peak_gb": round(step.peak_bytes / GIGA, 3),
        "between_steps_gb": round(step.steady_bytes / GIGA, 3),
        "host_gb": round(step.host_bytes / GIGA, 3),
        "flops_per_step": round(step.flops),
        "flops_per_step_with_insertion": step.flops_with_insertion,
        "steps": request.config.steps,
        "inference_peak_gb": round(whole.peak_bytes / GIGA, 3),
        "inference_flops": whole.flops,
    }
    if question.tflops is not None:
        plan["seconds_per_step"] = round(step.flops / (question.tflops * 1e12), 3)
        plan["minutes"] = round(request.config.steps * step.flops / (question.tflops * 1e12) / 60, 2)
    return plan


def text(plan: Mapping[str, Any]) -> str:
    """The plan for a reader."""
    lines = [
        f"{plan['model']}: {plan['parameters'] / 1e6:.1f} M parameters, {plan['adapted_parameters'] / 1e6:.1f} M adapted",
        f"{plan['views']} views of {plan['width']} x {plan['height']}, at most {plan['step_views']} in a step; options: "
        f"{plan['options']}",
        f"adaptation: {plan['peak_gb']:.1f} GB at most, {plan['between_steps_gb']:.1f} GB between steps, "
        f"{plan['host_gb']:.1f} GB on the host",
        f"a step: {plan['flops_per_step'] / 1e12:.2f} TFLOP on average, {plan['steps']} steps",
        f"reconstruction: {plan['inference_peak_gb']:.1f} GB, {plan['inference_flops'] / 1e12:.2f} TFLOP",
    ]
    if "minutes" in plan:
        lines.append(f"time: {plan['seconds_per_step']:.2f} s per step, {plan['minutes']:.1f} minutes")
    return "\n".join(lines)


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "plan",
        HELP,
        examples=[
            "model=worldmirror/large views=9 width=518",
            "model=worldmirror/large views=9 width=518 options=paper --json",
            "model=mini views=9 width=336 height=252 options=cpu tflops=0.05 adapt.steps=200",
        ],
    )
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", default=[], help="see above")
    parser.add_argument("--json", action="store_true", help="one object instead of text")
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Answer the question on the command line."""
    given = make_parser().parse_intermixed_args(arguments)
    plan = answer(parse(given.settings))
    print(json.dumps(plan, indent=1) if given.json else text(plan))


if __name__ == "__main__":
    main()
