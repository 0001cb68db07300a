"""Training from records in a store that fails: the losses of local training, at nearly its rate."""

import json
import re
import socket
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.context import Context
from experiments.core.metric_log import read_metrics
from experiments.study.dataset import open_dataset
from experiments.study.seed import StudySeed
from experiments.study.stages import StudySFT
from sensors_io import remote
from sensors_io.__main__ import main as sensors
from sensors_io.pipeline import ClipConfig
from sensors_io.records import RecordStore, RecordWriter
from sensors_io.remote import Mirror
from sensors_io.schema import ATTRIBUTES, LEVELS, SENSORS
from tests.experiments import tiny
from tests.sensors_io import fakes
from touchr1_jax.models.touch_policy import build_policy
from touchr1_jax.training.compilation import compilations_kept

URL = "s3://bucket/records"
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture
def store(tmp_path, monkeypatch):
    """Sets the faults of a store with one empty bucket; the number of its requests comes back."""
    for package in ("moto", "s3fs"):
        pytest.importorskip(package)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    endpoint = f"http://127.0.0.1:{port}"
    for name, value in (KEYS | {"AWS_ENDPOINT_URL": endpoint, remote.CACHE: str(tmp_path / "cache")}).items():
        monkeypatch.setenv(name, value)
    command = [sys.executable, "-m", "tests.experiments.study.faulty_store", str(port), "{}"]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def set_faults(**faults: float) -> int:
        request = urllib.request.Request(f"{endpoint}/faults", json.dumps(faults).encode())
        return int(urllib.request.urlopen(request, timeout=60).read())

    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    until = time.monotonic() + 60
    while True:
        try:
            set_faults()
            break
        except OSError:
            assert time.monotonic() < until
            time.sleep(0.1)
    s3fs.S3FileSystem().mkdir("bucket")
    yield set_faults
    server.kill()
    server.wait()
    s3fs.S3FileSystem.clear_instance_cache()


def write(path, contacts: int, px: int, per_shard: int):
    """Records of which no byte can be guessed: a download costs the most."""
    rng = np.random.default_rng(0)
    with RecordWriter(path, meta=fakes.META, contacts_per_shard=per_shard) as writer:
        for i in range(contacts):
            if i % 2 == 0:
                writer.write_object(fakes.card(i // 2))
            frames = lambda sensor: None if sensor == "tac3d" else rng.integers(0, 256, (12, px, px, 3), np.uint8)
            writer.write_contact([fakes.sequence(i // 2, s, trial=i % 2, frames=frames(s)) for s in SENSORS])
    return path


def train(records, directory, steps: int, cache) -> tuple[list, float]:
    """Logged lines of SFT, and its seconds from the first batch that it asks for, programs at hand."""
    directory.mkdir()
    clip = ClipConfig(frames=tiny.MODEL.frames, image_px=tiny.MODEL.image_px, view_px=tiny.MODEL.vision.image_px)
    context = Context(directory, directory / "cache", tiny.QUIET)
    data = open_dataset(records, clip, None)
    policy = build_policy(tiny.MODEL, data.clip.sensors)
    evidence = np.zeros((len(data.store), len(SENSORS), len(ATTRIBUTES), max(LEVELS.values())), np.float32)
    began = time.monotonic()
    with compilations_kept(cache):
        of = {"config": tiny.STUDY, "data": data, "policy": policy, "evidence": evidence, "context": context, "seed": 0}
        StudySeed(**of).run_sft(StudySFT(steps=steps, batch_size=4), "sft")
    context.close()
    return read_metrics(directory), time.monotonic() - began


@pytest.mark.parametrize(
    ("contacts", "px", "steps", "rounds"),
    [(12, 16, 3, 1), pytest.param(240, 80, 200, 3, marks=pytest.mark.slow)],
    ids=["quick", "measured"],
)
@pytest.mark.filterwarnings("ignore")
def test_training_from_a_store_that_fails_is_the_same(store, tmp_path, monkeypatch, contacts, px, steps, rounds):
    records = write(tmp_path / "records", contacts, px, per_shard=max(1, contacts // 15))
    assert sensors(["push", str(records), URL]) == 0
    store(errors=0.05)
    programs = tmp_path / "compiled"
    lines, _ = train(records, tmp_path / "compiling", steps, programs)
    ratios: dict[str, list[float]] = {"cold": [], "warm": []}
    for i in range(rounds):
        monkeypatch.setenv(remote.CACHE, str(tmp_path / f"cache-{i}"))
        _, local_s = train(records, tmp_path / f"local-{i}", steps, programs)
        for name, rates in ratios.items():
            found, seconds = train(URL, tmp_path / f"{name}-{i}", steps, programs)
            assert found == lines
            rates.append(local_s / seconds)
    sys.stdout.write(f"{ {name: np.round(rates, 2).tolist() for name, rates in ratios.items()} }, {local_s:.1f} s\n")
    if rounds > 1:
        assert np.median(ratios["warm"]) >= 0.9
        assert np.median(ratios["cold"]) >= 0.7


@pytest.mark.parametrize("stall_s", [0.3, pytest.param(30.0, marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore")
def test_a_store_that_stalls_is_waited_for(store, tmp_path, monkeypatch, caplog, stall_s):
    monkeypatch.setattr(remote, "_SLOW_S", min(stall_s / 3, 10.0))
    records = write(tmp_path / "records", 4, 16, per_shard=1)
    assert sensors(["push", str(records), URL]) == 0
    store(stall_s=stall_s)
    caplog.clear()
    assert len(RecordStore(URL)) == 4
    waited = f"{URL}/index.json: no answer for {remote._SLOW_S:g} s, still waiting"
    assert [line for line in caplog.messages if line.startswith(f"{URL}/index.json")] == [waited]


@pytest.mark.parametrize(
    ("faults", "url", "message"),
    [
        ({"full": 1.0}, URL, "6 times: wait until the store answers and has room"),
        ({"refuses": 1.0}, URL, "is refused"),
        ({}, "s3://nowhere/records", "is not there .* make the bucket"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_a_store_that_takes_nothing_is_named_in_one_line(store, tmp_path, monkeypatch, capsys, faults, url, message):
    monkeypatch.setattr(remote, "_WAITS_S", (0.0,) * 5)
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    records = write(tmp_path / "records", 2, 16, per_shard=1)
    store(**faults)
    assert sensors(["push", str(records), url]) == 1
    (line,) = " ".join(capsys.readouterr().err.split()).split("StoreError")[1:]
    assert re.search(message, line)
    store()
    assert sensors(["push", str(records), URL]) == 0  # the same command, once the fault is gone
    assert len(RecordStore(URL)) == 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_run_in_a_store_that_fails_is_stopped_and_goes_on_elsewhere(store, tmp_path, monkeypatch):
    def begin(machine: str, runs_dir: str) -> subprocess.Popen:
        monkeypatch.setenv(remote.CACHE, str(tmp_path / f"cache of {machine}"))
        options = ["--scale", "smoke", "--runs-dir", runs_dir, "--cache-dir", str(tmp_path / machine)]
        command = [sys.executable, "-m", "experiments", "pretrain_encoder", *options]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    assert begin("local", str(tmp_path / "runs")).wait() == 0
    store(errors=0.05)
    stopped = begin("first", "s3://bucket/runs")
    assert any(re.search(r" 1/\d+, ", line) for line in stopped.stdout)  # a step is done
    stopped.terminate()
    assert "the run is at s3://bucket/runs" in stopped.communicate()[0]
    assert stopped.returncode == 143
    continued = begin("second", "s3://bucket/runs")
    assert "continuing" in (printed := continued.communicate()[0])
    assert continued.returncode == 0, printed
    own = lambda run: {k: v for k, v in read_json(run / "results.json").items() if k != "timing"}
    Mirror("s3://bucket/runs/pretrain_encoder").copy(tmp_path / "copy")
    (there,), (here,) = ([*folder.glob("2*")] for folder in (tmp_path / "copy", tmp_path / "runs/pretrain_encoder"))
    assert own(there) == own(here)
    assert read_metrics(there) == read_metrics(here)
