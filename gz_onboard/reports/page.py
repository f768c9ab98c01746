"""Reports: one look for all self-contained HTML pages, tables as HTML or Markdown, pictures inside a page."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

from gz_onboard.errors import writable
from gz_onboard.reports.style import picture_format, write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
:root { color-scheme: light dark; --ground: #fff; --ink: #1f2933; --muted: #616e7c; --grid: #e4e7eb; --card: #f5f7fa;
 --blue: #1667b7; --orange: #c2620a; --green: #2f855a; --red: #c53030; --purple: #6b46c1; --grey: #9fb3c8;
 --amber: #e8a33d; }
@media (prefers-color-scheme: dark) { :root { --ground: #12181f; --ink: #e4e7eb; --muted: #9aa5b1; --grid: #323f4b;
 --card: #1f2933; --blue: #62b0f5; --orange: #f2a154; --green: #63c794; --red: #f58a8a; --purple: #b794f4;
 --grey: #7b8794; --amber: #e8a33d; } }
* { box-sizing: border-box; }
body { font: 1rem/1.4 system-ui, sans-serif; color: var(--ink); background: var(--ground); max-width: 62rem;
 margin: 0 auto; padding: 0 1rem 3rem; overflow-wrap: break-word; }
h1 { font-size: 1.5rem; margin: 1.2rem 0 .3rem; } h2 { font-size: 1.3rem; margin: 2rem 0 .2rem; }
h3 { font-size: 1rem; margin: 1.8rem 0 .3rem; } p { margin: .3rem 0; } a { color: var(--blue); }
.about, .note { color: var(--muted); font-size: .85rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: .6rem; margin: .8rem 0; }
.tiles div { background: var(--card); border-radius: .5rem; padding: .5rem .7rem; }
.tiles b { display: block; font-size: 1.25rem; font-variant-numeric: tabular-nums; }
.tiles span { color: var(--muted); font-size: .8rem; }
figure { margin: 1.6rem 0 0; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; font-variant-numeric: tabular-nums; }
td, th { padding: .25rem .5rem .25rem 0; border-bottom: 1px solid var(--grid); text-align: left; vertical-align: top; }
th { font-weight: 600; } .n { text-align: right; white-space: nowrap; } .summary td:first-child { width: 8.5rem; }
td.bar { width: 40%; } td.bar i { display: block; height: .8rem; background: currentColor; min-width: 1px; }
.total tr:last-child { font-weight: 600; } .at { white-space: nowrap; } .scroll { overflow-x: auto; }
.blue { color: var(--blue); } .orange { color: var(--orange); } .green { color: var(--green); }
.red { color: var(--red); } .purple { color: var(--purple); } .grey { color: var(--grey); }
.amber { color: var(--amber); } .muted { color: var(--muted); }
.bad { text-align: right; white-space: nowrap; background: var(--red); color: var(--ground); font-weight: 600; }
.no { background: var(--card); padding: .5rem .8rem; border-left: .25rem solid var(--amber); }
pre { background: var(--card); border-radius: .5rem; padding: .8rem; overflow-x: auto; }
summary { cursor: pointer; padding: .3rem 0; font-weight: 600; } nav a { margin-right: .8rem; }
.wide table { min-width: 38rem; }
.drawn { display: block; width: 100%; height: auto; } .scroll .drawn { min-width: 38rem; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(19rem, 100%), 1fr)); gap: 0 1rem; }
@media (prefers-color-scheme: dark) { .drawn { filter: invert(1) hue-rotate(180deg); mix-blend-mode: screen; } }
@media print { figure, table { break-inside: avoid; } }
"""
WIDE_INCHES = 8.0
"""A wider figure is scrolled on a phone, or its texts could not be read."""
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""A browser may fetch nothing for the page."""


class Failed(str):
    """A cell whose value is beyond its limit."""

    __slots__ = ()


class Subheading(str):
    """The only cell of a row that names those below it."""

    __slots__ = ()


def page(title: str, body: Sequence[str]) -> str:
    """A self-contained page for phone and desktop, light and dark; body: HTML."""
    named = html.escape(title)
    return "\n".join(
        [
            f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{named}</title>',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head><body>',
            *body,
            "</body></html>\n",
        ]
    )


def write_page(file: Path, title: str, body: Sequence[str]) -> None:
    """Write a page with `title` above the HTML of `body`. Raises OSError."""
    text = page(title, [f"<h1>{html.escape(title)}</h1>", *body])
    file.write_text(text, encoding="utf-8", errors="replace")


def tiles(values: Sequence[tuple[str, str, str]]) -> str:
    """Cards of a (key, value, text) each; value and text: HTML."""
    boxes = "".join(f'<div><b data-of="{key}">{value}</b><span>{text}</span></div>' for key, value, text in values)
    return f'<div class="tiles">{boxes}</div>'


def html_table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = (), anchors: Sequence[str] = ()
) -> str:
    """A table of texts; numbers: the columns to be aligned to the right; anchors: the first cell of each row links."""

    def cell(i: int, text: str) -> str:
        kind = " class=bad" if isinstance(text, Failed) else " class=n" if i in numbers else ""
        return f"<td{kind}>{html.escape(text)}</td>"

    lines = ["".join(f"<th{' class=n' if i in numbers else ''}>{html.escape(h)}</th>" for i, h in enumerate(heads))]
    for i, row in enumerate(rows):
        if isinstance(row[0], Subheading):
            lines.append(f"<th colspan={len(heads)}>{html.escape(row[0])}</th>")
            continue
        cells = [cell(column, text) for column, text in enumerate(row)]
        if anchors:
            cells[0] = f'<td><a href="#{anchors[i]}">{html.escape(row[0])}</a></td>'
        lines.append("".join(cells))
    wide = " wide" if len(heads) > 3 else ""
    return f'<div class="scroll{wide}"><table>' + "\n".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"


class Bar(NamedTuple):
    """A row of a `bar_table`: a bar from `begin` to `end`, and numbers. colour: a class of the style; empty: no bar."""

    name: str
    begin: float
    end: float
    colour: str
    cells: Sequence[str]


def bar_table(key: str, bars: Sequence[Bar], heads: Sequence[str] = (), kind: str = "") -> str:
    """A table with a horizontal bar in each row; key: its ``data-of``; kind: its class."""
    low = min(0.0, *(min(bar.begin, bar.end) for bar in bars))
    scale = 100 / (max(0.0, *(max(bar.begin, bar.end) for bar in bars)) - low or 1.0)
    lines = [f"<tr><th></th><th></th>{''.join(f'<th class=n>{head}</th>' for head in heads)}</tr>"] if heads else []
    for bar in bars:
        left, width = (min(bar.begin, bar.end) - low) * scale, abs(bar.end - bar.begin) * scale
        drawn = f'<i class="{bar.colour}" style="margin-left:{left:.1f}%;width:{width:.1f}%"></i>' if bar.colour else ""
        cells = "".join(f"<td class=n>{cell}</td>" for cell in bar.cells)
        lines.append(f'<tr><td>{html.escape(bar.name)}</td><td class="bar">{drawn}</td>{cells}</tr>')
    return f'<table class="{kind}" data-of="{key}">{"".join(lines)}</table>'


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same as Markdown; what failed in bold."""

    def line(row: Sequence[str]) -> list[str]:
        if isinstance(row[0], Subheading):
            return [f"*{row[0]}*", *[""] * (len(heads) - 1)]
        return [f"**{text}**" if isinstance(text, Failed) else text for text in row]

    lines = [list(heads), ["---"] * len(heads), *map(line, rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def write_below(file: Path, maker: str, text: str) -> None:
    """Write Markdown. Text of `file` above the mark of `maker` stays. Raises OSError."""
    mark = mark_of(maker)
    before = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    kept = f"{before.partition(mark)[0]}{mark}\n\n" if mark in before else ""
    file.write_text(kept + text, encoding="utf-8", errors="replace")


def mark_of(maker: str) -> str:
    """The comment in a page of Markdown below which `maker` writes."""
    return f"<!-- made by {maker} from here on -->"


def drawn(figure: Figure, label: str) -> str:
    """A figure inside a page as SVG, the same text for the same figure; label: for those who cannot see it."""
    picture = io.BytesIO()
    write(figure, picture, "svg")
    svg = re.sub(r"<metadata>.*?</metadata>", "", picture.getvalue().decode("utf-8"), flags=re.DOTALL)
    svg = re.sub(r"(?<=\.\d)\d+(?= )", "", svg[svg.index("<svg") :])  # a tenth of a point cannot be seen
    head = f'<svg class="drawn" role="img" aria-label="{html.escape(label)}" '
    shown = head + svg.removeprefix("<svg ")
    return f'<div class="scroll">{shown}</div>' if figure.get_figwidth() > WIDE_INCHES else shown


def image(file: Path) -> str:
    """The file of a picture inside a page; a link to a PDF, which no page can show. Raises OSError."""
    kind = picture_format(file)
    if kind == "pdf":
        return f"<a href='{html.escape(quote(file.name))}'>{html.escape(writable(file.name))}</a>"
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    return f'<img class="drawn" alt="" src="data:image/{"svg+xml" if kind == "svg" else kind};base64,{data}">'
