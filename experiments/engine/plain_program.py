"""The timed job of `job.py` as a plain JAX program: one jitted function that samples, scores and updates.

Every pass encodes a prompt once, and its group shares the keys and values.  The rest is what a JAX user would write
first: a scan over the tokens of all rollouts, all logits of a micro-batch at once, gradients by `jax.grad`.  Prompts,
positions and initial parameters are those of the job, so that both programs compute the same.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from experiments.engine.job import decoder_config, init_decoder, make_batch, make_fns
from experiments.engine.peers import BETA, CLIP, LEARNING_RATE, JobSize
from touchr1_jax.models.layers import Rotation, mrope
from touchr1_jax.models.policy import prompt_positions
from touchr1_jax.types import Params

EPSILON_NORM, EPSILON_REWARD = 1e-6, 1e-4  # added to mean squares of the norms, to σ of a group's rewards
OPTIMIZER = optax.adamw(LEARNING_RATE)

KeysValues = tuple[Array, Array]
"""Keys and values of one layer: of prompts [P, KV, L, d], or of rollouts [P, KV, G, T, d]."""


class Prompts(NamedTuple):
    """Prompts that begin with embedded tokens, and rotary angles [P, 1, 1, 1, L + T, d/2] of them and what follows."""

    embedded: Float[Array, "P N D"]
    words: Int[Array, "P W"]
    rotation: Rotation

    @property
    def length(self) -> int:
        """Tokens of a prompt, L."""
        return self.embedded.shape[1] + self.words.shape[1]

    def angles(self, start: int | Array, number: int) -> Rotation:
        """Those of some tokens."""
        return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, number, axis=4), self.rotation)


class PlainProgram:
    """One iteration as a call, as `Job` has it; gradients are summed over micro-batches of `micro_prompts` prompts."""

    def __init__(self, size: JobSize, prefix: int, micro_prompts: int) -> None:
        fns, batch, decoder = make_fns(size, prefix), make_batch(size, prefix, size.prompts), decoder_config(size)

        def rotation(touch_time: Array, mask: Array) -> Rotation:
            prompt = prompt_positions(touch_time, mask, fns.slots, fns.module.config.grid)
            new = jnp.broadcast_to(prompt.max() + 1 + jnp.arange(size.length), (3, size.length))
            positions = jnp.concatenate([prompt, new], 1)
            return mrope(positions, size.head_dim, decoder.mrope_section, decoder.rope_theta)

        each = jax.vmap(rotation)(batch.features.touch_time, batch.mask)
        embedded = jnp.concatenate([batch.features.view, batch.features.touch[:, 0]], 1)
        words = batch.ids[:, embedded.shape[1] :]
        self.prompts = Prompts(embedded, words, jax.tree.map(lambda x: x[:, None, None, None], each))
        self.params, self.reference = (plain_params(init_decoder(fns, batch), size) for _ in range(2))
        self.opt_state, self.key = OPTIMIZER.init(self.params), jax.random.key(0)
        self.size, self.parts = size, size.prompts // micro_prompts
        self._iterate = jax.jit(self.iterate, donate_argnums=(0, 1))

    def step(self) -> Array:
        """Run one iteration, which replaces parameters, optimizer state and key, and return the loss."""
        state = self.params, self.opt_state, self.key
        self.params, self.opt_state, self.key, loss = self._iterate(*state, self.reference, self.prompts)
        return loss

    def iterate(
        self, params: Params, opt_state: optax.OptState, key: Array, reference: Params, prompts: Prompts
    ) -> tuple[Params, optax.OptState, Array, Float[Array, ""]]:
        """Sample, score, update: the first three arguments anew, and the loss."""
        key, sample_key = jax.random.split(key)
        tokens, old = sample(self.size, params, prompts, sample_key)
        reward = jnp.mean(tokens < self.size.vocab_size // 2, -1)
        cut = lambda x: x.reshape(self.parts, -1, *x.shape[1:])

        def add(total: Any, part: Any) -> Any:
            return jax.tree.map(jnp.add, total, jax.value_and_grad(grpo_loss)(params, reference, *part)), None

        zero = jax.tree.map(jnp.zeros_like, (0.0, params))
        total, _ = jax.lax.scan(add, zero, jax.tree.map(cut, (prompts, tokens, reward, old)))
        loss, grads = jax.tree.map(lambda x: x / self.parts, total)
        updates, opt_state = OPTIMIZER.update(grads, opt_state, params)
        return optax.apply_updates(params, updates), opt_state, key, loss


def plain_params(params: Params, size: JobSize) -> Params:
    """Parameters of the policy's decoder, or their gradient, as a list of layers with joined matrices."""
    decoder, heads = params["decoder"], (size.num_kv_heads, -1, size.head_dim)
    by_head = lambda x: x.reshape(*x.shape[:-1], *heads)

    def plain(layer: Params) -> Params:
        qkv = lambda kind: jnp.concatenate([by_head(layer[f"{name}_proj"][kind]) for name in "qkv"], -2)
        return {
            "qkv": qkv("kernel"),
            "bias": qkv("bias"),
            "out": layer["o_proj"]["kernel"].reshape(*heads, size.hidden_size),
            "gate_up": jnp.concatenate([layer["mlp"][name]["kernel"] for name in ("gate", "up")], -1),
            "down": layer["mlp"]["down"]["kernel"],
            **{name: layer[name]["scale"] for name in ("norm_attention", "norm_mlp")},
        }

    before = [jax.tree.map(lambda x, i=i: x[i], decoder["layers"]) for i in range(size.num_layers - 1)]
    layers = [plain(layer) for layer in (*before, decoder["last_layer"])]
    return {"embedding": decoder["embedding"]["embedding"], "layers": layers, "norm": decoder["norm"]["scale"]}


def sample(
    size: JobSize, params: Params, prompts: Prompts, key: Array
) -> tuple[Int[Array, "P G T"], Float[Array, "P G T"]]:
    """Draw completions token by token; returns them and their log-probabilities."""
    last, past = encode(params, prompts)
    first = jnp.broadcast_to(logits(params, last)[:, :, 0], (size.prompts, size.group, size.vocab_size))
    shape = size.prompts, size.num_kv_heads, size.group, size.length, size.head_dim

    def step(carry: Any, at: tuple[Array, Array]) -> Any:
        (scores, caches), (t, noise) = carry, at
        token = jnp.argmax(scores + noise, -1)
        written = []

        def attention(i: int, q: Array, *row: Array) -> Array:
            write = lambda cache, new: jax.lax.dynamic_update_slice_in_dim(cache, new, t, axis=3)
            written.append(jax.tree.map(write, caches[i], row))
            return attend(q, past[i], written[i], jnp.arange(size.length)[None] <= t)

        here = prompts.angles(prompts.length + t, 1)
        x = decode(params, params["embedding"][token][:, :, None], here, attention)
        return (logits(params, x)[:, :, 0], written), (token, chosen(scores, token))

    empty = [(jnp.zeros(shape), jnp.zeros(shape)) for _ in past]
    noise = jax.random.gumbel(key, (size.length, *first.shape))
    _, drawn = jax.lax.scan(step, (first, empty), (jnp.arange(size.length), noise))
    tokens, log_prob = (jnp.moveaxis(x, 0, -1) for x in drawn)
    return tokens, log_prob


def grpo_loss(
    params: Params,
    reference: Params,
    prompts: Prompts,
    tokens: Int[Array, "P G T"],
    reward: Float[Array, "P G"],
    old: Float[Array, "P G T"],
) -> Float[Array, ""]:
    """−⟨min(ρ A, clip(ρ, 1 ± c) A) − β (r − 1 − log r)⟩ over all tokens, ρ = π/π_old, r = π_ref/π, A = (R − R̄)/(σ + ε).

    Args:
      params, reference: of the policies π and π_ref.
      prompts, tokens, reward: the prompts, the completions of each, and their rewards R.
      old: log-probabilities of the tokens under the policy that drew them.
    """
    spread = jnp.std(reward, -1, keepdims=True) + EPSILON_REWARD
    advantage = ((reward - jnp.mean(reward, -1, keepdims=True)) / spread)[..., None]
    log_prob = log_probs(params, prompts, tokens)
    ratio, log_r = jnp.exp(log_prob - old), log_probs(reference, prompts, tokens) - log_prob
    clipped = jnp.clip(ratio, 1 - CLIP, 1 + CLIP)
    return -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage) - BETA * (jnp.expm1(log_r) - log_r))


def log_probs(params: Params, prompts: Prompts, tokens: Int[Array, "P G T"]) -> Float[Array, "P G T"]:
    """Log-probabilities of the tokens of completions, all at once."""
    last, past = encode(params, prompts)
    n = tokens.shape[-1] - 1
    attention = lambda i, q, k, v: attend(q, past[i], (k, v), jnp.tri(n, dtype=bool))
    x = decode(params, params["embedding"][tokens[..., :-1]], prompts.angles(prompts.length, n), attention)
    first = jnp.broadcast_to(last, (*tokens.shape[:2], *last.shape[2:]))
    return chosen(logits(params, jnp.concatenate([first, x], 2)), tokens)


def encode(params: Params, prompts: Prompts) -> tuple[Float[Array, "P 1 1 D"], list[KeysValues]]:
    """Hidden state of each prompt's last token, and the prompts' keys and values of every layer."""
    x = jnp.concatenate([prompts.embedded, params["embedding"][prompts.words]], 1)[:, None]
    past: list[KeysValues] = []

    def attention(i: int, q: Array, k: Array, v: Array) -> Array:
        past.append((k[:, :, 0], v[:, :, 0]))
        nothing = k[:, :, 0, :0], v[:, :, 0, :0]
        return attend(q, nothing, (k, v), jnp.tri(q.shape[-2], dtype=bool))

    return decode(params, x, prompts.angles(0, prompts.length), attention)[:, :, -1:], past


def decode(
    params: Params, x: Float[Array, "P G T D"], rotation: Rotation, attention: Callable[..., Array]
) -> Float[Array, "P G T D"]:
    """Hidden states after all layers; attention(i, q, k, v) is that of layer i, with arguments as in `attend`."""
    for i, layer in enumerate(params["layers"]):
        qkv = jnp.einsum("pgtn,nkrd->pkgrtd", norm(x, layer["norm_attention"]), layer["qkv"])
        qkv = qkv + layer["bias"][:, None, :, None]
        turned = rotate(qkv[:, :, :, :-1], rotation)
        mixed = attention(i, turned[:, :, :, :-1], turned[:, :, :, -1], qkv[:, :, :, -1])
        x = x + jnp.einsum("pkgrtd,krdn->pgtn", mixed, layer["out"])
        gate, up = jnp.split(norm(x, layer["norm_mlp"]) @ layer["gate_up"], 2, -1)
        x = x + (jax.nn.silu(gate) * up) @ layer["down"]
    return x


def attend(
    q: Float[Array, "P KV G R T d"], past: KeysValues, own: KeysValues, seen: Bool[Array, "T S"]
) -> Float[Array, "P KV G R T d"]:
    """softmax(q kᵀ/√d) v over the keys of the prompt, which a group shares, and those of each rollout that are seen."""
    shared = jnp.einsum("pkgrtd,pksd->pkgrts", q, past[0])
    apart = jnp.where(seen, jnp.einsum("pkgrtd,pkgsd->pkgrts", q, own[0]), -jnp.inf)
    weight = jax.nn.softmax(jnp.concatenate([shared, apart], -1) * q.shape[-1] ** -0.5)
    shared, apart = jnp.split(weight, [past[0].shape[2]], -1)
    return jnp.einsum("pkgrts,pksd->pkgrtd", shared, past[1]) + jnp.einsum("pkgrts,pkgsd->pkgrtd", apart, own[1])


def logits(params: Params, x: Float[Array, "*n D"]) -> Float[Array, "*n V"]:
    """Scores of the next token."""
    return norm(x, params["norm"]) @ params["embedding"].T


def chosen(scores: Float[Array, "*n V"], tokens: Int[Array, "*n"]) -> Float[Array, "*n"]:
    """Log-probability of each token under the softmax of its scores."""
    return jnp.take_along_axis(jax.nn.log_softmax(scores), tokens[..., None], -1)[..., 0]


def norm(x: Float[Array, "*n D"], scale: Float[Array, "D"]) -> Float[Array, "*n D"]:
    """Root-mean-square normalisation."""
    return x * jax.lax.rsqrt(jnp.mean(x * x, -1, keepdims=True) + EPSILON_NORM) * scale


def rotate(x: Float[Array, "*n T d"], rotation: Rotation) -> Float[Array, "*n T d"]:
    """Turn the first and second half of every head by its token's angles."""
    a, b = jnp.split(x, 2, -1)
    return jnp.concatenate([a * rotation.cos - b * rotation.sin, b * rotation.cos + a * rotation.sin], -1)
