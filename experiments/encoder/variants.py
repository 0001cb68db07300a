"""Variants of the encoder that read more or less of a prompt of 8 frames by four sensors at 112²."""

import dataclasses
from collections.abc import Mapping
from collections.abc import Sequence as Seq
from typing import Any

from sensors_io.pipeline import Contacts
from sensors_io.schema import ContactKey, ObjectCard, Sequence
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.training.pretraining import PretrainConfig

FRAMES, IMAGE_PX = 8, 112
REFERENCE = "256 tokens"
"""The variant that the others are compared with: 4 steps of two frames, 64 patches of 14 px."""

STUDIED = "4 frames by salience"
"""The variant that the studies use: four frames, each a step of 16 patches of 28 px."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncoderVariant:
    """One encoder: its kind of saving, its networks and clips; with `fields` it reads fields instead of pictures."""

    name: str
    kind: str
    config: PretrainConfig
    fields: bool = False

    @property
    def tokens(self) -> int:
        """Tokens of a stream inside the transformer."""
        c, e = self.config, self.config.encoder
        frames = c.frames if c.frames_kept is None else c.frames_kept
        kept = (
            (c.image_px // (e.stem_px * e.patch_cells)) ** 2
            if e.patches_kept is None
            else e.patches_kept + (e.rest == "merge")
        )
        return frames // e.frames_per_step * kept


def variants(base: PretrainConfig) -> tuple[EncoderVariant, ...]:
    """Every saving alone, the reference first, then savings combined."""
    two = dataclasses.replace(base.encoder, frames_per_step=2)
    kept = lambda count, rest: dataclasses.replace(two, patches_kept=count, rest=rest)
    fine = dataclasses.replace(two, stem_px=2)

    def variant(
        name: str, kind: str, encoder: TactileViTConfig, *, fields: bool = False, **other: Any
    ) -> EncoderVariant:
        return EncoderVariant(
            name=name, kind=kind, config=dataclasses.replace(base, encoder=encoder, **other), fields=fields
        )

    return (
        variant(REFERENCE, "tokens", fine),
        variant("128 tokens", "tokens", base.encoder),
        variant("64 tokens", "tokens", two),
        variant("32 tokens", "tokens", dataclasses.replace(base.encoder, frames_per_step=4)),
        variant(STUDIED, "frames", base.encoder, frames_kept=4),
        variant("8 patches", "patches", kept(8, "drop")),
        variant("4 patches", "patches", kept(4, "drop")),
        variant("4 patches and the rest", "merged", kept(4, "merge")),
        variant("56²", "resolution", fine, image_px=56),
        variant("width 48", "width", dataclasses.replace(two, width=48)),
        variant("fields", "inputs", two, fields=True),
        variant("4 frames, 8 patches", "together", dataclasses.replace(base.encoder, patches_kept=8), frames_kept=4),
    )


class FieldsOnly:
    """Contacts without their pictures, so that clips are drawn from deformation and depth."""

    def __init__(self, store: Contacts) -> None:
        self._store = store

    @property
    def contacts(self) -> Seq[ContactKey]:
        """Identity of every contact."""
        return self._store.contacts

    @property
    def objects(self) -> Mapping[str, ObjectCard]:
        """Cards of all objects by id."""
        return self._store.objects

    def __len__(self) -> int:
        return len(self._store)

    def contact(self, i: int, *, fields: bool = True) -> Mapping[str, Sequence]:
        """Contact i by sensor; fields are always read, since nothing else is left."""
        del fields
        return {s: dataclasses.replace(x, frames=None) for s, x in self._store.contact(i, fields=True).items()}
