"""A pretrained encoder on disk."""

import dataclasses
import io
import json
import os

import jax
import numpy as np
import pytest

from touchr1_jax.models.pretrained import EncoderError, PretrainedEncoder, load_encoder
from touchr1_jax.models.tactile_vit import TactileViTConfig

CONFIG = TactileViTConfig(sensors=2, width=16, num_layers=0, num_heads=2, causal=True)


@pytest.fixture
def encoder():
    rng = np.random.default_rng(0)
    params = {
        "sensor": {"embedding": rng.normal(size=(2, 16)).astype(np.float32)},
        "norm": {"scale": rng.normal(size=16).astype(np.float32)},
        "patch_position": rng.normal(size=(1, 16)).astype(np.float32),
    }
    return PretrainedEncoder(config=CONFIG, sensors=("gelsight_mini", "xense"), params=params, notes={"steps": 3})


def test_it_comes_back_as_it_was(encoder, tmp_path):
    (tmp_path / "encoder.npz").write_bytes(encoder.to_bytes())
    for path in (tmp_path, tmp_path / "encoder.npz"):
        found = load_encoder(path)
        assert (found.config, found.sensors, found.notes) == (encoder.config, encoder.sensors, encoder.notes)
        assert jax.tree.structure(found.params) == jax.tree.structure(encoder.params)
        for a, b in zip(jax.tree.leaves(found.params), jax.tree.leaves(encoder.params), strict=True):
            np.testing.assert_array_equal(a, b)


def test_sensors_are_picked_by_name(encoder):
    table = encoder.params["sensor"]["embedding"]
    other = encoder.for_sensors(("xense", "tac3d", "gelsight_mini"))
    np.testing.assert_allclose(other.params["sensor"]["embedding"], [table[1], table.mean(0), table[0]], rtol=1e-6)
    assert (other.config.sensors, other.sensors[1]) == (3, "tac3d")
    assert dataclasses.replace(other.config, sensors=2) == CONFIG


def test_what_is_no_encoder_is_refused(encoder, tmp_path):
    with pytest.raises(EncoderError, match=r"no such file; give the run directory of pretrain_encoder"):
        load_encoder(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(EncoderError, match="no such file"):
        load_encoder(tmp_path / "pipe")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="it has no entry 'about'"):
        load_encoder(tmp_path / "other.npz")


@pytest.mark.parametrize(
    "about",
    [[], {}, {"config": None}, {"config": 3}, {"sensors": 3}, {"notes": None}, {"num_heads": None}, {"num_heads": 0}],
)
def test_an_encoder_of_another_form_is_named(encoder, tmp_path, about):
    with np.load(io.BytesIO(encoder.to_bytes())) as file:
        entries = dict(file)
    whole = json.loads(entries["about"].tobytes())
    if isinstance(about, dict) and about.keys() <= {"num_heads"}:
        about = {"config": whole["config"] | about} if about else about
    changed = whole | about if about and isinstance(about, dict) else about
    np.savez(tmp_path / "a.npz", **entries | {"about": np.frombuffer(json.dumps(changed).encode(), np.uint8)})
    with pytest.raises(EncoderError, match=r"its entry 'about' is of another form .*give a file"):
        load_encoder(tmp_path / "a.npz")


def test_a_flipped_bit_is_named_or_harmless(encoder, tmp_path):
    """Of every third byte one bit, in turn, and of all of the list of entries at the end."""
    path, whole = tmp_path / "encoder.npz", encoder.to_bytes()
    for i in [*range(0, len(whole), 3), *range(whole.index(b"PK\1\2"), len(whole))]:
        path.write_bytes(whole[:i] + bytes([whole[i] ^ 1 << i % 8]) + whole[i + 1 :])
        try:
            found = load_encoder(path)
        except EncoderError:
            continue
        assert (found.config, found.sensors, found.notes) == (encoder.config, encoder.sensors, encoder.notes)
        jax.tree.map(np.testing.assert_array_equal, found.params, encoder.params)
