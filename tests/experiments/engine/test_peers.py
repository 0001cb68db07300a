"""Peers are driven by their harness in a process of their own; here by one that only pretends."""

import sys
from pathlib import Path

import pytest

from experiments.engine.harness import PeerJob, answer, read_answer
from experiments.engine.harness_trl import settings
from experiments.engine.peers import Peer, PeerFailed, installed_peers
from experiments.engine.size import JobSize

JOB = PeerJob(prefix=5, rounds=2, size=JobSize(prompts=2, group=3, length=4, vocab_size=10))
PRETENDER = """
import sys
from experiments.engine.harness import PeerJob, answer
job = PeerJob.from_json(sys.argv[1])
print("a peer says many things")
print(answer(job, [0.0, 3.0, 4.0, 6.0], {"pretender": "1.0"}))
"""


def test_a_job_survives_the_command_line():
    assert PeerJob.from_json(JOB.to_json()) == JOB


def test_prompts_have_their_length_and_no_padding():
    prompts = JOB.prompts()
    assert (len(prompts), len(prompts[0]), len(prompts[0][0])) == (4, 2, 5)
    tokens = {t for batch in prompts for ids in batch for t in ids}
    assert tokens <= set(range(1, 10))
    assert len(tokens) > 5


def test_the_reward_is_the_share_of_low_ids():
    assert JOB.reward([0, 4, 5, 9]) == 0.5
    with pytest.raises(ValueError, match="completion has 2 tokens: must be 4"):
        JOB.reward([0, 4])


def test_an_answer_leaves_the_warm_up_out():
    times = read_answer("noise\n" + answer(JOB, [0.0, 3.0, 4.0, 6.0], {"x": "1"}) + "\nmore noise")
    assert (times.seconds, times.first_s, times.versions) == ((1.0, 2.0), 3.0, {"x": "1"})
    assert times.peak_gb > 0
    with pytest.raises(ValueError, match="peer took 3 steps: must be 4"):
        answer(JOB, [0.0, 1.0, 2.0], {})
    with pytest.raises(ValueError, match="output holds no line"):
        read_answer("nothing")


@pytest.fixture
def harness(tmp_path, monkeypatch):
    """A harness that this interpreter finds although it runs in the checkout."""
    (tmp_path / "pretender.py").write_text(PRETENDER)
    (tmp_path / "failing.py").write_text("raise SystemExit('no such engine')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


def test_a_peer_runs_in_its_own_process(harness):
    peer = Peer(name="Pretender", harness="pretender", python=Path(sys.executable))
    assert peer.measure(JOB).seconds == (1.0, 2.0)


def test_a_peer_that_fails_says_what_it_said(harness):
    peer = Peer(name="Failing", harness="failing", python=Path(sys.executable))
    with pytest.raises(PeerFailed, match=r"(?s)Failing ended with 1 at prefix 5: .*must be able.*no such engine"):
        peer.measure(JOB)


def test_an_interpreter_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"trl-python is .*nowhere: there is no such interpreter"):
        installed_peers(tmp_path / "nowhere", None)
    (peer,) = (p for p in installed_peers(None, Path(sys.executable)) if p.name == "Tunix")
    assert peer.python == Path(sys.executable)


def test_trl_is_asked_for_the_same_job():
    asked = settings(JOB, "somewhere")
    assert asked["per_device_train_batch_size"] == 6
    assert (asked["num_generations"], asked["max_completion_length"], asked["max_steps"]) == (3, 4, 4)
    assert (asked["beta"], asked["learning_rate"]) == (0.04, 1e-4)
