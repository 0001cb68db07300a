"""What the README says of released models is run as it stands, on a tiny checkpoint."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax.models.checkpoint import write_checkpoint
from touchr1_jax.models.lora import LoraConfig, merge
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.training.sft import SFTBatch, SFTState
from touchr1_jax.types import TouchBatch

README = Path(__file__).resolve().parents[3] / "touchr1_jax" / "README.md"
P, S, FRAMES, T = 1, 4, 2, 3


def touch_batch() -> TouchBatch:
    rng = np.random.default_rng(0)
    return TouchBatch(
        frames=jnp.asarray(rng.integers(0, 256, (P, S, FRAMES, 28, 28, 3)), jnp.uint8),
        force_n=jnp.zeros((P, S, FRAMES, 3)),
        frame_index=jnp.broadcast_to(jnp.arange(FRAMES), (P, S, FRAMES)),
        frame_mask=jnp.ones((P, S, FRAMES), bool),
        stream_mask=jnp.ones((P, S), bool),
        view=jnp.zeros((P, 64, 64, 3), jnp.uint8),
        view_mask=jnp.ones(P, bool),
        label=jnp.zeros((P, len(TOUCH_LANGUAGE.attributes)), jnp.int32),
    )


def make_batch(layout) -> SFTBatch:
    """One question about one contact, answered by three words."""
    return SFTBatch(
        touch=touch_batch(),
        ids=jnp.asarray(layout.ids[:1, None]),
        mask=jnp.asarray(layout.mask[:1, None]),
        streams=jnp.ones((P, 1, S), bool),
        tokens=jnp.full((P, 1, T), 7, jnp.int32),
        token_mask=jnp.ones((P, 1, T), bool),
    )


@pytest.mark.slow
def test_a_released_model_is_trained(tmp_path):
    (block,) = re.findall(r"^```python\n(.*?load_checkpoint.*?)^```$", README.read_text(), re.MULTILINE | re.DOTALL)
    write_checkpoint(tmp_path)
    lora, optimizer = LoraConfig(rank=16), optax.sgd(10.0)
    known = {"FRAMES": FRAMES, "LORA": lora, "OPTIMIZER": optimizer}
    known |= {"DIR": tmp_path, "KEY": jax.random.key(0), "TOUCH": touch_batch()}
    exec(block, known)
    base, trained = known["base"], known["trained"]
    state = SFTState(params=trained, opt_state=optimizer.init(trained), step=jnp.int32(0))
    state, metrics = known["step"](base, state, make_batch(known["layout"]))
    assert np.isfinite(metrics["loss"])
    merged = merge(base, state.params["adapters"], lora)
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), merged, base)
    assert not any(jax.tree.leaves(changed["vision"]))
    assert any(jax.tree.leaves(changed["decoder"]))
