"""Peers run in processes of their own; here by a harness that only pretends to train."""

import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.engine.harness_trl import settings
from experiments.engine.peers import JobSize, Peer, PeerFailed, PeerJob, format_answer, installed_peers, parse_answer

JOB = PeerJob(prefix=5, rounds=2, size=JobSize(prompts=2, group=3, length=4, vocab_size=10))
PRETENDER = """
import sys
from experiments.engine.harness_trl import settings
from experiments.engine.peers import PeerJob, format_answer
print("other output")
print(format_answer(PeerJob.from_json(sys.argv[1]), [0.0, 3.0, 4.0, 6.0], {"pretender": "1.0"}))
"""


def test_work_by_hand():
    """One layer of width 2 with one head of 2, MLP 2, vocabulary 2: 16 + 12 weights, 4 to the vocabulary."""
    ones = dict.fromkeys(("prompts", "group", "length", "num_layers", "num_heads", "num_kv_heads"), 1)
    twos = dict.fromkeys(("vocab_size", "hidden_size", "head_dim", "intermediate_size"), 2)
    weights, pair = 8 + 8 + 12, 4
    prompt, completion = 3 * weights + pair * 6, weights + 4 + pair * (3 + 1)
    assert JobSize(**ones, **twos).gflop(3) == pytest.approx(2 * 5 * (prompt + completion) / 1e9)


def test_prompts_and_rewards():
    prompts = JOB.prompts()
    assert np.shape(prompts) == (4, 2, 5)
    assert 5 < len(np.unique(prompts)) <= 9  # without padding, 0
    assert np.min(prompts) > 0
    assert JOB.reward([0, 4, 5, 9]) == 0.5
    with pytest.raises(ValueError, match="completion has 2 tokens: must be 4"):
        JOB.reward([0, 4])


def test_times_leave_the_warm_up_out():
    times = parse_answer("noise\n" + format_answer(JOB, [0.0, 3.0, 4.0, 6.0], {"x": "1"}) + "\nmore noise")
    assert (times.seconds, times.first_s, times.versions) == ((1.0, 2.0), 3.0, {"x": "1"})
    assert times.peak_gb > 0
    with pytest.raises(ValueError, match="peer took 3 steps: must be 4"):
        format_answer(JOB, [0.0, 1.0, 2.0], {})
    with pytest.raises(ValueError, match="output holds no line"):
        parse_answer("nothing")


def test_a_peer_runs_in_its_own_process_and_a_failure_shows_its_errors(tmp_path, monkeypatch):
    (tmp_path / "pretender.py").write_text(PRETENDER)
    (tmp_path / "failing.py").write_text("raise SystemExit('no such engine')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    pretender, failing = (Peer(name=n, harness=n, python=Path(sys.executable)) for n in ("pretender", "failing"))
    assert pretender.measure(JOB).seconds == (1.0, 2.0)
    with pytest.raises(PeerFailed, match=r"(?s)failing ended with 1 at prefix 5: .*no such engine"):
        failing.measure(JOB)


def test_an_interpreter_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"trl-python is .*nowhere: there is no such interpreter"):
        installed_peers(tmp_path / "nowhere", None)
    (peer,) = (p for p in installed_peers(None, Path(sys.executable)) if p.name == "Tunix")
    assert peer.python == Path(sys.executable)


def test_trl_gets_the_same_job():
    trl = settings(JOB, "somewhere")
    assert trl["per_device_train_batch_size"] == 6
    assert (trl["num_generations"], trl["max_completion_length"], trl["max_steps"]) == (3, 4, 4)
    assert (trl["beta"], trl["learning_rate"]) == (0.04, 1e-4)
