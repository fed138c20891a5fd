"""Atomic output: files and folders are written under a temporary name, then renamed."""

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from radiotwin.errors import BadInput

_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def require_writable(path: Path | str) -> None:
    """Check that a file can be written; call it before long work.

    Args:
        path: of the file.

    Raises:
        BadInput: the folder cannot be made or written, or `path` is not an ordinary file.
    """
    path = Path(path)
    _refuse_folder(path)
    with (_parent_of(path), _reported(path),
          tempfile.NamedTemporaryFile(prefix=_prefix(path), dir=path.parent)):
        pass


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Write a file atomically.

    Args:
        path: of the file; missing folders are made.

    Yields:
        a temporary path in the same folder with the same suffixes; it is renamed to `path` on
        success and removed on failure.

    Raises:
        BadInput: the folder cannot be made or written, the disk is full, or `path` is not an
            ordinary file.
    """
    path = Path(path)
    _refuse_folder(path)
    with _parent_of(path):
        with _reported(path):
            handle, name = tempfile.mkstemp(prefix=_prefix(path), suffix="".join(path.suffixes),
                                            dir=path.parent)
            os.close(handle)
        temporary = Path(name)
        try:
            with _reported(path, _DISK_ERRORS):
                yield temporary
            with _reported(path):
                umask = os.umask(0)
                os.umask(umask)
                temporary.chmod(0o666 & ~umask)  # mkstemp makes private files
                os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path | str) -> Iterator[Path]:
    """Write a folder atomically.

    Args:
        path: of the folder; missing parents are made.

    Yields:
        an empty temporary folder beside `path`, which replaces `path` on success and is removed on
        failure.

    Raises:
        BadInput: the parent cannot be written, the disk is full, or `path` is a file.
    """
    path = Path(path)
    with _reported(path):
        if path.exists() and not path.is_dir():
            raise BadInput(f"{path} is a file; give the name of a folder")
    with _parent_of(path):
        with _reported(path):
            temporary = Path(tempfile.mkdtemp(prefix=_prefix(path), dir=path.parent))
            temporary.chmod(0o755)
        try:
            with _reported(path, _DISK_ERRORS):
                yield temporary
            with _reported(path):
                _swap(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _swap(new: Path, path: Path) -> None:
    """Replace the folder `path` by `new`; restore the old one if that fails."""
    if not path.exists():
        os.replace(new, path)
        return
    aside = Path(tempfile.mkdtemp(prefix=_prefix(path), dir=path.parent))
    old = aside / "old"
    try:
        os.replace(path, old)
        try:
            os.replace(new, path)
        except OSError:
            os.replace(old, path)
            raise
    finally:
        if path.exists():
            shutil.rmtree(aside, ignore_errors=True)


@contextmanager
def _parent_of(path: Path) -> Iterator[None]:
    """Make the folders above `path`, and remove the new ones that are empty in the end."""
    with _reported(path):
        new = [folder for folder in path.parents if not folder.exists()]
    try:
        with _reported(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for folder in new:
            with suppress(OSError):  # not empty, or never made
                folder.rmdir()


@contextmanager
def _reported(path: Path, numbers: tuple[int, ...] | None = None) -> Iterator[None]:
    """Turn an OSError, or only those with these error numbers, into BadInput about `path`."""
    try:
        yield
    except OSError as error:
        if numbers is not None and error.errno not in numbers:
            raise
        raise BadInput(f"cannot write {path}: {error.strerror or error}; choose another output "
                       "path") from error


def _refuse_folder(path: Path) -> None:
    with _reported(path):
        if path.is_dir():
            raise BadInput(f"{path} is a folder; give the name of a file")
        if path.exists() and not path.is_file():
            raise BadInput(f"{path} is not an ordinary file; give the name of a file")


def _prefix(path: Path) -> str:
    return f".{path.stem[:40]}-"
