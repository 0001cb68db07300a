"""Read a released Qwen2.5-VL or Qwen3-VL: config, weights, tokenizer and chat template of one directory.

    python -m touchr1_jax.models.load DIR [--dtype bfloat16|float32]

says what it found, how long that took and how much memory; on files that do not fit it names each misfit and ends with
status 1.
"""

import contextlib
import dataclasses
import math
import resource
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import tyro
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

from touchr1_jax.models.qwen.config import QwenConfig, QwenVisionConfig
from touchr1_jax.models.qwen.config_file import read_config
from touchr1_jax.models.qwen.pictures import PixelBudget, read_budget
from touchr1_jax.models.qwen.safetensors import ReportBytes
from touchr1_jax.models.qwen.weights import load_params
from touchr1_jax.text.chat import VISION, VISION_END, check_template
from touchr1_jax.text.tokenizer import Tokenizer, from_file
from touchr1_jax.types import Params

TOKENIZER_FILE = "tokenizer.json"


class WeightsError(ValueError):
    """Released weights, or a file next to them, that cannot be used; the message says which, why, and what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """Contents of `directory`; `params` is the tree of `QwenVL`, `budget` the pixels that a picture may have."""

    config: QwenConfig
    params: Params
    tokenizer: Tokenizer
    budget: PixelBudget
    directory: Path


def load_checkpoint(
    directory: str | Path,
    dtype: jnp.dtype | type = jnp.bfloat16,
    progress: ReportBytes = lambda done_bytes, all_bytes: None,
    *,
    four_bits: bool = False,
) -> Checkpoint:
    """Read a checkpoint; small files first, so that a wrong one is refused before the weights are read.

    Args:
      directory: `config.json`, `tokenizer.json`, `preprocessor_config.json` or `processor_config.json`, a chat
        template, and the weights as `load_params` reads them.
      dtype: type of all parameters.
      progress: called for the weights as in `load_params`.
      four_bits: as in `load_params`; for a base of adapters.

    Raises:
      FileNotFoundError: a file that is missing.
      WeightsError: one that does not fit.
    """
    try:
        return _read(Path(directory), dtype, progress, four_bits)
    except ValueError as error:
        raise WeightsError(str(error)) from error


def _read(directory: Path, dtype: jnp.dtype | type, progress: ReportBytes, four_bits: bool) -> Checkpoint:
    config = read_config(directory)
    tokenizer = from_file(directory / TOKENIZER_FILE, vocab_size=config.decoder.vocab_size)
    check_ids(tokenizer, config)
    check_template(directory, config.vision.model_type)
    budget = read_budget(directory, config.vision)
    params = load_params(directory, config, dtype, progress=progress, four_bits=four_bits)
    return Checkpoint(config=config, params=params, tokenizer=tokenizer, budget=budget, directory=directory)


def check_ids(tokenizer: Tokenizer, config: QwenConfig) -> None:
    """Hold the ids that a config gives to special tokens against the tokenizer.

    Raises:
      ValueError: they differ.
    """
    ids = {
        "vision_start_token_id": (config.vision_start_id, tokenizer.encode(VISION)),
        "vision_end_token_id": (config.vision_end_id, tokenizer.encode(VISION_END)),
        "image_token_id": (config.image_id, [tokenizer.view_id]),
        "video_token_id": (config.video_id, [tokenizer.tactile_id]),
    }
    for field, (said, found) in ids.items():
        if [said] != found:
            raise ValueError(
                f"{field} is {said} in config.json and {found} in {TOKENIZER_FILE}: must be the same; "
                "take both files from one checkpoint"
            )


@contextlib.contextmanager
def _bar() -> Iterator[ReportBytes]:
    """Bytes, rate and time left on stderr; where that is no terminal, its last state alone."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Load:
    """Read a checkpoint and say what it is."""

    directory: Annotated[Path, tyro.conf.Positional]
    dtype: Literal["bfloat16", "float32"] = "bfloat16"

    def run(self) -> int:
        """Read, report, and return the exit status."""
        console, began = Console(soft_wrap=True, highlight=False, emoji=False), time.perf_counter()
        try:
            with _bar() as progress:
                found = load_checkpoint(self.directory, jnp.dtype(self.dtype), progress)
        except (OSError, ValueError) as error:
            Console(stderr=True, soft_wrap=True, emoji=False).print(
                f"{type(error).__name__}: {error}", markup=False, highlight=False
            )
            return 1
        except KeyboardInterrupt:
            return 128 + signal.SIGINT  # as shells have it
        leaves = jax.tree.leaves(found.params)
        size, peak = sum(x.nbytes for x in leaves), peak_memory()
        d, v = found.config.decoder, found.config.vision
        if isinstance(v, QwenVisionConfig):
            special = f"windows of {v.window_px} px, none in {v.full_layers}"
        else:
            special = f"those of {v.deepstack_layers} also read by the decoder"
        console.print(
            f"decoder  {d.num_layers} layers of {d.hidden_size}, {d.num_heads} heads over {d.num_kv_heads}, "
            f"{d.vocab_size} tokens, head {'tied' if d.tie_embedding else 'untied'}\n"
            f"vision   {v.depth} layers of {v.hidden_size}, {special}\n"
            f"weights  {sum(math.prod(x.shape) for x in leaves):,} parameters, {size / 1e9:.2f} GB {self.dtype}, "
            f"read in {time.perf_counter() - began:.1f} s\n"
            f"memory   {peak / 1e9:.2f} GB at most, {peak / size:.2f} × the weights"
        )
        return 0


def peak_memory() -> int:
    """Largest resident size that this program has had, bytes.

    From Linux's VmHWM, which starts anew with a program; `getrusage` would give a child its parent's.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        (line,) = (x for x in status.read_text(encoding="utf-8").splitlines() if x.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


if __name__ == "__main__":
    sys.exit(tyro.cli(Load, prog="python -m touchr1_jax.models.load").run())
