"""What the HTML pages share: their looks, tables, and figures inside the file, so that they open without a network."""

import base64
import html
from collections.abc import Sequence
from pathlib import Path

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c2733; background: #f6f7f8; margin: 0 }
main { max-width: 1080px; margin: 0 auto; padding: 2rem 1.2rem 4rem }
h1 { font-size: 1.9rem; margin: 0 } h2 { font-size: 1.2rem; margin: 2.4rem 0 .3rem }
p { margin: .3rem 0 .8rem; max-width: 46rem } .lead { font-size: 1.1rem }
img { max-width: 100%; background: #fff; border: 1px solid #dde2e6; border-radius: 6px }
table { border-collapse: collapse; background: #fff; font-variant-numeric: tabular-nums; font-size: .92rem }
caption { text-align: left; font-weight: 600; padding: .3rem 0 } .scroll { overflow-x: auto; margin: 1rem 0 }
th, td { padding: .3rem .7rem; text-align: right; border: 1px solid #dde2e6 } th { background: #eef1f3 }
th.text, td.text { text-align: left } tr.strong td { font-weight: 600; background: #eaf3f6 }
footer { margin-top: 3rem; color: #5b6b78; font-size: .85rem }
"""
TEXT, STRONG = ' class="text"', ' class="strong"'


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence], left: int = 1,
          strong: Sequence[int] = ()) -> str:
    """A table whose first `left` columns are text, with rows that stand out; floats get two decimals, NaN a dash."""
    def line(cells: Sequence, tag: str) -> str:
        return "".join(f'<{tag}{TEXT if number < left else ""}>{html.escape(_cell(cell))}</{tag}>'
                       for number, cell in enumerate(cells))
    body = "".join(f'<tr{STRONG if number in strong else ""}>{line(row, "td")}</tr>' for number, row in enumerate(rows))
    caption = f"<caption>{html.escape(title)}</caption>" if title else ""
    return f'<div class="scroll"><table>{caption}<tr>{line(columns, "th")}</tr>{body}</table></div>'


def image(path: Path, name: str) -> str:
    """A PNG file inside the page; nothing where there is none."""
    if not path.is_file():
        return ""
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img alt="{html.escape(name)}" src="data:image/png;base64,{data}">'


def details(summary: str, content: str) -> str:
    """Something that is folded away."""
    return f"<details><summary>{html.escape(summary)}</summary>{content}</details>"


def _cell(cell) -> str:
    if isinstance(cell, float):
        return "–" if cell != cell else f"{cell:.2f}"
    return str(cell)
