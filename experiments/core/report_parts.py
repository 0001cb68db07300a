"""What every report shows alike: its head, the data and the time, the configuration."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.core.page import Html, image, row, table, tag
from experiments.core.text import plain


def header(
    question: str, rest: str, description: Mapping[str, Any], settings: Mapping[str, Any], verdict: Sequence[str]
) -> Html:
    """Question, settings, verdict, and the rest of the experiment's docstring folded away.

    Args:
      question: first line of the docstring; `rest` what follows it.
      description: content of the run's `config.json`.
      settings: what a reader must know first.
      verdict: sentences.
    """
    git = description["git"]
    shown = {
        **settings,
        "scale": description["scale"],
        "code": git["commit"][:12] + (" with local changes" if git["dirty"] else ""),
    }
    items = [tag("li", f"{name} ", tag("b", plain(value))) for name, value in shown.items()]
    return tag(
        "header",
        tag("h1", description["experiment"]),
        tag("p", question, class_="question"),
        tag("ul", *items, class_="settings"),
        tag("div", *[tag("p", sentence) for sentence in verdict], class_="verdict") if verdict else "",
        tag("details", tag("summary", "About this experiment"), tag("pre", rest, class_="about")) if rest else "",
    )


def curve_figure(phase: str, names: Sequence[str], svg: bytes) -> Html:
    """The training curves of one phase."""
    return tag("figure", image(svg, "svg+xml", f"Training curves of {phase}: {', '.join(names)}"))


def curve_section(title: str, figures: Mapping[str, Html]) -> Html:
    """The figure of each phase, nothing where there is none."""
    if not figures:
        return Html("")
    note = "Thin: one line per seed. Bold: mean over seeds, averaged over a twentieth of the points."
    phases = [part for phase, figure in figures.items() for part in (tag("h3", phase), figure)]
    return tag("section", tag("h2", title), tag("p", note, class_="note"), *phases)


def data_and_time(data: Mapping[str, Any], timing: Mapping[str, float], title: str = "Data and time") -> Html:
    """Tables of the data and of the seconds of each stage, summed over seeds."""
    seconds: dict[str, list[float]] = {}
    for stage, value in timing.items():
        seconds.setdefault(stage.rpartition("/")[0] or stage, []).append(value)
    times = [row(name, str(len(s)), f"{sum(s) / len(s):,.1f}", f"{sum(s):,.1f}", head=1) for name, s in seconds.items()]
    sizes = [row(name, plain(value), head=1) for name, value in data.items()]
    parts = [
        tag("div", tag("h3", "Data"), table(["Quantity", "value"], sizes)) if sizes else Html(""),
        tag("div", tag("h3", "Wall time"), table(["Stage", "runs", "mean (s)", "all (s)"], times))
        if times
        else Html(""),
    ]
    return tag("section", tag("h2", title), tag("div", *parts, class_="columns"))


def appendix(description: Mapping[str, Any]) -> Html:
    """The resolved configuration."""
    text = json.dumps(description, indent=2, ensure_ascii=False)
    return tag("section", tag("h2", "Configuration"), tag("details", tag("summary", "config.json"), tag("pre", text)))
