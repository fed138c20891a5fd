"""List and open the files of an import: single files, folders, and zip files."""

import io
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath
from typing import IO

from radiotwin.errors import BadInput
from radiotwin.io.budgets import FILE_BYTES, IMPORT_FILES, ROW_BYTES, Budget
from radiotwin.io.inputs import bounded, decode_text, is_within, open_gzip, open_input

JSON = (".json", ".jsonl", ".ndjson", ".geojson", ".geojsonl")
TEXTS = (".csv", ".tsv", ".txt", ".log", *JSON)
BINARIES = (".parquet", ".xlsx")
_WHAT = f"log ({', '.join((*TEXTS, *BINARIES))}), folder or .zip"
BLOCK_BYTES = 2**20  # that are read at once
HEAD_BYTES = 2**16  # in which the kind of a text is recognised
_DIRECTORY_BYTES = 4 * 2**20  # of a zip's list of files, which takes ten times that in memory
_END, _END_64 = b"PK\x05\x06", b"PK\x06\x07"  # APPNOTE.TXT 6.3.10, 4.3.16 and 4.3.15


@dataclass(frozen=True)
class LogFile:
    """A file, or a member of a zip file, which is read without being extracted.

    Attributes:
        path: of the file, or of the zip file.
        name: of the file relative to the given folder, or in the zip file.
        member: name in the zip file, or None.
    """

    path: Path
    name: str
    member: str | None = None

    def __str__(self) -> str:
        return str(self.path) if self.member is None else f"{self.path}: {self.member}"

    @property
    def suffix(self) -> str:
        """Suffix of the name in lower case, without `.gz`."""
        return PurePath(self.name.lower().removesuffix(".gz")).suffix

    @contextmanager
    def open(self) -> Iterator[IO[bytes]]:
        """Open the file for reading, decompressed and bounded; BadInput if it cannot be read."""
        if self.member is None:
            with open_gzip(self.path, _WHAT) as file:
                yield file
            return
        with open_archive(self.path) as archive, open_member(archive, self.member, self) as packed:
            with bounded(packed, self, self.member.lower().endswith(".gz")) as content:
                yield content

    def read_text(self, budget: Budget) -> str:
        """Read the file as text in UTF-8; BadInput if it is not UTF-8, or too large."""
        with self.open() as file:
            data = bytearray()
            while block := file.read(BLOCK_BYTES):  # a single read would allocate the limit
                data += block
                budget.check(len(data), self)
        return decode_text(bytes(data), self)


@dataclass(frozen=True)
class Sheet(LogFile):
    """A sheet of a workbook as comma-separated text.

    Attributes:
        text: in UTF-8.
    """

    text: bytes = b""

    @contextmanager
    def open(self) -> Iterator[IO[bytes]]:
        """Open the text for reading."""
        yield io.BytesIO(self.text)


def list_files(paths: Iterable[Path | str],
               without: Iterable[Path | str]) -> tuple[list[LogFile], int]:
    """List the files to import, by name in each folder (with those in it) and zip file.

    Files and folders of `without` are skipped, such as tables of positions and the output, and so
    are hidden ones (`.name`, `__MACOSX` of a zip file).

    Returns:
        the files, and the number of others in folders and zip files: those of other formats, and
        `.parquet` and `.xlsx` in a zip file, which cannot be read there.

    Raises:
        BadInput: a path cannot be read, or there are none or too many files.
    """
    excluded = {_resolved(Path(path)) for path in without}
    found: dict[tuple[Path, str | None], LogFile] = {}
    others = 0
    for path in map(Path, paths):
        if os.path.isdir(path):
            files, strange = _in_folder(path, excluded)
        elif path.suffix.lower() == ".zip":
            files, strange = _in_archive(path)
        else:
            files, strange = [LogFile(path, path.name)], 0
        others += strange
        if not files:
            raise BadInput(f"{path} holds no file of a format that is read; allowed are "
                           f"{', '.join((*TEXTS, *BINARIES))}, and the first ones with .gz")
        found |= {(_resolved(file.path), file.member): file for file in files}
        IMPORT_FILES.check(len(found), path)
    return list(found.values()), others


def flight_names(files: list[LogFile]) -> list[str]:
    """Return a unique name of each file: without its ending, else with it, else its path."""
    stems = [PurePosixPath(re.sub(r"\.gz$", "", file.name, flags=re.IGNORECASE)).stem
             for file in files]
    if len(set(stems)) == len(stems):
        return stems
    names = [file.name for file in files]
    return names if len(set(names)) == len(names) else [str(file) for file in files]


@contextmanager
def open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip file for reading, after checks of its size when unpacked and its members.

    Raises:
        BadInput: no zip file, encrypted, of an unusual compression, or too large.
    """
    with open_input(path, "zip file") as file:
        try:
            _check_directory(file, path)
            archive = zipfile.ZipFile(file)
        except (zipfile.BadZipFile, struct.error, ValueError, NotImplementedError) as error:
            raise BadInput(f"{path} is no readable zip file ({error}); make it again") from None
        with archive:
            entries = archive.infolist()
            IMPORT_FILES.check(len(entries), path)
            FILE_BYTES.check(sum(entry.file_size for entry in entries), path)
            for entry in entries:
                if entry.flag_bits & 1:
                    raise BadInput(f"{path}: {entry.filename[:200]!r} is encrypted; unpack it, or "
                                   "make a zip file without a password")
                if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise BadInput(f"{path}: {entry.filename[:200]!r} has an unusual compression; "
                                   "allowed are stored and deflated: make the zip file again")
            yield archive


@contextmanager
def open_member(archive: zipfile.ZipFile, name: str, source: object) -> Iterator[IO[bytes]]:
    """Open a member of a zip file; BadInput if it is damaged."""
    try:
        with archive.open(name) as content:
            yield content
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, struct.error, ValueError,
            NotImplementedError, RuntimeError) as error:  # the last one of an encrypted file
        raise BadInput(f"{source}: {name[:200]!r} is damaged ({str(error)[:200]}); make the zip "
                       "file again") from None


def _check_directory(file: IO[bytes], path: Path) -> None:
    """Raise BadInput if a zip file's list of files is too long; `ZipFile` would read it all."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - 2**16 - 22, 0))  # the list's end: 22 bytes and a comment
    tail = file.read()
    end = tail.rfind(_END)
    if end < 0:
        raise zipfile.BadZipFile("it has no end of the list of its files")
    if tail[max(end - 20, 0):end].startswith(_END_64):
        IMPORT_FILES.refuse(path, "a zip file in the format for more than 65,535 files or 4 GiB")
    if struct.unpack("<I", tail[end + 12:end + 16])[0] > _DIRECTORY_BYTES:
        IMPORT_FILES.refuse(path, f"a list of files of more than {_DIRECTORY_BYTES:,} bytes")
    file.seek(0)


def _in_archive(path: Path) -> tuple[list[LogFile], int]:
    """Return the files in a zip file that are texts, and the number of the others."""
    with open_archive(path) as archive:
        names = [entry.filename for entry in archive.infolist() if not entry.is_dir()]
    names = sorted(name for name in names if not _is_hidden(PurePosixPath(name)))
    if len(set(names)) != len(names):
        raise BadInput(f"{path} holds two files of one name; make the zip file again")
    files = [LogFile(path, name, name) for name in names]
    # Parquet and workbooks are read from their end, which a zip member does not allow.
    kept = [file for file in files if file.suffix in TEXTS]
    return kept, len(files) - len(kept)


def _in_folder(folder: Path, excluded: set[Path]) -> tuple[list[LogFile], int]:
    """Return the files of known formats in a folder, recursively, and the number of others."""
    files, others = [], 0
    for root, folders, names in os.walk(folder):
        folders[:] = (name for name in folders if not name.startswith(".")
                      and _resolved(Path(root) / name) not in excluded)
        for name in names:
            path = Path(root) / name
            file = LogFile(path, path.relative_to(folder).as_posix())
            if name.startswith(".") or _resolved(path) in excluded:
                continue
            if file.suffix not in (*TEXTS, *BINARIES):
                others += 1
                continue
            if not is_within(path, folder):
                raise BadInput(f"{path} is a link that leads out of {folder}; give the file itself")
            files.append(file)
            IMPORT_FILES.check(len(files), folder)
    return sorted(files, key=lambda file: file.name), others


def _is_hidden(name: PurePosixPath) -> bool:
    return any((part.startswith(".") and part != "..") or part == "__MACOSX"
               for part in name.parts)


def _resolved(path: Path) -> Path:
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):  # an impossible name: opening it raises BadInput
        return path


class Lines:
    """Iterate over the lines of a text, with a bound of their length.

    Args:
        text: opened with `newline=""`.
        source: of the text, for messages.

    Attributes:
        number: of the last line, from 1.
    """

    def __init__(self, text: io.TextIOWrapper, source: object) -> None:
        self._text, self._source, self.number = text, source, 0

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = self._text.readline(ROW_BYTES.limit)
        if not line:
            raise StopIteration
        if len(line) == ROW_BYTES.limit and not line.endswith(("\n", "\r")):
            ROW_BYTES.refuse(f"{self._source}: line {self.number + 1}",
                             f"a line of {ROW_BYTES.limit:,} characters and more")
        self.number += 1
        return line if self.number > 1 else line.removeprefix("\ufeff")
