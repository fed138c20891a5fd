"""Outputs that are either whole or absent: written under a temporary name, then renamed."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from radiotwin.errors import BadInput


def require_writable(path: Path | str) -> None:
    """Raise BadInput unless a file can be written at `path`; to be asked before long work, not after it."""
    path = Path(path)
    if path.is_dir():
        raise BadInput(f"{path} is a folder; give the name of a file")
    _prepare_parent(path)


def _prepare_parent(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"cannot write {path}: {error.strerror}; choose another output path") from error
    if not os.access(path.parent, os.W_OK):
        raise BadInput(f"cannot write {path}: no permission in {path.parent}; choose another output path")


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffixes); rename it on success, remove it on failure.

    Raises:
        BadInput: the folder cannot be made or written, or `path` is a folder.
    """
    path = Path(path)
    require_writable(path)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem[:40]}-", suffix="".join(path.suffixes), dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes private files; an output is an ordinary one
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path | str) -> Iterator[Path]:
    """Yield an empty temporary folder beside `path`; it takes the place of `path` on success only.

    Raises:
        BadInput: the parent cannot be written, or `path` is a file.
    """
    path = Path(path)
    if path.is_file():
        raise BadInput(f"{path} is a file; give the name of a folder")
    _prepare_parent(path)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name[:40]}-", dir=path.parent))
    temporary.chmod(0o755)
    try:
        yield temporary
        if path.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{path.name[:40]}-old-", dir=path.parent))
            os.replace(path, old)
            os.replace(temporary, path)
            shutil.rmtree(old)
        else:
            os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
