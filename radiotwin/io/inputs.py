"""Open input files of strangers, or check them before a library opens them.

An input must be a regular file (a pipe or a device may block for ever), be within the folder that
names it, and fit a size budget that is checked before memory is allocated.

XML is parsed without declared entities: a few lines can expand to gigabytes of text ("billion
laughs"), or include another file of this machine.
"""

import gzip
import io
import json
import mmap
import os
import re
import stat
import tomllib
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat

from radiotwin.errors import BadInput
from radiotwin.io.budgets import (
    DOCUMENT_BYTES,
    FILE_BYTES,
    NESTING,
    SETTINGS_BYTES,
    TAG_BYTES,
    Budget,
)

_KEY_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_KEY_DOT = r"[ \t]*+\.[ \t]*+"
_BLOCK_BYTES = 2**20
_PROGRAM = b"radiotwin"
_TABLES = (".csv", ".csv.gz", ".parquet")
_HEADER_BYTES = 2**16


def is_within(path: Path, *folders: Path) -> bool:
    """Return whether a path is within one of the folders, with links resolved."""
    try:
        return any(path.resolve().is_relative_to(folder.resolve()) for folder in folders)
    except (OSError, RuntimeError, ValueError):  # circular links, a name that no file can have
        return False


def require_within(folder: Path, path: Path, source: str) -> Path:
    """Return a path unchanged; raise unless it is, with links resolved, within a folder.

    Args:
        folder: the only folder that may be read.
        path: of a file that another file names.
        source: file, and line if known, that names it, for the message.

    Raises:
        BadInput: the path leaves the folder by `..`, by its root, or by a symbolic link.
    """
    if not is_within(path, folder):
        raise BadInput(f"{source}: {path} leads out of {folder}; only files in that folder may be "
                       "named: copy the file there")
    return path


def keep_inputs(out: Path, *read: Path | None) -> None:
    """Raise BadInput if writing `out` would replace a file or folder that the command reads."""
    for path in read:
        if path is not None and is_within(path, out):
            raise BadInput(f"cannot write {out}: the command reads {path}, which would be lost; "
                           "choose another output path")


def keep_others(out: Path, force: bool, *marks: str) -> None:
    """Raise BadInput if an output would replace a file that this program did not write.

    Args:
        out: path that a command is to write.
        force: replace any file.
        marks: columns by which a table of this command is recognised; other files are recognised by
            the name of this program in them.
    """
    path, suffix = out / "zarr.json" if out.is_dir() else out, out.suffix.lower()
    if force or not path.is_file() or not path.stat().st_size:
        return
    names = [mark.encode() for mark in marks if out.name.lower().endswith(_TABLES)]
    with suppress(OSError, EOFError, zlib.error), open(path, "rb") as file:
        if names and suffix != ".parquet":
            with gzip.open(file) if suffix == ".gz" else nullcontext(file) as table:
                if {*names} <= {*re.split(rb"[,\r\n]", table.readline(_HEADER_BYTES))}:
                    return
        else:
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                if all(content.find(name) >= 0 for name in names or [_PROGRAM]):
                    return
    raise BadInput(f"{out} is there, and this command did not write it: choose another output "
                   "path, or replace it with --force")


def require_plain(folder: Path) -> None:
    """Raise BadInput if a folder contains a link, a pipe or a device, at any depth."""
    for entry in os.scandir(folder):
        if entry.is_dir(follow_symlinks=False):
            require_plain(Path(entry.path))
        elif not entry.is_file(follow_symlinks=False):
            kind = "a symbolic link" if entry.is_symlink() else "a pipe or a device"
            raise BadInput(f"{entry.path} is {kind}; only regular files and folders may be in "
                           f"{folder}: remove it")


def check_input(path: Path | str, what: str = "file") -> int:
    """Check a file that a library will open, and return its size [bytes]; see `open_input`."""
    with open_input(path, what) as file:
        return os.fstat(file.fileno()).st_size


@contextmanager
def open_input(path: Path | str, what: str = "file",
               budget: Budget = FILE_BYTES) -> Iterator[IO[bytes]]:
    """Open a regular file for reading.

    Args:
        path: of the file.
        what: kind of file that is expected, for the message, such as `radio map (.nc)`.
        budget: of its bytes, checked before the first is read.

    Raises:
        BadInput: no such file, a folder, a pipe, a device, no permission, or too large.
    """
    try:
        # Without O_NONBLOCK the opening of a pipe would wait for a writer.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)
                         | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0))
    except FileNotFoundError:
        raise BadInput(f"{path} does not exist; give the path of a {what}") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        reason = getattr(error, "strerror", None) or error
        raise BadInput(f"{path} cannot be read ({reason}); give the path of a {what}") from None
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode):
        os.close(handle)
        kind = ("a folder" if stat.S_ISDIR(status.st_mode)
                else "not a regular file (a pipe or a device)")
        raise BadInput(f"{path} is {kind}; give the path of a {what}")
    with open(handle, "rb") as file:
        budget.check(status.st_size, path)
        yield file


def read_bytes(path: Path | str, what: str = "file", budget: Budget = FILE_BYTES) -> bytes:
    """Read all bytes of a file; BadInput: see `open_input`."""
    with open_input(path, what, budget) as file:
        # `read` allocates the size that is asked for, so ask for the file's size only.
        data = _read(file, path, os.fstat(file.fileno()).st_size + 1)
        while more := _read(file, path, _BLOCK_BYTES):  # a growing file, or one of /proc
            data += more
            budget.check(len(data), path)
    return data


def read_text(path: Path | str, what: str = "text file",
              budget: Budget = DOCUMENT_BYTES) -> str:
    """Read a text in UTF-8, with or without a byte-order mark; BadInput if it is not UTF-8."""
    return decode_text(read_bytes(path, what, budget), path)


def decode_text(data: bytes, path: object) -> str:
    """Decode a text in UTF-8, with or without a byte-order mark; BadInput if it is not UTF-8."""
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise BadInput(f"{path} is not text in UTF-8 (byte {error.start + 1}); save it as "
                       "UTF-8") from None


def read_json(path: Path | str) -> Any:
    """Read a JSON document; NaN and infinity are refused. BadInput: see `parse_json`."""
    return parse_json(read_text(path, "JSON file"), path)


def parse_json(text: str, source: object, allow_nan: bool = False) -> Any:
    """Parse a JSON document.

    Args:
        text: of the document.
        source: file or other origin, with which messages begin.
        allow_nan: accept NaN and infinity, which some programs write; the caller checks numbers.

    Raises:
        BadInput: not JSON, nested too deeply, or a number of too many digits.
    """
    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is no JSON number")

    try:
        return json.loads(text, parse_constant=None if allow_nan else refuse)
    except RecursionError:
        NESTING.refuse(source, f"more than {NESTING.limit} levels of nesting")
    except ValueError as error:
        raise BadInput(f"{source} is not readable JSON ({error}); make or export it "
                       "again") from None


def read_toml(path: Path | str, what: str = "TOML file") -> dict[str, Any]:
    """Read a TOML document; BadInput if it is no TOML, nested too deeply, or has long numbers."""
    text = read_text(path, what, SETTINGS_BYTES)
    # The memory of tomllib grows with the square of the parts of a key.
    if re.search(rf"(?:^|[\[{{,])[ \t]*+{_KEY_PART}(?:{_KEY_DOT}{_KEY_PART}){{{NESTING.limit}}}",
                 text, re.MULTILINE):
        NESTING.refuse(path, f"a key of more than {NESTING.limit} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        NESTING.refuse(path, f"more than {NESTING.limit} levels of nesting")
    except ValueError as error:  # TOMLDecodeError, or too many digits
        raise BadInput(f"{path} is not readable TOML ({error}); correct that line") from None


@contextmanager
def open_gzip(path: Path | str, what: str = "file",
              budget: Budget = FILE_BYTES) -> Iterator[IO[bytes]]:
    """Open a file for reading, and decompress it if its name ends in `.gz` or `.GZ`.

    Yields:
        binary file of at most `budget` bytes; reading more, or damaged data, raises BadInput.

    Raises:
        BadInput: see `open_input`.
    """
    with open_input(path, what, budget) as file:
        if Path(path).suffix.lower() != ".gz":
            yield file
            return
        with bounded(file, path, True, budget) as content:
            yield content


@contextmanager
def bounded(file: IO[bytes], source: object, is_gzip: bool,
            budget: Budget = FILE_BYTES) -> Iterator[IO[bytes]]:
    """Wrap an open file, such as a member of a zip file, so that decompression is bounded.

    Yields:
        binary file of at most `budget` bytes; reading more, or damaged data, raises BadInput.
    """
    content = gzip.GzipFile(fileobj=file) if is_gzip else file
    with io.BufferedReader(_Bounded(content, source, budget), _BLOCK_BYTES) as buffered:
        yield buffered


class _Bounded(io.RawIOBase):
    """Decompressed bytes up to a budget."""

    def __init__(self, content: Any, path: object, budget: Budget) -> None:
        self._content, self._path, self._budget, self._left = content, path, budget, budget.limit

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer; BadInput once more bytes than the budget were decompressed."""
        data = _read(self._content, self._path, len(buffer))
        self._left -= len(data)
        if self._left < 0:
            self._budget.refuse(self._path,
                                f"more than {self._budget.limit:,} bytes when decompressed")
        buffer[:len(data)] = data
        return len(data)


def _read(file: Any, path: object, size: int) -> bytes:
    """Read up to `size` bytes from a file; BadInput if it is damaged or truncated."""
    try:
        return file.read(size)
    except (OSError, EOFError, zlib.error) as error:
        raise BadInput(f"{path} cannot be read ({error}); it is damaged or cut off: make or fetch "
                       "it again") from None


def parse_elements(path: Path, start: Callable[[str, dict[str, str], int], None],
                   end: Callable[[str], None] = lambda tag: None,
                   budget: Budget = FILE_BYTES,
                   text: Callable[[str], None] | None = None) -> int:
    """Parse an XML file with callbacks for its elements; return the bytes read.

    Args:
        path: XML file.
        start: called as `start(tag, attributes, line)` at the beginning of an element.
        end: called as `end(tag)` at its end.
        budget: of the file's bytes.
        text: called with each piece of text between tags; None: texts are not read.

    Raises:
        BadInput: no such file, malformed XML (with line and column), declared entities, or a file
            or a tag that is too large.
    """
    parser = expat.ParserCreate()

    def refuse_entity(name: str, *_: object) -> None:
        raise BadInput(f"{path}, line {parser.CurrentLineNumber}: declares the entity "
                       f"{name[:60]!r}, which can stand for any amount of text or for another "
                       "file; remove the <!DOCTYPE …> with its entities")

    parser.StartElementHandler = lambda tag, attributes: start(
        tag, attributes, parser.CurrentLineNumber)
    parser.EndElementHandler = end
    if text is not None:
        parser.CharacterDataHandler = text
    parser.EntityDeclHandler = refuse_entity
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    size = 0
    try:
        with open_input(path, "XML file", budget) as file:
            while block := file.read(_BLOCK_BYTES):
                size += len(block)
                budget.check(size, path)  # the file may grow
                parser.Parse(block, False)
                # Expat reads an unfinished tag from its beginning in every call.
                TAG_BYTES.check(size - max(parser.CurrentByteIndex, 0),
                                f"{path}, line {parser.CurrentLineNumber}")
            parser.Parse(b"", True)
    except (ValueError, LookupError, TypeError) as error:  # an encoding that Python does not know
        raise BadInput(f"{path}: its XML cannot be decoded ({error}); save it as UTF-8") from None
    except expat.ExpatError as error:
        raise BadInput(f"{path}, line {error.lineno}, column {error.offset + 1}: malformed XML "
                       f"({expat.ErrorString(error.code)}); correct or export the file "
                       "again") from None
    return size
