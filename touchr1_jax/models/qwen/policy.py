"""A policy on a pretrained Qwen-VL: its vision tower for the view, its decoder, and a tactile encoder of our own.

The tactile tokens stand in the prompt where those of a video would: on Qwen2.5-VL with integer frame indices as time
ids, on Qwen3-VL step by step after the time in words (`text.chat`).
"""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from touchr1_jax.models.nf4 import Nf4
from touchr1_jax.models.policy import Policy, PolicyConfig, Slots, init_policy
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.qwen.config import AnyVision, QwenConfig
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.model import vision_tower
from touchr1_jax.models.qwen.pictures import PICTURE_BUDGET, PixelBudget, fitting_size, patchify, resize
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.text.template import PromptLayout
from touchr1_jax.text.tokenizer import Tokenizer
from touchr1_jax.types import Params, TouchBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class QwenViewConfig:
    """The vision tower and the size of the pictures that it is shown, pixels; they are resized within `budget`."""

    tower_config: AnyVision
    height_px: int
    width_px: int
    budget: PixelBudget = PICTURE_BUDGET

    @property
    def size(self) -> tuple[int, int]:
        """Height and width after resizing, pixels."""
        return fitting_size(self.height_px, self.width_px, self.tower_config.cell_px, self.budget)

    @property
    def grid(self) -> int:
        """Tokens in one row of the view."""
        return self.size[1] // self.tower_config.cell_px

    @property
    def tokens(self) -> int:
        """Tokens of a view."""
        return self.grid * self.size[0] // self.tower_config.cell_px

    def tower(self, out_width: int) -> nn.Module:
        """The module that `Policy` builds."""
        if out_width != self.tower_config.out_size:
            raise ValueError(f"out_size {self.tower_config.out_size} must be the decoder's hidden_size, {out_width}")
        return QwenView(self)


class QwenView(nn.Module):
    """f(view) → tokens for the decoder, row by row: resized, cut into patches, through the vision tower."""

    config: QwenViewConfig

    def setup(self) -> None:
        self.tower = vision_tower(self.config.tower_config)

    def __call__(self, view: UInt8[Array, "P H W 3"]) -> Float[Array, "P token E"]:
        """Encode P pictures, none of which sees another.

        Raises:
          ValueError: pictures of another size than configured.
        """
        c = self.config
        if view.shape[1:3] != (c.height_px, c.width_px):
            raise ValueError(
                f"view is {view.shape[1]}×{view.shape[2]} px, the config says {c.height_px}×{c.width_px}: correct it"
            )
        height, width = c.size
        patches = patchify(resize(view, height, width)[:, None], c.tower_config)
        grid = Grid(1, height // c.tower_config.patch_px, width // c.tower_config.patch_px)
        tokens = self.tower(patches.reshape(-1, c.tower_config.patch_size), (grid,) * view.shape[0])
        return tokens.reshape(view.shape[0], c.tokens, -1)


def qwen_policy(
    config: QwenConfig,
    tactile: TactileViTConfig,
    view_px: tuple[int, int] = (64, 64),
    budget: PixelBudget = PICTURE_BUDGET,
    *,
    in_order: bool = False,
) -> Policy:
    """The policy; `view_px` is the height and width of the pictures in its batches, `in_order` as in `PolicyConfig`."""
    view = QwenViewConfig(tower_config=config.vision, height_px=view_px[0], width_px=view_px[1], budget=budget)
    return Policy(PolicyConfig(tactile=tactile, vision=view, decoder=config.decoder, in_order=in_order))


def qwen_fns(
    policy: Policy, layout: PromptLayout, tokenizer: Tokenizer, cache_dtype: jnp.dtype | type = jnp.bfloat16
) -> PolicyFns:
    """The functions that SFT and GRPO train; `cache_dtype` is the type of the decoder's parameters."""
    return PolicyFns.for_layout(policy, layout, tokenizer, cache_dtype)


def init_on_pretrained(
    policy: Policy,
    key: Array,
    batch: TouchBatch,
    ids: Int[np.ndarray, "L"],
    mask: Bool[np.ndarray, "L"],
    slots: Slots,
    pretrained: Params,
) -> Params:
    """Parameters of a policy on a pretrained model: its own vision tower and decoder, and fresh ones, float32.

    Vision tower and decoder are never initialised: memory is what `pretrained` has already.

    Args:
      policy: built from the config that belongs to `pretrained`.
      key: randomness of what is fresh.
      batch, ids, mask, slots: as `init_policy` takes them.
      pretrained: the tree of `QwenVL`, as `load_checkpoint` reads it.

    Raises:
      ValueError: towers of other shapes.
    """
    taken = {"vision": {"tower": pretrained["vision"]}, "decoder": pretrained["decoder"]}
    fresh = lambda k: init_policy(policy, k, batch, ids, mask, slots)
    wanted = jax.eval_shape(fresh, key)
    shapes = lambda tree: jax.tree.map(lambda x: x.shape, tree, is_leaf=lambda x: isinstance(x, Nf4))
    if shapes(taken) != shapes({name: wanted[name] for name in taken}):
        raise ValueError("pretrained has other shapes than the policy's towers; build the policy from its config")
    others = jax.jit(lambda k: {name: tree for name, tree in fresh(k).items() if name not in taken})
    return {**others(key), **taken}
