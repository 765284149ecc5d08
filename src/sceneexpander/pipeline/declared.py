"""Reads ``dvc.yaml``: which stages there are for the scenes, rounds and methods of ``params.yaml``, and which stand on which.

Knows what this project's file uses (``matrix``, ``deps``, ``params``, ``outs``, ``metrics``, ``persist``) and refuses the rest.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path, PurePosixPath
from typing import Any

from sceneexpander.config.files import read_yaml
from sceneexpander.errors import UserError, did_you_mean

PIPELINE, PARAMS = Path("dvc.yaml"), Path("params.yaml")
_KNOWN = {"matrix", "cmd", "deps", "params", "outs", "metrics"}
_REFERENCE = re.compile(r"\$\{([^${}]+)\}")
_FLAGS = {"cache", "persist"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """What a stage makes. ``persist``: it is not deleted before the stage runs again."""

    path: str
    persist: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class DeclaredStage:
    """One command of the pipeline, for one scene, round and method where it has them.

    Attributes:
        address: as DVC writes it, e.g. ``adapt@courtyard-round0``; rounds and other mappings are numbered from 0.
        name: of the stage, e.g. ``adapt``.
        command: what is run, relative to the pipeline's folder.
        dependencies: files and folders that it reads.
        parameters: by YAML or JSON file, the keys whose values it reads.
        outputs: files and folders that it makes.
    """

    address: str
    name: str
    command: str
    dependencies: tuple[str, ...]
    parameters: Mapping[str, tuple[str, ...]]
    outputs: tuple[Output, ...]

    @property
    def gathers(self) -> bool:
        """Whether it is one stage for all scenes: it goes on with those that are there."""
        return "@" not in self.address

    @property
    def reads(self) -> tuple[str, ...]:
        """All paths whose content decides what it makes."""
        return (*self.dependencies, *self.parameters)


def read_pipeline(folder: Path) -> tuple[DeclaredStage, ...]:
    """The stages of a pipeline folder, each after all that it depends on, otherwise in the order of the file.

    Raises:
        UserError: a file is malformed, uses what is not known here, or stages stand on each other.
    """
    declared = read_yaml(folder / PIPELINE)
    values = read_yaml(folder / PARAMS)
    if not isinstance(declared, dict) or not isinstance(declared.get("stages"), dict) or not isinstance(values, dict):
        raise UserError("holds no stages", where=folder / PIPELINE)
    stages = [stage for name, body in declared["stages"].items() for stage in _expand(name, body, values)]
    return tuple(_sort(stages))


def select_stages(stages: Sequence[DeclaredStage], targets: Sequence[str]) -> tuple[DeclaredStage, ...]:
    """The named stages (addresses, or names for all of one kind) with all that they depend on; no names: all stages."""
    if not targets:
        return tuple(stages)
    names, addresses = {stage.name for stage in stages}, {stage.address for stage in stages}
    for target in targets:
        if target not in names | addresses:
            raise UserError(
                "no such stage", where=target, fix=did_you_mean(target, addresses if "@" in target else names)
            )
    before = find_predecessors(stages)
    wanted: set[str] = set()
    left = [stage.address for stage in stages if {stage.address, stage.name} & set(targets)]
    while left:
        address = left.pop()
        if address not in wanted:
            wanted.add(address)
            left.extend(before[address])
    return tuple(stage for stage in stages if stage.address in wanted)


def find_predecessors(stages: Sequence[DeclaredStage]) -> dict[str, list[str]]:
    """For every stage the addresses of those that make something it reads: a path, a part of it, or what it is a part of."""
    makers: dict[PurePosixPath, str] = {}
    for stage in stages:
        for output in stage.outputs:
            path = PurePosixPath(output.path)
            if path in makers:
                raise UserError(f"is made by {makers[path]} and by {stage.address}", where=output.path)
            makers[path] = stage.address
    below: dict[PurePosixPath, set[str]] = {}
    for path, maker in makers.items():
        for folder in path.parents:
            below.setdefault(folder, set()).add(maker)
    found: dict[str, list[str]] = {}
    for stage in stages:
        before: set[str] = set()
        for text in stage.reads:
            path = PurePosixPath(text)
            before |= below.get(path, set())
            before |= {makers[part] for part in (path, *path.parents) if part in makers}
        found[stage.address] = [other.address for other in stages if other.address in before - {stage.address}]
    return found


def find_stale(stages: Sequence[DeclaredStage], left_out: Collection[str]) -> list[str]:
    """Outputs of an earlier run that stages for all scenes would gather although what makes them has failed or was left out."""
    gathered = [PurePosixPath(path) for stage in stages if stage.gathers for path in stage.reads]
    return [
        output.path
        for stage in stages
        if stage.address in left_out and not stage.gathers
        for output in stage.outputs
        if any(path in (PurePosixPath(output.path), *PurePosixPath(output.path).parents) for path in gathered)
    ]


def _sort(stages: Sequence[DeclaredStage]) -> Iterator[DeclaredStage]:
    before = find_predecessors(stages)
    by_address = {stage.address: stage for stage in stages}
    sorter: TopologicalSorter[str] = TopologicalSorter(before)
    sorter.prepare()
    while sorter.is_active():
        ready = set(sorter.get_ready())
        for address in (address for address in by_address if address in ready):
            yield by_address[address]
            sorter.done(address)


def _expand(name: str, body: Mapping[str, Any], values: Mapping[str, Any]) -> Iterator[DeclaredStage]:
    unknown = set(body) - _KNOWN
    if unknown:
        raise UserError(f"stage {name} uses {sorted(unknown)[0]!r}, which only DVC knows", where=PIPELINE)
    matrix: dict[str, list[Any]] = _filled(body.get("matrix", {}), values)
    for key, items in matrix.items():
        if not isinstance(items, list):
            raise UserError(f"the values of {key} of stage {name} are no list", where=PIPELINE)
    for numbers in itertools.product(*(range(len(items)) for items in matrix.values())):
        item = {key: matrix[key][number] for key, number in zip(matrix, numbers, strict=True)}
        labels = [
            f"{key}{number}" if isinstance(item[key], dict | list) else str(item[key])
            for key, number in zip(matrix, numbers, strict=True)
        ]
        filled = _filled({key: value for key, value in body.items() if key != "matrix"}, {**values, "item": item})
        yield DeclaredStage(
            address=f"{name}@{'-'.join(labels)}" if matrix else name,
            name=name,
            command=str(filled["cmd"]),
            dependencies=tuple(filled.get("deps", ())),
            parameters=_parameters(filled.get("params", ())),
            outputs=tuple(_outputs(name, (*filled.get("outs", ()), *filled.get("metrics", ())))),
        )


def _filled(node: Any, values: Mapping[str, Any]) -> Any:
    """A part of the file with every ``${...}`` replaced by the value that it names, keys included."""
    if isinstance(node, str):
        whole = _REFERENCE.fullmatch(node)
        if whole is not None:
            return _value(whole[1], values)
        return _REFERENCE.sub(lambda match: str(_value(match[1], values)), node)
    if isinstance(node, Mapping):
        return {_filled(key, values): _filled(value, values) for key, value in node.items()}
    if isinstance(node, list):
        return [_filled(value, values) for value in node]
    return node


def _value(dotted: str, values: Mapping[str, Any]) -> Any:
    node: Any = values
    for part in dotted.split("."):
        if not isinstance(node, Mapping) or part not in node:
            raise UserError(f"has no {dotted}, which {PIPELINE} asks for", where=PARAMS)
        node = node[part]
    return node


def _parameters(entries: Sequence[Any]) -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for entry in entries:
        keys = {PARAMS.as_posix(): [entry]} if isinstance(entry, str) else entry
        for file, named in keys.items():
            found[file] = (*found.get(file, ()), *named)
    return found


def _outputs(name: str, entries: Sequence[Any]) -> Iterator[Output]:
    for entry in entries:
        for path, flags in ({entry: {}} if isinstance(entry, str) else entry).items():
            if set(flags) - _FLAGS:
                raise UserError(f"an output of stage {name} uses what only DVC knows", where=PIPELINE)
            yield Output(path=path, persist=bool(flags.get("persist", False)))
