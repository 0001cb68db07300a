"""Asking a tiny policy: the same answers as a study gives, from every kind of input, in words, JSON and on a page."""

import dataclasses
import functools
import json
import re
import shutil
import socket
import sys
import types
import urllib.error
import urllib.parse
import urllib.request

import cv2
import numpy as np
import pytest

from experiments.ask.command import run_asking
from experiments.ask.demo import demo_server
from experiments.ask.inputs import read_touch
from experiments.core.artifacts import DamagedFileError
from experiments.core.errors import DataError
from experiments.core.runs import FIELDS, ROOT
from experiments.study.policies import find_policy, is_policy, measured_figures, publish_policy
from experiments.study.stages import encode_rows
from sensors_io.commands.console import print_in_any_encoding
from sensors_io.remote import CACHE
from sensors_io.schema import SENSORS
from tests.sensors_io.importers.films import film
from touchr1_jax.asking import SHIPPED, TouchAnswer, TouchInput, compared, load_policy, shipped
from touchr1_jax.models.saved_policy import PolicyError
from touchr1_jax.text.plain_questions import AskedAttribute, QuestionError
from touchr1_jax.training.evaluation import answer_program, evaluate_policy

ABOUT = dict.fromkeys(FIELDS, "") | {"experiment": "trial", "config": {}, "git": {"commit": "", "dirty": False}}


@pytest.fixture(scope="module")
def runs(tmp_path_factory, policy, params, data):
    """A run `trial/latest` with a policy of SFT."""
    run = tmp_path_factory.mktemp("runs") / "trial" / "latest"
    run.mkdir(parents=True)
    (run / "config.json").write_text(json.dumps(ABOUT))
    scores = {"acc": {"mean": 68.13, "ci95": [60.0, 70.0], "per_seed": [68.13]}}
    (run / "results.json").write_text(json.dumps({"verdict": [], "arms": {"sft": scores}, "data": {"test_objects": 5}}))
    context = types.SimpleNamespace(directory=run, processes=types.SimpleNamespace(write_once=lambda write: write()))
    publish_policy(policy, params, data, "sft", 0, context)
    return run.parents[1]


@pytest.fixture(scope="module")
def asked(runs):
    return find_policy(str(runs / "trial"), runs)


@pytest.mark.long
@pytest.mark.parametrize(("steps", "place"), [(9, "sft/0"), (0, "sft/1"), (0, "paper/0")])
def test_a_policy_of_another_run_arm_or_seed_is_not_taken_for_a_run_s_own(runs, tmp_path, steps, place):
    shutil.copytree(runs / "trial" / "latest" / "policies" / "sft" / "0", tmp_path / "policies" / place)
    (tmp_path / "config.json").write_text(json.dumps(ABOUT | ({"config": {"steps": steps}} if steps else {})))
    with pytest.raises(PolicyError, match=r"it is of policies/sft/0 \w{8}, must be of .*; put its own copy back"):
        find_policy(f"{tmp_path}/{place}", runs)


def ask(runs, *words):
    return run_asking(["ask", *map(str, words), "--runs-dir", str(runs), "--cache-dir", str(runs / "cache")])


@pytest.mark.long
def test_the_answers_are_those_of_a_study(asked, policy, params, data, records, context):
    rows = data.parts["test"][:2]
    features = encode_rows(policy, params, data, rows, context)
    evaluate = functools.partial(evaluate_policy, policy, params, label=data.label[rows], alone=False)
    evaluate = functools.partial(evaluate, answer=answer_program(policy, constrained=True))
    study = evaluate(features)
    none = dataclasses.replace(features, stream_mask=np.zeros_like(features.stream_mask))
    blind = evaluate(none)
    assert np.asarray(study.parsed.formatted).all()
    touches = [read_touch(f"{records}:{i}", asked.saved) for i in rows]
    answers = asked.answers([touch.touch for touch in touches])
    for n, (contact, attribute) in enumerate(zip(study.contact, study.attribute, strict=True)):
        name = policy.language.attributes[attribute].name
        answer = answers[contact][name]
        assert answer.trace == policy.tokenizer.decode(study.tokens[n]).strip()
        assert answer.untouched.trace == policy.tokenizer.decode(blind.tokens[n]).strip()
        assert sum(answer.probabilities.values()) == pytest.approx(1)
        levels = [level[0] for level in policy.language.attributes[attribute].levels]
        assert list(answer.probabilities) == levels
        assert touches[contact].truth[name] == levels[data.label[rows][contact, attribute]]
    assert touches[0].remarks == ()


def answer(*p: float) -> TouchAnswer:
    words = dict(zip(("soft", "firm", "hard"), p, strict=True))
    return TouchAnswer(question="how hard is it?", attribute="hardness", word="", trace="", probabilities=words)


@pytest.mark.parametrize(("sign", "word", "first"), [(1, "first", 0.2 * 0.2 + 0.8 * 0.6), (-1, "second", 0.2 * 0.4)])
def test_comparisons_follow_from_the_levels(sign, word, first):
    """The first is harder if firm against soft, or hard against soft or firm; softer if firm against hard."""
    one, two = answer(0.0, 0.2, 0.8), answer(0.2, 0.4, 0.4)
    found = compared("?", AskedAttribute(name="hardness", sign=sign, compares=True), one, two)
    assert found.probabilities["first"] == pytest.approx(first)
    assert found.probabilities["same level"] == pytest.approx(0.2 * 0.4 + 0.8 * 0.4)
    assert sum(found.probabilities.values()) == pytest.approx(1)
    assert found.word == word


@pytest.mark.long
def test_plain_arrays_are_enough_and_misfits_are_named(asked):
    rng = np.random.default_rng(0)
    frames = {"tac3d": rng.integers(0, 255, (3, 40, 60, 3), dtype=np.uint8)}
    same = asked.ask(TouchInput(frames=frames, force_n={"tac3d": np.zeros((3, 3))}), "How hard is it?")
    assert asked.ask(frames, "Is it soft?") == same
    assert asked.probabilities(frames)["hardness"] == same.probabilities
    with pytest.raises(QuestionError, match="it compares two objects; give two touches"):
        asked.ask(frames, "Which is harder?")
    with pytest.raises(QuestionError, match="levels of material have no order"):
        asked.compare(frames, frames, "Which material?")
    for wrong, message in (
        ({"digit": frames["tac3d"]}, r"frames are of \['digit'\]: the policy reads gelsight_mini"),
        ({}, "frames are of no sensor"),
        ({"xense": np.zeros((5, 4, 4, 3), np.uint8)}, r"uint8\[5, 4, 4, 3\]: must be uint8 .* 1 ≤ F ≤ 4"),
        (TouchInput(frames=frames, force_n={"tac3d": np.zeros((2, 3))}), r"are \(2, 3\) and \(3,\): must be"),
        (TouchInput(frames=frames, force_n={"tac3d": np.full((3, 3), np.nan)}), "must be finite numbers"),
        (TouchInput(frames=frames, force_n={"gelsight": np.zeros((3, 3))}), "are of gelsight: must be of sensors with"),
        (TouchInput(frames=frames, index={"tac3d": np.array([0, 1.5, 2])}), "whole numbers from 0"),
        (TouchInput(frames=frames, view=np.zeros((9, 9), np.uint8)), r"view is uint8\[9, 9\]: must be RGB"),
        ({"tac3d": np.zeros((3, 0, 0, 3), np.uint8)}, r"uint8\[3, 0, 0, 3\]: must be uint8"),
        ({"tac3d": 3}, r"must be uint8 \[F, H, W, 3\]"),
        (frames["tac3d"], "frames is ndarray: must name its sensor"),
        ({"tac3d": [np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4, 3), np.uint8)]}, "parts must have one shape"),
        ({**frames, 3: frames["tac3d"]}, r"frames are of \['3'\]"),
        (TouchInput(frames=frames, force_n={"tac3d": np.full((3, 3), 1e300)}), "must be finite numbers"),
        (TouchInput(frames=frames, force_n={"tac3d": np.full((3, 3), "1")}), "must be finite numbers"),
        (TouchInput(frames=frames, index={"tac3d": np.arange(3) + 2**30}), "whole numbers from 0"),
        (TouchInput(frames=frames, index={"tac3d": np.array([0, 2, 1], np.uint32)}), r"\[0 2 1\]: must increase"),
        (TouchInput(frames=frames, index={"tac3d": np.array([0, 1, 1])}), r"\[0 1 1\]: must increase"),
    ):
        with pytest.raises(QuestionError, match=message):
            asked.ask(wrong, "How hard is it?")


@pytest.mark.long
def test_inputs_are_read_as_training_data_are(asked, tmp_path):
    for n in range(6):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.full((24, 32, 3), 40 * n, np.uint8))
    pictures = read_touch(tmp_path, asked.saved, "xense")
    video = read_touch(film(tmp_path / "press.avi", frames=6), asked.saved)
    assert {name: x.shape for name, x in pictures.touch.frames.items()} == {"xense": (4, 28, 28, 3)}
    assert list(video.touch.frames) == ["gelsight_mini"]
    assert pictures.touch.index["xense"].tolist() == video.touch.index["gelsight_mini"].tolist()
    assert [r.partition(";")[0] for r in video.remarks] == [
        "read as pictures of gelsight_mini",
        "no force was measured",
        "there is no picture of the object",
        "touched by gelsight_mini alone",
    ]
    drawn = read_touch("generated:soft,wood", asked.saved)
    assert (drawn.truth["hardness"], drawn.truth["material"]) == ("soft", "wood")
    assert list(drawn.touch.frames) == [*SENSORS]
    number = re.search(r"generated:(\d+)", drawn.name)[1]
    again = read_touch(f"generated:{number}", asked.saved)
    assert np.array_equal(again.touch.frames["tac3d"], drawn.touch.frames["tac3d"])


@pytest.mark.long
@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("generated:squishy", "'squishy' is no property; choose from soft, firm"),
        ("generated:soft,hard", "an object has one hardness"),
        ("generated:²", "'²' is no property"),
        ("generated:" + 5_000 * "9", "is no property"),
        ("nowhere.mp4", "no such file or folder; must be a folder of records"),
        ("/dev/zero", "no such file or folder"),
        ("RECORDS:99", "must name a contact 0..15 or an object"),
        ("FILE", "does not open as a video"),
        ("EMPTY", "holds neither records nor pictures"),
        ("CUT", r"cut/2\.png is cut off, remove it"),
    ],
)
def test_what_is_no_input_is_named(asked, records, tmp_path, source, message):
    for name in ("empty", "cut"):
        (tmp_path / name).mkdir()
    (tmp_path / "file.mp4").write_text("no video")
    picture = cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))[1].tobytes()
    for n, content in ((1, picture), (2, picture[:-9])):
        (tmp_path / "cut" / f"{n}.png").write_bytes(content)
    places = {"RECORDS": records, "FILE": tmp_path / "file.mp4", "EMPTY": tmp_path / "empty", "CUT": tmp_path / "cut"}
    for name, path in places.items():
        source = source.replace(name, str(path))
    with pytest.raises(DataError, match=message):
        read_touch(source, asked.saved)


@pytest.mark.long
def test_the_command_prints_json_and_writes_a_page(runs, records, tmp_path, capsys):
    page = tmp_path / "page.html"
    words = [runs / "trial" / "latest" / "sft", f"{records}:0", f"{records}:1", "--question", "Which is softer?"]
    assert ask(runs, *words, "--json", "--html", page) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["policy"] == "trial, sft, seed 0"
    assert [touch["answers"][0]["attribute"] for touch in found["touches"]] == ["hardness"] * 2
    [comparison] = found["comparisons"]
    assert sum(comparison["probabilities"].values()) == pytest.approx(1)
    html = page.read_text(encoding="utf-8")
    assert len(html) < 3e6
    assert html.count("<img") == html.count("data:image/") == 2 * (1 + len(SENSORS))
    assert "http" not in html
    assert "Which is softer?" in html
    assert ask(runs, "trial", records, "--every", "test") == 0
    printed = capsys.readouterr().out
    assert re.search(r"hardness +[\d.]+ % \[[\d.]+, [\d.]+\] right of 5; always the most frequent level ", printed)


@pytest.mark.long
def test_what_cannot_be_asked_is_one_line(runs, records, capsys):
    for words, message in (
        (("trial/latest/ordinal", "generated"), "has sft/0; name RUN/ARM/SEED"),
        (("no-such-run", records), "must be a run, RUN/ARM or RUN/ARM/SEED under"),
        (("trial", records, "--question", "How heavy is it?"), "it names no attribute"),
        (("trial", records, "--question", "Which is harder?"), "give two INPUTs, or ask about one, as in 'how hard"),
        (("trial",), "must be at most one POLICY and one or two INPUTs"),
        (("trial", f"{records}:-1"), ":-1: must name a contact"),
        (("trial", "generated:3", "--sensor", "nose"), "sensor is 'nose': the policy reads"),
        (("trial", records, "--every", "all", "--html", "page.html"), "goes without --question, --sensor and --html"),
    ):
        assert ask(runs, *words) == 1
        error = capsys.readouterr().err
        assert message in error
        assert "Traceback" not in error


@pytest.mark.long
def test_notes_and_levels_of_another_version_are_named_or_left_out(asked):
    for scenes in ([1], "x", {"image_px": "a"}):
        odd = dataclasses.replace(asked.saved, notes={"scenes": scenes})
        with pytest.raises(DataError, match="notes scenes that this version cannot generate"):
            read_touch("generated:3", odd)
    hardness, *others = asked.saved.policy.language.attributes
    fewer = dataclasses.replace(hardness, levels=hardness.levels[:2])
    language = dataclasses.replace(asked.saved.policy.language, attributes=(fewer, *others))
    odd = dataclasses.replace(asked.saved, policy=dataclasses.replace(asked.saved.policy, language=language))
    assert read_touch("generated:3", odd).truth.keys() == {"roughness", "protrusion", "material"}


@pytest.mark.long
def test_a_name_that_is_not_utf_8_gets_a_page(runs, tmp_path, capsys):
    print_in_any_encoding()
    folder = tmp_path / "p\udcff"
    folder.mkdir()
    (folder / "1.png").write_bytes(cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))[1].tobytes())
    assert ask(runs, "trial", folder, "--html", tmp_path / "page.html") == 0
    assert r"p\udcff" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert ask(runs, "trial", folder, "--html", "") == 1
    assert "must be a file" in capsys.readouterr().err


@pytest.mark.long
def test_a_damaged_result_is_named_where_its_card_is_written(runs, tmp_path, capsys):
    results = runs / "trial" / "latest" / "results.json"
    before = results.read_text()
    for text in ("[]", '{"arms": 3}', '{"arms": {"sft": {"acc": {}}}, "data": {}}'):
        results.write_text(text)
        assert run_asking(["export", "trial", str(tmp_path / "p"), "--runs-dir", str(runs)]) == 1
        assert "results.json is not that of a run" in capsys.readouterr().err
    results.write_text(before)


@pytest.mark.long
def test_a_card_takes_the_figures_of_a_run_of_an_earlier_version_and_of_no_other(runs, tmp_path):
    (tmp_path / "policies" / "sft" / "0").mkdir(parents=True)
    found = json.loads((runs / "trial" / "latest" / "results.json").read_text())
    (tmp_path / "results.json").write_text(json.dumps(found | {"config": {"steps": 9}}))
    (tmp_path / "config.json").write_text(json.dumps({"experiment": "trial", "config": {"steps": 9}}))
    assert "on 5 unseen objects" in measured_figures(str(tmp_path), runs)["measured"]
    (tmp_path / "config.json").write_text(json.dumps({"experiment": "trial", "config": {"steps": 8}}))
    with pytest.raises(DamagedFileError, match="is of another run, with another config"):
        measured_figures(str(tmp_path), runs)


@pytest.mark.long
def test_an_exported_folder_and_a_repository_of_the_hub_are_policies(runs, asked, tmp_path, monkeypatch, capsys):
    folder, uploaded = tmp_path / "exported", []
    assert run_asking(["export", "trial/latest/sft/0", str(folder), "--runs-dir", str(runs)]) == 0
    hub = types.SimpleNamespace(
        snapshot_download=lambda name: {"me/touch": folder}[name],
        create_repo=lambda name, exist_ok: None,
        upload_folder=lambda repo_id, folder_path: uploaded.extend(p.name for p in folder_path.iterdir()) or "address",
    )
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    card = (folder / "README.md").read_text(encoding="utf-8")
    assert "| measured | on 5 unseen objects, 1 seeds, 95 % over objects |" in card
    assert "| file |" not in card
    assert "| 68.1 [60.0, 70.0] % |" in card
    frames = {"tac3d": np.zeros((1, 28, 28, 3), np.uint8)}
    assert load_policy("hub:me/touch").ask(frames, "How hard?") == asked.ask(frames, "How hard?")
    assert run_asking(["export", str(folder), "hub:me/touch"]) == 0
    assert "model.safetensors" in uploaded
    assert "address" in capsys.readouterr().out
    own = runs / "trial" / "latest" / "policies" / "sft" / "0"
    before = (own / "config.json").read_bytes()
    assert run_asking(["export", "trial/latest", str(own), "--precision", "int8", "--runs-dir", str(runs)]) == 1
    assert "is the place of a run's own policy" in capsys.readouterr().err
    assert (own / "config.json").read_bytes() == before
    with pytest.raises(PolicyError, match="no such folder"):
        load_policy("nowhere")


@pytest.mark.long
@pytest.mark.parametrize("command", [("ask", "hub:me/touch", "generated"), ("export", "touch-small", "hub:me/touch")])
def test_a_hub_that_fails_or_is_not_there_is_one_line(command, monkeypatch, capsys):
    def fails(*args, **options):
        raise RuntimeError("no\nnetwork")  # an error of the HTTP client, which is none of the system

    broken = types.SimpleNamespace(snapshot_download=fails, create_repo=fails)
    for hub, message in ((broken, "(no network): correct the name"), (None, "halted")):
        monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
        assert run_asking(command) == 1
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1


@pytest.mark.long
def test_an_exported_policy_may_lie_at_a_url(runs, asked, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    url = "memory://bucket/policy"
    assert run_asking(["export", "trial/latest/sft/0", url, "--runs-dir", str(runs)]) == 0
    assert "MB were sent" in capsys.readouterr().out
    assert is_policy(url, runs)
    assert not is_policy("memory://bucket/records:12", runs)
    frames = {"tac3d": np.zeros((1, 28, 28, 3), np.uint8)}
    assert find_policy(url, runs).ask(frames, "How hard?") == asked.ask(frames, "How hard?")
    assert run_asking(["ask", "memory://bucket/none", "generated"]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.fixture(scope="module")
def address(asked):
    with demo_server(asked, 0) as address:
        yield address


def fetch(address, path="", body=None, **headers):
    request = urllib.request.Request(address + path, data=body, headers=headers)
    try:
        with urllib.request.urlopen(request) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


@pytest.mark.long
def test_the_demo_answers_about_objects_and_videos(address, tmp_path):
    status, page = fetch(address)
    assert status == 200
    assert "trial, sft, seed 0" in page
    assert "<option>protruding</option>" in page
    status, answers = fetch(address, "generated?words=soft,smooth")
    assert status == 200
    assert "<b>soft</b> (true)" in answers
    video = film(tmp_path / "press.avi").read_bytes()
    status, answers = fetch(address, "video?name=press.avi&sensor=xense", video, Origin=address.rstrip("/"))
    assert status == 200
    assert answers.count("<img") == 1
    assert fetch(address, "video?name=press.avi&sensor=xense", b"no video")[0] == 400
    assert "no property" in fetch(address, "generated?words=squishy")[1]
    assert fetch(address, "records")[0] == 404


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("demo", "--port", "-1"), "port is -1: must lie in 0 … 65535"),
        (("demo", "--port", "65536"), "port is 65536: must lie in 0 … 65535"),
        (("ask", "generated", "--html", "/dev/null"), "html is /dev/null: must be a file or a folder, not a pipe"),
    ],
)
def test_numbers_and_places_that_nobody_means_are_refused_before_anything_is_read(words, message, capsys):
    assert run_asking(words) == 2
    assert message in capsys.readouterr().err


@pytest.mark.long
def test_the_demo_is_closed_to_other_pages_and_files(address, records):
    assert fetch(address, Host="evil.example:80")[0] == 403
    assert fetch(address, "video?name=a.avi", b"x", Origin="http://evil.example")[0] == 403
    assert fetch(address, f"generated?words={records}")[0] == 400
    assert fetch(address, "video?name=a.avi", b"", **{"Content-Length": str(2**40)})[0] == 413


@pytest.mark.long
def test_the_readme_asks_the_policy_of_the_package(capsys):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    [snippet] = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "load_policy" in block]
    exec(snippet, {})
    assert re.match(r"(soft|firm|hard) \(soft \d+%, firm \d+%, hard \d+%\); without touch ", capsys.readouterr().out)


@pytest.mark.long
@pytest.mark.parametrize("name", shipped())
def test_policies_of_the_package_are_small_and_have_a_card(name):
    files = {path.name: path.stat().st_size for path in (SHIPPED / name).iterdir()}
    assert sum(files.values()) < 800_000
    assert {"limits", "measured"} <= load_policy(name).saved.notes.keys()


@pytest.mark.long
def test_requests_of_no_browser_are_refused_without_a_word_in_the_terminal(address, capfd):
    """Lengths that are none, an upload that ends early, a name that is no file's, addresses that are none."""
    split = urllib.parse.urlsplit(address)
    host = f"Host: {split.netloc}\r\n".encode()
    for request, status in (
        (b"POST /video?name=a.avi HTTP/1.1\r\n" + host + b"Content-Length: \xb2\r\n\r\n", b"413"),
        (b"POST /video?name=a.avi HTTP/1.1\r\n" + host + b"Content-Length: 9\r\n\r\nabc", b"400"),
        (b"POST /video?name=a.%00 HTTP/1.1\r\n" + host + b"Content-Length: 3\r\n\r\nabc", b"400"),
        (b"GET http://[ HTTP/1.1\r\n" + host + b"\r\n", b"404"),
        (b"GET / HTTP/1.1\r\nHost: [\r\n\r\n", b"403"),
    ):
        with socket.create_connection((split.hostname, split.port), timeout=10) as connection:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            answer = b"".join(iter(lambda: connection.recv(65_536), b""))
        assert answer.partition(b" ")[2].startswith(status), request
    assert "Traceback" not in capfd.readouterr().err
