"""Stage 2 from parameters to parameters: the settings of supervised fine-tuning, and the stage itself.

`train_sft` trains end to end on clips, or, at a fraction of the cost, only the decoder on encoded contacts, which
teaches it to answer from the encoders that `train_encoder` has trained.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

from touchr1_jax.models.active_policy import ActivePolicy
from touchr1_jax.models.chunked_logits import MAX_LOGITS
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.lora import of_decoder, with_adapters
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.stacked import ADAPTERS, layer_by_layer
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.training.loop import SILENT, Batches, Hooks, LoopConfig, fit_best
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.training.packing import Packing
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import Params
from touchr1_jax.validation import at_least, require_wide, within


@dataclasses.dataclass(frozen=True, kw_only=True)
class SFTConfig:
    """A phase of stage 2; the learning rate is the paper's 1e-5 times `lr_scale`."""

    steps: int = 450
    batch_size: int = 16
    questions: int = 2
    """Questions per contact and step; the contact is encoded once for all of them."""
    save_every: int = 100
    """Steps between checkpoints; the best checkpoint on validation objects is kept."""
    micro_contacts: int = 2
    """Contacts of a micro-batch of the gradient; two stay in cache, which on a CPU is a third faster than sixteen."""
    max_logits: int = MAX_LOGITS
    """Logits that may exist at once; larger inputs are scored in blocks."""
    pack: int = 0
    """Tokens of a row that several questions with their answers share; 0 pads each to the longest instead."""
    remat: bool = False
    """Keep only matrix products of the decoder for the backward pass and compute the rest again: less memory."""
    curriculum: float = 0.0
    """Share of the steps within which the share of questions that show all sensors falls from 1 to a half."""
    conclusion_weight: float = 1.0
    """Weight of the concluded level in the loss, where that of every other token of the answer is 1."""
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0)

    def __post_init__(self) -> None:
        at_least(self, 0, "steps", "pack", "conclusion_weight")
        at_least(self, 1, "batch_size", "questions", "save_every", "micro_contacts", "max_logits")
        within(self, 0, 1, "curriculum")
        if self.batch_size % self.micro_contacts:
            raise ValueError(
                f"micro_contacts is {self.micro_contacts}: must divide batch_size = {self.batch_size}; change either"
            )

    def packing(self, devices: int) -> Packing | None:
        """Rows that the contacts of a micro-batch share on each of the devices; `None` pads.

        Raises:
          ValueError: a micro-batch that the devices cannot share.
        """
        if not self.pack:
            return None
        if self.micro_contacts % devices:
            raise ValueError(
                f"micro_contacts is {self.micro_contacts}: must be a multiple of the {devices} devices that share a "
                "micro-batch, for none reads the rows of another; raise it, or leave pack at 0"
            )
        micro_batches = self.batch_size // self.micro_contacts
        return Packing(width=self.pack, contacts=self.micro_contacts // devices, micro_batches=micro_batches)


def train_sft(
    policy: TouchPolicy | ActivePolicy,
    params: Params,
    batches: Batches,
    config: SFTConfig,
    hooks: Hooks = SILENT,
    *,
    seed: int = 0,
    blind: bool = False,
    decoder_only: bool = False,
    held_out: Callable[[Params], float] | None = None,
) -> Params:
    """Train a policy on verified answers: adapters if `policy.fns.lora` names any, and the towers without adapters.

    Args:
      policy: its prompts, forward passes, and towers that no stage trains.
      params: initial parameters.
      batches: `SFTBatch`es, for example of an `AnswerFeed`.
      config: steps, optimizer, memory.
      hooks: log, checkpoints, devices.
      seed: of fresh adapters.
      blind: train without touch.
      decoder_only: train only the decoder, on batches of encoded contacts.
      held_out: score of parameters on validation objects, higher is better, taken at every checkpoint and logged; the
        parameters of the best checkpoint are returned.  Needs checkpoints that keep the best.

    Raises:
      SizeError: a policy with frozen towers, and no adapters.
      ValueError: `held_out` without checkpoints, or as `require_wide`.
    """
    lora = policy.fns.lora
    if policy.frozen and not lora.rank:
        raise SizeError(f"lora.rank is 0: must be at least 1 where {' and '.join(policy.frozen)} stand still; raise it")
    whole = with_adapters(params, lora, params, seed)
    part = of_decoder(whole) if decoder_only else whole
    stand_still = {*policy.frozen, *(lora.towers if lora.rank else ())}
    frozen = {name: tree for name, tree in part.items() if name in stand_still}
    optimizer, step = sft_program(policy.fns, config, blind)
    trained = {name: tree for name, tree in part.items() if name not in frozen}
    require_wide(trained)
    trained = jax.tree.map(jnp.copy, trained)  # a step takes over the buffers of its state
    state = SFTState(params=trained, opt_state=optimizer.init(trained), step=jnp.zeros((), jnp.int32))
    loop = LoopConfig(steps=config.steps, save_every=config.save_every)
    devices = hooks.devices
    step, state, batches = devices.shard(step, state, batches, config.batch_size, frozen)

    def complete(state: SFTState) -> Params:
        return joined(whole, devices.gather(state.params))

    score = None if held_out is None else lambda state: held_out(complete(state))
    return complete(fit_best(step, state, batches, loop, hooks, held_out=score))


def joined(whole: Params, trained: Params) -> Params:
    """All parameters, those that were trained in their places, adapters tower by tower."""
    adapters = {**whole.get(ADAPTERS, {}), **trained.get(ADAPTERS, {})}
    return {**whole, **trained, **({ADAPTERS: adapters} if adapters else {})}


@functools.cache
def sft_program(fns: PolicyFns, config: SFTConfig, blind: bool) -> tuple[optax.GradientTransformation, Any]:
    """Optimizer and compiled step (state, batch, frozen towers) → (state, metrics), made once for all seeds."""
    optimizer = make_optimizer(config.optimizer, config.steps)
    fns = dataclasses.replace(fns, module=fns.module.clone(remat=True)) if config.remat else fns
    make = functools.partial(
        make_sft_step,
        optimizer=optimizer,
        blind=blind,
        max_logits=config.max_logits,
        micro_contacts=config.micro_contacts,
    )

    def step(state: SFTState, batch: SFTBatch, frozen: Params) -> tuple[SFTState, dict[str, Array]]:
        return make(dataclasses.replace(fns, base=frozen))(state, batch)

    return optimizer, jax.jit(step, donate_argnums=0, compiler_options=layer_by_layer(fns.cache_dtype))
