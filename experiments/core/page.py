"""HTML by construction: text is escaped unless it is already `Html`, and a page needs nothing from outside itself."""

import base64
import html
from collections.abc import Sequence

STYLE = """
:root { color-scheme: light; --ink: #1d2126; --quiet: #626b76; --line: #dfe3e8; --wash: #f6f7f9; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2.5rem 1.5rem 4rem; max-width: 68rem; background: #fff; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .4rem; letter-spacing: -.01em; }
h2 { font-size: 1.25rem; margin: 2.8rem 0 .6rem; padding-top: .9rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
p { margin: .5rem 0; max-width: 46rem; }
.question { font-size: 1.15rem; }
.verdict { background: var(--wash); border-left: 4px solid #0072b2; padding: .8rem 1.1rem; margin: 1.2rem 0; }
.verdict p { margin: .25rem 0; max-width: none; }
.note { color: var(--quiet); font-size: .875rem; }
.settings { display: flex; flex-wrap: wrap; gap: .4rem .5rem; padding: 0; margin: 1rem 0; list-style: none; }
.settings li { background: var(--wash); border: 1px solid var(--line); border-radius: .3rem; padding: .1rem .55rem;
  font-size: .875rem; }
.settings b { font-weight: 600; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; margin: .7rem 0; }
caption { text-align: left; color: var(--quiet); font-size: .875rem; padding: .2rem 0; }
th, td { padding: .32rem .7rem; text-align: right; vertical-align: top; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: .2rem; }
thead th { font-weight: 600; border-bottom: 2px solid var(--ink); vertical-align: bottom; }
tbody tr { border-bottom: 1px solid var(--line); }
tbody tr.first { border-top: 2px solid var(--line); }
tbody th { font-weight: 500; }
tbody th:first-child { white-space: normal; }
tr.baseline th, tr.baseline td { color: var(--quiet); }
td.text, th.text { text-align: left; }
td.text { white-space: normal; min-width: 11rem; }
td.long { min-width: 34rem; }
.ci { display: block; color: var(--quiet); font-size: .75rem; font-weight: 400; }
.better { color: var(--quiet); font-weight: 400; }
.swatch { display: inline-block; width: .7em; height: .7em; border-radius: 50%; margin-right: .45em; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; }
figcaption { color: var(--quiet); font-size: .875rem; max-width: 46rem; }
.rollout { border: 1px solid var(--line); border-radius: .4rem; padding: 1rem 1.2rem; margin: 1.1rem 0; }
.rollout h3 { margin-top: 0; }
.touch { display: flex; gap: 1.2rem; align-items: flex-start; flex-wrap: wrap; }
.touch figure { margin: .4rem 0; }
.view { width: 9rem; image-rendering: pixelated; border-radius: .2rem; }
.strips { flex: 1 1 30rem; min-width: 0; }
.strip { display: block; width: 100%; }
.forces { display: grid; color: var(--quiet); font-size: .72rem; text-align: center;
  font-variant-numeric: tabular-nums; }
.fields { display: flex; flex-wrap: wrap; gap: 0 1rem; }
.fields figure { margin: .4rem 0; }
.field { width: 11rem; border-radius: .2rem; }
td .trace { margin: 0; padding: .3rem .5rem; }
.trace { background: var(--wash); border-radius: .3rem; padding: .7rem .9rem; margin: .7rem 0; white-space: pre-wrap;
  overflow-wrap: anywhere; font: .875rem/1.7 ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace; }
mark { color: inherit; border-radius: .2rem; padding: .08rem .2rem; }
mark.perceive { background: #d3e8f6; }
mark.compare { background: #fbe6bd; }
mark.conclude { background: #cdeedd; }
.bar { position: relative; width: 10rem; height: .7rem; background: var(--wash); margin-top: .35rem; }
.bar i { position: absolute; top: 0; bottom: 0; background: #0072b2; }
.bar i.negative { background: #d55e00; }
.columns { display: flex; flex-wrap: wrap; gap: 0 3rem; }
details { margin: 1rem 0; }
summary { cursor: pointer; }
pre { background: var(--wash); padding: .8rem 1rem; overflow-x: auto; font-size: .8rem; line-height: 1.45; }
pre.about { white-space: pre-wrap; }
@media print { body { max-width: none; padding: 0; } .rollout { break-inside: avoid; } }
"""


class Html(str):
    """Markup that is already safe to insert."""


def tag(name: str, *children: str, **attributes: str | int) -> Html:
    """An element; an attribute that is a Python keyword takes a trailing underscore (`class_`)."""
    written = "".join(f' {key.rstrip("_")}="{html.escape(str(value))}"' for key, value in attributes.items())
    return Html(f"<{name}{written}>{join(children)}</{name}>")


def join(children: Sequence[str]) -> Html:
    """The children one after the other, plain text escaped."""
    return Html("".join(child if isinstance(child, Html) else html.escape(child) for child in children))


def row(*cells: str, head: int = 0, cell: str = "td", **attributes: str | int) -> Html:
    """A table row whose first `head` cells are headings; finished cells are taken as they are."""
    made = [
        text if isinstance(text, Html) and text.startswith(("<td", "<th")) else tag("th" if i < head else cell, text)
        for i, text in enumerate(cells)
    ]
    return tag("tr", *made, **attributes)


def table(head: Sequence[str], rows: Sequence[Html], caption: str = "") -> Html:
    """A table that scrolls sideways on its own where it is too wide."""
    above = [tag("caption", caption)] if caption else []
    return tag("div", tag("table", *above, tag("thead", row(*head, cell="th")), tag("tbody", *rows)), class_="wide")


def image(content: bytes, kind: str, alt: str, class_: str = "picture") -> Html:
    """An image that travels inside the page.

    Args:
      kind: "svg+xml" or "png".
    """
    data = base64.b64encode(content).decode()
    source = f"data:image/{kind};base64,{data}"
    return Html(f'<img class="{html.escape(class_)}" src="{source}" alt="{html.escape(alt)}">')


def document(title: str, *body: Html, reload_s: int | None = None) -> str:
    """A whole page; with `reload_s` a browser reads it again every so many seconds."""
    meta = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    if reload_s is not None:
        meta += f'<meta http-equiv="refresh" content="{reload_s}">'
    head = tag("head", Html(meta), tag("title", title), tag("style", Html(STYLE)))
    return f'<!DOCTYPE html>\n<html lang="en">{head}{tag("body", *body)}</html>\n'
