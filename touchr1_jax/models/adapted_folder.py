"""A policy on released weights as a folder that describes itself, small compared with the weights that it refers to.

DIR/config.json                 sizes, sensors, prompt, frames that it reads, where the released weights are, checksums
DIR/adapter_config.json         adapters in PEFT's format,
DIR/adapter_model.safetensors   which `peft` loads on the same weights
DIR/touch_encoder.safetensors   tactile encoder and the projection of its tokens
DIR/README.md                   model card
"""

import dataclasses
import functools
import os
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from touchr1_jax.models.load import Checkpoint, WeightsError, load_checkpoint
from touchr1_jax.models.lora import Adapter, LoraConfig, by_layer, merged_kernel
from touchr1_jax.models.qwen import names
from touchr1_jax.models.qwen.config import CONFIG_FILE
from touchr1_jax.models.qwen.names import Source
from touchr1_jax.models.qwen.peft import PEFT_CONFIG, PEFT_WEIGHTS, load_adapters, save_adapters
from touchr1_jax.models.qwen.safetensors import ReportBytes, read_header, read_tensor, write_file
from touchr1_jax.models.qwen.weights import INDEX, find_tensors, row_of, save_tensors
from touchr1_jax.models.released_policy import ReleasedModel, ReleasedPolicy, build_released_policy, instruction
from touchr1_jax.models.saved_policy import (
    CARD,
    MISFITS,
    PolicyError,
    PolicyInput,
    SavedPolicy,
    default_card,
    digest_of,
    fitting,
    format_of,
    published,
    read_policy,
    read_sealed,
    rebuilt,
    require_files,
    seal,
)
from touchr1_jax.models.stacked import ADAPTERS
from touchr1_jax.models.touch_policy import touch_shapes, with_lora
from touchr1_jax.types import Params

ADAPTED, VERSION = "touchr1-adapted", 1
TOUCH_FILE = "touch_encoder.safetensors"
COPIED = (".json", ".jinja", ".txt", ".md")
"""Endings of the small files of a released folder, which an export copies."""

SILENT: ReportBytes = lambda done_bytes, all_bytes: None


def save_adapted(folder: Path, saved: SavedPolicy, weights: str) -> None:
    """Publish a policy as a folder in one move; one that is there is replaced.

    Args:
      folder: where.
      saved: a policy on released weights, with adapters.
      weights: path of the released folder, absolute or from `folder` on.

    Raises:
      PolicyError: the folder holds something else too.
    """
    policy = saved.policy
    assert isinstance(policy, ReleasedPolicy)
    with published(folder, (PEFT_CONFIG, PEFT_WEIGHTS, TOUCH_FILE, CARD, CONFIG_FILE)) as unfinished:
        adapters = of_checkpoint(saved.params.get(ADAPTERS, {}))
        save_adapters(unfinished, adapters, policy.checkpoint.config, policy.fns.lora, weights)
        write_file(unfinished / TOUCH_FILE, touch_tensors(saved.params))
        (unfinished / CARD).write_text(default_card(saved, "float32"), encoding="utf-8")
        fields: dict[str, Any] = {
            "model_type": ADAPTED,
            "version": VERSION,
            "weights": {"folder": weights, "files": file_marks(policy.checkpoint.directory)},
            "sensors": saved.sensors,
            "model": dataclasses.asdict(policy.model),
            "lora": dataclasses.asdict(policy.fns.lora),
            "prompt": instruction(policy.language),
            "questions": dict(saved.questions),
            "input": dataclasses.asdict(saved.reads),
            "notes": dict(saved.notes),
            "files": {name: digest_of(unfinished / name) for name in (PEFT_CONFIG, PEFT_WEIGHTS, TOUCH_FILE)},
        }
        (unfinished / CONFIG_FILE).write_text(seal(fields), encoding="utf-8")


def read_adapted(
    folder: Path, weights: Path | None = None, found: Checkpoint | None = None, progress: ReportBytes = SILENT
) -> SavedPolicy:
    """The policy of a folder that `save_adapted` wrote.

    Args:
      folder: of the policy.
      weights: of the released model, where that is no longer where it was.
      found: the released model, where it was read already.
      progress: called for the weights as in `load_params`.

    Raises:
      PolicyError: a damaged folder, one of another version, or released weights that are missing or others.
      WeightsError, OSError: as `load_checkpoint`.
    """
    config = read_sealed(folder, ADAPTED, VERSION)
    try:
        require_files(folder, config["files"], (PEFT_CONFIG, PEFT_WEIGHTS, TOUCH_FILE))
        released = weights or Path(os.path.normpath(folder / config["weights"]["folder"]))
        if not released.is_dir():
            raise PolicyError(
                f"policy is {folder}: its released weights are not in {released}; say where by --weights DIR"
            )
        require_marks(folder, released, config["weights"]["files"])
        newer = {"in_order": False, "four_bits": False}  # older folders do not say it
        model = rebuilt(ReleasedModel, {**newer, **config["model"]})
        found = found or load_checkpoint(released, jnp.dtype(model.dtype), progress, four_bits=model.four_bits)
        adapters, lora = load_adapters(folder, found.config)
        policy = build_released_policy(_without_sensors(model), found, tuple(config["sensors"]))
        lora = _same_lora(rebuilt(LoraConfig, config["lora"]), lora, adapters)
        if instruction(policy.language) != config["prompt"]:
            raise PolicyError(f"policy is {folder}: prompt differs from this version's; use the version that wrote it")
        reads = rebuilt(PolicyInput, config["input"])
        notes, questions = (
            {**config["notes"]},
            {a.name: config["questions"][a.name] for a in policy.language.attributes},
        )
        batch = touch_shapes(policy.model, model.view_px, tuple(config["sensors"]))
        wanted = jax.eval_shape(functools.partial(policy.init, 0), batch)
        touch = read_touch(folder, {name: tree for name, tree in wanted.items() if name not in policy.frozen})
    except WeightsError:
        raise
    except MISFITS as error:
        raise PolicyError(f"policy is {folder}: its config does not fit ({error}); save it anew") from error
    params: Params = {**touch, "vision": {"tower": found.params["vision"]}, ADAPTERS: of_policy(adapters)}
    params["decoder"] = found.params["decoder"]
    policy = with_lora(policy, lora)
    return SavedPolicy(policy=policy, params=params, reads=reads, notes=notes, questions=questions)


def read_saved(folder: Path, weights: Path | None = None) -> SavedPolicy:
    """A policy of either format; again if its folder was replaced meanwhile, so that files of two are never mixed.

    Raises:
      PolicyError, WeightsError: as `read_policy` and `read_adapted`, or weights for a policy that has its own.
    """
    while True:
        before = _state(folder)
        try:
            found = _read_either(folder, weights)
        except (WeightsError, OSError):
            if _state(folder) == before:
                raise
        else:
            if _state(folder) == before:
                return found


def _state(folder: Path) -> tuple[int, ...]:
    """Marks in which another folder in the same place differs; nothing where there is none."""
    try:
        found = folder.stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_mtime_ns


def _read_either(folder: Path, weights: Path | None) -> SavedPolicy:
    if format_of(folder) == ADAPTED:
        return read_adapted(folder, weights)
    if weights is not None:
        raise PolicyError(f"weights are {weights}: must be left out for {folder}, a policy with weights of its own")
    return read_policy(folder)


def export_merged(folder: Path, saved: SavedPolicy, dtype: jnp.dtype, progress: ReportBytes = SILENT) -> float:
    """Publish the released folder with the adapters merged into its weights, and the touch encoder next to them.

    One tensor at a time is merged and written.  Of a base in four bits the released weights are read again, which is
    what adapters are usually merged into.

    Args:
      folder: new, or empty.
      saved: a policy on released weights.
      dtype: of the weights; float32 keeps every change, bfloat16 what is larger than its rounding.
      progress: called after each tensor.

    Returns:
      The share of the adapters' change that the written weights keep.

    Raises:
      PolicyError: the folder holds something already.
    """
    policy = saved.policy
    assert isinstance(policy, ReleasedPolicy)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PolicyError(f"folder is {folder}: it exists and is not empty; choose a new one")
    released = {"decoder": saved.params["decoder"], "vision": saved.params["vision"]["tower"]}
    flat, adapters = traverse_util.flatten_dict(released), by_layer(of_checkpoint(saved.params[ADAPTERS]))
    stored = find_tensors(policy.checkpoint.directory) if policy.model.four_bits else {}
    kept = np.zeros(2)

    def merged(s: Source) -> np.ndarray:
        as_read = names.read(jnp.asarray(read_tensor(stored[s.key])), s.turned) if stored else row_of(flat, s)
        kernel = as_read.astype(dtype)
        if s.path[-1] == "kernel" and s.path[:-1] in adapters:
            of_layer = Adapter(*(x if s.row is None else x[s.row] for x in adapters[s.path[:-1]]))
            kernel, shares = _merged_kernel(kernel, of_layer, policy.fns.lora)
            kept[:] += shares
        return names.write(kernel, s)

    with published(folder) as unfinished:
        for path in sorted(policy.checkpoint.directory.iterdir()):
            if path.is_file() and path.suffix in COPIED and path.name != INDEX:
                shutil.copy(path, unfinished)
        save_tensors(unfinished, policy.checkpoint.config, merged, dtype, progress)
        write_file(unfinished / TOUCH_FILE, touch_tensors(saved.params))
    return float(kept[0] / kept[1]) if kept[1] else 1.0


_merged_kernel = jax.jit(merged_kernel, static_argnums=2)


def of_checkpoint(adapters: Params) -> Params:
    """Adapters nested as `QwenVL`, whose vision tower a policy has one level deeper."""
    return {name: tree["tower"] if name == "vision" else tree for name, tree in adapters.items()}


def of_policy(adapters: Params) -> Params:
    """Inverse of `of_checkpoint`."""
    return {name: {"tower": tree} if name == "vision" else tree for name, tree in adapters.items()}


def touch_tensors(params: Params) -> dict[str, np.ndarray]:
    """Parameters that are neither released nor adapters, by dotted names."""
    own = {name: tree for name, tree in params.items() if name not in ("vision", "decoder", ADAPTERS)}
    return {name: np.asarray(x) for name, x in traverse_util.flatten_dict(own, sep=".").items()}


def read_touch(folder: Path, wanted: Params) -> Params:
    """The tactile encoder and its projection.

    Raises:
      PolicyError: as `fitting`.
    """
    entries = read_header(folder / TOUCH_FILE)
    return fitting(folder, {name: read_tensor(entry) for name, entry in entries.items()}, wanted)


def _same_lora(stated: LoraConfig, lora: LoraConfig, adapters: Params) -> LoraConfig:
    """The config of adapters, which both files and the tensors must agree on.

    Raises:
      ValueError: naming what differs.
    """
    layers = {tower: {path[-1] for path in by_layer(adapters) if path[0] == tower} for tower in adapters}
    wanted = {tower: {*names} for tower, names in stated.towers.items()}
    if lora != dataclasses.replace(stated, targets=lora.targets, vision_targets=lora.vision_targets):
        raise ValueError(f"lora is {stated} in {CONFIG_FILE} and {lora} in {PEFT_CONFIG}: must be the same")
    if layers != wanted:
        raise ValueError(f"adapters are of {layers}: must be of {wanted}")
    return stated


def file_marks(directory: Path) -> dict[str, list[int]]:
    """Fingerprint of every file of a folder."""
    return {path.name: fingerprint(path) for path in sorted(directory.iterdir()) if path.is_file()}


def fingerprint(path: Path) -> list[int]:
    """Size of a file and the CRC-32 of its first and of its last mebibyte: shards of gigabytes are not read twice."""
    size, ends = path.stat().st_size, []
    with path.open("rb") as file:
        for start in (0, max(0, size - 2**20)):
            file.seek(start)
            ends.append(zlib.crc32(file.read(2**20)))
    return [size, *ends]


def require_marks(folder: Path, released: Path, marks: Mapping[str, list[int]]) -> None:
    """Refuse released weights that are not those that a policy was trained on.

    Raises:
      PolicyError: naming the files that differ.
    """
    here = file_marks(released)
    changed = sorted(name for name, mark in marks.items() if here.get(name) != list(mark))
    if changed:
        raise PolicyError(
            f"policy is {folder}: {', '.join(changed)} in {released} are not what it was trained on; give its own "
            "weights by --weights DIR"
        )


def _without_sensors(model: ReleasedModel) -> ReleasedModel:
    return dataclasses.replace(model, tactile=dataclasses.replace(model.tactile, sensors=0))
