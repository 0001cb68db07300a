"""Values that mean nothing, through the command line of a study: named before anything is made."""

import pytest

from experiments.core.runner import main


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("seeds", "0"),
        ("grpo-share", "1"),
        ("grpo-steps", "-1"),
        ("grpo.group", "1"),
        ("grpo.micro-prompts", "0"),
        ("grpo.learning-rate", "-1"),
        ("grpo.final-share", "nan"),
        ("sft.steps", "-1"),
        ("sft.batch-size", "0"),
        ("sft.optimizer.lr-scale", "-1"),
        ("sft.optimizer.b2", "1"),
        ("sft.optimizer.learning-rate", "inf"),
        ("probe.folds", "1"),
        ("model.tactile.num-layers", "-1"),
        ("model.decoder.rope-theta", "0"),
        ("scenes.seed", "-1"),
        ("scenes.ramp-s", "0"),
        ("scenes.solver-max-iterations", "0"),
        ("data-dir", "somewhere"),
    ],
)
def test_what_means_nothing_is_refused_before_anything_is_made(field, value, tmp_path, capsys):
    places = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path / "cache")]
    try:
        status = main(["ablation_ordinal", f"--{field}={value}", *places])
    except SystemExit as end:
        status = end.code
    said = capsys.readouterr().err
    assert status == 2
    assert f"{field.rpartition('.')[2].replace('-', '_')} is {value}" in said
    assert "Traceback" not in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [None, b"", b"no archive"])
def test_an_encoder_that_is_none_is_named_before_data_are_made(content, tmp_path, capsys):
    path = tmp_path / "encoder.npz"
    if content is not None:
        path.write_bytes(content)
    places = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path / "cache")]
    assert main(["ablation_ordinal", "--scale", "smoke", "--encoder", str(path), *places]) == 1
    assert f"EncoderError: encoder is {path}: " in capsys.readouterr().err
    assert not list(tmp_path.glob("cache/scenes-*"))
