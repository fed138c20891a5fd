"""Render HTML pages that are one file each: style, scripts and figures are inside.

What a page shows may come from somebody else. All of it is escaped, nothing that a text holds can
run: the browser runs the scripts of this package alone, which the page names by their hashes.
"""

import base64
import hashlib
import os
import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from radiotwin.errors import BadInput
from radiotwin.io.budgets import PICTURE_BYTES, PICTURE_PIXELS
from radiotwin.io.files import atomic_file
from radiotwin.io.inputs import read_bytes, require_within
from radiotwin.io.texts import shown, shown_data

MAX_ROWS = 5000  # of a table
MAX_NOTES = 200
STYLE = "style.css"
PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"


@dataclass(frozen=True)
class Table:
    """A table of a page.

    Attributes:
        columns: headings.
        rows: cells; numbers of type float get two decimals, NaN a dash. Beyond `MAX_ROWS` they
            are counted.
        title: caption; empty: none.
        text_columns: number of columns, from the left, that hold text.
        strong: indices of the rows that are emphasised.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence]
    title: str = ""
    text_columns: int = 1
    strong: Collection[int] = ()


class PictureData(str):
    """A figure as a `data:` address: the only text of a page that is never shortened."""


@dataclass(frozen=True)
class Picture:
    """A figure of a page with its heading and its description.

    Attributes:
        panels: labels of its panels, equally wide and side by side; empty: it has one panel.
    """

    title: str
    source: PictureData
    text: str = ""
    panels: Sequence[str] = ()


def read_picture(folder: Path, name: str, title: str, text: str = "",
                 panels: Sequence[str] = ()) -> Picture | None:
    """Read a PNG file of a folder for a page; None if the folder lacks it.

    Raises:
        BadInput: it leads out of the folder, is not PNG, or is too large.
    """
    path = folder / name
    if not os.path.isfile(path):
        return None
    data = read_bytes(require_within(folder, path, str(folder)), "figure (PNG)", PICTURE_BYTES)
    if not data.startswith(PNG) or len(data) < 24:
        raise BadInput(f"{path} is not a PNG file; make the run again, or remove it")
    width, height = struct.unpack(">II", data[16:24])
    PICTURE_PIXELS.check(width * height, path)
    encoded = base64.b64encode(data).decode()
    return Picture(title, PictureData(f"data:image/png;base64,{encoded}"), text, panels)


def write_page(template: str, path: Path | str, context: dict[str, Any],
               scripts: Sequence[tuple[str, str]] = ()) -> None:
    """Render a template of this package to a file, completely or not at all.

    Args:
        template: file name of the template.
        path: HTML file.
        context: variables of the template.
        scripts: (package, file) of each script that the page runs, in this order.
    """
    style, sources = _source("radiotwin.report", STYLE), [_source(*script) for script in scripts]
    page = _environment().get_template(template).render(
        context | {"style": style, "scripts": sources, "policy": _policy(style, sources)})
    with atomic_file(path) as file:
        file.write(page.encode())


@cache
def _source(package: str, name: str) -> Markup:
    """Read a style sheet or a script that is shipped with a package; it is not escaped."""
    return Markup(files(package).joinpath("static", name).read_text(encoding="utf-8"))


def _policy(style: Markup, scripts: Sequence[Markup]) -> str:
    """Return a content security policy that allows this style and these scripts by their hashes."""
    def hashes(sources: Sequence[Markup]) -> str:
        digests = [hashlib.sha256(source.encode()).digest() for source in sources]
        return " ".join(f"'sha256-{base64.b64encode(each).decode()}'" for each in digests) \
            or "'none'"

    return "; ".join(["default-src 'none'", f"script-src {hashes(scripts)}",
                      f"style-src {hashes([style])}", "img-src data:", "connect-src 'none'",
                      "base-uri 'none'", "form-action 'none'",
                      "require-trusted-types-for 'script'", "trusted-types 'none'"])


@cache
def _environment() -> Environment:
    """Return the template engine: all values are escaped, missing variables are errors."""
    environment = Environment(
        loader=PackageLoader("radiotwin.report"), autoescape=True, undefined=StrictUndefined,
        finalize=_final, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    environment.filters |= {"cell": _cell, "shown_data": shown_data}
    environment.globals |= {"max_rows": MAX_ROWS, "max_notes": MAX_NOTES}
    return environment


def _final(value: object) -> object:
    """Make a printed value readable and short, unless it is markup or a figure of this package."""
    if isinstance(value, Markup | PictureData):
        return value
    return shown(str(value))


def _cell(value: object) -> str:
    """Return a table cell: a float with two decimals, NaN as a dash."""
    if isinstance(value, float):
        return "–" if value != value else f"{value:.2f}".replace("-", "−")
    return str(value)
