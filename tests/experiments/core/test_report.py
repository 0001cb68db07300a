"""The report is one well-formed page that needs nothing from outside and trusts no text."""

import base64
import dataclasses
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from experiments.core.artifacts import write_text
from experiments.core.look import PALETTE, SYMBOLS
from experiments.core.report import (
    MOST_BYTES,
    is_best,
    pieces,
    settings_in_words,
    webp,
    word_columns,
    write_report,
)
from experiments.core.results import Comparison, Estimate, Picture, Results, Trace, named_table
from experiments.core.text import MEANINGLESS, SMOKE, bounds, number, preset_in_words
from tests.experiments.core.test_results import FAST, SLOW
from tests.experiments.fakes import coin
from touchr1_jax.bench.metrics import METRICS

VOID = {"meta", "img", "br", "hr", "link", "input"}
SVG = b'<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>'
HOSTILE = '<script>alert("x")</script>&"\''
DESCRIPTION = {
    "experiment": "coin",
    "scale": "default",
    "config": {"steps": 3},
    "git": {"commit": "a" * 40, "dirty": True},
}


class PageReader(HTMLParser):
    """Checks that elements nest, and keeps the text, the elements and what they load."""

    def __init__(self) -> None:
        super().__init__()
        self.open, self.seen, self.loads, self.text = list[str](), set[str](), list[str](), ""

    def handle_starttag(self, tag, attrs):
        self.seen.add(tag)
        self.loads += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def read(page: str) -> PageReader:
    reader = PageReader()
    reader.feed(page)
    reader.close()
    assert not reader.open
    return reader


def row(value: float) -> dict[str, Estimate]:
    return {m: Estimate(mean=value, ci95=(value - 1, value + 1), per_seed=(value, value)) for m in METRICS}


def compared(metric: str, arm: str, against: str, low: float, high: float) -> Comparison:
    mean = (low + high) / 2
    return Comparison(
        metric=metric, arm=arm, against=against, difference=mean, ci95=(low, high), over="seeds", n=2, p_value=0.5
    )


TABLE = named_table(
    "Tiers",
    [{"tier": "spg", "time": -2.0, "ok": True}, {"tier": "winkler", "ok": False}],
    formats={"time": ".2f"},
    units={"time": "ms"},
    meanings={"time": "median"},
)
CHART = Picture(name="pareto", title="Speed", caption="left is faster", content=SVG)


@pytest.fixture
def results() -> Results:
    instead = {c: Trace(text=coin.TRACE, slots=coin.example().slots) for c in ("drop", "noise")}
    others = {"unpaid": dataclasses.replace(instead["drop"], right=False)}
    fields = {"xense": np.zeros((192, 192, 3), np.uint8)}
    return Results(
        arms={"paid": row(60.0), "unpaid": row(50.0)},
        baselines={"blind": row(30.0)},
        settings={"preset": "paper", "lr_scale": 100.0},
        comparisons=(compared("acc", "paid", "unpaid", 5, 15), compared("omae", "unpaid", "paid", -15, -5)),
        verdict=("Being paid helps.",),
        data={"objects": {"train": 10}},
        timing={"sft/0": 1.0, "sft/1": 3.0},
        examples=(dataclasses.replace(coin.example(), fields=fields, instead=instead, others=others, right=True),),
        requirements=(FAST, SLOW),
        tables=(TABLE,),
        pictures=(CHART,),
    )


def write(directory, results, about="Does it?\n\nPerhaps.", description=DESCRIPTION) -> str:
    return write_report(directory, results, about=about, description=description).read_text()


def test_the_page_is_well_formed_whole_and_loads_nothing(tmp_path, results):
    lines = [f'{{"stage": "sft/{s}", "step": {t}, "loss": {t + s}}}\n' for s in range(2) for t in range(50)]
    for folder in (tmp_path, tmp_path / "again"):
        write_text(folder / "metrics.jsonl", "".join(lines))
    page = write(tmp_path, results)
    reader = read(page)
    assert all(load.startswith("data:image/") for load in reader.loads)
    assert not re.search(r"https?://|@import|url\(", page)
    assert not {"script", "link", "iframe"} & reader.seen
    for text in (
        "Does it?", "Being paid helps.", "paid", "unpaid", "blind", "preset paper", "loss",
        "learning rate 100 × the paper's", "<th>sft</th><td>2</td><td>2.0</td><td>4.0</td>",
        "NOT MET", "≥ 400 records/s", "−2.00", "winkler", "–", "left is faster", "Fields of xense",
    ):  # fmt: skip
        assert text in reader.text or text in page
    assert page.count('class="trace"') == 4  # the answer, that of another arm, and those without touch
    for metric in METRICS.values():
        assert metric.title in reader.text
        assert metric.meaning in reader.text
    assert (tmp_path / "plots" / "curves_sft.svg").exists()
    assert (tmp_path / "plots" / "pareto.svg").read_bytes() == SVG
    assert write(tmp_path / "again", results) == page


def test_a_smoke_page_says_that_its_figures_mean_nothing(tmp_path, results):
    text = read(write(tmp_path, results, description={**DESCRIPTION, "scale": SMOKE})).text
    assert MEANINGLESS in text
    assert "Being paid helps." not in text
    assert "Requirements" not in text
    assert MEANINGLESS not in read(write(tmp_path, results)).text


def test_hostile_text_stays_text(tmp_path, results):
    example = dataclasses.replace(
        coin.example(),
        question=HOSTILE, label=HOSTILE, trace=HOSTILE, object_id=HOSTILE, slots=((0, 4, "perceive"),),
        reward={HOSTILE: 1.0}, frames={HOSTILE: np.zeros((2, 4, 4, 3), np.uint8)},
    )  # fmt: skip
    hostile = dataclasses.replace(
        results,
        arms={HOSTILE: row(60.0), "b": row(50.0)},
        baselines={"c" + HOSTILE: row(1.0)},
        settings={"preset": HOSTILE, "lr_scale": 1.0},
        comparisons=(compared("acc", HOSTILE, "b", 1, 2),),
        verdict=(HOSTILE,),
        data={HOSTILE: HOSTILE},
        timing={HOSTILE: 1.0},
        examples=(example,),
        requirements=(dataclasses.replace(SLOW, note=HOSTILE),),
    )
    page = write(tmp_path, hostile, about=HOSTILE, description={**DESCRIPTION, "experiment": HOSTILE})
    reader = read(page)
    assert "<script" not in page
    assert "script" not in reader.seen
    assert reader.text.count(HOSTILE) >= 9


def test_bold_needs_a_paired_interval_without_zero(results):
    assert is_best("acc", "paid", results)
    assert not is_best("acc", "unpaid", results)
    assert is_best("omae", "unpaid", results)  # lower is better, and the pair may be given either way round
    assert not is_best("h_acc", "paid", results)  # never compared
    assert not is_best("middle_rate", "paid", results)  # no direction
    for low, high in ((-1, 9), (0, 9), (-9, 0)):  # an interval that ends at 0 holds it
        doubtful = (*results.comparisons, compared("acc", "paid", "unpaid", low, high))
        assert not is_best("acc", "paid", dataclasses.replace(results, comparisons=doubtful))


def test_a_difference_is_bold_where_its_interval_excludes_zero(tmp_path, results):
    bold = {(-1, 9): False, (0, 9): False, (-9, 0): False, (1, 9): True, (-9, -1): True}
    arms = {name: row(60.0) for name in "abcde"}
    pairs = tuple(compared("acc", arm, "blind", *interval) for arm, interval in zip(arms, bold, strict=True))
    page = write(tmp_path, dataclasses.replace(results, arms=arms, comparisons=pairs))
    shown = {interval: bounds(*interval, "+" + METRICS["acc"].format) for interval in bold}
    assert all(f">{text}<" in page for text in shown.values())
    assert {interval: f"<b>{text}</b>" in page for interval, text in shown.items()} == bold


def test_a_run_without_curves_rollouts_or_middle_rate_has_no_such_sections(tmp_path):
    arms = {"a": {"acc": Estimate(mean=1.0, ci95=(0.0, 2.0), per_seed=(1.0,))}}
    bare = Results(arms=arms, baselines={}, settings={"preset": "paper", "lr_scale": 1.0})
    page = write_report(tmp_path, bare, about="Why?", description=DESCRIPTION).read_text()
    assert not any(section in read(page).text for section in ("Training curves", "rollouts", "middle"))
    assert 'class="swatch"' not in page  # an arm that no chart shows has no colour
    rated = dataclasses.replace(bare, arms={"a": {"acc": row(1.0)["acc"]}, "b": row(2.0)})
    page = write_report(tmp_path, rated, about="Why?", description=DESCRIPTION).read_text()
    assert re.findall(r'class="swatch"[^>]*></span>(\w)', page) == ["b", "b"]  # in both tables of scores


def test_arms_that_have_curves_alone_have_colours_of_their_own(tmp_path):
    lines = [f'{{"stage": "grpo/{arm}/0", "step": 0, "loss": 1}}\n' for arm in ("a", "a-100", "a-400")]
    write_text(tmp_path / "metrics.jsonl", "".join(lines))
    settings = {"preset": "paper", "lr_scale": 1.0}
    write_report(tmp_path, Results(arms={"a": row(1.0)}, settings=settings), about="Why?", description=DESCRIPTION)
    drawn = (tmp_path / "plots" / "curves_grpo.svg").read_text()
    assert all(colour in drawn for colour in PALETTE[:3])


def test_figures_with_intervals_are_figures_and_a_missing_one_is_no_word():
    rows = [{"arm": "a", "gain": "+1.0 [−0.2, 2.1]", "p": 0.1, "why": None}, {"arm": "b", "gain": "–", "why": "noise"}]
    assert word_columns(named_table("", rows)) == [True, False, False, True]
    assert word_columns(named_table("", [{"law": "fitted", "of": "0.1, " * 9}])) == [True, True]  # long


def test_pairs_of_a_metric_are_together_and_a_column_without_figures_is_left_out(tmp_path, results):
    mixed = [compared(metric, arm, "unpaid", 1, 2) for arm in ("paid", "blind") for metric in ("acc", "omae")]
    page = write(tmp_path, dataclasses.replace(results, comparisons=tuple(mixed), data={"nested": {"a": 1}, "n": 2}))
    assert page.count('<tr class="first">') == 2
    assert "<th>95 % over objects</th>" not in page
    paired = [dataclasses.replace(c, over="objects", p_value=None) for c in mixed]
    page = write(tmp_path, dataclasses.replace(results, comparisons=tuple(paired), data={"nested": {"a": 1}, "n": 2}))
    assert "<th>95 % over objects</th>" in page
    assert "over seeds</th>" not in page
    assert "nested" not in page
    assert "Quantity" in page
    assert "Quantity" not in write(tmp_path, dataclasses.replace(results, data={"nested": {"a": 1}}))


def test_a_table_of_more_than_fifty_rows_is_closed(tmp_path, results):
    tables = [named_table("Levels", [{"arm": "a", "share": 0.5}] * n) for n in (50, 51)]
    pages = [write(tmp_path, dataclasses.replace(results, tables=(table,))) for table in tables]
    assert ["Table of 51 rows" in page for page in pages] == [False, True]


def test_requirements_without_notes_have_no_column_for_them(tmp_path, results):
    noted = [dataclasses.replace(SLOW, note=note) for note in ("", "why")]
    pages = [write(tmp_path, dataclasses.replace(results, requirements=(one,))) for one in noted]
    assert ['<th class="text">Note</th>' in page for page in pages] == [False, True]


def test_the_sign_of_zero_shows_in_an_interval_alone():
    assert [number(x, spec) for x, spec in ((-0.04, "+.1f"), (-0.04, ".1f"), (-0.06, ".1f"))] == ["+0.0", "0.0", "−0.1"]
    assert bounds(-0.04, 0.04, "+.1f") == "[−0.0, +0.0]"


def test_a_preset_is_told_in_words():
    changed = "paper with prompts=4, buckets=(8, 12), enumerated=none, mask_truncated=True, segment_credit=False"
    words = "paper with 4 prompts a step, buckets (8, 12), enumerated none, mask truncated, no segment credit"
    assert [preset_in_words(preset) for preset in ("paper", changed)] == ["paper", words]
    assert settings_in_words({"preset": changed, "preset of soft": changed}) == {
        "preset": words,
        "preset of soft": words,
    }


def test_a_heading_keeps_its_hyphen_on_the_line_and_an_empty_answer_is_told(tmp_path, results):
    empty = dataclasses.replace(coin.example(), trace="", slots=())
    page = write(tmp_path, dataclasses.replace(results, examples=(empty,)))
    assert '<th><span class="whole">H-Acc</span><span' in page
    assert "an empty answer" in page


def test_arms_beyond_the_colours_have_other_symbols(tmp_path, results):
    arms = {f"arm_{i}": row(60.0) for i in range(len(PALETTE) + 1)}
    page = write(tmp_path, dataclasses.replace(results, arms=arms, comparisons=(), baselines={"sft": row(1.0)}))
    shown = re.findall(r'data-mark="(.)" style="color:(#\w+)"></span>(\w+)', page)
    assert len({look[:2] for look in shown}) == len(arms)
    assert SYMBOLS[1] in {symbol for symbol, *_ in shown}
    assert "sft: supervised fine-tuning" in page


def test_a_text_is_cut_at_its_segments():
    assert list(pieces("a b c d", ((2, 3, "compare"), (6, 7, "conclude")))) == [
        ("a ", ""), ("b", "compare"), (" c ", ""), ("d", "conclude"), ("", ""),
    ]  # fmt: skip


def rollouts(section: str) -> str:
    """That section of a page."""
    return section[section.index("A few rollouts") : section.index("Data and time")]


def test_rollouts_of_a_group_fold_away_under_its_heading(tmp_path, results):
    examples = tuple(dataclasses.replace(coin.example(), group=group) for group in (HOSTILE, HOSTILE, "far off", ""))
    page = rollouts(write(tmp_path, dataclasses.replace(results, examples=examples)))
    found = [page.count(text) for text in ("<b>Question </b>", "<details", '<details open="open">', "<script")]
    assert found == [4, 2, 1, 0]
    assert page.count("<img") == 3 * 2  # view and frames, once for each touch of a group


def test_questions_about_one_touch_share_its_pictures(tmp_path, results):
    pressed = {"xense": np.full((4, 8, 8, 3), 121, np.uint8)}
    others = [{"frames": pressed}, {"question": "How rough is it?"}, {"frames": pressed}, {"object_id": "object_0008"}]
    examples = (coin.example(), *(dataclasses.replace(coin.example(), **other) for other in others))
    page = rollouts(write(tmp_path, dataclasses.replace(results, examples=examples)))
    touches = [part.count("<b>Question </b>") for part in page.split("<article")[1:]]
    assert touches == [2, 2, 1]
    assert page.count("<img") == 2 * len(touches)


@pytest.mark.long
def test_a_page_stays_small_however_many_photographs_it_has(tmp_path, results):
    """Of four sensors with eight frames of 224 px, as full of detail as no gel is."""
    rng = np.random.default_rng(0)
    strip, field = (rng.integers(0, 256, (2 * side, 2 * side, 3), np.uint8) for side in (224, 192))

    def example(i: int):
        frames = np.stack([strip[i : i + 224, f : f + 224] for f in range(8)])
        fields = {f"gel_{s}": field[i : i + 192, :250] for s in range(4)}
        own = {"frames": dict.fromkeys(fields, frames), "force_n": {}, "fields": fields, "view": strip[i:, i:]}
        return dataclasses.replace(coin.example(), object_id=f"object_{i}", **own)

    examples = tuple(map(example, range(12)))
    page = write(tmp_path, dataclasses.replace(results, examples=examples))
    assert len(page.encode()) <= MOST_BYTES
    assert page.count("<img") >= 12 * 9
    whole = base64.b64encode(webp(examples[0].fields["gel_0"])).decode()
    assert whole not in page
    assert whole in write(tmp_path, dataclasses.replace(results, examples=examples[:1]))
