"""Published weights into parameters and back, tensor by tensor.

The shapes that `abstract_params` gives are compared with the headers of all files before a single tensor is read, and
everything that does not fit is named in one error.
"""

import functools
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec, Sharding
from jaxtyping import Array

from touchr1_jax.models.nf4 import Nf4, encode, quantised
from touchr1_jax.models.qwen import names, safetensors
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.model import abstract_params
from touchr1_jax.models.qwen.names import Source, canonical, published, sources
from touchr1_jax.types import Params

SINGLE = "model.safetensors"
INDEX = "model.safetensors.index.json"
HEAD, EMBEDDING = "lm_head.weight", "text.embed_tokens.weight"
SHARD_BYTES = 2_000_000_000
"""Size of a shard that is written."""

SHOWN = 12
"""How many misfits an error lists before it counts the rest."""


def load_params(
    directory: str | Path,
    config: QwenConfig,
    dtype: jnp.dtype | type = jnp.bfloat16,
    place: Callable[[Params], Params] | None = None,
    progress: safetensors.ReportBytes = lambda done_bytes, all_bytes: None,
    *,
    four_bits: bool = False,
) -> Params:
    """Parameters of `QwenVL` from the safetensors files of a directory.

    One tensor at a time is read, cast and laid out, the largest first, while memory is free: the host never holds more
    than the parameters placed on it and two copies of a small one.  A tied checkpoint may also store the head.

    Args:
      directory: `model.safetensors`, or `model.safetensors.index.json` with its shards.
      config: shapes that are expected.
      dtype: type of all parameters.
      place: from shapes to the sharding of each parameter, such as `rules.state_shardings` of a mesh; each device gets
        its part of a tensor as it is read.  `None` puts all on JAX's default device.
      progress: called before the first tensor and after each with the bytes of the files that are read, and all.
      four_bits: encode kernels as `nf4.quantised` does, each after it is read.

    Raises:
      FileNotFoundError: no weights, or a shard that is missing.
      ValueError: a file that is no safetensors file; keys that are missing, extra, double, of the wrong shape or of
        a type that no weight has, all of them listed; a tied head that differs from the embedding; NaN or infinity.
    """
    entries = find_tensors(Path(directory))
    wanted = sources(config)
    require_fit(Path(directory), entries, wanted, config)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, dtype), abstract_params(config))
    shapes = jax.eval_shape(quantised, shapes) if four_bits else shapes
    whole = jax.sharding.SingleDeviceSharding(jnp.zeros(()).device)
    places = jax.tree.map(lambda _: whole, shapes) if place is None else place(shapes)
    flat, lies = flax.traverse_util.flatten_dict(shapes), flax.traverse_util.flatten_dict(places)
    done, size = 0, sum(entry.size for entry in entries.values())
    loaded: dict[names.Path, Any] = {}
    progress(done, size)
    for s in sorted(wanted.values(), key=lambda s: -math.prod(s.shape)):
        found, finite = _place(entries[s.key], s, flat[s.path].dtype, jax.tree.leaves(lies[s.path])[0])
        found = encode(found) if isinstance(flat[s.path], Nf4) else found
        if s.row is not None:
            stack = loaded.pop(s.path) if s.path in loaded else jax.tree.map(_empty, flat[s.path], lies[s.path])
            found = _with_row(stack, found, s.row)
        loaded[s.path] = jax.block_until_ready(found)
        if not finite:
            raise ValueError(
                f"{entries[s.key].path}: {published(s.key, config)} holds NaN or infinity as {jnp.dtype(dtype)}: must "
                "be finite; fetch the weights again, or load them in float32"
            )
        done += entries[s.key].size
        progress(done, size)
    return flax.traverse_util.unflatten_dict(loaded)


def require_fit(
    directory: Path, entries: dict[str, safetensors.TensorEntry], wanted: Mapping[str, Source], config: QwenConfig
) -> None:
    """Compare a checkpoint with its config; a tied head that is stored too is taken out of the entries.

    Raises:
      ValueError: tensors that do not fit, all of them listed, or a tied head that differs from the embedding.
    """
    head, embedding = entries.get(HEAD), entries.get(EMBEDDING)
    if config.decoder.tie_embedding and head and embedding and head.shape == embedding.shape:
        del entries[HEAD]
        if not np.array_equal(safetensors.read_tensor(head), safetensors.read_tensor(embedding)):
            raise ValueError(
                f"{head.path}: {HEAD} differs from the embedding, which config.json ties to it; set "
                "tie_word_embeddings to false, or fetch the files again"
            )
    misfits = compare(entries, {s.key: s.shape for s in wanted.values()}, config)
    if misfits:
        more = f"\n  … and {len(misfits) - SHOWN} more" if len(misfits) > SHOWN else ""
        listed = "".join(f"\n  {line}" for line in misfits[:SHOWN])
        raise ValueError(
            f"{directory} does not hold the tensors that its config asks for:{listed}{more}\n"
            "fetch the files again, or read them with the config.json that belongs to them"
        )


def find_tensors(directory: Path) -> dict[str, safetensors.TensorEntry]:
    """All tensors of a checkpoint by key without prefix.

    Raises:
      FileNotFoundError: no weights, or a shard that is missing.
      ValueError: an index that contradicts its shards, or two keys that mean the same tensor.
    """
    found: dict[str, safetensors.TensorEntry] = {}
    for name, entry in _raw_tensors(directory).items():
        if canonical(name) in found:
            raise ValueError(f"{entry.path}: {name} is there twice, under an old and a new name; delete one file")
        found[canonical(name)] = entry
    return found


def compare(
    entries: Mapping[str, safetensors.TensorEntry], wanted: Mapping[str, tuple[int, ...]], config: QwenConfig
) -> list[str]:
    """Mismatches, one line each, by published keys: missing, extra, shape, type."""
    name = lambda key: published(key, config)
    missing = [f"missing: {name(key)} {shape}" for key, shape in wanted.items() if key not in entries]
    strangers = [(name(key), entry) for key, entry in entries.items() if key not in wanted]
    extra = [f"extra: {key} {entry.shape} in {entry.path.name}" for key, entry in strangers]
    shared = [(name(key), entries[key], shape) for key, shape in wanted.items() if key in entries]
    shapes = [
        f"shape: {key} is {entry.shape}, expected {shape}" for key, entry, shape in shared if entry.shape != shape
    ]
    types = [
        f"type: {key} is {entry.dtype}, expected one of {', '.join(safetensors.DTYPES)}"
        for key, entry, _ in shared
        if entry.dtype not in safetensors.DTYPES
    ]
    return missing + extra + shapes + types


def save_params(
    directory: Path,
    params: Params,
    config: QwenConfig,
    progress: safetensors.ReportBytes = lambda done_bytes, all_bytes: None,
) -> None:
    """Write parameters as `save_tensors`, in their own type.

    Args:
      directory: of the files.
      params: the tree of `QwenVL`.
      config: its shapes.
      progress: called after each tensor.

    Raises:
      ValueError: a tree that is not that of the config.
    """
    flat, wanted = flax.traverse_util.flatten_dict(params), sources(config)
    if differ := sorted("/".join(p) for p in flat.keys() ^ {s.path for s in wanted.values()}):
        raise ValueError(f"params and config differ in {', '.join(differ[:SHOWN])}; save with the config of the params")
    dtype = jnp.result_type(*flat.values())
    save_tensors(directory, config, lambda s: names.write(row_of(flat, s), s), dtype, progress)


def row_of(flat: Mapping[names.Path, Array], s: Source) -> Array:
    """The parameter of a published tensor, or its row of a stacked one."""
    return flat[s.path] if s.row is None else flat[s.path][s.row]


def save_tensors(
    directory: Path,
    config: QwenConfig,
    tensor: Callable[[Source], np.ndarray],
    dtype: jnp.dtype,
    progress: safetensors.ReportBytes = lambda done_bytes, all_bytes: None,
    shard_bytes: int = SHARD_BYTES,
) -> int:
    """Write a checkpoint in the published layout, never more than one tensor in memory; return the bytes of tensors.

    Args:
      directory: of the shards and their index, or of the one file.
      config: shapes and published keys.
      tensor: a published tensor, made when it is written.
      dtype: of all tensors.
      progress: called after each tensor.
      shard_bytes: size of a shard at most, but for a larger tensor.
    """
    of_type, filled, size = np.dtype(dtype), 0, 0
    shards: list[dict[str, safetensors.Deferred]] = [{}]
    for s in sources(config).values():
        needed = math.prod(s.shape) * of_type.itemsize
        if filled and filled + needed > shard_bytes:
            shards.append({})
            filled = 0
        shards[-1][published(s.key, config)] = safetensors.Deferred(of_type, s.shape, functools.partial(tensor, s))
        filled, size = filled + needed, size + needed
    files = [f"model-{i + 1:05}-of-{len(shards):05}.safetensors" for i in range(len(shards))]
    files, done = files if len(shards) > 1 else [SINGLE], 0
    for file, shard in zip(files, shards, strict=True):
        safetensors.write_file(directory / file, shard, _of_all(done, size, progress))
        done += sum(math.prod(x.shape) * of_type.itemsize for x in shard.values())
    if len(shards) > 1:
        place = {name: file for file, shard in zip(files, shards, strict=True) for name in shard}
        index = {"metadata": {"total_size": size}, "weight_map": place}
        (directory / INDEX).write_text(json.dumps(index), encoding="utf-8")
    return size


def _of_all(before: int, size: int, progress: safetensors.ReportBytes) -> safetensors.ReportBytes:
    """Progress of one shard as that of all."""
    return lambda done, _: progress(before + done, size)


def _raw_tensors(directory: Path) -> dict[str, safetensors.TensorEntry]:
    """All tensors by the keys that the files have."""
    index = directory / INDEX
    if not index.is_file():
        single = directory / SINGLE
        shards = sorted(path.name for path in directory.glob("*.safetensors"))
        if not single.is_file() and shards:
            raise FileNotFoundError(
                f"{directory} holds {shards[0]} and not {INDEX}, which says what is where; fetch it"
            )
        if not single.is_file():
            raise FileNotFoundError(
                f"{directory} holds neither {SINGLE} nor {INDEX}: no weights; correct the directory"
            )
        return safetensors.read_header(single)
    try:
        place = dict(json.loads(index.read_text(encoding="utf-8"))["weight_map"])
        odd = [shard for shard in place.values() if not isinstance(shard, str) or Path(shard).name != shard]
        if odd:
            raise ValueError(f"{odd[0]!r} must be the name of a file in its folder")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        reason = f"{type(error).__name__}: {error}"  # its `repr` may hold the whole file
        raise ValueError(f"{index} is no index: must be JSON with a weight_map ({reason}); fetch it again") from error
    entries: dict[str, safetensors.TensorEntry] = {}
    for shard in sorted(set(place.values())):
        if not (directory / shard).is_file():
            raise FileNotFoundError(f"{directory / shard} is named by {INDEX} and is not there; fetch it")
        header = safetensors.read_header(directory / shard)
        twice = sorted(entries.keys() & header.keys())
        if twice:
            raise ValueError(f"{directory / shard} holds {twice[0]}, as another shard does; delete one of them")
        entries |= header
    lost = sorted(name for name in place.keys() | entries.keys() if place.get(name) != _file_of(name, entries))
    if lost:
        raise ValueError(f"{index} and its shards differ in {', '.join(lost[:SHOWN])}; fetch them again")
    return entries


def _file_of(name: str, entries: Mapping[str, safetensors.TensorEntry]) -> str | None:
    return entries[name].path.name if name in entries else None


def _place(entry: safetensors.TensorEntry, s: Source, dtype: jnp.dtype, lies: Sharding) -> tuple[Array, Array]:
    """A tensor laid out as its parameter, or as a row of it, where that lies, and whether it is finite.

    It waits, so that no two tensors are on their way at once.
    """
    of_row = lies
    if isinstance(lies, NamedSharding) and s.row is not None:
        of_row = NamedSharding(lies.mesh, PartitionSpec(*lies.spec[1:]))
    as_read = of_row
    if isinstance(of_row, NamedSharding) and s.turned:
        spec = (*of_row.spec, None, None)[:2][::-1] if len(s.shape) == 2 else ()
        as_read = NamedSharding(of_row.mesh, PartitionSpec(*spec))
    found, finite = _lay_out(jax.device_put(safetensors.read_tensor(entry), as_read), s.turned, dtype)
    return jax.block_until_ready((jax.device_put(found, of_row), finite))


def _empty(shape: jax.ShapeDtypeStruct, lies: Sharding) -> Array:
    return jnp.zeros(shape.shape, shape.dtype, device=lies)


@functools.partial(jax.jit, static_argnames=("turned", "dtype"))
def _lay_out(raw: Array, turned: bool, dtype: jnp.dtype) -> tuple[Array, Array]:
    found = names.read(raw, turned).astype(dtype)
    return found, jnp.isfinite(found).all()


@functools.partial(jax.jit, donate_argnums=0)
def _with_row(stack: Any, row: Any, i: int) -> Any:
    return jax.tree.map(lambda x, y: jax.lax.dynamic_update_index_in_dim(x, y, i, 0), stack, row)
