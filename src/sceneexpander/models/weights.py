"""Where weights come from, and loading them strictly.

A weights spec is ``builtin`` (shipped with the package), a local ``.safetensors`` path, or a hub id ``org/name@revision``.
Only safetensors is ever read: other formats go through ``python -m sceneexpander.convert_checkpoint`` once.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from sceneexpander.errors import UserError
from sceneexpander.typed import REFUSALS, shorten

BUILTIN = "builtin"
HUB_FILE = "model.safetensors"
HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*@[\w./-]+")
HUB_ID_WITHOUT_REVISION = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
MAX_HEADER_BYTES = 100_000_000
SHOWN_NAMES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedWeights:
    """A weights file that exists, with what a record of a run needs to name it."""

    spec: str  # as the user gave it
    path: Path
    sha256: str


def resolve_weights(
    spec: str, *, model: str, hub_file: str = HUB_FILE, allow_download: bool = False
) -> ResolvedWeights:
    """Find the weights file that ``spec`` names, and hash it.

    Args:
        spec: ``builtin``, a path, or ``org/name@revision``.
        model: folder of `sceneexpander.models` whose package data ``builtin`` means.
        hub_file: name of the weights file inside a hub repository.
        allow_download: let the hub client use the network; otherwise only its local cache is read.

    Raises:
        UserError: if there is no such file, or it is not a whole safetensors file.
    """
    local = named_file(spec)
    if spec == BUILTIN:
        path = _builtin(model)
    elif local is not None:
        path = local
    elif HUB_ID.fullmatch(spec):
        path = _from_hub(spec, hub_file, allow_download)
    elif HUB_ID_WITHOUT_REVISION.fullmatch(spec):
        raise UserError("names no revision", where=spec, fix=f"pin one, like {spec}@main or a commit")
    else:
        path = Path(spec)
    check_safetensors(path)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return ResolvedWeights(spec=spec, path=path, sha256=digest)


def named_file(spec: str | None) -> Path | None:
    """The local file that a weights spec means; None for weights that ship with the package, those of a hub, and no spec."""
    if spec is None or spec == BUILTIN:
        return None
    return Path(spec) if spec.endswith(".safetensors") or _is_there(Path(spec)) else None


def _is_there(path: Path) -> bool:
    """False, never an error, for names that no file system holds."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise UserError(f"cannot be read ({error.strerror})", where=path) from None


def _builtin(model: str) -> Path:
    folder = Path(__file__).parent / model / "weights"
    found = sorted(folder.glob("*.safetensors"))
    if len(found) != 1:
        problem = f"the package has no built-in weights for {model}"
        raise UserError(problem, where=BUILTIN, fix="give a .safetensors path or a hub id with revision")
    return found[0]


def _from_hub(spec: str, hub_file: str, allow_download: bool) -> Path:
    try:
        import huggingface_hub
    except ImportError:
        fix = "pip install 'sceneexpander[hub]', or give a local .safetensors path"
        raise UserError("needs the huggingface_hub package, which is not installed", where=spec, fix=fix) from None
    repo, revision = spec.split("@", 1)
    try:
        found = huggingface_hub.hf_hub_download(repo, hub_file, revision=revision, local_files_only=not allow_download)
    # The client's errors are OSErrors (missing entry, HTTP, no connection) or ValueErrors (bad names).
    except (OSError, ValueError) as error:
        if allow_download:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            problem, fix = f"could not be downloaded ({reason})", "check the name, the revision and the connection"
        else:
            problem = f"{hub_file} is not in the local hub cache"
            fix = "allow the download, or give a local .safetensors path"
        raise UserError(problem, where=spec, fix=fix) from None
    return Path(found)


def check_safetensors(path: Path) -> None:
    """Refuse what is not a whole safetensors file, saying why.

    Raises:
        UserError: missing, a folder, of another format, or truncated.
    """
    if not _is_there(path) or not path.is_file():
        raise UserError(
            "is not a file" if _is_there(path) else "does not exist",
            where=shorten(str(path), 300),
            fix="check the weights path",
        )
    total = path.stat().st_size
    with _opened(path) as file:
        start = file.read(8)
        header_bytes = int.from_bytes(start, "little")
        if start[:2] in (b"PK", b"\x80\x02", b"\x80\x04"):
            fix = "convert it once: python -m sceneexpander.convert_checkpoint IN OUT.safetensors"
            raise UserError("is a PyTorch checkpoint, not a safetensors file", where=path, fix=fix)
        if len(start) < 8 or not 2 <= header_bytes <= MAX_HEADER_BYTES:
            raise UserError("is not a safetensors file", where=path, fix="expected an 8-byte header length first")
        raw = file.read(header_bytes)
    if len(raw) < header_bytes:
        problem = f"is truncated (its header alone needs {8 + header_bytes} bytes, found {total})"
        raise UserError(problem, where=path, fix="fetch the file again")
    try:
        header = json.loads(raw)
        ends = [entry["data_offsets"][1] for name, entry in header.items() if name != "__metadata__"]
        end = max(ends, default=0)
        if not all(type(value) is int and value <= total for value in (*ends, end)):
            raise UserError(
                f"is truncated or damaged (a tensor ends behind its {total} bytes)",
                where=path,
                fix="fetch the file again",
            )
    except (*REFUSALS, RecursionError):
        raise UserError(
            "is not a safetensors file (unreadable header)", where=path, fix="fetch the file again"
        ) from None
    if total != 8 + header_bytes + end:
        problem = f"is truncated or damaged (expected {8 + header_bytes + end} bytes, found {total})"
        raise UserError(problem, where=path, fix="fetch the file again")


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a safetensors file, on the CPU.

    Raises:
        UserError: see `check_safetensors`.
    """
    check_safetensors(path)
    try:
        return load_file(path)
    except (SafetensorError, *REFUSALS, OSError) as error:
        raise UserError(f"cannot be read as safetensors ({error})", where=path, fix="fetch the file again") from None


def load_weights(model: nn.Module, path: Path) -> None:
    """Give the model exactly the tensors of the file; floating-point values take the dtype of the parameter they fill.

    A model built on the meta device ends up on the CPU without a second copy in memory.

    Raises:
        UserError: one line with the first names that are missing, unexpected, of another shape or not finite.
    """
    tensors = read_tensors(path)
    expected = model.state_dict()
    problem = describe_mismatch(
        {name: tuple(value.shape) for name, value in expected.items()},
        {name: tuple(value.shape) for name, value in tensors.items()},
    )
    if problem:
        raise UserError(
            f"does not fit the model: {problem}", where=path, fix="check that weights and configuration agree"
        )
    broken = [name for name, value in sorted(tensors.items()) if not bool(torch.isfinite(value).all())]
    if broken:
        problem = f"{len(broken)} tensors hold values that are not finite ({', '.join(broken[:SHOWN_NAMES])})"
        raise UserError(problem, where=path, fix="fetch or export the weights again")
    cast = {name: value.to(expected[name].dtype) for name, value in tensors.items()}
    model.load_state_dict(cast, strict=True, assign=any(value.is_meta for value in expected.values()))


def describe_mismatch(expected: dict[str, tuple[int, ...]], found: dict[str, tuple[int, ...]]) -> str:
    """How two sets of named shapes differ, naming the first few of each kind; empty if they agree."""
    missing = sorted(expected.keys() - found.keys())
    unexpected = sorted(found.keys() - expected.keys())
    reshaped = [
        f"{name} {found[name]} instead of {expected[name]}"
        for name in sorted(expected.keys() & found.keys())
        if expected[name] != found[name]
    ]
    parts = []
    for label, names in (("missing", missing), ("unexpected", unexpected), ("of another shape", reshaped)):
        if names:
            more = ", ..." if len(names) > SHOWN_NAMES else ""
            parts.append(f"{len(names)} {label} ({', '.join(names[:SHOWN_NAMES])}{more})")
    return "; ".join(parts)
