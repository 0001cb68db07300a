"""Compute the golden arrays with Hugging Face transformers on PyTorch (CPU, float32): the `parity` extra.

    python -m tests.touchr1_jax.models.qwen.make_golden [--check]

For each case: logits [L, V] and position ids [3, L]; also a picture's patches.
`--check` compares with the committed arrays and writes nothing.
"""

import argparse
from typing import Any

import numpy as np
import torch
import transformers
from transformers.models.qwen2_5_vl import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil
from transformers.models.qwen3_vl import Qwen3VLConfig, Qwen3VLForConditionalGeneration

from tests.touchr1_jax.models.qwen import cases
from tests.touchr1_jax.models.qwen.cases import CASES, Case, Picture, Video

ROUNDING = 2e-5
"""Largest difference of two float32 runs of the reference, relative to the largest logit."""


Reference = Qwen2_5_VLForConditionalGeneration | Qwen3VLForConditionalGeneration


def reference_model(case: Case) -> Reference:
    """The reference with weights by formula."""
    kinds = Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration
    if case.shape is not None:
        kinds = Qwen3VLConfig, Qwen3VLForConditionalGeneration
    config = kinds[0](**case.config())
    config._attn_implementation = "eager"
    model = kinds[1](config).float().eval()
    with torch.no_grad():
        for name, weight in model.named_parameters():
            weight.copy_(torch.from_numpy(cases.tensor(without_prefix(name), tuple(weight.shape))))
    return model


def without_prefix(name: str) -> str:
    """A parameter's name as `cases.tensor` knows it, written independently of the loader."""
    return name.replace("model.language_model.", "text.").replace("model.visual.", "visual.")


def reference_inputs(name: str, case: Case) -> dict[str, torch.Tensor]:
    """What the reference takes; pictures and videos apart."""
    ids = torch.from_numpy(cases.prompt_ids(case))[None]
    inputs: dict[str, Any] = {
        "input_ids": ids,
        "mm_token_type_ids": ((ids == cases.IMAGE) + 2 * (ids == cases.VIDEO)).int(),
    }
    for kind, pixels, grid in (
        (Picture, "pixel_values", "image_grid_thw"),
        (Video, "pixel_values_videos", "video_grid_thw"),
    ):
        parts = [(i, part) for i, part in enumerate(case.seen()) if isinstance(part, kind)]
        if parts:
            inputs[pixels] = torch.from_numpy(np.concatenate([cases.patches(f"{name} {i}", p) for i, p in parts]))
            inputs[grid] = torch.tensor([[cases.steps(p), p.rows, p.columns] for _, p in parts])
            if kind is Video and case.shape is None:
                inputs["second_per_grid_ts"] = torch.tensor([p.seconds_per_step for _, p in parts])
    return inputs


def positions(model: Reference, case: Case, inputs: dict[str, torch.Tensor]) -> torch.Tensor:
    """Position ids by the reference, or, where it has left the released model, by the released model's rule."""
    if case.ids_as_reference:
        if not case.seen():
            return torch.arange(inputs["input_ids"].shape[1]).expand(3, 1, -1)
        known = {k: v for k, v in inputs.items() if not k.startswith("pixel")}
        return model.model.get_rope_index(**known)[0]
    start, rows = 0, []
    for part in case.parts:
        if isinstance(part, int):
            block = [(i, i, i) for i in range(part)]
            rows += [(start + t, start + y, start + x) for t, y, x in block]
        else:
            rows.append((start, start, start))  # mark before
            start += 1
            pace = part.seconds_per_step * model.config.vision_config.tokens_per_second
            block = [
                (int(t * pace), y, x)
                for t in range(part.steps)
                for y in range(part.rows // cases.MERGE)
                for x in range(part.columns // cases.MERGE)
            ]
            rows += [(start + t, start + y, start + x) for t, y, x in block]
            start += max(max(b) for b in block) + 1
            block = [(0, 0, 0)]
            rows.append((start, start, start))  # mark after
        start += max(max(b) for b in block) + 1
    return torch.tensor(rows).T[:, None]


@torch.no_grad()
def golden(name: str, case: Case) -> dict[str, np.ndarray]:
    """Logits and positions of one case; the reference's own cached decoding must agree with its full forward pass."""
    model = reference_model(case)
    inputs = reference_inputs(name, case)
    ids = positions(model, case, inputs)
    full = model(**inputs, position_ids=ids, use_cache=False).logits[0].numpy()
    cached = decoded(model, inputs, ids, last=4)
    assert np.abs(cached - full[-4:]).max() <= ROUNDING * np.abs(full).max(), name
    return {f"{name}.logits": full, f"{name}.positions": ids[:, 0].numpy().astype(np.int16)}


def decoded(model, inputs: dict[str, torch.Tensor], ids: torch.Tensor, last: int) -> np.ndarray:
    """Logits of the last tokens, fed one by one after a prefill with the others."""
    head = {k: v[:, :-last] if k in ("input_ids", "mm_token_type_ids") else v for k, v in inputs.items()}
    out = model(**head, position_ids=ids[..., :-last], use_cache=True)
    rows = []
    for i in range(-last, 0):
        token = inputs["input_ids"][:, i : i + 1 or None]
        out = model(
            input_ids=token,
            position_ids=ids[..., i : i + 1 or None],
            past_key_values=out.past_key_values,
            use_cache=True,
        )
        rows.append(out.logits[0, -1].numpy())
    return np.stack(rows)


def picture_levels() -> dict[str, np.ndarray]:
    """What the released processor makes of a picture, turned back into levels 0..255, uint8 [patch, pixel]."""
    processor = Qwen2VLImageProcessorPil()
    patches = processor(images=[cases.picture_pixels()], return_tensors="np")["pixel_values"].reshape(-1, 3, 2 * 14**2)
    mean, std = (np.array(x)[:, None] for x in (processor.image_mean, processor.image_std))
    levels = (patches * std + mean) * 255
    assert np.abs(levels - np.round(levels)).max() < 0.01
    return {"picture.levels": np.round(levels).astype(np.uint8).reshape(len(levels), -1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare with the committed arrays, write nothing")
    check = parser.parse_args().check
    arrays = picture_levels()
    for name, case in CASES.items():
        arrays |= golden(name, case)
    if check:
        compare(arrays)
        return
    cases.GOLDEN.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(cases.GOLDEN, transformers=np.array(transformers.__version__), **arrays)


def compare(arrays: dict[str, np.ndarray]) -> None:
    """Fail where the committed arrays are not what this machine computes."""
    with np.load(cases.GOLDEN) as committed:
        assert set(arrays) == set(committed.files) - {"transformers"}
        for name, x in arrays.items():
            scale = np.abs(x.astype(float)).max()
            np.testing.assert_allclose(x, committed[name], atol=ROUNDING * scale, rtol=0, err_msg=name)


if __name__ == "__main__":
    main()
