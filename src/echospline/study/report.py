"""One self-contained HTML page: the report of a study."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from echospline.atomic import appearing

Cell = str | int | float | bool | None
_KINDS = {".png": "image/png", ".svg": "image/svg+xml"}
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 74rem; margin: 2rem auto; padding: 0 1rem; color: #1b1b1b; background: #fff; }
h1 { font-size: 1.6rem; } h2 { margin-top: 2.4rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 13px; display: block; overflow-x: auto; }
th, td { border: 1px solid #ddd; padding: .25rem .6rem; text-align: left; vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; } thead th { background: #f2f2f2; }
figure { margin: 1.5rem 0; } img { max-width: 100%; height: auto; } figcaption { color: #444; font-size: 13px; }
code { background: #f2f2f2; padding: 0 .25rem; }
"""


def table(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> str:
    """Return rows as an HTML table.

    Parameters
    ----------
    rows : sequence of mapping
        Values by key.
    columns : mapping
        Heading by key, in order.
    """
    head = "".join(f"<th>{escape(heading)}</th>" for heading in columns.values())
    body = "".join(f"<tr>{''.join(_cell(row.get(key)) for key in columns)}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def figure(path: Path, caption: str) -> str:
    """Return a picture embedded in HTML, so that the page needs no other file."""
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    source = f"data:{_KINDS[path.suffix]};base64,{data}"
    return f'<figure><img src="{source}" alt="{escape(caption, quote=True)}"><figcaption>{escape(caption)}</figcaption></figure>'


def paragraph(text: str) -> str:
    """Return plain text as a paragraph of HTML."""
    return f"<p>{escape(text)}</p>"


def write_report(path: Path, title: str, sections: Sequence[tuple[str, Sequence[str]]]) -> None:
    """Write the page.

    Parameters
    ----------
    path : Path
        Of the ``.html`` file.
    title : str
        Plain text.
    sections : sequence of (heading, parts)
        Parts are HTML made by the functions of this module.
    """
    body = "".join(
        f"<section><h2>{escape(heading)}</h2>{''.join(parts)}</section>" for heading, parts in sections
    )
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>{body}</body></html>\n"
    )
    with appearing(path) as part:
        part.write_text(page, encoding="utf-8")


def _cell(value: Cell) -> str:
    if isinstance(value, bool):
        return f"<td>{'yes' if value else 'no'}</td>"
    if isinstance(value, int | float):
        return (
            f'<td class="number">{value:.4g}</td>'
            if isinstance(value, float)
            else f'<td class="number">{value}</td>'
        )
    return f"<td>{'' if value is None else escape(str(value))}</td>"
