"""Adapters in the format of Hugging Face's PEFT: `adapter_config.json` and `adapter_model.safetensors`."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from touchr1_jax.models.lora import Adapter, Adapters, LoraConfig, by_layer, nested
from touchr1_jax.models.qwen import names
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.safetensors import DTYPES, read_header, read_tensor, write_file

PEFT_CONFIG, PEFT_WEIGHTS = "adapter_config.json", "adapter_model.safetensors"
PREFIX = "base_model.model."
FACTORS = {"a": "lora_A", "b": "lora_B"}
"""Our factors, [in, r] and [r, out], and PEFT's, which are turned."""

REFUSED = {
    "bias": "none",
    "use_dora": False,
    "fan_in_fan_out": False,
    "modules_to_save": None,
    "rank_pattern": {},
    "alpha_pattern": {},
    "layer_replication": None,
}
"""Fields of a config and the values without which adapters compute something else than here."""

MOST_ALPHA = 1e6
"""No training has more; a number that is no float would pass as one."""


def save_adapters(folder: Path, adapters: Adapters, config: QwenConfig, lora: LoraConfig, base: str) -> None:
    """Write adapters so that PEFT reads them, in float32.

    Args:
      folder: that exists.
      adapters: nested as the parameters of `QwenVL`.
      config: shapes of the model that they belong to.
      lora: as they were trained.
      base: name of the folder of the released weights, for PEFT.
    """
    tensors: dict[str, np.ndarray] = {}
    found = by_layer(adapters)
    for s in names.sources(config).values():
        adapter = found.get(s.path[:-1]) if s.path[-1] == "kernel" else None
        for name, factor in () if adapter is None else adapter._asdict().items():
            of_layer = np.asarray(factor if s.row is None else factor[s.row], np.float32)
            tensors[f"{PREFIX}{names.nested(s.key.removesuffix('.weight'))}.{FACTORS[name]}.weight"] = of_layer.T
    write_file(folder / PEFT_WEIGHTS, tensors)
    fields = {
        "peft_type": "LORA",
        "task_type": None,
        "base_model_name_or_path": base,
        "r": lora.rank,
        "lora_alpha": lora.alpha,
        "use_rslora": lora.rank_stabilised,
        "target_modules": target_pattern(lora),
        "lora_dropout": 0.0,
        "inference_mode": True,
        **REFUSED,
    }
    (folder / PEFT_CONFIG).write_text(json.dumps(fields, indent=2) + "\n", encoding="utf-8")


def load_adapters(folder: Path, config: QwenConfig) -> tuple[Adapters, LoraConfig]:
    """Adapters that PEFT or `save_adapters` wrote, and their config.

    Raises:
      FileNotFoundError: a file is missing.
      ValueError: adapters of another kind or of another model, or NaN or infinity; the message names the first misfit.
    """
    for name in (PEFT_CONFIG, PEFT_WEIGHTS):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"{folder / name} is no file: must be a part of saved adapters; correct the folder")
    try:
        fields = json.loads((folder / PEFT_CONFIG).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{folder / PEFT_CONFIG} is no JSON ({error}); copy it again") from error
    lora, header = read_lora(fields, folder / PEFT_CONFIG), read_header(folder / PEFT_WEIGHTS)
    entries = {_canonical(key): entry for key, entry in header.items()}
    if not entries or len(entries) < len(header):
        raise ValueError(f"{folder / PEFT_WEIGHTS}: has no adapter, or one of them twice; save the adapters anew")
    layers: dict[names.Path, dict[int | None, Adapter]] = {}
    for s in names.sources(config).values():
        keys = [f"{s.key.removesuffix('.weight')}.{FACTORS[name]}.weight" for name in ("a", "b")]
        if not any(key in entries for key in keys):
            continue
        out, inp = s.shape
        factors: list[Any] = []
        for key, shape in zip(keys, ((lora.rank, inp), (out, lora.rank)), strict=True):
            if key not in entries or entries[key].shape != shape or entries[key].dtype not in DTYPES:
                found = f"{entries[key].dtype} {entries[key].shape}" if key in entries else "missing"
                raise ValueError(
                    f"{folder / PEFT_WEIGHTS}: {key} is {found}: must be {shape} of rank {lora.rank}, of real numbers"
                )
            factors.append(read_tensor(entries.pop(key)).astype(np.float32).T)
            if not np.isfinite(factors[-1]).all():
                raise ValueError(f"{folder / PEFT_WEIGHTS}: {key} holds NaN or infinity; its training diverged")
        layers.setdefault(s.path[:-1], {})[s.row] = Adapter(*factors)
    if entries:
        raise ValueError(f"{folder / PEFT_WEIGHTS}: {min(entries)} belongs to no layer of the base; take its own base")
    return nested({path: _stacked(path, rows, config) for path, rows in layers.items()}), lora


def read_lora(fields: Mapping[str, Any], where: Path) -> LoraConfig:
    """The config of adapters, without their targets, which the tensors name.

    Raises:
      ValueError: another kind of adapters.
    """
    if not isinstance(fields, Mapping):
        raise ValueError(f"{where} is {str(fields)[:40]!r}: must be a JSON object; copy it again")
    wanted = {"peft_type": "LORA", **REFUSED}
    odd = [name for name, value in wanted.items() if (fields.get(name, value) or None) != (value or None)]
    if odd:
        raise ValueError(f"{where}: {odd[0]} is {fields[odd[0]]!r}: must be {wanted[odd[0]]!r}; nothing else is read")
    rank: Any = fields.get("r")
    alpha: Any = fields.get("lora_alpha")
    stabilised = fields.get("use_rslora", False)
    if type(rank) is not int or rank < 1 or type(alpha) not in (int, float) or not 0 < alpha <= MOST_ALPHA:
        found = f"r is {rank!r} and lora_alpha {str(alpha)[:20]}"
        raise ValueError(f"{where}: {found}: must be a whole number ≥ 1 and a number above 0; correct them")
    if type(stabilised) is not bool:
        raise ValueError(f"{where}: use_rslora is {stabilised!r}: must be true or false; correct it")
    return LoraConfig(rank=rank, alpha=float(alpha), rank_stabilised=stabilised)


def target_pattern(lora: LoraConfig) -> str:
    """Regular expression of the adapted modules' names: MLPs of both towers have layers of one name."""
    named = lambda layers: "|".join(re.escape(names.MODULES.get(x, x)) for x in layers)
    kinds = [rf"(?!.*visual\.).*\.({named(lora.targets)})"] if lora.targets else []
    kinds += [rf".*visual\.(.*\.)?({named(lora.vision_targets)})"] if lora.vision_targets else []
    return "|".join(kinds)


def _canonical(key: str) -> str:
    """A key of PEFT as `names.sources` has it, with the factor at its end."""
    return names.canonical(key.removeprefix(PREFIX).replace(".default.", "."))


def _stacked(path: names.Path, rows: Mapping[int | None, Adapter], config: QwenConfig) -> Adapter:
    """The adapters of a stack of layers.

    Raises:
      ValueError: some layers have none.
    """
    if None in rows:
        return Adapter(*map(jnp.asarray, rows[None]))
    count = config.decoder.num_layers - 1 if path[0] == "decoder" else config.vision.depth
    lacking = sorted(set(range(count)) - rows.keys())
    if lacking:
        raise ValueError(f"layer {lacking[0]} has no adapter of {path[-1]}: must have one where another layer has")
    return Adapter(*(jnp.stack([rows[i][f] for i in range(count)]) for f in range(2)))
