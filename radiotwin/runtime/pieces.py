"""Cache of finished parts of long work, so that a killed run goes on where it was.

A part is the result of a function. Its name is the hash of the inputs, of the sources of this
package, and of the versions of the libraries that compute it, so that no part is ever out of date.

Parts are cached inside `with keep_pieces():`; elsewhere `cached` only calls the function.
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
from functools import cache, partial
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

MIN_SECONDS = 0.05  # a part that took less is computed again faster than it is written
LEFT_SHARE = 0.9  # of the size limit, to which the cache is reduced
LIBRARIES = ("numpy", "scipy", "numba", "embreex", "torch", "sionna-rt", "mitsuba", "drjit")
_DAMAGE = (BadInput, OSError, ValueError, KeyError, TypeError, IndexError, AttributeError,
           EOFError, zipfile.BadZipFile)


def pieces_folder() -> Path:
    """Return the folder of cached results: in `RADIOTWIN_CACHE`, or in the user's cache folder."""
    if given := os.environ.get("RADIOTWIN_CACHE"):
        return Path(given) / "pieces"
    caches = os.environ.get("XDG_CACHE_HOME")
    return (Path(caches) if caches else Path.home() / ".cache") / "radiotwin" / "pieces"


@dataclass(eq=False)
class PieceStore:
    """Cached parts in a folder, and what this run did with them.

    Attributes:
        folder: of the files.
        earlier: number of parts that were read from an earlier run.
        made: number of parts that were computed.
        saved: number of parts that were written.
        failed: why writing has stopped; empty if it has not.
        shown: warnings of parts that have been shown.
    """

    folder: Path
    earlier: int = 0
    made: int = 0
    saved: int = 0
    failed: str = ""
    shown: set[str] = field(default_factory=set)
    _written: set[str] = field(default_factory=set)
    _bytes: int | None = None

    @property
    def progress(self) -> str:
        """Message with the number of results from an earlier run; empty if there are none."""
        if not self.earlier:
            return ""
        return (f"{self.earlier} of {self.earlier + self.made} parts were kept from an earlier "
                "run")

    def get(self, name: str, unpack: Callable[[dict[str, np.ndarray], Any], T],
            ) -> tuple[T, list[str]] | None:
        """Read a cached result and its warnings; None if it is absent or damaged."""
        path = self.folder / f"{name}.npz"
        try:
            if not path.is_file():
                return None
            arrays, (content, messages) = _decode(read_bytes(path, budget=PIECE_BYTES))
            value = unpack(arrays, content), [str(message) for message in messages]
        except _DAMAGE:
            return None
        with suppress(OSError):
            os.utime(path)  # the least recently used part is removed first
        return value

    def put(self, name: str, piece: Piece, messages: list[str]) -> None:
        """Write a part (a cached result) to a file; on failure, warn once and write no more.

        A part larger than `PIECE_BYTES` is not written, without a warning.
        """
        if self.failed:
            return
        data = _encode(piece[0], [piece[1], messages])
        if len(data) > PIECE_BYTES.limit:
            return
        try:
            # Not flushed to the disk: a part that a power failure damages is computed again.
            with atomic_path(self.folder / f"{name}.npz", flush=False) as temporary:
                temporary.write_bytes(data)
        except (BadInput, RunFailed, OSError) as error:
            self.failed = str(error)
            warnings.warn(f"finished parts are not kept: {error}", stacklevel=2)
            return
        self.saved += 1
        note_finished()
        self._written.add(name)
        self._shrink(len(data))

    def files(self) -> list[tuple[float, int, Path]]:
        """Return time of last use [s since 1970], size [bytes] and path of every cached result."""
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
        """Remove all cached results; return their number."""
        count = 0
        for _, _, path in self.files():
            with suppress(FileNotFoundError):
                path.unlink()
                count += 1
        return count

    def _shrink(self, more: int) -> None:
        """Add written bytes to the size; remove the least recently used parts above the limit."""
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
    """Return the number and size of cached results, by kind.

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
    """Remove all parts from the cache; return their number."""
    return PieceStore(pieces_folder()).clear()


_stores: list[PieceStore] = []  # the last one is in use


@contextmanager
def keep_pieces(folder: Path | None = None) -> Iterator[PieceStore]:
    """Cache results of the block in a folder, and use those of earlier runs; yield the store.

    A part is the result of one call. `folder` None: `pieces_folder`.
    """
    store = PieceStore(pieces_folder() if folder is None else folder)
    _stores.append(store)
    try:
        yield store
    finally:
        _stores.remove(store)


def with_pieces(function: Callable[[P], T]) -> Callable[[P], T]:
    """Wrap a function so that it uses this process's cache in worker processes, too."""
    return partial(_call_with_pieces, function, _stores[-1].folder) if _stores else function


def _call_with_pieces(function: Callable[[P], T], folder: Path, piece: P) -> T:
    if _stores:
        return function(piece)
    with keep_pieces(folder):
        return function(piece)


def keeps() -> bool:
    """Return whether parts are cached now, inside `keep_pieces`."""
    return bool(_stores)


def cached(kind: str, inputs: tuple, make: Callable[[], T], pack: Callable[[T], Piece | None],
           unpack: Callable[[dict[str, np.ndarray], Any], T]) -> T:
    """Return the result of `make()`, from the cache if it is there.

    Args:
        kind: of the part; letters, digits and dashes.
        inputs: everything that the result depends on; not cached unless `content_hash` accepts it.
        make: the function.
        pack: result -> arrays and JSON data; None: it is not cached.
        unpack: the inverse, to the bit; an error means that the part is damaged.
    """
    return cached_with_name(kind, inputs, make, pack, unpack)[0]


def cached_with_name(kind: str, inputs: tuple, make: Callable[[], T],
                     pack: Callable[[T], Piece | None],
                     unpack: Callable[[dict[str, np.ndarray], Any], T]) -> tuple[T, str]:
    """Return the result of `make()` like `cached`, and its name in the cache; `""`: it has none."""
    parts: ResultCache[None, T] = ResultCache(kind, lambda _: inputs, pack, unpack)
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
class ResultCache(Generic[P, T]):
    """`jobs.Cache` over the store in use, for parts of one kind.

    Attributes:
        kind, pack, unpack: see `cached`.
        inputs: piece -> everything that its result depends on, see `cached`.
    """

    kind: str
    inputs: Callable[[P], tuple]
    pack: Callable[[T], Piece | None]
    unpack: Callable[[dict[str, np.ndarray], Any], T]

    def name(self, piece: P) -> str:
        """Return a result's name in the cache, from a hash of its inputs; `""`: it has none."""
        if not _stores:
            return ""
        try:
            return f"{self.kind}-{content_hash((self.kind, *versions(), *self.inputs(piece)))}"
        except Unhashable:
            return ""

    def get(self, piece: P) -> tuple[T] | None:
        """Return the part of a piece in a tuple, and show its warnings; None if there is none."""
        name = self.name(piece)
        return self.find(name) if name else None

    def put(self, piece: P, value: T, messages: list[str], seconds: float) -> None:
        """Store the part of a piece, with its warnings and its computing time [s]."""
        name = self.name(piece)
        if name:
            self.keep(name, value, messages, seconds)

    def find(self, name: str) -> tuple[T] | None:
        """Return the cached result of a name, in a tuple, or None; repeat its warnings once."""
        store = _stores[-1]
        found = store.get(name, self.unpack)
        if found is None:
            return None
        value, messages = found
        if name not in store._written:
            store.earlier += 1
            note_finished()
        for message in messages:
            if message not in store.shown:
                store.shown.add(message)
                warnings.warn(message, stacklevel=1)
        return (value,)

    def keep(self, name: str, value: T, messages: list[str], seconds: float) -> None:
        """Cache a result under a name if it took `MIN_SECONDS` or more, and can be packed."""
        store = _stores[-1]
        store.shown.update(messages)
        store.made += 1
        if seconds >= MIN_SECONDS:
            packed = self.pack(value)
            if packed is not None:
                store.put(name, packed, messages)


@cache
def versions() -> tuple[str, ...]:
    """Return the versions of Python and libraries, and the hash of this package's sources."""
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
    """Collect the texts of UserWarnings that the block raises; they are shown as well."""
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
    """Decode a cached result without running code; errors (`_DAMAGE`) mean that it is damaged."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:  # its sizes are claims
        PIECE_BYTES.check(sum(entry.file_size for entry in archive.infolist()), "part")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise ValueError("compressed")
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return arrays, json.loads(arrays.pop("_json").tobytes())
