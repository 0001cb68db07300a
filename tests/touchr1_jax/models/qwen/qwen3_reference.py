"""What transformers makes of a Qwen3-VL: run as a program of its own, `python -m … FOLDER NAME`, by the `parity` extra.

It writes `checkpoint/` by its own `save_pretrained`, and `reference.npz`: the gradient of every parameter, greedy
tokens, and what the released processor makes of a conversation with pictures and videos.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from tokenizers import Tokenizer
from transformers import PreTrainedTokenizerFast
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil
from transformers.models.qwen3_vl import Qwen3VLProcessor, Qwen3VLVideoProcessor

from experiments.paper.tiny_checkpoint import TEMPLATE_QWEN3
from tests.touchr1_jax.models.qwen import cases, words
from tests.touchr1_jax.models.qwen.cases import CASES
from tests.touchr1_jax.models.qwen.make_golden import reference_inputs, reference_model
from touchr1_jax.text.language import TOUCH_LANGUAGE

TOKENS = 32


def conversation(question: str) -> list[dict]:
    """A picture, then each sensor's name and a video."""
    content: list[dict] = [{"type": "image"}]
    for sensor in TOUCH_LANGUAGE.sensors:
        content += [{"type": "text", "text": sensor.phrases[0]}, {"type": "video"}]
    content.append({"type": "text", "text": question})
    return [{"role": "system", "content": "Be brief."}, {"role": "user", "content": content}]


def processed(folder: Path, frames: int, question: str) -> dict[str, np.ndarray]:
    """Ids and patches of a conversation whose videos have so many frames."""
    words.write(folder / "tokenizer.json", TOUCH_LANGUAGE)
    library = Tokenizer.from_file(str(folder / "tokenizer.json"))
    sizes = {
        "patch_size": cases.PATCH_PX,
        "temporal_patch_size": cases.PATCH_FRAMES,
        "merge_size": cases.MERGE,
        "image_mean": [0.5] * 3,
        "image_std": [0.5] * 3,
        "size": {"shortest_edge": cases.SIDE**2, "longest_edge": 64 * cases.SIDE**2},
    }
    processor = Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessorPil(**sizes),
        tokenizer=PreTrainedTokenizerFast(tokenizer_object=library),
        video_processor=Qwen3VLVideoProcessor(**sizes, do_sample_frames=False, do_resize=False),
        chat_template=TEMPLATE_QWEN3.read_text(),
    )
    text = processor.apply_chat_template(conversation(question), tokenize=False, add_generation_prompt=True)
    shown = [cases.video(frames)] * len(TOUCH_LANGUAGE.sensors)
    metadata = {"fps": 2.0, "total_num_frames": frames, "frames_indices": list(range(frames))}
    found = processor(
        text=[text],
        images=[cases.video(1)[0]],
        videos=shown,
        video_metadata=[dict(metadata) for _ in shown],
        return_tensors="np",
    )
    n = len(found["pixel_values_videos"]) // len(shown)
    return {
        f"ids_{frames}": np.asarray(found["input_ids"])[0],
        f"picture_{frames}": np.asarray(found["pixel_values"]),
        f"video_{frames}": np.asarray(found["pixel_values_videos"])[:n],
    }


def main(folder: Path, name: str, question: str) -> None:
    case = CASES[name]
    model = reference_model(case)
    model.save_pretrained(folder / "checkpoint")
    inputs = reference_inputs(name, case)
    logits = model(**inputs, use_cache=False).logits[0]
    torch.nn.functional.cross_entropy(logits[:-1], inputs["input_ids"][0, 1:]).backward()
    found = {f"grad {key}": x.grad.numpy() for key, x in model.named_parameters()}
    with torch.no_grad():
        settings = {"max_new_tokens": TOKENS, "do_sample": False, "eos_token_id": None, "pad_token_id": 0}
        found["greedy"] = model.generate(**inputs, **settings)[0, -TOKENS:].numpy()
    for frames in (4, 5):
        found |= processed(folder, frames, question)
    np.savez(folder / "reference.npz", **found)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
