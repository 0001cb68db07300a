"""A folder with a trained policy that chooses its touches and the networks that read its contacts.

DIR/config.json         choices, sizes, stored frames of a contact, most contacts of a trajectory, checksum
DIR/model.safetensors   parameters of the policy and of the readers

In training, beliefs are averaged over networks and probes; a saved policy uses only the networks.
"""

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from jaxtyping import Float, UInt8

from experiments.active.contacts import LEVELS, PROPERTIES, ContactsConfig
from experiments.active.encoder import (
    ContactEncoderConfig,
    ContactReader,
    SingleContact,
    belief_tokens,
    patch_statistics,
    read_contacts,
)
from experiments.active.policies import answerer, explore
from experiments.active.world import TouchWorld, restored, stored
from experiments.core.artifacts import DamagedFileError, jsonable, read_json, write_sealed
from experiments.core.runs import labelled
from experiments.study.policies import FILE, POLICIES, require_own
from sensors_io.json_files import require_regular
from touchr1_jax.models.active_policy import ActivePolicy, build_active_policy
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.qwen.config import CONFIG_FILE
from touchr1_jax.models.qwen.safetensors import read_header, read_tensor, write_file
from touchr1_jax.models.qwen.weights import SINGLE
from touchr1_jax.models.saved_policy import PolicyError, format_of
from touchr1_jax.models.stacked import restacked, unstacked
from touchr1_jax.rl.environment import TouchBank, TouchChoice
from touchr1_jax.training.exploration import NO_CHOICE
from touchr1_jax.types import Params

FORMAT, VERSION = "touchr1-explorer", 1

Give = Callable[[int], UInt8[np.ndarray, "F H W 3"] | None]
"""Number of a choice → kept frames of that contact; `None` where it cannot be made."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Explorer:
    """A policy that chooses its touches, and all that it takes to make tokens of a new contact.

    Attributes:
      policy, params: what chooses and answers.
      contacts: choices, and what is kept of a contact.
      encoder, readers, scale: beliefs about a contact, and their standard deviation in training.
      budget: most contacts of a trajectory.
    """

    policy: ActivePolicy
    params: Params
    contacts: ContactsConfig
    encoder: ContactEncoderConfig
    readers: tuple[ContactReader, ...]
    scale: float
    budget: int

    def tokens(self, choice: int, frames: UInt8[np.ndarray, "F H W 3"]) -> Float[np.ndarray, "A W"]:
        """Observation of a contact, one token a property."""
        statistics, which = np.asarray(patch_statistics(frames[None])), np.array([choice], np.int32)
        read = np.mean([read_contacts(self.encoder, r, statistics, which)[0] for r in self.readers], 0)
        return belief_tokens(np.asarray(jax.nn.log_softmax(read)), self.scale)

    def ask(self, question: int, give: Give) -> "Exploration":
        """Ask for one contact after the other until the policy concludes; a contact without frames is not observed.

        The policy is greedy, so that a trajectory that goes on repeats its beginning.
        """
        shape = (1, len(self.contacts.choices))
        tokens = np.zeros((*shape, len(PROPERTIES), len(PROPERTIES) + LEVELS), np.float32)
        made, observed = np.zeros(shape, bool), np.zeros(shape, bool)
        while True:
            bank = self._bank(tokens, observed)
            chosen = explore(self.policy, self.params, bank, np.zeros(1, int), self.budget).choices[0, question]
            new = [int(c) for c in chosen if c != NO_CHOICE and not made[0, c]]
            if not new:
                break
            made[0, new[0]], frames = True, give(new[0])
            if frames is not None:
                tokens[0, new[0]], observed[0, new[0]] = self.tokens(new[0], frames), True
        answer = answerer(self.policy, self.params, bank)
        level = np.exp(answer(np.zeros(1, int), np.array([question]), chosen[None]))[0]
        return Exploration(tuple(int(c) for c in chosen if c != NO_CHOICE), level / level.sum())

    def _bank(self, tokens: np.ndarray, observed: np.ndarray) -> TouchBank:
        """The contacts of the object so far."""
        return TouchBank(
            tokens=jnp.asarray(tokens),
            available=jnp.asarray(observed),
            seconds=jnp.asarray(self.contacts.seconds)[None],
            harm=jnp.zeros(observed.shape),
            label=jnp.zeros((1, len(PROPERTIES)), jnp.int32),
            choices=touch_choices(self.contacts),
        )


@dataclasses.dataclass(frozen=True)
class Exploration:
    """The choices that a policy made, in order, and its probabilities of the levels."""

    choices: tuple[int, ...]
    probabilities: Float[np.ndarray, "K"]


def touch_choices(contacts: ContactsConfig) -> tuple[TouchChoice, ...]:
    """The choices of a configuration as actions."""
    return tuple(TouchChoice(sensor=s, motion=m, force_n=f) for s, m, f in contacts.choices)


def publish(
    world: TouchWorld, policy: ActivePolicy, params: Params, budget: int, name: str, seed: int, run: Path
) -> None:
    """Save a policy of a run where `ask` finds it."""
    explorer = Explorer(
        policy=policy,
        params=params,
        contacts=world.config.contacts,
        encoder=world.config.encoder,
        readers=world.readers,
        scale=world.scale,
        budget=budget,
    )
    save_explorer(run / POLICIES / name / str(seed), explorer, labelled(run, f"{POLICIES}/{name}/{seed}"))


def require_published(run: Path, name: str, seed: int) -> None:
    """`PolicyError` if a run lacks a policy that `publish` saved, or has a damaged or another one."""
    folder = run / POLICIES / name / str(seed)
    read_explorer(folder)
    require_own(folder, read_json(folder / CONFIG_FILE).get(FILE))


def save_explorer(folder: Path, explorer: Explorer, file: str = "") -> None:
    """Write a policy; one that is there is replaced, `config.json` last.  `file` says which it is of its run."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG_FILE).unlink(missing_ok=True)
    flat = unstacked(traverse_util.flatten_dict({"policy": explorer.params}, sep="."))
    arrays = {name.replace(".", "/"): np.asarray(x, np.float32) for name, x in flat.items()} | {
        name: np.asarray(x, np.float32) for name, x in stored(explorer.readers).items()
    }
    write_file(folder / SINGLE, arrays)
    decoder = explorer.policy.fns.module.config.decoder
    fields: Mapping[str, Any] = {
        "model_type": FORMAT,
        "version": VERSION,
        "decoder": dataclasses.asdict(decoder),
        "contacts": dataclasses.asdict(explorer.contacts),
        "encoder": {"width": explorer.encoder.width, "layers": explorer.encoder.layers},
        "scale": explorer.scale,
        "budget": explorer.budget,
        FILE: file,
        "sha256": hashlib.sha256((folder / SINGLE).read_bytes()).hexdigest(),
    }
    write_sealed(folder / CONFIG_FILE, jsonable(fields))


def is_explorer(folder: Path) -> bool:
    """True for a folder that `save_explorer` wrote."""
    return format_of(folder) == FORMAT


def read_explorer(folder: Path) -> Explorer:
    """The policy of a folder that `save_explorer` wrote; `PolicyError` if it is damaged or of another version."""
    try:
        found = read_json(folder / CONFIG_FILE)
        if found["version"] != VERSION:
            raise PolicyError(f"policy is {folder}: version is {found['version']}: must be {VERSION}; train it anew")
        require_regular(folder / SINGLE)
        if hashlib.sha256((folder / SINGLE).read_bytes()).hexdigest() != found["sha256"]:
            raise PolicyError(f"policy is {folder}: {SINGLE} was changed after it was written; copy the folder again")
        contacts = ContactsConfig(**_tuples(found["contacts"]))
        policy = build_active_policy(
            tuple(choice.words for choice in touch_choices(contacts)),
            dataclasses.replace(DecoderConfig(**_tuples(found["decoder"])), vocab_size=0),
            repeats=False,
        )
        arrays = {name: read_tensor(entry) for name, entry in read_header(folder / SINGLE).items()}
        named = {name.replace("/", "."): x for name, x in arrays.items() if name.startswith("policy/")}
        tree = traverse_util.unflatten_dict(restacked(named), sep=".")
        explorer = Explorer(
            policy=policy,
            params=jax.tree.map(jnp.asarray, tree["policy"]),
            contacts=contacts,
            encoder=ContactEncoderConfig(**found["encoder"]),
            readers=restored(arrays),
            scale=float(found["scale"]),
            budget=int(found["budget"]),
        )
        _require_fit(explorer)
        return explorer
    except (DamagedFileError, OSError, AttributeError, ValueError, TypeError, LookupError) as error:
        if isinstance(error, PolicyError):
            raise
        raise PolicyError(f"policy is {folder}: cannot be read ({error}); copy the folder again") from error


def _require_fit(one: Explorer) -> None:
    """Refuse parameters of other shapes than the sizes need, numbers that are not finite, no contact.

    Raises:
      ValueError: naming the first misfit.
    """
    if not (0 < one.scale < math.inf and one.budget >= 1):
        raise ValueError(f"scale is {one.scale} and budget {one.budget}: must be finite and above 0, and at least 1")
    contacts, px = one.contacts, one.contacts.picture_px
    frames = jax.ShapeDtypeStruct((1, contacts.moments, px + px // 2, px, 3), np.uint8)
    statistics, choice = jax.eval_shape(patch_statistics, frames), np.zeros(1, np.int32)
    network = SingleContact(one.encoder, len(contacts.choices))
    of_choice = jax.ShapeDtypeStruct((len(contacts.choices), statistics.shape[1]), np.float32)
    network_params = jax.eval_shape(lambda x: network.init(jax.random.key(0), x, choice)["params"], statistics)
    reader = {"params": network_params, "centre": of_choice, "spread": of_choice}
    shapes = jax.eval_shape(lambda: one.policy.init(0, len(PROPERTIES) + LEVELS))
    pairs = [("policy", shapes, one.params)] + [(f"reader {k}", reader, vars(r)) for k, r in enumerate(one.readers)]
    for name, wanted, given in pairs:
        want, have = (traverse_util.flatten_dict(dict(tree), sep=".") for tree in (wanted, given))
        for key in sorted(want.keys() | have.keys()):
            if key not in want or key not in have or want[key].shape != have[key].shape:
                raise ValueError(f"{key} of {name} is missing, left over, or of another shape than the sizes need")
            if not np.isfinite(have[key]).all():
                raise ValueError(f"{key} of {name} holds numbers that are not finite: its training diverged")


def _tuples(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(x) if isinstance(x, list) else x for name, x in fields.items()}
