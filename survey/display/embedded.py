"""Tables and pictures as HTML inside notebooks."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable
from pathlib import Path


def table_html(rows: Iterable[tuple[str, object]]) -> str:
    """A table of labels and values."""
    lines = (
        f"<tr><th style='text-align: left'>{html.escape(label)}</th>"
        f"<td style='text-align: left'>{html.escape(str(value))}</td></tr>"
        for label, value in rows
    )
    return f"<table>{''.join(lines)}</table>"


def picture_html(path: Path) -> str:
    """A PNG, inside the page."""
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img alt="{html.escape(path.stem)}" style="max-width: 40em" src="data:image/png;base64,{data}">'
