"""The page of a run in progress is whole, up to date and cheap; event files hold what `metrics.jsonl` holds."""

import itertools
import re
import signal
import struct
import sys
from types import SimpleNamespace
from unittest.mock import Mock, call

import pytest
from tensorboardX.proto.event_pb2 import Event, SessionLog

from experiments.core import watchers
from experiments.core.context import Context
from experiments.core.metric_log import MetricLog
from experiments.core.progress import TrainingSample
from experiments.core.runner import main
from experiments.core.stopping import Stopped
from experiments.core.watchers import CURVES_SHARE, PAGE_EVERY_S, SAMPLES, TENSORBOARD, WANDB, Events, LivePage
from tests.experiments.core.test_report import DESCRIPTION, HOSTILE, read

FAKES = "tests.experiments.fakes"
RELOAD = 'http-equiv="refresh"'


class Clock:
    """A clock that only the test advances."""

    now = 100.0

    def __call__(self):
        return self.now


def watched(directory, console, clock) -> tuple[LivePage, Context]:
    description = DESCRIPTION | {"command": "python -m experiments coin --fresh"}
    about = f"Why?\n\n{HOSTILE}"
    curves = {"grpo": ("reward", "absent")}
    page = LivePage(directory, about=about, description=description, curves=curves, usual_s=1170.0, clock=clock)
    return page, Context(directory, directory, console, [page])


def shown(context) -> str:
    return (context.directory / "report.html").read_text()


def test_the_page_follows_loops_and_lines_and_ends_with_the_cause(tmp_path, console):
    clock = Clock()
    page, context = watched(tmp_path, console, clock)
    assert RELOAD in shown(context)
    text = read(shown(context)).text
    assert "0 s so far; the last run of this configuration took 19 min 30 s." in text
    assert HOSTILE in text
    with context.progress(f"grpo {HOSTILE}", 40, completed=10) as advance:
        context.log("grpo/paid/0", 0, reward=0.5, kl=1.0)
        clock.now += PAGE_EVERY_S
        advance(5, "reward 0.5")
        text = read(shown(context)).text
        assert f"grpo {HOSTILE}15 of 40" in text
        assert "reward 0.5" in text
        assert "not drawn: 1." in text
    clock.now += PAGE_EVERY_S
    context.log("grpo/paid/0", 1, reward=0.5, kl=1.0)
    assert "15 of 40" not in shown(context)
    page.end(RuntimeError(f"rolled away {HOSTILE}"))
    assert RELOAD not in shown(context)
    verdict = read(shown(context)).text.partition("Configuration")[0]
    assert f"by RuntimeError: rolled away {HOSTILE}. To continue: python -m experiments coin" in verdict
    assert "--fresh" not in verdict
    context.close()


def test_the_page_shows_what_the_policy_answers(tmp_path, console):
    clock = Clock()
    _, context = watched(tmp_path, console, clock)
    clock.now += PAGE_EVERY_S
    for step in range(9):
        sample = TrainingSample(
            question="how hard is it?", answer=f"soft {HOSTILE}", truth="hardness soft", reward=0.97
        )
        context.sampled("grpo/paid/0", step, sample)
    with context.progress("grpo", 3, note="compiling the first step"):
        text = read(shown(context)).text
    assert "compiling the first step" in text
    assert f"soft {HOSTILE}hardness soft0.97" in text.replace("\n", "")
    assert text.count("how hard is it?") == SAMPLES
    context.close()


@pytest.mark.long
def test_curves_take_their_share_of_the_time_and_pages_stay_fresh(tmp_path, console):
    """Every look at the clock takes a second, so that curves take one and pages follow after ten."""
    page, context = watched(tmp_path, console, itertools.count().__next__)
    pages, curves = [shown(context)], set()
    for step in range(700):
        context.log("grpo/paid/0", step, reward=0.5)
        pages += [shown(context)] * (shown(context) != pages[-1])
        curves |= set(re.findall(r"data:image/([^\"]*)", pages[-1]))
    assert 700 // (PAGE_EVERY_S + 5) <= len(pages) <= 2 + 700 // PAGE_EVERY_S
    assert 1 <= len(curves) <= 1 + 700 * CURVES_SHARE
    page.end(RuntimeError("over"))
    assert set(re.findall(r"data:image/([^\"]*)", shown(context))) - curves  # the last page has all lines
    context.close()


def test_the_last_page_tells_what_ended_a_run_though_its_curves_cannot_be_drawn(tmp_path, console, monkeypatch):
    """As after a signal while Matplotlib was imported: the run ended with the error of its half-made classes."""
    page, context = watched(tmp_path, console, Clock())
    context.log("grpo/paid/0", 0, reward=0.5)
    monkeypatch.setattr(watchers, "draw_phases", lambda *lines, **options: {}["Rectangle:kwdoc"])
    page.end(Stopped(signal.SIGTERM))
    assert "by Stopped: SIGTERM. To continue: python -m experiments coin" in read(shown(context)).text
    context.close()


@pytest.mark.long
def test_the_report_replaces_the_page_of_a_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    latest, arguments = tmp_path / "runs/coin/latest", ["coin", "--crash-at", "2", "--seeds", "2"]
    for usual in ("no run of this configuration", "the last run of this configuration took"):
        monkeypatch.setenv("COIN_CRASHES", "1")
        with pytest.raises(RuntimeError):
            main(arguments, package=FAKES)
        assert usual in (latest / "report.html").read_text()
        monkeypatch.delenv("COIN_CRASHES")
        assert main(arguments, package=FAKES) == 0
        assert RELOAD not in (latest / "report.html").read_text()


def read_events(folder):
    """The events of a stage, file after file: each has its length, a checksum of that, its bytes, a checksum."""
    found = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        content, at = path.read_bytes(), 0
        while at < len(content):
            (size,) = struct.unpack_from("<Q", content, at)
            found.append(Event.FromString(content[at + 12 : at + 12 + size]))
            at += 16 + size
    return found


def curve(folder, name):
    """Step → value as TensorBoard shows it: a session that starts drops what earlier ones wrote at or past its step."""
    points = {}
    for event in read_events(folder):
        if event.session_log.status == SessionLog.START:
            points = {step: value for step, value in points.items() if step < event.step}
        points |= [(event.step, value.simple_value) for value in event.summary.value if value.tag == name]
    return points


def test_a_resumed_stage_shows_what_its_last_session_logged(tmp_path):
    for steps, scale in ((range(6), 1.0), (range(4, 8), 0.5)):
        written = Events(tmp_path / "events")
        lines = MetricLog(tmp_path / "metrics.jsonl", [written])
        for step in steps:
            lines.append("grpo/paid/0", step, {"reward": scale * step, "levels": [1, 2], "whole": 3})
        lines.close()
        written.closed()
    folder = tmp_path / "events" / "grpo" / "paid" / "0"
    assert curve(folder, "reward") == {0: 0, 1: 1, 2: 2, 3: 3, 4: 2, 5: 2.5, 6: 3, 7: 3.5}
    assert curve(folder, "whole") == dict.fromkeys(range(8), 3)
    assert curve(folder, "levels") == {}


@pytest.mark.long
def test_a_run_writes_events_when_asked_and_needs_the_package(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["coin", "--scale", "smoke", "--tensorboard"], package=FAKES) == 0
    folder = tmp_path / "runs/coin/latest/events/train/unpaid/1"
    assert curve(folder, "reward") == pytest.approx({0: 0, 1: 1 / 3, 2: 2 / 3})
    assert main(["coin", "--scale", "smoke"], package=FAKES) == 0
    assert not (tmp_path / "runs/coin/latest/events").exists()
    runs = sorted(tmp_path.glob("runs/coin/*"))
    monkeypatch.setitem(sys.modules, TENSORBOARD, None)
    assert main(["coin", "--tensorboard"], package=FAKES) == 2
    assert "pip install 'touchr1-jax[tensorboard]'" in capsys.readouterr().err
    assert sorted(tmp_path.glob("runs/coin/*")) == runs


@pytest.mark.long
def test_a_run_sends_its_figures_when_asked_and_goes_on_in_the_same_place(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    orders, sent = [], Mock()  # a run of Weights & Biases
    monkeypatch.setitem(sys.modules, WANDB, SimpleNamespace(init=lambda **order: (orders.append(order), sent)[1]))
    arguments = ["coin", "--steps", "6", "--seeds", "2", "--crash-at", "5", "--wandb"]
    monkeypatch.setenv("COIN_CRASHES", "1")
    with pytest.raises(RuntimeError):
        main(arguments, package=FAKES)
    monkeypatch.delenv("COIN_CRASHES")
    assert main(arguments, package=FAKES) == 0
    assert orders[0] == orders[1]
    assert orders[0]["id"] == f"coin-{(tmp_path / 'runs/coin/latest').resolve().name}"
    assert orders[0]["config"]["steps"] == 6
    assert call("train/unpaid/1/*", step_metric="train/unpaid/1/step") in sent.define_metric.mock_calls
    lines = [one.args[0] for one in sent.log.mock_calls]
    assert [line["train/paid/0/step"] for line in lines if "train/paid/0/reward" in line] == [0, 1, 2, 3, 4, 5]
    assert sent.finish.call_count == 2
    monkeypatch.setitem(sys.modules, WANDB, None)
    assert main(arguments, package=FAKES) == 2
    assert "pip install 'touchr1-jax[wandb]'" in capsys.readouterr().err
