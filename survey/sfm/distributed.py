"""Features and matches computed on the workers of a run: parts of COLMAP's database go there and come back.

A part is a database of the same schema (https://colmap.github.io/database.html) that holds the features of the images
of some pairs alone. Its matches and two-view geometries come back as rows.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
# Rows by the table that they are of.
Rows = Mapping[str, list[tuple]]

# Of large tables the rows of some images; of others, that matching fills, none.
_OF_IMAGES, _FILLED = ("keypoints", "descriptors"), ("matches", "two_view_geometries")


class Workers(Protocol):
    """Workers that compute a function of many items."""

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results in the order of the items."""


_WORKERS: ContextVar[Callable[[], AbstractContextManager[Workers]] | None] = ContextVar("workers", default=None)


@contextmanager
def computing_on(start: Callable[[], AbstractContextManager[Workers]]) -> Iterator[None]:
    """Within it, features and matches are computed on workers, which ``start`` gives when they are needed."""
    token = _WORKERS.set(start)
    try:
        yield
    finally:
        _WORKERS.reset(token)


def workers() -> AbstractContextManager[Workers] | None:
    """The workers to compute on; None where this process computes all itself."""
    start = _WORKERS.get()
    return None if start is None else start()


@dataclass(frozen=True)
class Part:
    """Pairs of images, and a database (bytes of its file) with their features."""

    pairs: tuple[tuple[str, str], ...]
    database: bytes


def part_of(database: Path, pairs: Sequence[tuple[str, str]]) -> Part:
    """The part of a database that some pairs of images need, without matches."""
    names = sorted({name for pair in pairs for name in pair})
    with TemporaryDirectory() as folder:
        path = Path(folder) / "part.db"
        with closing(sqlite3.connect(path)) as part, part:
            part.execute("ATTACH ? AS whole", (str(database),))
            part.execute(f"PRAGMA main.user_version = {part.execute('PRAGMA whole.user_version').fetchone()[0]}")
            made = part.execute("SELECT type, name, sql FROM whole.sqlite_master WHERE name NOT LIKE 'sqlite_%'")
            tables = []
            # Tables first: indices are made of them.
            for kind, name, sql in sorted(made.fetchall(), key=lambda row: row[0] != "table"):
                part.execute(sql)
                tables += [name] if kind == "table" else []
            part.execute("CREATE TEMP TABLE wanted (image_id INTEGER)")
            part.executemany(
                "INSERT INTO wanted SELECT image_id FROM whole.images WHERE name = ?", [(name,) for name in names]
            )
            for table in tables:
                if table not in _FILLED:
                    condition = " WHERE image_id IN (SELECT image_id FROM wanted)" if table in _OF_IMAGES else ""
                    part.execute(f"INSERT INTO main.{table} SELECT * FROM whole.{table}{condition}")
        return Part(tuple(pairs), path.read_bytes())


def rows_of(part: Part, match: Callable[[Path, Sequence[tuple[str, str]], Path, int], Any]) -> Rows:
    """Matches and two-view geometries of a part, computed on one thread of this process.

    ``match`` fills a database, given the pairs, a folder for its files, and the number of threads.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "part.db"
        path.write_bytes(part.database)
        match(path, part.pairs, Path(folder), 1)
        with closing(sqlite3.connect(path)) as database:
            return {table: database.execute(f"SELECT * FROM {table}").fetchall() for table in _FILLED}


def add_rows(database: Path, rows: Rows) -> None:
    """Add rows of `rows_of` to the whole database."""
    with closing(sqlite3.connect(database)) as connection, connection:
        for table, of_table in rows.items():
            if of_table:
                connection.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(of_table[0]))})", of_table)
