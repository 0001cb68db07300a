"""The page of a run that is going on: whole, up to date, cheap, and quiet once the run has ended."""

import itertools

import pytest

from experiments.core import curves, live
from experiments.core.context import Context
from experiments.core.live import LivePage
from experiments.core.runner import main
from tests.experiments.core.test_report import HOSTILE, read

FAKES = "tests.experiments.fakes"
RELOAD = 'http-equiv="refresh"'
DESCRIPTION = {
    "experiment": "coin",
    "scale": "smoke",
    "config": {"steps": 3},
    "git": {"commit": "a" * 40, "dirty": True},
    "command": "python -m experiments coin --fresh",
}


class Clock:
    """Time that passes only when it is told to."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now

    def strftime(self, form):
        return "noon"


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(live, "time", made)
    return made


@pytest.fixture
def page(tmp_path, clock, console):
    """A page and the context of its run."""
    curves = {"grpo": ("reward", "absent")}
    made = LivePage(tmp_path, about=f"Why?\n\n{HOSTILE}", description=DESCRIPTION, curves=curves, usual_s=1170.0)
    context = Context(tmp_path, tmp_path, console, [made])
    yield context, made
    context.close()


def shown(context):
    return (context.directory / "report.html").read_text()


def test_it_stands_there_from_the_start(page):
    context, _ = page
    assert RELOAD in shown(context)
    text = read(shown(context)).text
    assert "0 s so far; the last run of this configuration took 19 min 30 s." in text
    assert HOSTILE in text


def test_it_follows_loops_and_lines(page, clock):
    context, _ = page
    with context.progress(f"grpo {HOSTILE}", 40, completed=10) as advance:
        context.log("grpo/paid/0", 0, reward=0.5, kl=1.0)
        clock.now += live.EVERY_S
        advance(5, "reward 0.5")
        text = read(shown(context)).text
        assert f"grpo {HOSTILE}15 of 40" in text
        assert "reward 0.5" in text
        assert "Training curves so far" in text
        assert "Scalars in metrics.jsonl that are not drawn: 1." in text
    clock.now += live.EVERY_S
    context.log("grpo/paid/0", 1, reward=0.5, kl=1.0)
    assert "Under way" not in shown(context)


def test_without_a_choice_the_first_scalars_are_drawn(page, clock, monkeypatch):
    drawn = []
    monkeypatch.setattr(curves, "training_curves", lambda scalars, colour: drawn.append(tuple(scalars)) or b"<svg/>")
    context, _ = page
    clock.now += live.EVERY_S
    context.log("sft/0", 0, **{f"s{i:02}": i for i in range(20)})
    assert drawn == [tuple(f"s{i:02}" for i in range(live.MOST))]


def test_pages_take_their_share_of_the_time_and_no_more(page, clock, monkeypatch):
    context, _ = page
    monkeypatch.setattr(curves, "training_curves", lambda scalars, colour: setattr(clock, "now", clock.now + 2) or b"")
    pages = []
    monkeypatch.setattr(live, "write_text", lambda path, text: pages.append(clock.now))
    for step in range(1000):
        clock.now += 1
        context.log("grpo/paid/0", step, reward=0.5)
    assert pages[0] == 100 + live.EVERY_S + 2
    assert min(b - a for a, b in itertools.pairwise(pages)) >= 2 / live.SHARE


def test_a_phase_without_new_lines_is_not_drawn_again(page, clock, monkeypatch):
    context, _ = page
    drawn = []
    monkeypatch.setattr(curves, "training_curves", lambda scalars, colour: drawn.append(tuple(scalars)) or b"<svg/>")
    for stage in ("sft/0", "grpo/paid/0", "grpo/paid/1"):
        clock.now += live.EVERY_S
        context.log(stage, 0, loss=1.0, reward=0.5)
    assert drawn == [("loss", "reward"), ("reward",), ("reward",)]
    assert shown(context).count("<figure>") == 2


def test_an_ended_session_says_why_and_how_to_go_on(page, clock):
    context, made = page
    made.end(RuntimeError(f"rolled away {HOSTILE}"))
    assert RELOAD not in shown(context)
    text = read(shown(context)).text
    assert f"Ended on noon by RuntimeError: rolled away {HOSTILE}. To continue: python -m experiments coin" in text
    assert "--fresh" not in text.partition("Configuration")[0]


def test_the_report_takes_its_place(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COIN_CRASHES", "1")
    with pytest.raises(RuntimeError):
        main(["coin", "--crash-at", "2"], package=FAKES)
    latest = tmp_path / "runs" / "coin" / "latest"
    stopped = (latest / "report.html").read_text()
    assert "by RuntimeError: the coin rolled away. To continue: python -m experiments coin --crash-at 2" in stopped
    monkeypatch.delenv("COIN_CRASHES")
    assert main(["coin", "--crash-at", "2"], package=FAKES) == 0
    assert "to watch: runs/coin" in capsys.readouterr().out
    assert RELOAD not in (latest / "report.html").read_text()
    assert "Paired comparisons" in (latest / "report.html").read_text()


def test_the_time_of_the_last_such_run_is_known(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pages = []
    monkeypatch.setattr(live, "write_text", lambda path, text: pages.append(text))
    assert main(["coin", "--scale", "smoke"], package=FAKES) == 0
    assert "no run of this configuration has finished yet" in pages[-1]
    assert main(["coin", "--scale", "smoke"], package=FAKES) == 0
    assert "the last run of this configuration took" in pages[-1]
