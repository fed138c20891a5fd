"""Read tables of a stranger's SQLite file.

Only plain table scans are allowed: no view, trigger, virtual table, computed column, function or
second file is evaluated.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.io.budgets import FEATURES, FILE_BYTES, Budget
from radiotwin.io.inputs import check_input, open_input

_MAGIC = b"SQLite format 3\0"
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_PRAGMA)


@contextmanager
def open_tables(path: Path, what: str) -> Iterator[sqlite3.Connection]:
    """Open a database read-only, with everything but table scans disabled.

    Raises:
        BadInput: no such file, no SQLite, or one that another program has open.
        sqlite3.Error: a damaged database.
    """
    with open_input(path, what) as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise BadInput(f"{path} is not a readable {what} (it is no SQLite database); export "
                           "it again")
    for suffix in ("-wal", "-journal"):
        log = path.with_name(path.name + suffix)
        if log.exists() and check_input(log, "log of SQLite"):
            raise BadInput(f"{log} holds changes that are not in {path.name} yet: another program "
                           "has it open, or was killed; close or open and close it there")
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1",
                                 uri=True)) as database:
        database.text_factory = lambda data: data.decode("utf-8", "replace")
        database.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(FILE_BYTES.limit, 2**31 - 1))
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("PRAGMA cell_size_check = ON")
        database.set_authorizer(lambda action, *_: sqlite3.SQLITE_OK if action in _ALLOWED
                                else sqlite3.SQLITE_DENY)
        yield database


def require_table(database: sqlite3.Connection, name: str) -> None:
    """Raise sqlite3.Error unless a name is that of an ordinary table."""
    for kind, known, text in scan(database, "sqlite_master", ["type", "name", "sql"]):
        if str(known).lower() != name.lower() or kind not in ("table", "view"):
            continue
        if kind == "view" or str(text).split()[:2] and \
                [word.lower() for word in str(text).split()[:2]] != ["create", "table"]:
            raise sqlite3.DatabaseError(
                f"{name!r} is a view or a virtual table, only tables are read")
        return
    raise sqlite3.DatabaseError(f"it has no table {name!r}")


def scan(database: sqlite3.Connection, table: str, columns: list[str],
         budget: Budget = FEATURES) -> Iterator[tuple]:
    """Yield columns of every row of a table that passed `require_table`.

    Raises:
        BadInput: too many rows.
        sqlite3.Error: no such column, or a damaged database.
    """
    missing = set(columns) - {row[1] for row in stored_columns(database, table)}
    if missing:  # or a computed one, or in SQLite's reading of quotation marks a text
        raise sqlite3.DatabaseError(f"{table!r} has no column {min(missing)!r}")
    names = ", ".join(map(_quoted, columns))
    rows = database.execute(f"SELECT {names} FROM {_quoted(table)} NOT INDEXED")
    for number, row in enumerate(rows):
        if number >= budget.limit:  # a damaged tree of pages may be endless
            budget.refuse(table, f"more than {budget.limit:,} rows")
        yield row


def stored_columns(database: sqlite3.Connection, table: str) -> list[tuple]:
    """Return number, name, type, … of a table's stored columns, without computed ones."""
    return database.execute(f"PRAGMA table_info({_quoted(table)})").fetchall()


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
