"""How the page of a ride looks: for phone and desktop, light and dark, with nothing to fetch."""

from __future__ import annotations

import html
from collections.abc import Sequence

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
.about, .note, .unit, figcaption span { color: var(--muted); font-size: .85rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: .6rem; margin: .8rem 0; }
.tiles div { background: var(--card); border-radius: .5rem; padding: .5rem .7rem; }
.tiles b { display: block; font-size: 1.25rem; font-variant-numeric: tabular-nums; }
.tiles span { color: var(--muted); font-size: .8rem; }
figure { margin: 1.6rem 0 0; } figcaption b { margin-right: .3rem; }
.key { margin-left: .8rem; white-space: nowrap; }
.key i { display: inline-block; width: .9rem; height: .25rem; margin-right: .3rem; vertical-align: middle;
 background: currentColor; }
.plot { position: relative; height: 9rem; margin: .6rem 1.4rem 2rem 2.6rem; }
.plot svg, .strip svg, .bar svg { position: absolute; left: 0; width: 100%; height: 100%; overflow: visible; }
.plot span { position: absolute; font-size: .75rem; color: var(--muted); line-height: 1; white-space: nowrap; }
.plot .y { right: 100%; margin-right: .35rem; transform: translateY(-50%); }
.plot .x { top: 100%; margin-top: .35rem; transform: translateX(-50%); }
path { fill: none; stroke: currentColor; stroke-width: 1.4; vector-effect: non-scaling-stroke;
 stroke-linejoin: round; stroke-linecap: round; }
path.grid { stroke: var(--grid); stroke-width: 1; } path.band { fill: currentColor; stroke: none; opacity: .2; }
path.box { fill: currentColor; stroke: none; } path.dashed { stroke-dasharray: 5 4; stroke: var(--muted); }
path.way { stroke-width: 3; } path.dot { stroke-width: 12; } path.bar { stroke-width: 3; stroke: var(--ink); }
.map { display: block; width: 100%; max-height: 34rem; background: var(--card); border-radius: .5rem; }
.strip { margin: .5rem 1.4rem 0 2.6rem; font-size: .85rem; } .strip div { position: relative; height: .8rem; }
.strip div { background: var(--card); }
table { border-collapse: collapse; width: 100%; font-size: .9rem; font-variant-numeric: tabular-nums; }
td, th { padding: .25rem .5rem .25rem 0; border-bottom: 1px solid var(--grid); text-align: left; vertical-align: top; }
th { font-weight: 600; } .n { text-align: right; white-space: nowrap; } .summary td:first-child { width: 8.5rem; }
td.bar { width: 40%; position: relative; } td.bar svg { top: 15%; height: 70%; }
.total tr:last-child { font-weight: 600; } .at { white-space: nowrap; } .scroll { overflow-x: auto; }
.blue { color: var(--blue); } .orange { color: var(--orange); } .green { color: var(--green); }
.red { color: var(--red); } .purple { color: var(--purple); } .grey { color: var(--grey); }
.amber { color: var(--amber); } .muted { color: var(--muted); }
@media print { figure, table { break-inside: avoid; } }
"""
_POLICY = "default-src 'none'; style-src 'unsafe-inline'"
"""What a browser may fetch for the page: nothing."""


def page(title: str, body: Sequence[str]) -> str:
    """The whole page; body: HTML."""
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
