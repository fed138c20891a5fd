"""Figures that a page quotes from the tables of the studies, and those that it should have quoted.

A quotation is a comment behind the figure: `6.2 dB<!--campus: 60 m blocks, twin; combined-->`, with the study, the
beginning of the row's cells, and a part of the column's heading. `<!--models: RBM, traced; …; …-->` also names the table.
"""

import re
from functools import cache
from pathlib import Path

RESULTS = Path(__file__).parents[1] / "docs" / "results"
NUMBER = r"[-−–]?\d+(?:,\d{3})*(?:\.\d+)?"
UNIT = r"(?: ?(?:dB|%|m|km|s|h|°|ms|GiB|MiB|min|nats|links/s))?"
QUOTATION = re.compile(rf"(?P<said>{NUMBER}(?: of {NUMBER})?){UNIT}\**<!--(?P<study>\w+): (?P<where>[^>]+?)-->")
FIGURE = re.compile(rf"(?<![\w.]){NUMBER}(?: of {NUMBER})?{UNIT}(?![\w<]|\.\d)")


def plain(cell):
    """Return a cell without its marks."""
    return re.sub(r"[*`]", "", cell).strip()


@cache
def tables(study):
    """Return title, headings and rows of each table of a study's page."""
    found, title, heads = [], "", None
    for line in (RESULTS / f"{study}.md").read_text(encoding="utf-8").splitlines():
        if not line.startswith("|"):
            title, heads = (line if line else title), None
        elif heads is None:
            heads = [plain(each) for each in line.split("|")[1:-1]]
            found.append((plain(title), heads, []))
        elif not line.startswith("|--"):
            found[-1][2].append([plain(each) for each in line.split("|")[1:-1]])
    return found


def cell(study, where):
    """Return the one cell that a quotation names."""
    *table, row, column = [each.strip() for each in where.split(";")]
    found = {}
    for title, heads, rows in tables(study):
        columns = [i for i, head in enumerate(heads) if head == column] or [i for i, head in enumerate(heads) if column in head]
        for cells in rows if all(each in title for each in table) else []:
            if columns and (", ".join(cells) + ",").startswith(row + ","):
                found[title, tuple(cells)] = [cells[i] for i in columns]
    exact = {key: cells for key, cells in found.items() if key[1][0] == row}
    found = exact or found
    assert len(found) == 1, f"{study}: {where}: {len(found)} rows"
    only, = found.values()
    assert len(only) == 1, f"{study}: {where}: {len(only)} columns"
    return only[0]


def numbers(text):
    """Return the numbers of a text, as they are written without thousands' commas."""
    return [each.replace(",", "").replace("−", "-").replace("–", "") for each in re.findall(NUMBER, text)]


def is_quoted(said, text):
    """Return whether the figures that are said stand in a cell, rounded as far as they are said."""
    known = [float(each) for each in numbers(text) if each]
    for each in numbers(said):
        digits = len(each.partition(".")[2])
        sign = abs if each[0] != "-" else float  # without a sign it is a size
        if not any(abs(float(each) - sign(value)) <= 0.5 * 10**-digits + 1e-9 for value in known):
            return False
    return True


def wrong_quotations(page):
    """Return the quotations of a page that are not what the tables say."""
    found = [(match["said"], match["study"], match["where"]) for match in QUOTATION.finditer(page)]
    assert len(found) == page.count("-->"), "a comment is no quotation"
    return [(said, study, where, cell(study, where)) for said, study, where in found if not is_quoted(said, cell(study, where))]


def unquoted_figures(page):
    """Return the decimal figures, percentages and shares of a page's prose and tables that are no quotations."""
    text = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", QUOTATION.sub("", page), flags=re.DOTALL)
    return [each for each in FIGURE.findall(text) if re.search(r"\d\.\d|%|dB| of \d", each)]
