"""Render HTML pages that are one file each: style, scripts and figures are inside."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from radiotwin.files import atomic_path


@dataclass(frozen=True)
class Table:
    """A table of a page.

    Attributes:
        columns: headings.
        rows: cells; numbers of type float get two decimals, NaN a dash.
        title: caption; empty: none.
        text_columns: number of columns, from the left, that hold text.
        strong: indices of the rows that are emphasised.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence]
    title: str = ""
    text_columns: int = 1
    strong: Sequence[int] = ()


@dataclass(frozen=True)
class Picture:
    """A figure of a page with its heading and its description."""

    title: str
    source: str
    text: str = ""


def read_picture(folder: Path, name: str, title: str, text: str = "") -> Picture | None:
    """Read a PNG file of a folder to be put into a page; None where the folder does not hold it."""
    path = (folder / name).resolve()
    if path.parent != folder.resolve() or not path.is_file():  # a name may come with the run
        return None
    data = base64.b64encode(path.read_bytes()).decode()
    return Picture(title, f"data:image/png;base64,{data}", text)


def write_page(template: str, path: Path | str, context: dict[str, Any]) -> None:
    """Render a template of this package to a file, completely or not at all.

    Args:
        template: file name of the template.
        path: HTML file.
        context: variables of the template.
    """
    page = _environment().get_template(template).render(context)
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def source_text(name: str, package: str = "radiotwin.report") -> Markup:
    """Read a style sheet or a script that is shipped with a package; it is not escaped."""
    return Markup(files(package).joinpath("static", name).read_text(encoding="utf-8"))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("radiotwin.report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    environment.filters["cell"] = _cell
    environment.globals["source_text"] = source_text
    return environment


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "–" if value != value else f"{value:.2f}"
    return str(value)
