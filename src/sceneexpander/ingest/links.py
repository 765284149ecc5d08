"""Which links may be followed.

In a folder of photos that the user names, a link to a plain file is as good as the file: the user put it there. A scene folder, which
has a ``scene.yaml``, may come from somebody else, and what it names is copied and shown: names and links in it stay inside it. The one
exception are links into the stores of tools that keep data beside a repository, because that is how these tools check data out: DVC's
cache, and the objects of git-annex of the repository that the scene is in.
"""

from __future__ import annotations

import re
from pathlib import Path

from sceneexpander.errors import UserError
from sceneexpander.plainfiles import require_plain_file

# Named by digest: only who knows the content can name it. Before version 3 DVC had no folder for the kind of digest.
_DVC_OBJECT = re.compile(r"/(?:files/md5|\.dvc/cache)/[0-9a-f]{2}/[0-9a-f]{30}$")


def require_inside(path: Path, folder: Path, *, where: str | None = None) -> Path:
    """``path`` itself, unless it leads to a place outside ``folder`` (by ``..`` or a link) that is no data store.

    ``where`` is what the error names instead of the path. Whether anything is there is not looked at.

    Raises:
        UserError: the name leads out, in a circle, or cannot be the name of a file.
    """
    named = path if where is None else f"{where}: {path.name}"
    try:
        target, root = path.resolve(), folder.resolve()
    except (OSError, RuntimeError):  # the second is what Python 3.11 and 3.12 say of a circle
        require_plain_file(path, where=named)
        raise UserError("cannot be followed", where=named) from None
    except ValueError:
        raise UserError("cannot be the name of a file", where=named) from None
    if target.is_relative_to(root) or _is_stored_object(path, target, root):
        return path
    how = "is a link that leads" if path.is_symlink() else "leads"
    if where is not None:
        how = f"{path.name} {how}"
    raise UserError(f"{how} out of {folder}", where=named, fix="copy the file into the scene folder")


def _is_stored_object(path: Path, target: Path, root: Path) -> bool:
    if not path.is_symlink() or not path.parent.resolve().is_relative_to(root):
        return False
    if _DVC_OBJECT.search(target.as_posix()):
        return True
    repository = next((parent for parent in (root, *root.parents) if (parent / ".git").exists()), None)
    return repository is not None and target.is_relative_to(repository / ".git" / "annex" / "objects")
