"""Atomic output: files and folders are written to a temporary folder, flushed, then renamed.

The temporary folder `.radiotwin-????????` is beside the output, and locked while its process lives.
A killed run leaves it behind; the next run that writes there removes it.
"""

import errno
import fnmatch
import io
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO, Any

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.signals import deferred

try:
    import fcntl
except ImportError:  # Windows: nothing is locked, and nothing is swept
    fcntl = None  # type: ignore[assignment]

_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
_FLUSHED_AT_ONCE = 16
_TEMPORARY = re.compile(r"\.radiotwin-[a-z0-9_]{8}(?P<aside>-aside)?")


def is_temporary(path: Path) -> bool:
    """Return whether a path has the name of a temporary folder."""
    return _TEMPORARY.fullmatch(path.name) is not None


def require_writable(path: Path | str) -> None:
    """Check, before long work, that a file can be written.

    Raises:
        BadInput: the folder cannot be made or written, or `path` is not an ordinary file.
        RunFailed: the disk is full.
    """
    path = Path(path)
    _refuse_folder(path)
    with (_made_parents(path, only_tried=True), _reported(path),
          _temporary_folder(path) as folder):
        (folder / path.name).touch()


def require_suffix(path: Path | str, *allowed: str) -> None:
    """Raise BadInput unless a file's name ends in one of the allowed suffixes."""
    if not str(path).lower().endswith(allowed):
        raise BadInput(f"{path}: unknown format; allowed {'are' if len(allowed) > 1 else 'is'} "
                       f"{' and '.join(allowed)}")


@contextmanager
def atomic_path(path: Path | str, flush: bool = True) -> Iterator[Path]:
    """Write a file as a whole or not at all, with code that takes a path and raises OSError.

    Args:
        path: of the file; missing folders are made.
        flush: wait for the disk; without this, a power failure may leave a damaged file.

    Yields:
        a temporary path with the same file name. It is flushed and renamed to `path` on success,
        and removed on failure.

    Raises:
        BadInput: the folder cannot be made or written, or `path` is not an ordinary file.
        RunFailed: the disk is full or failed; an older file at `path` is unchanged.
    """
    path = Path(path)
    _refuse_folder(path)
    with _made_parents(path), _reported(path, only_disk=True), _temporary_folder(path) as folder:
        temporary = folder / path.name
        with _reported(path):
            temporary.touch()
        yield temporary
        with _reported(path):
            if flush:
                _flush(temporary)
            os.replace(temporary, path)


@contextmanager
def atomic_file(path: Path | str, hide_errors: bool = False) -> Iterator[IO[bytes]]:
    """Write a file as a whole or not at all, with code that takes an open file.

    Args:
        path: of the file; missing folders are made.
        hide_errors: raise an error of a write only at the end of the block, for libraries that
            crash on it or swallow it (HDF5); what is written after it goes to memory.

    Yields:
        binary file, open for reading and writing.

    Raises:
        BadInput, RunFailed: see `atomic_path`.
    """
    with atomic_path(path) as temporary:
        if not hide_errors:
            with open(temporary, "w+b") as file:
                yield file
            return
        kept = _ErrorsKept(open(temporary, "w+b", buffering=0))
        try:
            with kept:
                yield kept  # type: ignore[misc]  # a raw file
        finally:  # the first error is the cause, whatever the library raised after it
            if kept.error is not None:
                raise kept.error


@contextmanager
def atomic_folder(path: Path | str, names: Collection[str] | None = None) -> Iterator[Path]:
    """Write a folder as a whole, or not at all if the block fails.

    Args:
        path: of the folder; missing parents are made.
        names: patterns, such as `effect_*.png`, of the files and folders that are replaced; others
            in an older folder stay. None: the older folder is replaced as a whole.

    Yields:
        an empty temporary folder. Its content is moved to `path` on success, and removed on
        failure.

    Raises:
        BadInput: the folder cannot be written, or `path` is a file.
        RunFailed: the disk is full or failed; an older folder at `path` is unchanged.
    """
    path = Path(path)
    with (_made_parents(path), _reported(path, only_disk=True),
          _temporary_folder(_temporaries_place(path)) as temporary):
        try:
            yield temporary
        except (BadInput, RunFailed) as error:  # of a file in it, by the name that it will have
            raise type(error)(str(error).replace(str(temporary), str(path))) from error
        with _reported(path):
            inside = [path for path in temporary.rglob("*") if path.is_file()]
            with ThreadPoolExecutor(_FLUSHED_AT_ONCE) as pool:  # each waits for the disk
                list(pool.map(_flush, inside))
            temporary.chmod(0o755)
            _swap(temporary, path, names)


def require_folder(path: Path | str, names: Collection[str], mark: str | None = None,
                   keep_others: bool = False) -> None:
    """Check, before long work, that a folder can be written and no foreign file is lost.

    Args:
        path: of the folder.
        names: patterns, such as `effect_*.png`, of everything that an earlier run may have written.
        mark: name of a file that every earlier run wrote; if it is missing, all files are foreign.
        keep_others: whether files of other names stay in the folder, see `atomic_folder`.

    Raises:
        BadInput: the folder cannot be written, or a foreign file in it would be lost.
        RunFailed: the disk is full.
    """
    path = Path(path)
    place = _temporaries_place(path)
    try:
        held = sorted(name for name in os.listdir(path)
                      if not _TEMPORARY.fullmatch(name) and name != ".DS_Store")
    except (FileNotFoundError, NotADirectoryError):
        held = []
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise BadInput(f"cannot write {path}: {getattr(error, 'strerror', None) or error}; "
                       "choose another output folder") from None
    if mark is not None and (path / mark).is_dir():
        raise BadInput(f"{path / mark} is a folder, where a file is to be; move it away or choose "
                       "another output folder")
    is_earlier = mark is None or mark in held
    lost = [name for name in held if (not keep_others if not _is_one_of(name, names)
                                      else not is_earlier)]
    if lost:
        unmarked = "" if is_earlier else f", and no {mark} of an earlier run"
        raise BadInput(f"{path} holds {', '.join(lost[:5])}{unmarked}, which the new content "
                       "would erase; move it away or choose another output folder")
    with _made_parents(path, only_tried=True), _reported(path), _temporary_folder(place):
        pass


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a temporary folder that is removed at the end, or by the next run after a kill."""
    with _temporary_folder(Path(tempfile.gettempdir()) / "scratch") as folder:
        yield folder


class _ErrorsKept(io.RawIOBase):
    """A file whose writes never fail: after the first error they go to memory.

    HDF5 reads back what it wrote, and crashes if that is lost.

    Attributes:
        error: of the first write that failed.
    """

    def __init__(self, file: io.FileIO) -> None:
        self._file = file
        self._position = self._end = 0
        self._lost: list[tuple[int, bytes]] = []  # position and data
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write to the file; after the first error, which is kept, write to memory instead."""
        data = memoryview(data).cast("B")
        if self.error is None:
            try:
                self._file.seek(self._position)
                rest = data
                while rest:
                    rest = rest[self._file.write(rest):]
            except OSError as error:
                self.error = error
        if self.error is not None:
            self._lost.append((self._position, bytes(data)))
        self._position += len(data)
        self._end = max(self._end, self._position)
        return len(data)

    def readinto(self, buffer: Any) -> int:
        """Read from the file, with the data of failed writes, kept in memory, laid over it."""
        view = memoryview(buffer).cast("B")
        start = self._position
        stop = max(start, min(start + len(view), self._end))
        view[:stop - start] = bytes(stop - start)
        self._file.seek(start)
        rest = view[:stop - start]
        while rest and (count := self._file.readinto(rest)):
            rest = rest[count:]
        for first, data in self._lost:
            low, high = max(first, start), min(first + len(data), stop)
            if low < high:
                view[low - start:high - start] = data[low - first:high - first]
        self._position = stop
        return stop - start

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position,
                                   os.SEEK_END: self._end}[whence]
        return self._position

    def tell(self) -> int:
        return self._position

    def truncate(self, size: int | None = None) -> int:
        """Set the file's end, at the present position by default; an error is kept, not raised."""
        self._end = self._position if size is None else size
        if self.error is None:
            try:
                self._file.truncate(self._end)
            except OSError as error:
                self.error = error
        return self._end

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def close(self) -> None:
        """Close the file; an error is kept, not raised."""
        if not self._file.closed:
            try:
                self._file.close()
            except OSError as error:
                self.error = self.error or error
        super().close()


@contextmanager
def _temporary_folder(path: Path, suffix: str = "") -> Iterator[Path]:
    """Make and lock an empty folder beside `path` for the block; remove it in the end."""
    _sweep(path.parent)
    name: str | None = None
    handle: int | None = None
    try:
        with _reported(path), deferred():
            # Another thread or process may sweep the new folder before it is locked.
            while True:
                name = tempfile.mkdtemp(prefix=".radiotwin-", suffix=suffix, dir=path.parent)
                if fcntl is None or (handle := _lock(name)) is not None:
                    break
        yield Path(name)
    finally:
        with deferred():
            if name is not None:
                _remove(name)
            if handle is not None:
                os.close(handle)


def _lock(name: str) -> int | None:
    """Lock a folder and return its file handle; None if the folder does not exist any more."""
    try:
        handle = os.open(name, os.O_RDONLY)
    except FileNotFoundError:
        return None
    with suppress(OSError):  # a file system without locks
        fcntl.flock(handle, fcntl.LOCK_EX)
    with suppress(FileNotFoundError):
        if os.path.samestat(os.fstat(handle), os.stat(name)):
            return handle
    os.close(handle)
    return None


@cache  # once a folder and process: a store of batches writes thousands of files to one
def _sweep(folder: Path) -> None:
    """Remove from a folder the temporary folders that killed processes left in it."""
    if fcntl is None:
        return
    with suppress(OSError):
        for entry in os.scandir(folder):
            match = _TEMPORARY.fullmatch(entry.name)
            if match and entry.is_dir(follow_symlinks=False):
                with suppress(OSError):
                    _remove_stale(Path(entry.path), aside=bool(match["aside"]))


def _remove_stale(path: Path, aside: bool) -> None:
    """Remove a temporary folder whose process has ended, after its content `aside` is put back."""
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises if its process lives
        for old in path.iterdir() if aside else ():  # killed in `_swap`
            if not (path.parent / old.name).exists():
                os.replace(old, path.parent / old.name)
        _remove(path)
    finally:
        os.close(handle)


def _remove(folder: str | Path) -> None:
    """Remove a folder, also with write-protected folders in it."""
    shutil.rmtree(folder, ignore_errors=True)
    for at, names, _ in os.walk(folder):  # usually it is gone
        for path in (os.path.join(at, name) for name in names):
            with suppress(OSError):
                if not os.path.islink(path):
                    os.chmod(path, stat.S_IRWXU)
    shutil.rmtree(folder, ignore_errors=True)


def _is_one_of(name: str, patterns: Collection[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _temporaries_place(path: Path) -> Path:
    """Return a path beside which temporary folders for the folder `path` can be made.

    A working folder, a link, a mount point (a container's volume), and a folder in a
    write-protected one cannot be renamed; then temporaries go inside.
    """
    with _reported(path):
        try:
            found = path.stat()  # once: another process may be replacing it
            if not stat.S_ISDIR(found.st_mode):
                raise BadInput(f"{path} is a file; give the name of a folder")
            stays = (path.is_symlink() or path.is_mount()
                     or os.path.samestat(found, os.stat(os.curdir))
                     or not os.access(path.parent, os.W_OK))
        except (FileNotFoundError, NotADirectoryError):
            stays = False
    return path / "inside" if stays else path


def _swap(new: Path, path: Path, names: Collection[str] | None) -> None:
    """Replace the folder `path` by the folder `new`; if a move fails, undo those made before.

    With `names`, files in `path` that match none of them and are not in `new` stay.
    """
    inside = _temporaries_place(path) != path
    with deferred(), _locked(path if inside else path.parent):  # another process may swap it, too
        if not inside:
            try:
                os.replace(new, path)  # nothing is there, or an empty folder
                return
            except OSError:
                if not path.exists():
                    raise
        held, fresh = os.listdir(path), os.listdir(new)
        others = [] if names is None else [
            name for name in held if name not in fresh and not _is_one_of(name, names)]
        whole = not (inside or others)
        with _temporary_folder(path if whole else path / "inside", "-aside") as aside:
            pairs = [(path, aside / path.name), (new, path)] if whole else [
                *((path / name, aside / name) for name in held
                  if name not in others and not _TEMPORARY.fullmatch(name)),
                *((new / name, path / name) for name in fresh)]
            done = 0
            try:
                for source, target in pairs:
                    os.replace(source, target)
                    done += 1
            except OSError:
                for source, target in reversed(pairs[:done]):
                    os.replace(target, source)
                raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes that replace its content."""
    handle = None if fcntl is None or is_temporary(folder) else _lock(str(folder))
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


@contextmanager
def _made_parents(path: Path, only_tried: bool = False) -> Iterator[None]:
    """Make the folders above `path` for the block; remove the new ones if it fails.

    With `only_tried`, they are removed in any case, if they are empty.
    """
    written = False
    with _reported(path):
        new = [folder for folder in path.parents if not folder.exists()]
    try:
        with _reported(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        yield
        written = not only_tried
    finally:
        # After a write the folders stay: another process may use them.
        for folder in () if written else new:
            with suppress(OSError):  # not empty, or never made
                folder.rmdir()


@contextmanager
def _reported(path: Path, only_disk: bool = False) -> Iterator[None]:
    """Turn an OSError, or with `only_disk` that of a full or failed disk, into a message."""
    try:
        yield
    except OSError as error:
        if error.errno in _DISK_ERRORS:
            raise RunFailed(f"cannot write {path}: {error.strerror}; what was there before is "
                            "unchanged: make room, or choose another output path") from error
        if only_disk:
            raise
        raise BadInput(f"cannot write {path}: {error.strerror or error}; choose another output "
                       "path") from error


def _flush(path: Path) -> None:
    """Flush a file to the disk."""
    handle = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _refuse_folder(path: Path) -> None:
    """Raise BadInput if `path` is a folder or a special file."""
    with _reported(path):
        try:
            mode = path.stat().st_mode  # once: another process may write or remove it meanwhile
        except (FileNotFoundError, NotADirectoryError):
            return
        if stat.S_ISDIR(mode):
            raise BadInput(f"{path} is a folder; give the name of a file")
        if not stat.S_ISREG(mode):
            raise BadInput(f"{path} is not an ordinary file; give the name of a file")
