"""A second decoder, written from the equations: one full causal sequence, no cache, no sharing, loops over heads."""

import jax
import jax.numpy as jnp
import numpy as np

from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.types import Params


def rms(x: jax.Array, scale: jax.Array) -> jax.Array:
    """x · g / √(mean x² + 1e-6)."""
    return x / jnp.sqrt((x**2).mean(-1, keepdims=True) + 1e-6) * scale


def turn(x: jax.Array, positions: np.ndarray, config: DecoderConfig) -> jax.Array:
    """Rotary positions as complex rotations: (x_j, x_{j + d/2}) is the number that frequency j turns, x [T, d]."""
    half = config.head_dim // 2
    angles = np.zeros((x.shape[0], half))
    axes = [axis for axis, size in enumerate(config.mrope_section) for _ in range(size)]
    for j, axis in enumerate(axes):
        angles[:, j] = positions[axis] * config.rope_theta ** (-2 * j / config.head_dim)
    z = (x[:, :half] + 1j * x[:, half:]) * np.exp(1j * angles)
    return jnp.concatenate([z.real, z.imag], -1)


def layer(p: Params, x: jax.Array, positions: np.ndarray, seen: np.ndarray, config: DecoderConfig) -> jax.Array:
    """One transformer layer over x [T, D]; `seen` [T, T] says which keys a query may look at."""
    d = config.head_dim
    y = rms(x, p["norm_attention"]["scale"])
    q, k, v = (y @ p[name]["kernel"] + p[name]["bias"] for name in ("q_proj", "k_proj", "v_proj"))
    heads = []
    for h in range(config.num_heads):
        g = h // (config.num_heads // config.num_kv_heads)
        query = turn(q[:, h * d : (h + 1) * d], positions, config)
        key = turn(k[:, g * d : (g + 1) * d], positions, config)
        weights = jax.nn.softmax(jnp.where(seen, query @ key.T / np.sqrt(d), -jnp.inf), -1)
        heads.append(weights @ v[:, g * d : (g + 1) * d])
    x = x + jnp.concatenate(heads, -1) @ p["o_proj"]["kernel"]
    y, mlp = rms(x, p["norm_mlp"]["scale"]), p["mlp"]
    gate = y @ mlp["gate"]["kernel"]
    return x + (gate * jax.nn.sigmoid(gate) * (y @ mlp["up"]["kernel"])) @ mlp["down"]["kernel"]


def logits(
    p: Params, prompt: jax.Array, tokens: jax.Array, positions: np.ndarray, mask: np.ndarray, config: DecoderConfig
) -> jax.Array:
    """Logits [T, V] of the completion tokens [T] after an embedded prompt [L, D], positions int [3, L + T].

    A masked token sees itself alone, so that its softmax is defined; nothing sees it.
    """
    length = positions.shape[1]
    seen = np.tril(np.ones((length, length), bool)) & np.append(mask, np.ones(len(tokens), bool))
    seen |= np.eye(length, dtype=bool)
    x = jnp.concatenate([prompt, p["embedding"]["embedding"][tokens]])
    for i in range(config.num_layers - 1):
        x = layer(jax.tree.map(lambda stack, i=i: stack[i], p["layers"]), x, positions, seen, config)
    x = layer(p["last_layer"], x, positions, seen, config)
    scores = rms(x, p["norm"]["scale"]) @ p["embedding"]["embedding"].T
    return scores[len(prompt) - 1 : -1]


def prompt_positions(mask: np.ndarray, touch_time: np.ndarray, grid: int, blocks: list[tuple]) -> np.ndarray:
    """(time, row, column) of a prompt, counted in Python; `blocks` are ("text" | "view" | stream, length) in order."""
    rows, base, at = [], 0, 0
    for kind, length in blocks:
        block, inside, column = [], 0, 0
        for i in range(length):
            if kind == "text":
                block.append((base + inside,) * 3)
                inside += bool(mask[at + i])
            elif kind == "view":
                block.append((base, base + i // grid, base + i % grid))
            else:
                time = int(touch_time[kind, i])
                column = column + 1 if i and time == touch_time[kind, i - 1] else 0
                block.append((base + time, base, base + column))
        there = [max(row) for row, exists in zip(block, mask[at : at + length], strict=True) if exists]
        base = max(there) + 1 if there else base
        rows, at = rows + block, at + length
    return np.array(rows).T
