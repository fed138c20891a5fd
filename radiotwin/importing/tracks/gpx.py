"""Track points of a GPX file (https://www.topografix.com/GPX/1/1/)."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.importing.tracks.fixes import Fixes, make_fixes
from radiotwin.io.budgets import ROWS
from radiotwin.io.cells import shown
from radiotwin.io.safe_xml import parse_elements

_MAX_TEXT = 100  # characters of a time or a height


class _Points:
    """Collects track points while the file is parsed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.rows: list[tuple[float, float, float, float]] = []  # time, latitude, longitude, height
        self._point: dict[str, str] | None = None
        self._text = ""
        self._line = 0

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        if _local(tag) == "trkpt":
            self._point, self._line = dict(attributes), line
        self._text = ""

    def text(self, text: str) -> None:
        if self._point is not None and len(self._text) < _MAX_TEXT:
            self._text += text[:_MAX_TEXT]

    def end(self, tag: str) -> None:
        if self._point is None:
            return
        name = _local(tag)
        if name in ("ele", "time"):
            self._point.setdefault(name, self._text.strip())
        elif name == "trkpt":
            ROWS.check(len(self.rows) + 1, self._path)
            self.rows.append((self._time(), self._number("lat"), self._number("lon"),
                              self._number("ele")))
            self._point = None

    def _number(self, name: str) -> float:
        text = (self._point or {}).get(name, "nan")
        try:
            return float(text)
        except ValueError:
            raise BadInput(f"{self._path}, line {self._line}: {name} = {shown(text)} is not a "
                           "number") from None

    def _time(self) -> float:
        text = (self._point or {}).get("time")
        if text is None:
            return np.nan
        try:
            stamp = datetime.fromisoformat(text)
            return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError):
            raise BadInput(f"{self._path}, line {self._line}: time {shown(text)} is not ISO 8601, "
                           "as GPX prescribes") from None


def read_gpx(path: Path) -> Fixes:
    """Read the track points of a GPX file; times without an offset are UTC, as GPX prescribes.

    Args:
        path: of the file.

    Raises:
        BadInput: no GPX, or fewer than two track points have a time.
    """
    points = _Points(path)
    parse_elements(path, points.start, points.end, text=points.text)
    columns = np.array(points.rows, dtype=float).reshape(-1, 4).T
    return make_fixes(path, columns[0], dict(zip(("latitude", "longitude", "altitude"),
                                                 columns[1:])))


def _local(tag: str) -> str:
    return tag.rpartition(":")[2]
