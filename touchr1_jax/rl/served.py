"""Rollouts that a server draws: the requests, and how their answers are read.

The protocol is that of vLLM from 0.24 on, POST /v1/completions.  `prompt_embeds` of a request is the embedded prompt,
in base64 as `torch.save` writes it; an answer holds `token_ids` of each completion and each token's log-probability.
Such a server numbers embedded tokens one by one, as `PolicyConfig.in_order` does.  Everything here is pure;
`training.rollout_server` sends and receives.
"""

import base64
import io
import math
import zipfile
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from touchr1_jax.models.policy import Slots, prompt_mask, with_features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.losses import check_centering
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.types import Rollout

STORAGES = {"float32": "FloatStorage", "bfloat16": "BFloat16Storage"}
"""Types of embeddings, and of PyTorch's storages."""

LEAST_BIAS = -100.0
"""Added to the logits of tokens that are never drawn: the least that the protocol allows."""

TOKEN = "token_id:"
"""Before the id of a token, where the answer's names of tokens are ids."""

ROUNDED = 1e-3
"""Log-probabilities up to this far above 0 are rounding."""


class RolloutError(RuntimeError):
    """Rollouts that a server did not draw, or that cannot be read."""


def check_served(config: GRPOConfig) -> None:
    """Refuse settings of the sampler that a server does not support.

    Raises:
      ValueError: a temperature other than 1, tokens that are cut off, a constraint, or as `check_centering`.
    """
    for field, value in (("temperature", 1.0), ("top_p", 1.0), ("min_p", 0.0)):
        if getattr(config, field) != value:
            raise ValueError(
                f"{field} is {getattr(config, field)}: must be {value} where a server draws rollouts, whose "
                "log-probabilities are those before it; leave it, or leave rollouts.url out"
            )
    if config.algorithm.score_centering:
        check_centering(config.algorithm)
    if config.algorithm.constrained:
        raise ValueError(
            "constrained is True: must be False where a server draws rollouts; leave it, or leave rollouts.url out"
        )


def embedded_prompts(
    table: Float[Array, "V D"], batch: GRPOBatch, slots: Slots
) -> tuple[Float[Array, "P L D"], Bool[Array, "P L"]]:
    """Embedded prompts as the decoder reads them, and which of their tokens exist; only these are sent.

    Args:
      table: of embeddings.
      batch: encoded contacts with questions.
      slots: places of tactile and view tokens in prompts.
    """

    def one(features: Any, ids: Array, mask: Array) -> tuple[Array, Array]:
        return with_features(table[ids], features, slots)[0], prompt_mask(features, mask, slots)

    return jax.vmap(one)(batch.features, jnp.asarray(batch.ids), jnp.asarray(batch.mask))


def completion_request(
    name: str, prompt: Float[np.ndarray, "n D"], config: GRPOConfig, fns: PolicyFns, seed: int
) -> dict[str, Any]:
    """The request for a group of completions of one prompt.

    Args:
      name: of the served adapters.
      prompt: embedded tokens that exist.
      config: group, length, and how many of the most likely tokens score centering needs.
      fns: ids that end a completion, and those that are never drawn.
      seed: of the group.
    """
    return {
        "model": name,
        "prompt_embeds": base64.b64encode(torch_file(prompt)).decode("ascii"),
        "n": config.group,
        "max_tokens": config.length,
        "seed": seed,
        "stop_token_ids": list(fns.end_ids),
        "ignore_eos": True,  # the ids above end a completion, whatever a generation_config.json says
        "logit_bias": {str(i): LEAST_BIAS for i in np.flatnonzero(fns.banned)},
        "logprobs": max(1, config.algorithm.score_centering),
        "return_token_ids": True,
        "return_tokens_as_token_ids": True,
        # all of them, for what is left out is taken from the generation_config.json of the weights
        "temperature": 1.0,
        "top_p": 1.0,
        "top_k": 0,
        "min_p": 0.0,
        "repetition_penalty": 1.0,
        "presence_penalty": 0.0,
        "frequency_penalty": 0.0,
    }


def read_completions(answer: Any, config: GRPOConfig, fns: PolicyFns) -> Rollout:
    """The group of completions in an answer to `completion_request`, as arrays [G, T] of the host.

    Raises:
      RolloutError: naming the field that is missing or invalid.
    """
    choices = answer.get("choices") if isinstance(answer, dict) else None
    group, length, most = config.group, config.length, config.algorithm.score_centering
    if not isinstance(choices, list) or not all(isinstance(choice, dict) for choice in choices):
        raise _misfit("choices", choices, "a list of completions")
    if sorted(str(choice.get("index")) for choice in choices) != sorted(map(str, range(group))):
        raise _misfit("choices", f"of {len(choices)} completions", f"of the group's {group}, each with its index")
    tokens = np.full((group, length), fns.pad_id, np.int32)
    log_prob, mask = np.zeros((group, length), np.float32), np.zeros((group, length), bool)
    head_ids = np.zeros((group, most, length), np.int32)
    head_log_prob = np.full((group, most, length), -np.inf, np.float32)
    for choice in choices:
        i, where = int(choice["index"]), f"choices[{choice['index']}]"
        ids = _token_ids(choice.get("token_ids"), f"{where}.token_ids", length, fns)
        log_probs = choice.get("logprobs")
        log_probs = log_probs if isinstance(log_probs, dict) else {}
        tokens[i, : len(ids)], mask[i, : len(ids)] = ids, True
        log_prob[i, : len(ids)] = _log_probs(
            log_probs.get("token_logprobs"), f"{where}.logprobs.token_logprobs", len(ids)
        )
        for t, best in enumerate(
            _heads(log_probs.get("top_logprobs"), f"{where}.logprobs.top_logprobs", len(ids), most)
        ):
            kept = sorted(best.items(), key=lambda item: -item[1])[:most]
            head_ids[i, :, t] = [_id(name, where, fns) for name, _ in kept]
            head_log_prob[i, :, t] = [value for _, value in kept]
    if not most:
        return Rollout(tokens=tokens, log_prob=log_prob, mask=mask)  # type: ignore[arg-type]
    head_log_prob[fns.banned[head_ids]] = -np.inf
    return Rollout(tokens, log_prob, mask, head_ids, head_log_prob)  # type: ignore[arg-type]


def torch_file(x: np.ndarray) -> bytes:
    """An array as `torch.save` writes a contiguous tensor: a zip archive of a pickle and of the numbers.

    The pickle is written opcode by opcode, `_rebuild_tensor_v2(storage, 0, size, stride, False, OrderedDict())` with
    the storage ('storage', type, '0', 'cpu', n) as persistent id, so that PyTorch is not needed.

    Raises:
      KeyError: an array that is neither float32 nor bfloat16.
    """
    integer = lambda n: b"J" + int(n).to_bytes(4, "little")
    text = lambda s: b"X" + len(s).to_bytes(4, "little") + s.encode("ascii")
    items = lambda *codes: b"(" + b"".join(codes) + b"t"
    storage = f"ctorch\n{STORAGES[x.dtype.name]}\n".encode("ascii")
    stored = items(text("storage"), storage, text("0"), text("cpu"), integer(x.size)) + b"Q"
    strides = [math.prod(x.shape[i + 1 :]) for i in range(x.ndim)]
    sizes = (items(*map(integer, numbers)) for numbers in (x.shape, strides))
    hooks = b"ccollections\nOrderedDict\n)R"
    tensor = b"ctorch._utils\n_rebuild_tensor_v2\n" + items(stored, integer(0), *sizes, b"\x89", hooks) + b"R"
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + tensor + b".")
        archive.writestr("archive/byteorder", "little")
        archive.writestr("archive/data/0", np.ascontiguousarray(x).tobytes())
        archive.writestr("archive/version", "3\n")
    return buffer.getvalue()


def _misfit(field: str, value: Any, constraint: str) -> RolloutError:
    shown = repr(value) if not isinstance(value, str) else value
    return RolloutError(
        f"{field} of the server's answer is {shown[:100]}: must be {constraint}; start a server of the protocol of "
        "vLLM 0.24 or later, with --enable-prompt-embeds"
    )


def _token_ids(ids: Any, field: str, length: int, fns: PolicyFns) -> list[int]:
    """Ids of a completion that ends by an end token, or is as long as allowed."""
    if not isinstance(ids, list) or not 1 <= len(ids) <= length:
        raise _misfit(field, ids, f"a list of 1 to {length} ids")
    for i in ids:
        if type(i) is not int or not 0 <= i < len(fns.banned) or fns.banned[i]:
            raise _misfit(field, f"{i!r} at one place", f"one of {len(fns.banned)} ids, and none that is never drawn")
    if any(i in fns.end_ids for i in ids[:-1]) or (len(ids) < length and ids[-1] not in fns.end_ids):
        raise _misfit(field, ids[-8:], f"{length} long, or ended by one of {list(fns.end_ids)}; raise --max-model-len")
    return ids


def _log_probs(values: Any, field: str, count: int) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        raise _misfit(field, values, f"a list of {count} log-probabilities")
    for value in values:
        if type(value) not in (int, float) or not -math.inf < value <= ROUNDED:
            raise _misfit(field, f"{value!r} at one place", "a finite log-probability")
    return [min(value, 0.0) for value in values]


def _heads(values: Any, field: str, count: int, most: int) -> list[Mapping[str, float]]:
    """The most likely tokens of each place; none where none are asked for."""
    if not most:
        return []
    if not isinstance(values, list) or len(values) != count:
        raise _misfit(field, values, f"a list of {count} mappings")
    for best in values:
        if not isinstance(best, dict) or len(best) < most:
            raise _misfit(field, best, f"a mapping of {most} tokens; start the server with --max-logprobs {most}")
        _log_probs(list(best.values()), field, len(best))
    return values


def _id(name: str, where: str, fns: PolicyFns) -> int:
    number = name.removeprefix(TOKEN)
    if not number.isdecimal() or int(number) >= len(fns.banned):
        raise _misfit(f"{where}.logprobs.top_logprobs", name, f"named {TOKEN}N, N one of {len(fns.banned)} ids")
    return int(number)
