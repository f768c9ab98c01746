"""Reports: tables as HTML or Markdown, pictures inside an HTML page that needs no other file."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from gz_onboard.errors import writable
from gz_onboard.offline.style import GRID, INK, picture_format, write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = f"""
body {{ font-family: system-ui, sans-serif; color: {INK}; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; }}
table {{ border-collapse: collapse; margin: 0.5rem 0 1.5rem; font-size: 0.9rem; font-variant-numeric: tabular-nums; }}
td, th {{ padding: 0.2rem 0.6rem; border-bottom: 1px solid {GRID}; text-align: left; vertical-align: top; }}
th {{ font-weight: 600; vertical-align: bottom; }}
.n, .bad {{ text-align: right; }} td.n, td.bad {{ white-space: nowrap; }}
.bad {{ background: #fde8e8; color: #9b1c1c; font-weight: 600; }}
.no {{ background: #fdf1e3; padding: 0.5rem 1rem; border-left: 4px solid #e9a03b; }}
figure {{ margin: 1.5rem 0; }} svg {{ width: 100%; height: auto; }} img {{ width: 100%; }}
pre {{ background: #f5f7fa; padding: 1rem; overflow-x: auto; }}
"""


class Failed(str):
    """A cell whose value is beyond its limit."""

    __slots__ = ()


class Subheading(str):
    """The only cell of a row that names those below it."""

    __slots__ = ()


def write_page(file: Path, title: str, body: Sequence[str]) -> None:
    """Write a page with `title` above the HTML of `body`. Raises OSError."""
    named = html.escape(title)
    lines = "\n".join(body)
    file.write_text(
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{named}</title><style>{_STYLE}</style>'
        f"</head><body><h1>{named}</h1>\n{lines}\n</body></html>\n",
        encoding="utf-8",
        errors="replace",
    )


def html_table(heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """A table of texts; numbers: the columns to be aligned to the right."""

    def cell(i: int, text: str) -> str:
        kind = " class=bad" if isinstance(text, Failed) else " class=n" if i in numbers else ""
        return f"<td{kind}>{html.escape(text)}</td>"

    lines = ["".join(f"<th{' class=n' if i in numbers else ''}>{html.escape(h)}</th>" for i, h in enumerate(heads))]
    for row in rows:
        if isinstance(row[0], Subheading):
            lines.append(f"<th colspan={len(heads)}>{html.escape(row[0])}</th>")
        else:
            lines.append("".join(cell(i, text) for i, text in enumerate(row)))
    return "<table>" + "\n".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same as Markdown; what failed in bold."""

    def line(row: Sequence[str]) -> list[str]:
        if isinstance(row[0], Subheading):
            return [f"*{row[0]}*", *[""] * (len(heads) - 1)]
        return [f"**{text}**" if isinstance(text, Failed) else text for text in row]

    lines = [list(heads), ["---"] * len(heads), *map(line, rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def write_below(file: Path, maker: str, text: str) -> None:
    """Write Markdown. Where `file` says that the rest is made by `maker`, what is above it stays. Raises OSError."""
    mark = mark_of(maker)
    before = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    kept = f"{before.partition(mark)[0]}{mark}\n\n" if mark in before else ""
    file.write_text(kept + text, encoding="utf-8", errors="replace")


def mark_of(maker: str) -> str:
    """The comment in a page of Markdown below which `maker` writes."""
    return f"<!-- made by {maker} from here on -->"


def svg(figure: Figure) -> str:
    """A figure as SVG inside a page, the same text for the same figure."""
    stream = io.BytesIO()
    write(figure, stream, "svg")
    return "<svg" + stream.getvalue().decode("utf-8").partition("<svg")[2]


def image(file: Path) -> str:
    """The file of a picture inside a page; a link to a PDF, which no page can show. Raises OSError."""
    kind = picture_format(file)
    if kind == "pdf":
        return f"<a href='{html.escape(quote(file.name))}'>{html.escape(writable(file.name))}</a>"
    return embedded(file.read_bytes(), "svg+xml" if kind == "svg" else kind)


def embedded(picture: bytes, kind: str = "png") -> str:
    """A picture inside a page."""
    return f'<img alt="" src="data:image/{kind};base64,{base64.b64encode(picture).decode("ascii")}">'
