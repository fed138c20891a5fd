"""Finished parts of long work, kept between runs: a killed run goes on where it was.

A part is the result of a function of known inputs. Its name is the hash of all that decides it: the
inputs, the sources of this package, and the versions of the libraries that compute it. So whatever
asks for the same part gets the same bits, and nothing is ever out of date.

Work keeps its parts inside `with keep_pieces():`; elsewhere `kept` only calls the function.
"""

from __future__ import annotations

import io
import json
import os
import platform
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.budgets import CACHE_BYTES, PIECE_BYTES
from radiotwin.io.content_hash import Unhashable, content_hash
from radiotwin.io.files import atomic_path
from radiotwin.io.inputs import read_bytes
from radiotwin.io.signals import note_finished

Piece = tuple[dict[str, np.ndarray], Any]
"""Arrays by name, and what JSON can hold."""
P = TypeVar("P")
T = TypeVar("T")

MIN_SECONDS = 0.05  # a part that took less is made again sooner than it is written
LEFT_SHARE = 0.9  # of the limit, after the oldest parts were removed
LIBRARIES = ("numpy", "scipy", "numba", "embreex", "torch", "sionna-rt", "mitsuba", "drjit")
_DAMAGE = (BadInput, OSError, ValueError, KeyError, TypeError, IndexError, AttributeError,
           EOFError, zipfile.BadZipFile)


def pieces_folder() -> Path:
    """Return the folder of the parts: in `RADIOTWIN_CACHE`, or the user's folder of caches."""
    own = os.environ.get("RADIOTWIN_CACHE")
    if own:
        return Path(own) / "pieces"
    caches = os.environ.get("XDG_CACHE_HOME")
    return (Path(caches) if caches else Path.home() / ".cache") / "radiotwin" / "pieces"


@dataclass(eq=False)
class PieceStore:
    """Parts in a folder.

    Attributes:
        folder: of the files.
        earlier: parts that this run took from an earlier one.
        made: parts that it made.
        saved: of these, those that were written.
        failed: why nothing more is written; empty while all is well.
        shown: warnings of parts that this run has shown.
    """

    folder: Path
    earlier: int = 0
    made: int = 0
    saved: int = 0
    failed: str = ""
    shown: set[str] = field(default_factory=set)
    _own: set[str] = field(default_factory=set)
    _bytes: int | None = None

    @property
    def progress(self) -> str:
        """How many parts were taken from an earlier run; empty where none was."""
        if not self.earlier:
            return ""
        return (f"{self.earlier} of {self.earlier + self.made} parts were kept from an earlier "
                "run")

    def get(self, name: str, unpack: Callable[[dict[str, np.ndarray], Any], T],
            ) -> tuple[T, list[str]] | None:
        """Return a part and the warnings that it came with; None where it is absent or damaged."""
        path = self.folder / f"{name}.npz"
        try:
            if not path.is_file():
                return None
            arrays, (content, messages) = _decode(read_bytes(path, budget=PIECE_BYTES))
            value = unpack(arrays, content), [str(message) for message in messages]
        except _DAMAGE:
            return None
        with suppress(OSError):
            os.utime(path)  # the oldest use, not the oldest part, is removed first
        return value

    def put(self, name: str, piece: Piece, messages: list[str]) -> None:
        """Write a part; on failure, warn once and write no more."""
        if self.failed:
            return
        data = _encode(piece[0], [piece[1], messages])
        if len(data) > PIECE_BYTES.limit:
            return
        try:
            # Not flushed to the disk: a part that a power failure has damaged is made again.
            with atomic_path(self.folder / f"{name}.npz", flush=False) as temporary:
                temporary.write_bytes(data)
        except (BadInput, RunFailed, OSError) as error:
            self.failed = str(error)
            warnings.warn(f"finished parts are not kept: {error}", stacklevel=2)
            return
        self.saved += 1
        note_finished()
        self._own.add(name)
        self._shrink(len(data))

    def files(self) -> list[tuple[float, int, Path]]:
        """Return time of the last use [s], size [bytes] and path of every part."""
        found = []
        with suppress(OSError):
            for entry in os.scandir(self.folder):
                with suppress(OSError):
                    if entry.name.endswith(".npz") and not entry.name.startswith(".") \
                            and entry.is_file(follow_symlinks=False):
                        status = entry.stat(follow_symlinks=False)
                        found.append((status.st_mtime, status.st_size, Path(entry.path)))
        return found

    def clear(self) -> int:
        """Remove all parts; return their number."""
        count = 0
        for _, _, path in self.files():
            with suppress(FileNotFoundError):
                path.unlink()
                count += 1
        return count

    def _shrink(self, more: int) -> None:
        """Count bytes that were written; remove the oldest parts if there are too many."""
        if self._bytes is None:
            self._bytes = sum(size for _, size, _ in self.files())
        else:
            self._bytes += more
        if self._bytes <= CACHE_BYTES.limit:
            return
        files = sorted(self.files())  # again: other processes write and remove, too
        self._bytes = sum(size for _, size, _ in files)
        for _, size, path in files:
            if self._bytes <= LEFT_SHARE * CACHE_BYTES.limit:
                break
            with suppress(OSError):
                path.unlink()
            self._bytes -= size


def cache_content() -> dict[str, Any]:
    """Return what is kept of finished and of killed runs.

    Returns:
        `folder`, `bytes`, `limit_bytes`, and `parts`: kind -> `parts` (their number) and `bytes`.
    """
    store = PieceStore(pieces_folder())
    by_kind: dict[str, dict[str, int]] = {}
    for _, size, path in sorted(store.files(), key=lambda file: file[2].name):
        kind = by_kind.setdefault(path.stem.rpartition("-")[0], {"parts": 0, "bytes": 0})
        kind["parts"] += 1
        kind["bytes"] += size
    return {"folder": str(store.folder), "bytes": sum(each["bytes"] for each in by_kind.values()),
            "limit_bytes": CACHE_BYTES.limit, "parts": by_kind}


def clear_cache() -> int:
    """Remove all that is kept of finished and of killed runs; return the number of parts."""
    return PieceStore(pieces_folder()).clear()


_stores: list[PieceStore] = []  # the last one is in use


@contextmanager
def keep_pieces(folder: Path | None = None) -> Iterator[PieceStore]:
    """Keep finished parts of the work inside, and take those of earlier runs.

    Args:
        folder: of the parts; None: `pieces_folder`.

    Yields:
        the store, which counts.
    """
    store = PieceStore(pieces_folder() if folder is None else folder)
    _stores.append(store)
    try:
        yield store
    finally:
        _stores.remove(store)


def with_pieces(function: Callable[[P], T]) -> Callable[[P], T]:
    """Return a function that keeps parts where this process does, in other processes, too."""
    return _Keeping(function, _stores[-1].folder) if _stores else function


@dataclass(frozen=True)
class _Keeping(Generic[P, T]):
    function: Callable[[P], T]
    folder: Path

    def __call__(self, piece: P) -> T:
        if _stores:
            return self.function(piece)
        with keep_pieces(self.folder):
            return self.function(piece)


def keeps() -> bool:
    """Return whether parts are kept now: inside `keep_pieces`."""
    return bool(_stores)


def kept(kind: str, inputs: tuple, make: Callable[[], T], pack: Callable[[T], Piece | None],
         unpack: Callable[[dict[str, np.ndarray], Any], T]) -> T:
    """Return the result of a function, from an earlier run where there is one.

    Args:
        kind: of the part; letters, digits and dashes.
        inputs: all that decides it; what `content_hash` knows, else the part is not kept.
        make: the function.
        pack: its result -> arrays and what JSON can hold; None if that cannot hold it.
        unpack: the reverse, to the bit; any error of it means that the part is damaged.
    """
    return kept_with_name(kind, inputs, make, pack, unpack)[0]


def kept_with_name(kind: str, inputs: tuple, make: Callable[[], T],
                   pack: Callable[[T], Piece | None],
                   unpack: Callable[[dict[str, np.ndarray], Any], T]) -> tuple[T, str]:
    """Return the result of a function as `kept`, and the hash of its inputs; "" without one."""
    parts: KeptParts[None, T] = KeptParts(kind, lambda _: inputs, pack, unpack)
    name = parts.name(None)
    if not name:
        return make(), ""
    found = parts.find(name)
    if found is not None:
        return found[0], name
    started = time.perf_counter()
    with noted_warnings() as messages:
        value = make()
    parts.keep(name, value, messages, time.perf_counter() - started)
    return value, name


@dataclass(frozen=True, eq=False)
class KeptParts(Generic[P, T]):
    """Parts of one kind in the store in use, by the pieces of work that they are of.

    Attributes:
        kind: as of `kept`.
        inputs: piece -> all that decides its part; what `content_hash` knows, else it is not kept.
        pack, unpack: as of `kept`.
    """

    kind: str
    inputs: Callable[[P], tuple]
    pack: Callable[[T], Piece | None]
    unpack: Callable[[dict[str, np.ndarray], Any], T]

    def name(self, piece: P) -> str:
        """Return the name of a part; "" where nothing is kept, or its inputs have no hash."""
        if not _stores:
            return ""
        try:
            return f"{self.kind}-{content_hash((self.kind, *versions(), *self.inputs(piece)))}"
        except Unhashable:
            return ""

    def get(self, piece: P) -> tuple[T] | None:
        """Return a part in a tuple, with its warnings shown; None where there is none."""
        name = self.name(piece)
        return self.find(name) if name else None

    def put(self, piece: P, value: T, messages: list[str], seconds: float) -> None:
        """Keep a part that was made, with the warnings that were shown, and the time it took."""
        name = self.name(piece)
        if name:
            self.keep(name, value, messages, seconds)

    def find(self, name: str) -> tuple[T] | None:
        """Return the part of a name as `get` does."""
        store = _stores[-1]
        found = store.get(name, self.unpack)
        if found is None:
            return None
        value, messages = found
        if name not in store._own:
            store.earlier += 1
            note_finished()
        for message in messages:
            if message not in store.shown:
                store.shown.add(message)
                warnings.warn(message, stacklevel=1)
        return (value,)

    def keep(self, name: str, value: T, messages: list[str], seconds: float) -> None:
        """Keep the part of a name as `put` does."""
        store = _stores[-1]
        store.shown.update(messages)
        store.made += 1
        if seconds >= MIN_SECONDS:
            packed = self.pack(value)
            if packed is not None:
                store.put(name, packed, messages)


@cache
def versions() -> tuple[str, ...]:
    """Return hashes and versions of the code that makes parts."""
    from importlib.metadata import PackageNotFoundError, version

    found = [platform.python_version(), platform.machine()]
    for name in LIBRARIES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    root = Path(__file__).parents[1]
    sources = sorted(root.rglob("*.py"))
    return (*found, content_hash(tuple((path.relative_to(root).as_posix(), path.read_bytes())
                                       for path in sources)))


@contextmanager
def noted_warnings() -> Iterator[list[str]]:
    """Yield a list that gets the texts of the warnings that are shown meanwhile."""
    # `warnings.catch_warnings` would forget which ones were shown before.
    show, messages = warnings.showwarning, list[str]()

    def note(message: Warning | str, category: type[Warning], *args: Any, **options: Any) -> None:
        if category is UserWarning:  # others, as numpy's of a division by zero, are no messages
            messages.append(str(message))
        show(message, category, *args, **options)

    warnings.showwarning = note
    try:
        yield messages
    finally:
        warnings.showwarning = show


def _encode(arrays: dict[str, np.ndarray], content: Any) -> bytes:
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(content).encode(), dtype=np.uint8)
    np.savez(buffer, **{**arrays, "_json": text})  # type: ignore[arg-type]  # not its options
    return buffer.getvalue()


def _decode(data: bytes) -> Piece:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:  # its sizes are claims
        PIECE_BYTES.check(sum(entry.file_size for entry in archive.infolist()), "part")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise ValueError("compressed")
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return arrays, json.loads(arrays.pop("_json").tobytes())
